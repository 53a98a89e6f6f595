"""Libraries that only some uses need are extras of the package: what a missing one is called."""

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def extra(name: str, purpose: str) -> Iterator[None]:
    """Put the imports of what the extra `name` installs in here; `purpose` begins the message.

    Raises:
      ImportError: a library is not installed; the message says what for, and how to install it.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise ImportError(
            f"{purpose} needs {error.name}, which is not installed: run "
            f"pip install 'jaxreg[{name}]'.",
            name=error.name,
        ) from None
