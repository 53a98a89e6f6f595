"""PCD, the format of the Point Cloud Library: ascii, binary, binary_compressed; versions 0.5 to 0.7."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxreg.io import lzf
from jaxreg.io.contents import Scan
from jaxreg.io.decoding import as_utf8, number, with_points
from jaxreg.io.matrix import turn_of

_KINDS = {"F": "f", "I": "i", "U": "u"}
_NORMALS = ("normal_x", "normal_y", "normal_z")
_FINE = 1e-6
"""Coordinates stay in single precision where it rounds by less than this share of their extent."""


class _File(NamedTuple):
    """A header's `entries`, the type of a `row`, how many, and the `body` after the DATA line."""

    entries: dict[str, list[str]]
    row: np.dtype
    count: int
    body: bytes


def read(path: Path) -> Scan:
    """The points (n, 3), float64. Raises what `jaxreg.io.read_cloud` raises."""
    file = _opened(path)
    if _encoding(file) == "ascii":
        return Scan(_coordinates(path, file), viewpoint=_viewpoint(file))
    rows = _rows(path, file)
    points = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
    return Scan(points, viewpoint=_viewpoint(file))


def _viewpoint(file: _File) -> np.ndarray | None:
    """The place in ``VIEWPOINT tx ty tz qw qx qy qz``; None where there is none, or no numbers."""
    try:
        place = np.array([float(word) for word in file.entries.get("VIEWPOINT", [])[:3]])
    except ValueError:
        return None
    return place if len(place) == 3 and np.isfinite(place).all() else None


def more(path: Path) -> tuple[str, ...]:
    """The fields of a point besides x, y, z."""
    return tuple(n for n in _names(_opened(path).row) if n not in "xyz" and not n.startswith("_"))


def write(path: Path, points: np.ndarray) -> None:
    """Binary, fields x y z, double."""
    rows = np.empty(len(points), [(axis, "<f8") for axis in "xyz"])
    for axis, column in zip("xyz", points.T, strict=True):
        rows[axis] = column
    _write(path, rows, {"WIDTH": [str(len(points))], "HEIGHT": ["1"]})


def write_moved(path: Path, original: Path, rotation: np.ndarray, translation: np.ndarray) -> None:
    """Write a PCD file again with points, normals and viewpoint moved and every other field kept.

    The fields keep their order, ascii stays ascii, all else becomes binary; x, y, z become double
    where single precision would round them by more than a millionth of their extent.
    """
    file = _opened(original)
    file.entries.update(_moved_viewpoint(file, rotation, translation))
    if _encoding(file) == "ascii":
        moved = _coordinates(original, file) @ rotation.T + translation
        return _write_ascii(path, file, moved, rotation)
    old = _rows(original, file)
    points = np.stack([old[axis] for axis in "xyz"], axis=1).astype(np.float64)
    moved = points @ rotation.T + translation
    kinds = [
        (n, _kind(old.dtype[n], moved) if n in "xyz" else old.dtype[n]) for n in _names(file.row)
    ]
    rows = np.empty(len(old), kinds)
    for name in _names(file.row):
        rows[name] = old[name]
    for axis, column in zip("xyz", moved.T, strict=True):
        rows[axis] = column
    if set(_NORMALS) <= set(_names(file.row)):
        normals = np.stack([old[name] for name in _NORMALS], axis=1) @ turn_of(rotation).T
        for name, column in zip(_NORMALS, normals.T, strict=True):
            rows[name] = column
    return _write(path, rows, file.entries)


def _moved_viewpoint(
    file: _File, rotation: np.ndarray, translation: np.ndarray
) -> dict[str, list[str]]:
    """The moved place and attitude of the scanner; nothing where the file holds no seven numbers."""
    place = _viewpoint(file)
    try:
        w, *axis = (float(word) for word in file.entries["VIEWPOINT"][3:7])
        attitude = Rotation.from_quat([*axis, w])
    except (KeyError, ValueError):
        return {}
    if place is None:
        return {}
    # -0.0 and 0.0 are one number.
    x, y, z, w = (Rotation.from_matrix(turn_of(rotation)) * attitude).as_quat(canonical=True) + 0.0
    moved = rotation @ place + translation + 0.0
    words = [f"{number:.15g}" for number in moved] + [f"{number:.9g}" for number in (w, x, y, z)]
    return {"VIEWPOINT": words}


def _kind(kind: np.dtype, points: np.ndarray) -> np.dtype:
    """The type of a coordinate after moving: that of the file, or double where that is too coarse."""
    finite = points[np.isfinite(points).all(axis=1)]
    if kind.kind != "f" or len(finite) == 0:
        return np.dtype("<f8")
    extent = np.ptp(finite, axis=0).max()
    step = np.spacing(np.abs(finite).max().astype(kind))
    return kind if step <= 2 * _FINE * extent else np.dtype("<f8")


