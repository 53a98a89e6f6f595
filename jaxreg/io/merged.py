"""The merged cloud of many scans: which scan every point is from, and its colour if it had one."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from plyfile import PlyData, PlyElement

from jaxreg.io import packed, ply
from jaxreg.io.writing import WRITERS, check_writable

_COLORS = ("red", "green", "blue")


def read_colors(
    paths: Sequence[Path], clouds: Sequence[Float[np.ndarray, "_ 3"]]
) -> np.ndarray | None:
    """The colours (n, 3) uint8 of the finite points of PLY files in turn; None if none has any.

    Scans without colours are grey. A mesh, whose points are drawn from its faces, has none.
    """
    found = [_colors(path, points) for path, points in zip(paths, clouds, strict=True)]
    if all(colors is None for colors in found):
        return None
    parts = []
    for colors, points in zip(found, clouds, strict=True):
        grey = np.full((len(points), 3), 128, np.uint8)
        parts.append((grey if colors is None else colors)[np.isfinite(points).all(axis=1)])
    return np.concatenate(parts)


def _colors(path: Path, points: np.ndarray) -> np.ndarray | None:
    if packed.suffix(path) != ".ply":
        return None
    with packed.unpacked(path) as file:
        if ply.has_faces(file) or not set(_COLORS) <= set(ply.more(file)):
            return None
        vertex = ply.vertices(file)
    if len(vertex) != len(points) or any(vertex.dtype[name] != np.uint8 for name in _COLORS):
        return None
    return np.stack([vertex[name] for name in _COLORS], axis=1)


def write_merged(
    path: Path,
    points: Float[np.ndarray, "n 3"],
    scan: Int[np.ndarray, "n"],
    colors: np.ndarray | None = None,
) -> None:
    """Write points; PLY (binary) also gets the number of each one's `scan`, and the colours.

    Raises:
      ValueError, ImportError: as `write_cloud`.
    """
    check_writable(path)
    if path.suffix.lower() != ".ply":
        WRITERS[path.suffix.lower()](path, points)
        return
    kinds = [(axis, "<f8") for axis in "xyz"] + [("scan", "<i4")]
    if colors is not None:
        kinds += [(name, "u1") for name in _COLORS]
    rows = np.empty(len(points), kinds)
    for axis, column in zip("xyz", points.T, strict=True):
        rows[axis] = column
    rows["scan"] = scan
    if colors is not None:
        for name, column in zip(_COLORS, colors.T, strict=True):
            rows[name] = column
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))
