"""PLY: ascii and binary of both byte orders, with any other properties and elements, with plyfile."""

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError


def read(path: Path) -> np.ndarray:
    """The vertices (n, 3), float64. Raises what `jaxreg.io.read_cloud` raises."""
    try:
        vertex = _open(path)["vertex"]
        return np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
    except KeyError:
        raise ValueError(
            f"{path} has no element 'vertex', so it is not a point cloud: export it again."
        ) from None
    except ValueError as error:
        missing = "no field" in str(error)
        reason = "its vertices lack x, y or z" if missing else str(error)
        raise ValueError(f"{path}: {reason}: export it again.") from None


def _open(path: Path) -> PlyData:
    try:
        # Mapped, because plyfile otherwise reads row by row: 0.3 s for 50,000 points instead of 0.01.
        data = PlyData.read(str(path), mmap="c")
    except PlyParseError as error:
        # plyfile says which element and row, or which line of the header.
        raise ValueError(f"malformed or truncated PLY ({error})") from None
    except UnicodeDecodeError:
        raise ValueError("the header is not ascii text") from None
    for element in data.elements:
        # A copy, so the file can be written again under its own name.
        element.data = np.array(element.data)
    return data


def write(path: Path, points: np.ndarray) -> None:
    """Binary little-endian vertices x y z, double."""
    rows = np.empty(len(points), [(axis, "<f8") for axis in "xyz"])
    for axis, column in zip("xyz", points.T, strict=True):
        rows[axis] = column
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))


def write_moved(path: Path, original: Path, rotation: np.ndarray, translation: np.ndarray) -> None:
    """Write a PLY file again with its vertices (and normals) moved and everything else kept.

    x, y, z become double, so large offsets lose nothing.
    """
    data = _open(original)
    elements = []
    for element in data.elements:
        if element.name == "vertex":
            moved = _moved(element.data, rotation, translation)
            element = PlyElement.describe(moved, "vertex", comments=element.comments)
        elements.append(element)
    header = {"comments": data.comments, "obj_info": data.obj_info}
    PlyData(elements, text=data.text, byte_order=data.byte_order, **header).write(str(path))


def _moved(vertex: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    fields = vertex.dtype.names or ()
    kinds = [(name, "f8" if name in "xyz" else vertex.dtype[name]) for name in fields]
    moved = np.empty(len(vertex), kinds)
    for name in fields:
        moved[name] = vertex[name]
    points = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float64)
    for axis, column in zip("xyz", (points @ rotation.T + translation).T, strict=True):
        moved[axis] = column
    names = ("nx", "ny", "nz")
    if set(names) <= set(fields):
        normals = np.stack([vertex[name] for name in names], axis=1)
        for name, column in zip(names, (normals @ rotation.T).T, strict=True):
            moved[name] = column
    return moved
