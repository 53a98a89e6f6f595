"""Text with one point per line: XYZ, TXT, CSV, ASC, PTS, XYZN, XYZRGB; in any encoding."""

import array
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxreg.io import columns
from jaxreg.io.contents import TWO_COLUMNS, Scan
from jaxreg.io.decoding import decoded, number
from jaxreg.io.layout import (
    Layout,
    is_count,
    is_data,
    lines,
    parted,
    recognised,
    split,
    uncommented,
)
from jaxreg.io.matrix import turn_of

SUFFIXES = (".xyz", ".txt", ".csv", ".tsv", ".asc", ".pts", ".xyzn", ".xyzrgb", ".xyzi", ".dat")
WRITABLE = (".xyz", ".txt", ".csv", ".asc")
_FEWEST = 3
"""Fewer lines of two numbers may be anything."""
_LEVEL = 1e-9
"""Heights below this share of the extent are rounding."""
_GRID = re.compile(r"\s*ncols\s+\d+\s+nrows\s+\d+", re.IGNORECASE)


def read(path: Path) -> Scan:
    """The points (n, 3), float64. Raises what `jaxreg.io.read_cloud` raises.

    Separated by blanks, tabs, commas, semicolons or bars; the decimal mark is a point or a comma.
    Columns x, y, z where a header names them, also in a comment above the points, with units ("X
    [m]"), or as a surveyor does (Easting, Northing, Elevation); without a header the first three
    columns of numbers. A header that has a name for every column, and none of these, is an error, and
    so is a first column that seems to number the points. Other comments are skipped, and so are lines
    with nothing but the number of points that follow. An empty field or "-nan(ind)" is NaN. If every
    line has two numbers, they are x and y, and z is 0.
    """
    text = decoded(path, path.read_bytes())
    if _GRID.match(text):
        raise ValueError(
            f"{path} is a grid of heights (ESRI), not a list of points: convert it first, as in "
            "gdal_translate -of XYZ grid.asc points.xyz."
        )
    if (planar := _in_plane(path, text)) is not None:
        return Scan(planar[0], (TWO_COLUMNS,))
    layout = recognised(path, text)
    if layout is None:
        return Scan(np.empty((0, 3)))
    return Scan(_points(path, text, layout))


def _in_plane(path: Path, text: str) -> tuple[np.ndarray, Layout] | None:
    """The points of a file of x and y alone, with z = 0, and its layout; None for any other file.

    What parts the columns is told line by line: the separator of the layout is that of no line.

    Raises:
      ValueError: the two columns are longitude and latitude.
    """
    rows, first, comma, order, angles = [], 0, False, (0, 1), False
    for count, line in lines(text):
        if not is_data(line):
            continue
        line = uncommented(line).strip()
        mark = _mark(line)
        fields = [number(field, comma=mark == ";") for field in split(line, mark)]
        if len(fields) != 2 or (None in fields and rows):
            return None
        if None in fields:
            names = split(line, mark)
            angles = angles or columns.geographic(names)
            order = columns.plane(names) or order
        if None not in fields:
            rows.append(fields)
            first = first or count
            comma = comma or (mark == ";" and "," in line)
    if len(rows) < _FEWEST:
        return None
    if angles:
        raise ValueError(
            f"{path}: the columns are longitude and latitude, angles and no lengths: project them to "
            "metres first, to UTM for instance."
        )
    points = np.column_stack([np.array(rows, np.float64)[:, order], np.zeros(len(rows))])
    return points, Layout(None, comma, order, None, first, None)


def _mark(line: str) -> str | None:
    """What parts the two columns of a line; None: blanks and tabs."""
    line = uncommented(line).strip()
    mark = next((mark for mark in ";|" if mark in line), None)
    alone = "," in line and (len(line.split()) == 1 or ", " in line)
    return mark or ("," if alone else None)


def more(path: Path) -> tuple[str, ...]:
    """What a line holds besides x, y, z."""
    text = decoded(path, path.read_bytes())
    layout = None if _in_plane(path, text) else recognised(path, text)
    if layout is None:
        return ()
    row = next(line for count, line in lines(text) if count == layout.first)
    further = len(split(uncommented(row), layout.separator)) - 3
    return (f"{further} further columns",) if further > 0 else ()


def write(path: Path, points: np.ndarray) -> None:
    """One point per line, 12 digits; a CSV file gets the header x,y,z."""
    csv = path.suffix.lower() == ".csv"
    header, delimiter = ("x,y,z", ",") if csv else ("", " ")
    np.savetxt(path, points, fmt="%.12g", delimiter=delimiter, header=header, comments="")


