"""Meshes (OBJ, OFF, STL, GLB, PLY with faces) as clouds: points spread evenly over the surface."""

import io
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxreg.io import ply, stl
from jaxreg.io.contents import Scan
from jaxreg.io.decoding import as_utf8, decoded, with_points
from jaxreg.io.matrix import turn_of

_POINTS = 20_000
"""Points drawn from a surface; a file without faces gives its vertices."""
_GLUED = re.compile(rb"^\s*([CN]*OFF)[ \t]*(?=[\d-])")
"""ModelNet has files that begin with "OFF1568 1242 0" on one line."""
SUFFIXES = (".stl", ".obj", ".off", ".glb", ".ply")
_MORE = {
    ".obj": re.compile(rb"^\s*(?:(?:vn|vt|usemtl)\s|v(?:[ \t]+[^\s#]+){4})", re.MULTILINE),
    ".off": re.compile(rb"^\s*[STCN4]+n?OFF", re.MULTILINE),
}
"""What a vertex or a face has besides coordinates and corners."""
_CONTINUED = re.compile(r"(?m)^([ \t]*vn?[ \t][^\n]*)\\\n")
_FROM_THE_END = re.compile(rb"^\s*f\s[^\n]*[\s/]-\d", re.MULTILINE)
_NARROW = (".stl", ".glb")
"""Formats that store coordinates in single precision."""


