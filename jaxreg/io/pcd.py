"""PCD, the format of the Point Cloud Library: ascii, binary and binary_compressed, version 0.7."""

from pathlib import Path

import numpy as np

_KINDS = {"F": "f", "I": "i", "U": "u"}


def read(path: Path) -> np.ndarray:
    """The points (n, 3), float64. Raises what `jaxreg.io.read_cloud` raises."""
    content = path.read_bytes()
    header, body = _header(path, content)
    row = _row_type(path, header)
    count = _integer(path, header, "POINTS" if "POINTS" in header else "WIDTH")
    kind = header["DATA"][0].lower()
    if kind == "ascii":
        return _ascii(path, body, row, count)
    if kind == "binary_compressed":
        return _columns(path, _decompressed(path, body), row, count)
    if kind != "binary":
        raise ValueError(f"{path}: DATA '{kind}' is not a PCD encoding: save it again as binary.")
    if len(body) < count * row.itemsize:
        raise ValueError(
            f"{path} is truncated: it announces {count} points, but row "
            f"{len(body) // row.itemsize} is incomplete: copy it again."
        )
    rows = np.frombuffer(body, row, count)
    return np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)


def write(path: Path, points: np.ndarray) -> None:
    """Binary, fields x y z, double."""
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\n"
        f"TYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(points)}\nDATA binary\n"
    )
    path.write_bytes(header.encode("ascii") + np.ascontiguousarray(points, "<f8").tobytes())


def _header(path: Path, content: bytes) -> tuple[dict[str, list[str]], bytes]:
    """The header's entries and what follows the DATA line."""
    entries, position = {}, 0
    while position < len(content):
        end = content.find(b"\n", position)
        end = len(content) if end < 0 else end
        words = content[position:end].decode("latin-1").split()
        position = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
            if words[0].upper() == "DATA":
                break
    missing = [name for name in ("FIELDS", "SIZE", "TYPE", "DATA") if not entries.get(name)]
    if missing:
        raise ValueError(f"{path}: the PCD header lacks {', '.join(missing)}: save it again.")
    return entries, content[position:]


def _row_type(path: Path, header: dict[str, list[str]]) -> np.dtype:
    names, sizes, kinds = (header[key] for key in ("FIELDS", "SIZE", "TYPE"))
    counts = header.get("COUNT", ["1"] * len(names))
    if not set("xyz") <= set(names):
        raise ValueError(f"{path}: the fields are {' '.join(names)}, without x y z: save it again.")
    try:
        fields = [
            (f"{name}.{i}" if name == "_" else name, f"<{_KINDS[kind]}{int(size)}", (int(n),))
            if n != "1"
            else (f"{name}.{i}" if name == "_" else name, f"<{_KINDS[kind]}{int(size)}")
            for i, (name, size, kind, n) in enumerate(zip(names, sizes, kinds, counts, strict=True))
        ]
        return np.dtype(fields)
    except (KeyError, ValueError, TypeError) as error:
        raise ValueError(
            f"{path}: FIELDS, SIZE, TYPE and COUNT of the PCD header do not match ({error}): "
            "save it again."
        ) from None


def _integer(path: Path, header: dict[str, list[str]], name: str) -> int:
    try:
        return int(header[name][0]) * (1 if name == "POINTS" else int(header["HEIGHT"][0]))
    except (KeyError, IndexError, ValueError):
        raise ValueError(f"{path}: the PCD header gives no {name}: save it again.") from None


def _ascii(path: Path, body: bytes, row: np.dtype, count: int) -> np.ndarray:
    starts = np.cumsum([0] + [int(np.prod(row[name].shape)) for name in _names(row)])
    columns = [starts[_names(row).index(axis)] for axis in "xyz"]
    lines = [line.split() for line in body.decode("latin-1").splitlines() if line.strip()]
    if len(lines) < count:
        raise ValueError(
            f"{path} is truncated: it announces {count} points and has {len(lines)}: copy it again."
        )
    points = np.empty((count, 3))
    for i, words in enumerate(lines[:count]):
        try:
            points[i] = [float(words[column]) for column in columns]
        except (IndexError, ValueError):
            raise ValueError(
                f"{path}, point {i}: '{' '.join(words)[:60]}' is not a point: fix or remove the line."
            ) from None
    return points


def _decompressed(path: Path, body: bytes) -> bytes:
    if len(body) < 8:
        raise ValueError(f"{path} is truncated after its header: copy it again.")
    packed, size = (int(x) for x in np.frombuffer(body, "<u4", 2))
    content = _lzf(body[8 : 8 + packed]) if len(body) >= 8 + packed else b""
    if len(content) != size:
        raise ValueError(f"{path} is truncated inside its compressed data: copy it again.")
    return content


def _lzf(packed: bytes) -> bytes:
    """LZF: runs of literals, and back references into what has been unpacked."""
    result, i = bytearray(), 0
    try:
        while i < len(packed):
            control = packed[i]
            i += 1
            if control < 32:
                result += packed[i : i + control + 1]
                i += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += packed[i]
                i += 1
            start = len(result) - ((control & 31) << 8) - packed[i] - 1
            i += 1
            for offset in range(start, start + length + 2):  # may overlap with what it appends
                result.append(result[offset])
    except IndexError:
        return b""
    return bytes(result)


def _columns(path: Path, content: bytes, row: np.dtype, count: int) -> np.ndarray:
    """Compressed files store one field after the other."""
    if len(content) < count * row.itemsize:
        raise ValueError(
            f"{path}: the compressed data has fewer than {count} points: save it again."
        )
    columns, position = {}, 0
    for name in _names(row):
        columns[name] = np.frombuffer(
            content, row[name].base, count * int(np.prod(row[name].shape)), position
        )
        position += count * row[name].itemsize
    return np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)


def _names(row: np.dtype) -> tuple[str, ...]:
    return row.names or ()
