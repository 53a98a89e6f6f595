"""The libraries that the baselines call: each is there, or the message says how to get it."""

import importlib
from typing import Any


def library(module: str, name: str) -> Any:
    """The module, by its name: a checker of types takes `import open3d` here for our own file.

    Raises:
      ValueError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ValueError(
            f'this baseline needs {name} ({error}): pip install "jaxreg[baselines]".'
        ) from None
