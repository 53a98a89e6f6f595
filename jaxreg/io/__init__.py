"""Read and write clouds: one function each; the suffix chooses the format."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxreg.io import arrays, e57, las, mesh, packed, pcd, ptx, text, unread
from jaxreg.io.arrays import read_numbers
from jaxreg.io.contents import Scan
from jaxreg.io.matrix import read_matrix
from jaxreg.io.merged import read_colors, write_merged
from jaxreg.io.places import check_folder, check_place, reading, whole
from jaxreg.io.poses import check_poses_output, read_pairs_log, read_poses, write_poses
from jaxreg.io.writing import WRITERS, check_output, check_writable, write_cloud, write_moved

__all__ = [
    "READABLE",
    "WRITABLE",
    "Scan",
    "check_folder",
    "check_output",
    "check_place",
    "check_poses_output",
    "check_writable",
    "read_cloud",
    "read_colors",
    "read_matrix",
    "read_numbers",
    "read_pairs_log",
    "read_poses",
    "read_scan",
    "suffix",
    "whole",
    "write_cloud",
    "write_merged",
    "write_moved",
    "write_poses",
]

_READERS: dict[str, Callable[[Path], Scan]] = {
    ".ply": mesh.read_ply,
    ".pcd": pcd.read,
    **dict.fromkeys(text.SUFFIXES, text.read),
    ".ptx": ptx.read,
    ".npy": arrays.read,
    ".npz": arrays.read,
    **dict.fromkeys((".obj", ".off", ".stl", ".glb"), mesh.read),
    ".las": las.read,
    ".laz": las.read,
    ".e57": e57.read,
}
READABLE, WRITABLE = tuple(_READERS), tuple(WRITERS)


def suffix(path: str | Path) -> str:
    """The suffix that tells the format: ".ply" of "a.PLY" and of "a.ply.gz"."""
    return packed.suffix(Path(path))


def read_cloud(path: str | Path) -> Float[np.ndarray, "n 3"]:
    """Read a point cloud: (n, 3) float64, in the file's unit and order. The suffix chooses the format.

    Each format may be packed by gzip (``.ply.gz``). Points that are NaN stay in place: they are for
    the caller to refuse or to drop. Nothing is ever unpickled.

    Raises:
      ValueError: there is no such file, it is a directory, it may not be read, its suffix is unknown,
        it is malformed or truncated, its header names columns without x, y, z, or it contains no
        points; the message names the file, the row where there is one, and the remedy.
      ImportError: a LAS, LAZ or E57 file, and what reads it is not installed.
    """
    return read_scan(path).points


def read_scan(path: str | Path) -> Scan:
    """The points as `read_cloud` gives them, and `notes`: that it is a mesh, or of many stations.

    Raises:
      ValueError, ImportError: as `read_cloud`.
    """
    path = Path(path)
    with reading(path):
        if path.is_dir():
            raise IsADirectoryError
        if suffix(path) not in _READERS:
            raise ValueError(unread.advice(path, READABLE))
        if path.stat().st_size == 0:
            raise ValueError(f"{path} is empty (0 bytes): export it again.")
        path.open("rb").close()  # Readers would take a lack of permission for damage.
    # A damaged file holds numbers that overflow, and NaN that signal.
    with packed.unpacked(path) as file, np.errstate(all="ignore"):
        scan = _READERS[suffix(path)](file)
        if len(scan.points) == 0:
            raise ValueError(f"{path} contains no points: export it again, or choose another file.")
    return scan
