"""Read and write clouds: one function each; the suffix chooses the format."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxreg.io import arrays, las, mesh, pcd, ply, text
from jaxreg.io.matrix import read_matrix
from jaxreg.io.places import check_folder, check_place, whole

__all__ = [
    "READABLE",
    "WRITABLE",
    "check_folder",
    "check_place",
    "check_writable",
    "read_cloud",
    "read_matrix",
    "whole",
    "write_cloud",
]

_READERS: dict[str, Callable[[Path], np.ndarray]] = {
    ".ply": ply.read,
    ".pcd": pcd.read,
    ".xyz": text.read,
    ".txt": text.read,
    ".csv": text.read,
    ".npy": arrays.read,
    ".npz": arrays.read,
    ".obj": mesh.read,
    ".off": mesh.read,
    ".stl": mesh.read,
    ".las": las.read,
    ".laz": las.read,
}
_WRITERS: dict[str, Callable[[Path, np.ndarray], None]] = {
    ".ply": ply.write,
    ".pcd": pcd.write,
    ".xyz": text.write,
    ".txt": text.write,
    ".csv": text.write,
    ".npy": arrays.write,
    ".npz": arrays.write,
    ".las": las.write,
    ".laz": las.write,
}
READABLE, WRITABLE = tuple(_READERS), tuple(_WRITERS)


def read_cloud(path: str | Path) -> Float[np.ndarray, "n 3"]:
    """Read a point cloud: (n, 3) float64, in the file's unit and order. The suffix chooses the format.

    Meshes are sampled by area. Points that are NaN stay in place: the caller refuses or drops them.
    Nothing is ever unpickled.

    Raises:
      ValueError: there is no such file, it is a directory, its suffix is unknown, it is malformed or
        truncated, its header names columns without x, y, z, or it contains no point; the message
        names the file, the row if there is one, and the remedy.
      ImportError: a LAS or LAZ file, and laspy is not installed.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path} is a directory, not a file: name a file in it.")
    if path.suffix.lower() not in _READERS:
        raise ValueError(
            f"{path}: unknown format '{path.suffix}': convert the file to one "
            f"of {', '.join(READABLE)}."
        )
    if not path.is_file():
        raise ValueError(f"{path}: no such file; check the path.")
    if path.stat().st_size == 0:
        raise ValueError(f"{path} is empty (0 bytes): export it again.")
    points = _READERS[path.suffix.lower()](path)
    if len(points) == 0:
        raise ValueError(f"{path} contains no points: export it again, or choose another file.")
    return points


def write_cloud(path: str | Path, points: Float[np.ndarray, "n 3"]) -> None:
    """Write points in the format of the suffix: float64, in text 12 digits, in LAS integer steps.

    LAS and LAZ leave out rows that are not finite; all other formats keep them.

    Raises:
      ValueError: the suffix is not writable, the folder does not exist, or LAS gets no finite row.
      ImportError: a LAS or LAZ file, and laspy is not installed.
    """
    path = Path(path)
    check_writable(path)
    _WRITERS[path.suffix.lower()](path, np.asarray(points, np.float64))


def check_writable(path: Path) -> None:
    """Raise what `write_cloud` would raise before it writes: for suffix, folder, and laspy for LAS."""
    if path.suffix.lower() not in _WRITERS:
        raise ValueError(
            f"{path}: clouds cannot be written as '{path.suffix}': choose one of "
            f"{', '.join(WRITABLE)}."
        )
    if path.suffix.lower() in (".las", ".laz"):
        las.check_installed(path)
    check_folder(path)