def write_moved(
    path: Path, original: Path, rotation: np.ndarray, translation: np.ndarray
) -> tuple[str, ...]:
    """Write a text file again with its points (and normals) moved and everything else kept.

    Columns stay in their order, rows without a point and comments as they are. To a ``.csv`` from
    columns parted by blanks, commas part them. The text becomes UTF-8. Returns what it cannot hold:
    a height beside two columns.
    """
    text = decoded(original, original.read_bytes())
    planar = _in_plane(original, text)
    layout = recognised(original, text) if planar is None else planar[1]
    if layout is None:
        raise ValueError(f"{original} contains no points: choose another file.")
    points = _points(original, text, layout) if planar is None else planar[0]
    moved = points @ rotation.T + translation
    rows, csv = iter(moved), path.suffix.lower() == ".csv"
    with path.open("w", encoding="utf-8", newline="\n") as file:
        for count, line in lines(text):
            here = layout if planar is None else _of_line(layout, line)
            new = line
            if count >= layout.first and is_data(line) and not _counts(line, layout):
                new = _replaced(line, here, next(rows), rotation)
            commas = csv and here.separator is None and not here.comma
            if commas and is_data(line) and not _counts(line, layout):
                new = ",".join(new.split())
            file.write(new + "\n")
    return () if planar is None else _without_height(moved)


def _of_line(layout: Layout, line: str) -> Layout:
    """The layout of one line of a file of two columns."""
    mark = _mark(line)
    return layout._replace(separator=mark, comma=layout.comma and mark == ";")


def _without_height(moved: np.ndarray) -> tuple[str, ...]:
    finite = moved[np.isfinite(moved).all(axis=1)]
    if len(finite) == 0:
        return ()
    height = np.abs(finite[:, 2]).max()
    if height <= _LEVEL * np.ptp(finite[:, :2], axis=0).max():
        return ()
    return (f"two columns hold x and y alone: z, up to {height:.3g}, is left out",)


def _replaced(line: str, layout: Layout, point: np.ndarray, rotation: np.ndarray) -> str:
    body = uncommented(line)
    body = body if body == line else body.rstrip(" ")
    mark = layout.separator
    parts = re.split(r"(\s+)", body) if mark is None else parted(body, mark)
    # Between the fields of blanks stand the blanks; before the first may stand some, too.
    places = [i for i, part in enumerate(parts) if layout.separator or part.strip()]
    point = point[: len(layout.columns)]
    new = dict(zip(layout.columns, point, strict=True)) if np.isfinite(point).all() else {}
    if layout.normals and new:
        fields = [parts[places[c]].strip().strip('"') for c in layout.normals]
        vector = [number(field, comma=layout.comma) for field in fields]
        if None not in vector:
            new |= dict(
                zip(layout.normals, turn_of(rotation) @ np.array(vector, float), strict=True)
            )
    for column, value in new.items():
        digits = f"{value:.12g}"
        digits = digits.replace(".", ",") if layout.comma else digits
        parts[places[column]] = (
            f'"{digits}"' if layout.separator == "," and layout.comma else digits
        )
    return (layout.separator or "").join(parts) + line[len(body) :]


def _points(path: Path, text: str, layout: Layout) -> np.ndarray:
    # Numpy would take "#" for the begin of a remark, and part what stands between quotes.
    if ".#" in text or ",#" in text or ('"' in text and layout.separator is not None):
        return _slowly(path, text, layout)
    try:
        points = np.loadtxt(
            _plain(text, layout), delimiter=layout.separator, usecols=layout.columns, ndmin=2
        )
    except ValueError:
        return _slowly(path, text, layout)
    if layout.count is not None and layout.count != len(points):
        return _slowly(path, text, layout)
    return points


def _plain(text: str, layout: Layout) -> Iterator[str]:
    for count, line in lines(text):
        if count >= layout.first and is_data(line):
            yield line.replace(",", ".") if layout.comma else line


def _slowly(path: Path, text: str, layout: Layout) -> np.ndarray:
    """Row by row: with what numpy does not take for a number, and with counts between the rows."""
    values, announced = array.array("d"), (layout.count, 0, layout.first - 1)
    for count, line in lines(text):
        if count < layout.first or not is_data(line):
            continue
        if _counts(line, layout):
            _check_count(path, announced, len(values) // 3)
            announced = (int(line), len(values) // 3, count)
            continue
        values.extend(_row(f"{path}, line {count}", line, layout))
    _check_count(path, announced, len(values) // 3)
    return np.array(values).reshape(-1, 3)


def _counts(line: str, layout: Layout) -> bool:
    """Whether a line holds a number of points and nothing else."""
    return layout.count is not None and is_count(line.strip())


def _check_count(path: Path, announced: tuple[int | None, int, int], found: int) -> None:
    count, before, line = announced
    if count is not None and found - before != count:
        raise ValueError(
            f"{path}: line {line} announces {count} points and {found - before} follow: copy the "
            "file again, or remove that line if the points are right."
        )


def _row(where: str, line: str, layout: Layout) -> list[float]:
    fields = split(uncommented(line), layout.separator)
    if len(fields) <= max(layout.columns):
        raise ValueError(
            f"{where}: '{line.strip()[:60]}' has {len(fields)} column(s), but a point needs "
            f"{max(layout.columns) + 1}: complete or remove the line."
        )
    row = []
    for column in layout.columns:
        value = number(fields[column], comma=layout.comma)
        if value is None:
            hint = "fix or remove the line"
            if re.fullmatch(r"[+-]?\d+,\d+", fields[column]):
                hint = "if the comma is a decimal mark, write all numbers with decimal points"
            raise ValueError(f"{where}: '{fields[column][:40]}' is not a number: {hint}.")
        row.append(value)
    return row
