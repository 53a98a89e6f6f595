"""STL: binary, also with a header that begins "solid" or with bytes after the last triangle; ascii."""

import array
import re
from pathlib import Path

import numpy as np

from jaxreg.io.decoding import as_utf8, with_points

_HEADER, _TRIANGLE = 84, 50
_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_KEYWORD = re.compile(rb"\s(facet|vertex|endsolid)\s", re.IGNORECASE)
_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


def corners(path: Path) -> np.ndarray:
    """The corners of all triangles, (f, 3, 3), float64.

    Raises:
      ValueError: it is shorter than it says, or a corner is not three numbers.
    """
    content = path.read_bytes()
    if not _is_ascii(content):
        return _binary(path, content)
    content = with_points(as_utf8(content))
    values = array.array("d")
    for match in _VERTEX.finditer(content):
        try:
            values.extend(map(float, match.groups()))
        except ValueError:
            line = content.count(b"\n", 0, match.start()) + 1
            raise ValueError(
                f"{path}, line {line}: a corner is not three numbers: export it again."
            ) from None
    if len(values) % 9 or not re.search(rb"end\s*solid", content[-2000:], re.IGNORECASE):
        raise ValueError(f"{path} is truncated, its last triangle is not closed: export it again.")
    return np.array(values).reshape(-1, 3, 3)


def _is_ascii(content: bytes) -> bool:
    head = as_utf8(content[:2000]) if content[:2] in (b"\xff\xfe", b"\xfe\xff") else content[:2000]
    begins = head.removeprefix(b"\xef\xbb\xbf").lstrip()[:5].lower() == b"solid"
    return begins and b"\0" not in head[84:] and bool(_KEYWORD.search(head))


def _binary(path: Path, content: bytes) -> np.ndarray:
    count = int.from_bytes(content[80:_HEADER], "little")
    if len(content) < _HEADER + _TRIANGLE * count or len(content) < _HEADER:
        raise ValueError(
            f"{path} is truncated: it announces {count} triangles, and holds "
            f"{max(0, len(content) - _HEADER) // _TRIANGLE}: export it again."
        )
    return np.frombuffer(content, _ROW, count, _HEADER)["corners"].astype(np.float64)