class Mesh(NamedTuple):
    """Triangles: which three vertices each one joins. No faces: the vertices are a cloud."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


def read(path: Path) -> Scan:
    """Points (n, 3) of the surface, uniform by area, the same in every run; float64.

    Raises what `jaxreg.io.read_cloud` raises.
    """
    mesh = load(path)
    if len(mesh.faces) == 0:
        return Scan(mesh.vertices)
    return sampled(mesh)


def read_ply(path: Path) -> Scan:
    """The vertices of a PLY file; where it has faces, points of its surface as `read` gives them."""
    vertices, faces, notes = ply.read(path)
    if len(faces) == 0:
        return Scan(vertices, notes)
    mesh = Mesh(vertices, faces)
    _check(path, mesh)
    return sampled(mesh)


def load(path: Path) -> Mesh:
    """The triangles of a file in its own unit; polygons are cut into triangles."""
    kind = path.suffix.lower()
    if kind == ".ply":
        vertices, faces, _ = ply.read(path)
        mesh = Mesh(vertices, faces)
    elif kind == ".stl":
        corners = stl.corners(path)
        vertices = corners.reshape(-1, 3)
        mesh = Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3))
    else:
        mesh = _by_trimesh(path, kind.lstrip("."))
    _check(path, mesh)
    return mesh


def sampled(mesh: Mesh) -> Scan:
    """Points drawn evenly from the surface of a mesh; its vertices where it has no area."""
    import trimesh  # a second of start-up that other formats need not pay

    # A triangle without three finite corners has no surface.
    whole = np.isfinite(mesh.vertices[mesh.faces]).all(axis=(1, 2))
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces[whole], process=False)
    with np.errstate(all="ignore"):
        area = surface.area
        if not (np.isfinite(area) and area > 0):
            return Scan(mesh.vertices)
        points = np.asarray(trimesh.sample.sample_surface(surface, _POINTS, seed=0)[0], np.float64)
    return Scan(points, (f"a mesh of {len(mesh.faces):,} triangles, sampled over its surface",))


def is_mesh(path: Path) -> bool:
    """Whether the file has faces."""
    return path.suffix.lower() in SUFFIXES and len(load(path).faces) > 0


def write_moved(path: Path, original: Path, rotation: np.ndarray, translation: np.ndarray) -> None:
    """Write the mesh `original` in the format of the suffix of `path`, its vertices moved.

    From OBJ to OBJ everything else stays as it is, from GLB to GLB the scene with its materials.

    Raises:
      ValueError: the file has no faces, and another format than its own is asked for.
    """
    kinds = (original.suffix.lower(), path.suffix.lower())
    if kinds == (".obj", ".obj"):
        return _write_obj(path, original, rotation, translation)
    if kinds == (".glb", ".glb"):
        scene = _loaded(original, original.read_bytes(), "glb")
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation, translation
        scene.apply_transform(matrix)
        scene.export(str(path), file_type="glb")
        return None
    mesh = load(original)
    if len(mesh.faces) == 0:
        raise ValueError(
            f"{path}: {original} has no faces, so there is no surface to write: choose .ply or "
            "another format of clouds."
        )
    return _export(path, Mesh(mesh.vertices @ rotation.T + translation, mesh.faces))


def more(path: Path) -> tuple[str, ...]:
    """What an OBJ or OFF file holds besides vertices and faces."""
    found = _MORE[path.suffix.lower()].search(as_utf8(path.read_bytes()))
    return ("normals, colours or textures",) if found else ()


def rounding(suffix: str, points: np.ndarray) -> float:
    """By how much coordinates are rounded in a mesh of this format; 0 where it stores doubles."""
    if suffix not in _NARROW or len(points) == 0:
        return 0.0
    return float(np.spacing(np.float32(np.nanmax(np.abs(points)))) / 2)


def _export(path: Path, mesh: Mesh) -> None:
    import trimesh

    kind = path.suffix.lower()
    if kind == ".ply":
        ply.write(path, mesh.vertices, mesh.faces)
        return
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    options = {"digits": 12} if kind in (".obj", ".off") else {}
    surface.export(path, file_type=kind[1:], **options)


def _write_obj(path: Path, original: Path, rotation: np.ndarray, translation: np.ndarray) -> None:
    """Line by line: vertices moved, normals turned, groups, textures and faces as they are."""
    text = decoded(original, original.read_bytes())
    while (joined := _CONTINUED.sub(r"\1 ", text)) != text:
        text = joined
    with path.open("w", encoding="utf-8", newline="\n") as file:
        for line in text.splitlines():
            words = line.split()
            if words and words[0] in ("v", "vn") and len(words) > 3:
                try:
                    numbers = [float(word.replace(",", ".")) for word in words[1:4]]
                except ValueError:
                    raise ValueError(
                        f"{original}: '{line[:60]}' is no vertex: export the file again."
                    ) from None
                vertex = words[0] == "v"
                moved = rotation @ numbers + translation if vertex else turn_of(rotation) @ numbers
                line = " ".join([words[0], *(f"{x:.12g}" for x in moved), *words[4:]])
            file.write(line + "\n")


def _by_trimesh(path: Path, kind: str) -> Mesh:
    import trimesh

    content = path.read_bytes()
    if kind in ("obj", "off"):
        content = with_points(as_utf8(content))
        content = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if kind == "obj":
        content = _plain_obj(content)
    if kind == "off":
        content = _GLUED.sub(rb"\1\n", content, count=1)
    shape = _loaded(path, content, kind)
    try:
        shape = shape.to_geometry() if isinstance(shape, trimesh.Scene) else shape
    except Exception as error:  # noqa: BLE001 - as in _loaded
        raise _malformed(path, error) from None
    vertices = np.asarray(getattr(shape, "vertices", np.empty((0, 3))), np.float64)
    faces = np.asarray(getattr(shape, "faces", ()), np.int64).reshape(-1, 3)
    return Mesh(vertices, faces)


def _plain_obj(content: bytes) -> bytes:
    """Without what trimesh does not read: tabs, remarks behind a line, and indices from the end.

    These count from the last vertex *above* the face.
    """
    content = content.replace(b"\\\n", b" ").replace(b"\t", b" ")
    if b"#" in content:
        content = re.sub(rb"[ ]#[^\n]*", b"", content)
    if not _FROM_THE_END.search(content):
        return content
    counts, made = {b"v": 0, b"vt": 0, b"vn": 0}, []
    for line in content.split(b"\n"):
        words = line.split()
        if words and words[0] in counts:
            counts[words[0]] += 1
        if words and words[0] == b"f":
            corners = [corner.split(b"/") for corner in words[1:]]
            line = b"f " + b" ".join(b"/".join(_counted(c, counts)) for c in corners)
        made.append(line)
    return b"\n".join(made)


def _counted(corner: list[bytes], counts: dict[bytes, int]) -> list[bytes]:
    return [
        b"%d" % (count + 1 + int(index)) if index.startswith(b"-") else index
        for index, count in zip(corner, counts.values(), strict=False)
    ]


def _loaded(path: Path, content: bytes, kind: str):
    import trimesh

    try:
        return trimesh.load(io.BytesIO(content), file_type=kind, process=False)
    except Exception as error:  # noqa: BLE001 - trimesh raises whatever its parsers raise
        raise _malformed(path, error) from None


def _malformed(path: Path, error: Exception) -> ValueError:
    told = " ".join(str(error).split())[:120]
    return ValueError(
        f"{path} cannot be read as {path.suffix[1:].upper()} ({type(error).__name__}: {told}): "
        "it is malformed or truncated; export it again."
    )


def _check(path: Path, mesh: Mesh) -> None:
    vertices, faces = mesh
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"{path}: its vertices do not have three coordinates: export it again.")
    wrong = (faces < 0).any(axis=1) | (faces >= len(vertices)).any(axis=1)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise ValueError(
            f"{path}: face {row} names vertex {faces[row].max()} of {len(vertices)}: the file is "
            "malformed or truncated; export it again."
        )
