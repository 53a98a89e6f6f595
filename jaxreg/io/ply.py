"""PLY: ascii and binary of both byte orders, with any other properties and elements, with plyfile."""

import contextlib
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from jaxreg.io.decoding import as_utf8, with_points
from jaxreg.io.matrix import turn_of

_END = re.compile(rb"end_header[ \t]*(\r\n|\n|\r)")
_LONGEST = 1 << 20
"""Bytes in which a header must end."""
_FREE = 1 << 16
_WIDE = (b"\xff\xfe", b"\xfe\xff")
"""The marks of UTF-16."""
_NORMALS = ("nx", "ny", "nz")
_TURNS = ("rot_0", "rot_1", "rot_2", "rot_3")
"""The quaternion of a Gaussian splat, w first."""
_SIZES = ("scale_0", "scale_1", "scale_2")
"""The logarithms of its extents."""
_BLANKS = re.compile(r"(?m)^end_header[ \t]+")
_CAPITAL = re.compile(r"(?m)^(property\s+\w+\s+)([XYZ])([ \t\r]*)$")


def read(path: Path) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Vertices (n, 3), triangles (f, 3), and notes. Raises what `jaxreg.io.read_cloud` raises."""
    data = _told(path)
    try:
        vertex = data["vertex"]
        points = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], axis=1)
    except KeyError:
        raise ValueError(
            f"{path} has no element 'vertex', so it is not a point cloud: export it again."
        ) from None
    except ValueError as error:
        missing = "no field" in str(error)
        reason = "its vertices lack x, y or z" if missing else str(error)
        raise ValueError(f"{path}: {reason}: export it again.") from None
    if points.ndim != 2:
        raise ValueError(f"{path}: its vertices do not have three coordinates: export it again.")
    notes = ()
    if "tristrips" in data:
        notes = ("a mesh of triangle strips, of which the vertices alone are read",)
    return points, _triangles(path, data), notes


def more(path: Path) -> tuple[str, ...]:
    """The properties of a vertex besides x, y, z."""
    return tuple(p.name for p in _told(path)["vertex"].properties if p.name not in "xyz")


def vertices(path: Path) -> np.ndarray:
    """The rows of the element `vertex`, with all their properties."""
    return _told(path)["vertex"].data


def has_faces(path: Path) -> bool:
    """Whether the header announces faces; False also where there is none to read."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        found = re.search(rb"element\s+face\s+(\d+)", _header(file.read(_LONGEST)))
        return bool(found) and int(found[1]) > 0
    return False


def write(path: Path, points: np.ndarray, faces: np.ndarray | None = None) -> None:
    """Binary little-endian vertices x y z, double; and triangles, where there are any."""
    rows = np.empty(len(points), [(axis, "<f8") for axis in "xyz"])
    for axis, column in zip("xyz", points.T, strict=True):
        rows[axis] = column
    elements = [PlyElement.describe(rows, "vertex")]
    if faces is not None:
        lists = np.empty(len(faces), [("vertex_indices", "<i4", (3,))])
        lists["vertex_indices"] = faces
        elements.append(PlyElement.describe(lists, "face"))
    PlyData(elements, byte_order="<").write(str(path))


def write_moved(
    path: Path, original: Path, rotation: np.ndarray, translation: np.ndarray
) -> tuple[str, ...]:
    """Write a PLY file again with its vertices (and normals) moved and everything else kept.

    x, y, z become double, so large offsets lose nothing. Gaussian splats turn with their centres; of
    their colours what depends on the direction of view does not, and that is returned as a note.
    """
    data = _told(original)
    elements = []
    for element in data.elements:
        if element.name == "vertex":
            moved = _moved(element.data, rotation, translation)
            element = PlyElement.describe(moved, "vertex", comments=element.comments)
        elements.append(element)
    header = {"comments": data.comments, "obj_info": data.obj_info}
    PlyData(elements, text=data.text, byte_order=data.byte_order, **header).write(str(path))
    fields = data["vertex"].data.dtype.names or ()
    if "f_rest_0" not in fields:
        return ()
    return ("the colours of splats by direction of view (f_rest_*) are not turned",)


def _told(path: Path) -> PlyData:
    """The content of a file; what is wrong with it names the file."""
    try:
        with _readable(path) as (clean, lists):
            data = _open(clean, lists)
    except PlyParseError as error:
        # plyfile says which element and row, or which line of the header.
        raise ValueError(
            f"{path}: malformed or truncated PLY ({error}): export it again."
        ) from None
    except (ValueError, OverflowError, IndexError, TypeError, MemoryError) as error:
        told = str(error)
        told = told if str(path) in told else f"{path}: malformed PLY ({told}): export it again."
        raise ValueError(told) from None
    for element in data.elements:
        # A copy, so that the file can be written again under its own name.
        element.data = np.array(element.data)
    return data


def _open(path: Path, lists: dict[str, dict[str, int]]) -> PlyData:
    """Lists of three, as triangles are, can be mapped as they are; others are read row by row."""
    if lists:
        with contextlib.suppress(PlyParseError, ValueError):
            return PlyData.read(str(path), mmap="c", known_list_len=lists)
    # Mapped, since plyfile reads row by row otherwise: 0.3 s for 50,000 points instead of 0.01.
    return PlyData.read(str(path), mmap="c")


