"""Files packed by gzip: unpacked beside the work, read as what they are inside."""

import contextlib
import gzip
import shutil
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path


def suffix(path: Path) -> str:
    """The suffix that tells the format, in lower case: ".ply" of "a.PLY" and of "a.ply.gz"."""
    name = path.with_suffix("") if path.suffix.lower() == ".gz" else path
    return name.suffix.lower()


@contextlib.contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """The file as it is, or, of a ``.gz``, its content in a file that is gone afterwards.

    Raises:
      ValueError: it is cut or damaged; or whatever the reading finds, under the name of `path`.
    """
    if path.suffix.lower() != ".gz":
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        inside = Path(folder) / path.with_suffix("").name
        try:
            with gzip.open(path) as packed, inside.open("wb") as plain:
                shutil.copyfileobj(packed, plain, 1 << 20)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise ValueError(
                f"{path} is a damaged or truncated gzip file ({error}): copy it again."
            ) from None
        try:
            yield inside
        except ValueError as error:
            raise ValueError(str(error).replace(str(inside), str(path))) from None
