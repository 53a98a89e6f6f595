"""The libraries that the baselines call; if one is missing, the message says how to install it."""

import importlib
from typing import Any


def library(module: str, name: str) -> Any:
    """The module, imported by name: a type checker would take `import open3d` here for our own file.

    Raises:
      ValueError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ValueError(
            f'this baseline needs {name} ({error}): pip install "jaxreg[baselines]".'
        ) from None