def _opened(path: Path) -> _File:
    content = path.read_bytes()
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        content = as_utf8(content)
    entries, position = _header(path, content)
    row = _row_type(path, entries)
    count = _integer(path, entries, "POINTS" if "POINTS" in entries else "WIDTH")
    if count < 0 or count > len(content) * 100:
        raise ValueError(f"{path} is truncated: it announces {count} points: copy it again.")
    return _File(entries, row, count, content[position:])


def _encoding(file: _File) -> str:
    return file.entries["DATA"][0].lower()


def _header(path: Path, content: bytes) -> tuple[dict[str, list[str]], int]:
    """The header's entries and where the data begin, after the DATA line."""
    entries, position = {}, 0
    while position < len(content):
        end = content.find(b"\n", position)
        end = len(content) if end < 0 else end
        line = content[position:end].removeprefix(b"\xef\xbb\xbf").strip()
        position = end + 1
        words = line.decode("latin-1").split() if len(line) < 65536 else []
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
            if words[0].upper() == "DATA":
                break
    if "FIELDS" not in entries and "COLUMNS" in entries:  # as version 0.5 has it
        entries["FIELDS"] = entries.pop("COLUMNS")
    missing = [name for name in ("FIELDS", "DATA") if not entries.get(name)]
    if missing:
        raise ValueError(f"{path}: the PCD header lacks {', '.join(missing)}: save it again.")
    return entries, position


def _row_type(path: Path, header: dict[str, list[str]]) -> np.dtype:
    """The type of a row; where an old header is silent, fields are floats of four bytes."""
    names = [name.lower() if name in "XYZ" else name for name in header["FIELDS"]]
    sizes = header.get("SIZE") or ["4"] * len(names)
    kinds = header.get("TYPE") or ["F"] * len(names)
    counts = header.get("COUNT") or ["1"] * len(names)
    if not set("xyz") <= set(names):
        raise ValueError(f"{path}: the fields are {' '.join(names)}, without x y z: save it again.")
    try:
        fields = []
        for i, (name, size, kind, n) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
            shape = () if n == "1" else (int(n),)
            name = f"_.{i}" if name == "_" else name
            fields.append((name, f"<{_KINDS[kind.upper()]}{int(size)}", shape))
        row = np.dtype(fields)
        if any(row[axis].shape for axis in "xyz"):
            raise ValueError("x, y or z has more than one value")
        return row
    except (KeyError, ValueError, TypeError, OverflowError) as error:
        raise ValueError(
            f"{path}: FIELDS, SIZE, TYPE and COUNT of the PCD header do not match ({error}): "
            "save it again."
        ) from None


def _integer(path: Path, header: dict[str, list[str]], name: str) -> int:
    try:
        height = 1 if name == "POINTS" else int(header.get("HEIGHT", ["1"])[0])
        return int(header[name][0]) * height
    except (KeyError, IndexError, ValueError):
        raise ValueError(f"{path}: the PCD header gives no {name}: save it again.") from None


def _starts(row: np.dtype) -> list[int]:
    """The word of an ascii line at which every field begins, and their number."""
    return np.cumsum([0] + [int(np.prod(row[name].shape)) for name in _names(row)]).tolist()


def _axes(row: np.dtype, names: tuple[str, ...] = ("x", "y", "z")) -> list[int]:
    return [_starts(row)[_names(row).index(name)] for name in names]


def _ascii_lines(file: _File) -> Iterator[bytes]:
    """The lines of points, one after the other."""
    body, position = with_points(file.body.replace(b"\xef\xbb\xbf", b"")), 0
    found = 0
    while position < len(body) and found < file.count:
        end = body.find(b"\n", position)
        end = len(body) if end < 0 else end
        line = body[position:end]
        position = end + 1
        if line.strip():
            found += 1
            yield line


def _coordinates(path: Path, file: _File) -> np.ndarray:
    columns, found = _axes(file.row), 0
    if file.count > len(file.body):
        raise ValueError(f"{path} is truncated: it announces {file.count} points: copy it again.")
    points = np.empty((file.count, 3))
    for found, line in enumerate(_ascii_lines(file), start=1):
        words = line.split()
        try:
            points[found - 1] = [float(words[column]) for column in columns]
        except (IndexError, ValueError):
            told = line.decode("latin-1").strip()[:60]
            raise ValueError(
                f"{path}, point {found - 1}: '{told}' is not a point: fix or remove the line."
            ) from None
    if found < file.count:
        raise ValueError(
            f"{path} is truncated: {file.count} points are announced, but there are {found}: "
            "copy it again."
        )
    return points


