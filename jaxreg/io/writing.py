"""Clouds to files: points alone, or the file of a source again with its points moved."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxreg.io import arrays, las, mesh, packed, pcd, ply, text
from jaxreg.io.places import check_folder

_TEXT = text.SUFFIXES
_LAS = (".las", ".laz")
WRITERS: dict[str, Callable[[Path, np.ndarray], None]] = {
    ".ply": ply.write,
    ".pcd": pcd.write,
    **dict.fromkeys(text.WRITABLE, text.write),
    ".npy": arrays.write,
    ".npz": arrays.write,
    ".las": las.write,
    ".laz": las.write,
}
_MORE: dict[str, Callable[[Path], tuple[str, ...]]] = {
    ".ply": ply.more,
    ".pcd": pcd.more,
    ".npy": arrays.more,
    ".npz": arrays.more,
    ".obj": mesh.more,
    ".off": mesh.more,
    **dict.fromkeys(text.SUFFIXES, text.more),
}
_ROUNDED = 1e-5
"""Rounding by more than this share of the extent is worth a word."""


def write_cloud(path: str | Path, points: Float[np.ndarray, "n 3"]) -> None:
    """Write points in the format of the suffix: float64, in text 12 digits, in LAS integer steps.

    LAS and LAZ leave out rows that are not finite; all other formats keep them. A masked row is NaN.

    Raises:
      ValueError: the points are not numbers (n, 3), the suffix is not writable, the folder does not
        exist, or LAS gets no finite row.
      ImportError: a LAS or LAZ file, and laspy is not installed.
    """
    path = Path(path)
    check_writable(path)
    try:
        array = np.ma.filled(np.ma.asarray(points).astype(np.float64), np.nan)
    except (TypeError, ValueError):
        raise ValueError(
            f"points must be numbers of shape (n, 3), got {type(points).__name__}: of an object give "
            "its array of points."
        ) from None
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"points must have shape (n, 3), got {array.shape}.")
    WRITERS[path.suffix.lower()](path, array)


def check_writable(path: Path) -> None:
    """Raises what `write_cloud` would that is known before: suffix, folder, and laspy for LAS."""
    if path.suffix.lower() not in WRITERS:
        raise ValueError(
            f"{path}: clouds cannot be written as '{path.suffix}': choose one of "
            f"{', '.join(WRITERS)}."
        )
    if path.suffix.lower() in (".las", ".laz"):
        las.check_installed(path)
    check_folder(path)


def check_output(path: Path, source: Path) -> None:
    """Raises ValueError or ImportError where `write_moved` could not write `source` to `path`."""
    kind, origin = path.suffix.lower(), packed.suffix(source)
    if kind == ".gz":
        raise ValueError(f"{path}: nothing is packed here: leave .gz out, and run gzip afterwards.")
    known = kind in WRITERS or (kind in _TEXT and origin in _TEXT)
    if kind in mesh.SUFFIXES and kind not in WRITERS:
        known = _may_be_mesh(source)
        if not known:
            raise ValueError(
                f"{path}: clouds cannot be written as '{path.suffix}', which holds surfaces, and "
                f"{source} has none: choose one of {', '.join(WRITERS)}."
            )
    if not known:
        raise ValueError(
            f"{path}: clouds cannot be written as '{path.suffix}': choose one of "
            f"{', '.join(WRITERS)}; meshes also as {', '.join(mesh.SUFFIXES)}."
        )
    if kind in _LAS:
        las.check_installed(path)
    check_folder(path)


def write_moved(
    path: Path,
    source: Path,
    rotation: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, "3"],
    *,
    points: Float[np.ndarray, "n 3"],
) -> tuple[str, ...]:
    """Write the file `source` with ``R x + t`` for its points; returns what the format cannot hold.

    `rotation` may have a scale: normals are turned by its rotation alone. `points` are those of the
    source as `read_cloud` gives them. A mesh stays a mesh, with its vertices moved. PLY, PCD, text
    and LAS keep all that a point carries where the format stays; other formats get coordinates alone.

    Raises:
      ValueError: as `check_output`, or the source has changed meanwhile.
    """
    kind, origin = path.suffix.lower(), packed.suffix(source)
    with packed.unpacked(source) as file:
        own = _own_writer(kind, origin)
        if own is not None:
            return own(path, file, rotation, translation) or ()
        if kind in mesh.SUFFIXES and (kind not in WRITERS or mesh.is_mesh(file)):
            mesh.write_moved(path, file, rotation, translation)
            moved = points @ rotation.T + translation
            return (*_rounding(kind, moved), *_bare(kind, origin, file))
        WRITERS[kind](path, points @ rotation.T + translation)
        return _lost(kind, origin, file)


def _own_writer(kind: str, origin: str) -> Callable | None:
    if kind == origin == ".ply":
        return ply.write_moved
    if kind == origin == ".pcd":
        return pcd.write_moved
    if kind in _LAS and origin in _LAS:
        return las.write_moved
    return text.write_moved if kind in _TEXT and origin in _TEXT else None


def _may_be_mesh(source: Path) -> bool:
    origin = packed.suffix(source)
    if origin == ".ply" and source.suffix.lower() != ".gz":
        return ply.has_faces(source)
    return origin in mesh.SUFFIXES


def _rounding(kind: str, points: np.ndarray) -> tuple[str, ...]:
    step = mesh.rounding(kind, points)
    if step <= _ROUNDED * np.ptp(points, axis=0).max(initial=0):
        return ()
    return (
        f"{kind} stores single precision, which rounds here by up to {step:.2g}: .ply does not",
    )


def _bare(kind: str, origin: str, source: Path) -> tuple[str, ...]:
    """What of a mesh is lost besides its vertices and faces."""
    kept = kind == origin and kind in (".obj", ".glb", ".ply")
    more = () if kept or origin not in _MORE else _MORE[origin](source)
    return (f"{kind} gets vertices and faces alone, without {_listed(more)}",) if more else ()


def _listed(more: tuple[str, ...]) -> str:
    return ", ".join(more[:8]) + (" ..." if len(more) > 8 else "")


def _lost(kind: str, origin: str, source: Path) -> tuple[str, ...]:
    more = _MORE[origin](source) if origin in _MORE else ()
    if origin in _LAS:
        more = ("intensity and whatever else a point has",)
    if not more:
        return ()
    if _own_writer(origin, origin) is None:
        return (f"{kind} gets coordinates alone, without {_listed(more)}",)
    return (f"{kind} gets coordinates alone; {origin} would keep {_listed(more)}",)