@contextlib.contextmanager
def _readable(path: Path) -> Iterator[tuple[Path, dict[str, dict[str, int]]]]:
    """The file itself, or a copy that plyfile understands; and the lists of its elements.

    The copy has no byte-order marks, ascii letters only, and numbers with decimal points.
    """
    with path.open("rb") as file:
        head = file.read(_LONGEST)
    plain = head.startswith((b"ply\n", b"ply\r"))
    header = _header(head)
    text = re.search(rb"^format\s+ascii", header, re.MULTILINE) is not None
    lists = _lists(path, header, path.stat().st_size, text=text)
    as_it_is = not text and not _capitals(header) and not re.search(rb"end_header[ \t]", header)
    if plain and header.isascii() and as_it_is:
        yield path, lists
        return
    content = path.read_bytes()
    clean = _cleaned(content, text=text)
    if clean == content:
        yield path, lists
        return
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "clean.ply"
        copy.write_bytes(clean)
        del content, clean
        yield copy, lists


def _header(head: bytes) -> bytes:
    """The bytes down to the end of the header, without a mark before it."""
    head = as_utf8(head) if head[:2] in _WIDE else head.removeprefix(b"\xef\xbb\xbf")
    end = _END.search(head)
    return head[: end.end()] if end else head[:4096]


def _cleaned(content: bytes, *, text: bool) -> bytes:
    """Without byte-order marks, other letters in the header as "?"; a binary body as it is."""
    wide = content[:2] in _WIDE
    content = as_utf8(content) if wide else content.removeprefix(b"\xef\xbb\xbf")
    end = _END.search(content)
    cut = end.end() if end else len(content)
    try:
        header = content[:cut].decode("utf-8")
    except UnicodeDecodeError:
        header = content[:cut].decode("latin-1")
    header = _BLANKS.sub("end_header", header)
    if _capitals(content[:cut]):
        header = _CAPITAL.sub(lambda m: m[1] + m[2].lower() + m[3], header)
    body = content[cut:]
    if text:
        body = with_points(body.replace(b"\xef\xbb\xbf", b""))
    return header.encode("ascii", "replace") + body


def _capitals(header: bytes) -> bool:
    """Whether coordinates are named X, Y, Z, and none x, y, z."""
    names = {m[2] for m in _CAPITAL.finditer(header.decode("latin-1"))}
    return names == set("XYZ") and not re.search(rb"(?m)^property\s+\w+\s+[xyz]\s*$", header)


def _lists(path: Path, header: bytes, size: int, *, text: bool) -> dict[str, dict[str, int]]:
    """The properties of the elements that are lists, taken to be of three.

    Raises:
      ValueError: far more is announced than there is, which would fill the memory.
    """
    lists: dict[str, dict[str, int]] = {}
    element, rows, announced = "", 0, 0
    for line in header.decode("latin-1").splitlines():
        words = line.split()
        if words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal():
            element, rows = words[1], int(words[2])
            announced += rows
        elif words[:1] == ["property"]:
            announced += rows * (2 if text else 1)
            if words[1:2] == ["list"]:
                lists.setdefault(element, {})[words[-1]] = 3
        if announced > 2 * size + _FREE:
            raise ValueError(
                f"{path} is truncated: its header announces {rows} of '{element}', and it has "
                f"{size} bytes: copy or export it again."
            )
    return lists


def _triangles(path: Path, data: PlyData) -> np.ndarray:
    """Polygons cut into fans of triangles, (f, 3)."""
    none = np.empty((0, 3), np.int64)
    face = next((element for element in data.elements if element.name == "face"), None)
    names = [p.name for p in face.properties if isinstance(p, PlyListProperty)] if face else []
    name = next((n for n in ("vertex_indices", "vertex_index") if n in names), None)
    if face is None or name is None or face.count == 0:
        return none
    lists = face.data[name]
    if lists.dtype != object:
        return _fans(np.asarray(lists))
    lengths = np.fromiter(map(len, lists), np.int64, len(lists))
    groups = [np.stack(lists[lengths == k].tolist()) for k in np.unique(lengths) if k > 2]
    return np.concatenate([none, *map(_fans, groups)])


def _fans(polygons: np.ndarray) -> np.ndarray:
    polygons = polygons.astype(np.int64)
    fans = [polygons[:, [0, k, k + 1]] for k in range(1, polygons.shape[1] - 1)]
    return np.concatenate(fans) if fans else np.empty((0, 3), np.int64)


def _moved(vertex: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    fields = vertex.dtype.names or ()
    kinds = [(name, "f8" if name in "xyz" else vertex.dtype[name]) for name in fields]
    moved = np.empty(len(vertex), kinds)
    for name in fields:
        moved[name] = vertex[name]
    points = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float64)
    for axis, column in zip("xyz", (points @ rotation.T + translation).T, strict=True):
        moved[axis] = column
    if set(_NORMALS) <= set(fields):
        normals = np.stack([vertex[name] for name in _NORMALS], axis=1)
        for name, column in zip(_NORMALS, (normals @ turn_of(rotation).T).T, strict=True):
            moved[name] = column
    if set(_TURNS) <= set(fields):
        from scipy.spatial.transform import Rotation  # start-up of programs that only import this

        w, *axis = (vertex[name] for name in _TURNS)
        turned = Rotation.from_matrix(turn_of(rotation)) * Rotation.from_quat(
            np.stack([*axis, w], 1)
        )
        for name, column in zip((*_TURNS[1:], _TURNS[0]), turned.as_quat().T, strict=True):
            moved[name] = column
        for name in set(_SIZES) & set(fields):
            moved[name] += np.log(np.cbrt(np.linalg.det(rotation)))
    return moved
