"""Meshes (OBJ, OFF, STL) as clouds: points spread evenly over the surface, with trimesh."""

import io
import re
from pathlib import Path

import numpy as np

_POINTS = 20_000
"""Points drawn from a surface; a file without faces gives its vertices."""
_GLUED = re.compile(rb"^\s*(C?OFF)[ \t]*(?=[\d-])")
"""ModelNet has files that begin with "OFF1568 1242 0" on one line."""


def read(path: Path) -> np.ndarray:
    """Points (n, 3) of the surface, uniform by area, the same in every run; float64.

    Raises what `jaxreg.io.read_cloud` raises.
    """
    import trimesh  # a second of start-up that other formats need not pay

    content = path.read_bytes()
    kind = path.suffix.lower().lstrip(".")
    if kind == "off":
        content = _GLUED.sub(rb"\1\n", content, count=1)
    elif kind == "stl" and _cut(content):
        raise ValueError(f"{path} is truncated: it announces more triangles: export it again.")
    elif kind == "obj":
        content = _utf8(content)
    try:
        shape = trimesh.load(io.BytesIO(content), file_type=kind, process=False)
    except Exception as error:  # noqa: BLE001 - trimesh raises whatever its parsers raise
        raise ValueError(
            f"{path} cannot be read as {kind.upper()} ({type(error).__name__}: {error}): "
            "it is malformed or truncated; export it again."
        ) from None
    if isinstance(shape, trimesh.Scene):
        shape = shape.to_geometry()
    vertices = np.asarray(getattr(shape, "vertices", np.empty((0, 3))), np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"{path}: its vertices do not have three coordinates: export it again.")
    faces = getattr(shape, "faces", ())
    if len(faces) == 0:
        return vertices
    return _sampled(path, vertices, np.asarray(faces))


def _utf8(content: bytes) -> bytes:
    """Text in UTF-8: names in an OBJ file may be in an older encoding, which trimesh would guess."""
    try:
        content.decode("utf-8")
    except UnicodeDecodeError:
        return content.decode("latin-1").encode("utf-8")
    return content


def _cut(content: bytes) -> bool:
    """Whether a binary STL file is shorter than it says; ascii ones begin with "solid"."""
    if content.lstrip()[:5] == b"solid":
        return False
    return len(content) < 84 + 50 * int.from_bytes(content[80:84], "little")


def _sampled(path: Path, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    if faces.min() < 0 or faces.max() >= len(vertices):
        row = int(np.argmax((faces < 0).any(axis=1) | (faces >= len(vertices)).any(axis=1)))
        raise ValueError(
            f"{path}: face {row} names vertex {faces[row].max()} of {len(vertices)}: the file is "
            "malformed or truncated; export it again."
        )
    import trimesh

    surface = trimesh.Trimesh(vertices, faces, process=False)
    if not surface.area > 0:
        return vertices
    return np.asarray(trimesh.sample.sample_surface(surface, _POINTS, seed=0)[0], np.float64)