def _rows(path: Path, file: _File) -> np.ndarray:
    kind = _encoding(file)
    if kind == "binary_compressed":
        return _columns(path, _decompressed(path, file.body), file.row, file.count)
    if kind != "binary":
        raise ValueError(f"{path}: DATA '{kind}' is not a PCD encoding: save it again as binary.")
    if len(file.body) < file.count * file.row.itemsize:
        raise ValueError(
            f"{path} is truncated: {file.count} points are announced, and row "
            f"{len(file.body) // file.row.itemsize} is incomplete: copy it again."
        )
    return np.frombuffer(file.body, file.row, file.count)


def _decompressed(path: Path, body: bytes) -> bytes:
    if len(body) < 8:
        raise ValueError(f"{path} is truncated after its header: copy it again.")
    packed, size = (int(x) for x in np.frombuffer(body, "<u4", 2))
    content = lzf.unpacked(body[8 : 8 + packed], size) if len(body) >= 8 + packed else b""
    if len(content) != size:
        raise ValueError(f"{path} is truncated inside its compressed data: copy it again.")
    return content


def _columns(path: Path, content: bytes, row: np.dtype, count: int) -> np.ndarray:
    """Compressed files store one field after the other."""
    if len(content) < count * row.itemsize:
        raise ValueError(f"{path}: the compressed data has fewer than {count} points: save again.")
    rows, position = np.empty(count, row), 0
    for name in _names(row):
        values = int(np.prod(row[name].shape))
        column = np.frombuffer(content, row[name].base, count * values, position)
        rows[name] = column.reshape(count, *row[name].shape)
        position += count * row[name].itemsize
    return rows


def _names(row: np.dtype) -> tuple[str, ...]:
    return row.names or ()


def _write(path: Path, rows: np.ndarray, entries: dict[str, list[str]]) -> None:
    kinds = [rows.dtype[name] for name in _names(rows.dtype)]
    letters = {kind: letter for letter, kind in _KINDS.items()}
    fields = {
        "FIELDS": ["_" if name.startswith("_.") else name for name in _names(rows.dtype)],
        "SIZE": [str(kind.base.itemsize) for kind in kinds],
        "TYPE": [letters[kind.base.kind] for kind in kinds],
        "COUNT": [str(int(np.prod(kind.shape))) for kind in kinds],
    }
    path.write_bytes(_header_text(fields, entries, len(rows), "binary") + rows.tobytes())


def _header_text(
    fields: dict[str, list[str]], entries: dict[str, list[str]], count: int, data: str
) -> bytes:
    lines = {"VERSION": ["0.7"], **fields}
    for name, default in (("WIDTH", [str(count)]), ("HEIGHT", ["1"])):
        lines[name] = entries.get(name) or default
    lines["VIEWPOINT"] = entries.get("VIEWPOINT") or ["0", "0", "0", "1", "0", "0", "0"]
    lines |= {"POINTS": [str(count)], "DATA": [data]}
    text = "".join(f"{name} {' '.join(words)}\n" for name, words in lines.items())
    return ("# .PCD v0.7 - Point Cloud Data file format\n" + text).encode("latin-1", "replace")


def _write_ascii(path: Path, file: _File, moved: np.ndarray, rotation: np.ndarray) -> None:
    """Word by word, so that what is no coordinate keeps its digits."""
    names = _names(file.row)
    places = _axes(file.row)
    across = _axes(file.row, _NORMALS) if set(_NORMALS) <= set(names) else []
    kinds = {name: file.row[name] for name in names}
    fields = {
        "FIELDS": ["_" if name.startswith("_.") else name for name in names],
        "SIZE": [str(kinds[n].base.itemsize) for n in names],
        "TYPE": ["F" if n in "xyz" else _letter(kinds[n]) for n in names],
        "COUNT": [str(int(np.prod(kinds[n].shape))) for n in names],
    }
    with path.open("wb") as out:
        out.write(_header_text(fields, file.entries, file.count, "ascii"))
        for line, point in zip(_ascii_lines(file), moved, strict=True):
            words = line.decode("latin-1").split()
            if across:
                vector = [number(words[c]) or 0.0 for c in across]
                for column, value in zip(across, turn_of(rotation) @ vector, strict=True):
                    words[column] = f"{value:.9g}"
            if np.isfinite(point).all():
                for column, value in zip(places, point, strict=True):
                    words[column] = f"{value:.12g}"
            out.write((" ".join(words) + "\n").encode("latin-1"))


def _letter(kind: np.dtype) -> str:
    return next(letter for letter, code in _KINDS.items() if code == kind.base.kind)
