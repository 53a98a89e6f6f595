"""Where files are read and written: a file is written whole or left as it was."""

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path


def check_place(path: Path, taken: Sequence[Path] = ()) -> None:
    """Raise ValueError unless a file can be written there without replacing one of `taken`."""
    check_folder(path)
    if path.is_dir():
        raise ValueError(f"{path} is a directory: name a file in it.")
    if path.resolve() in [other.resolve() for other in taken]:
        raise ValueError(f"{path} is already read or written by this command: choose another name.")


def check_folder(path: Path) -> None:
    """Raise ValueError unless there is a folder for the file."""
    if not path.parent.is_dir():
        raise ValueError(f"{path}: the folder {path.parent} does not exist: make it first.")


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """What is done inside reads the file `path`.

    Raises:
      ValueError: there is no such file, it is a directory, or it may not be read.
    """
    try:
        yield
    except (FileNotFoundError, NotADirectoryError):
        raise ValueError(f"{path}: no such file; check the path.") from None
    except OSError as error:
        if os.path.isdir(path):  # Windows calls this, too, a lack of permission.
            raise ValueError(f"{path} is a directory, not a file: name a file in it.") from None
        raise ValueError(
            f"{path} cannot be read ({error.strerror or error}): check who may read it, or copy it."
        ) from None


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A file to write to, which takes the place of `path` once it is complete.

    Raises:
      ValueError: it cannot be written there.
    """
    if path.exists() and not path.is_file():  # A device or a pipe is written as it is.
        yield path
        return
    part = path.resolve().with_name(f".{os.getpid()}-{path.name}")
    try:
        yield part
        part.replace(path.resolve())
    except OSError as error:
        raise ValueError(
            f"{path} could not be written ({error.strerror or error}): choose another place."
        ) from None
    finally:
        with contextlib.suppress(OSError):  # The folder may be gone, too.
            part.unlink(missing_ok=True)
