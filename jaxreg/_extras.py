"""Optional dependencies: the error when one is missing names the extra to install."""

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def extra(name: str, purpose: str) -> Iterator[None]:
    """Wrap the imports of what the extra `name` installs; `purpose` begins the message.

    Raises:
      ImportError: a library is not installed; the message says what needs it and how to install it.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise ImportError(
            f"{purpose} needs {error.name}, which is not installed: run "
            f"pip install 'jaxreg[{name}]'.",
            name=error.name,
        ) from None
