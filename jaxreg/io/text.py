"""Text with one point per line: XYZ, TXT, CSV; separated by spaces, tabs, commas or semicolons."""

import io
import re
from pathlib import Path

import numpy as np

_COMMENTS = ("#", "//")
_MARK = re.compile(r"^\s*[#/]+")
_LABEL = re.compile(r"^\s*\w+:\s")
"""As in "# columns: x y z"."""
_UNIT = re.compile(r"\s+(?=[\[(][^\W\d]+[\])])")
"""The space in "X [m]", which does not separate columns."""
_AXIS = re.compile(r"([xyz])(\s*[\[(].*[\])]|[\s_/](m|mm|cm|km|ft|in))?", re.IGNORECASE)


def read(path: Path) -> np.ndarray:
    """The points (n, 3), float64. Raises what `jaxreg.io.read_cloud` raises.

    Columns x, y, z if a header names them, also in a comment above the points and with units ("X
    [m]"); without a header the first three. Other columns are ignored. A header that has a name for
    every column, and none of x, y, z, is an error. Other comments are skipped, and so is a first
    line with nothing but the number of points.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ValueError(
            f"{path} is not a text file: give it the suffix of its format, or export it as text."
        ) from None
    numbered = [(number, line) for number, line in enumerate(lines, start=1) if _is_data(line)]
    if not numbered:
        return np.empty((0, 3))
    sample = numbered[min(1, len(numbered) - 1)][1].split("#")[0]
    separator = _separator(sample)
    first = _split(numbered[0][1], separator)
    headed = not _is_number(first[0])
    above = numbered[0][0] - (0 if headed else 1)
    head = [(number, line) for number, line in enumerate(lines[:above], start=1) if line.strip()]
    columns = _columns(path, head, separator, len(_split(sample, separator)))
    if headed or (len(first) == 1 and len(numbered) == int(float(first[0])) + 1):
        numbered = numbered[1:]
    if not numbered:
        return np.empty((0, 3))
    try:
        text = "\n".join(line for _, line in numbered)
        return np.loadtxt(io.StringIO(text), delimiter=separator, usecols=columns, ndmin=2)
    except ValueError:
        raise ValueError(_fault(path, numbered, separator, columns)) from None


def write(path: Path, points: np.ndarray) -> None:
    """One point per line, 12 digits; a CSV file gets the header x,y,z."""
    csv = path.suffix.lower() == ".csv"
    header, delimiter = ("x,y,z", ",") if csv else ("", " ")
    np.savetxt(path, points, fmt="%.12g", delimiter=delimiter, header=header, comments="")


def _is_data(line: str) -> bool:
    stripped = line.strip()
    return bool(stripped) and not stripped.startswith(_COMMENTS)


def _separator(line: str) -> str | None:
    """The separator in the line; None is any run of spaces and tabs."""
    return next((mark for mark in (";", ",") if mark in line), None)


def _split(line: str, separator: str | None) -> list[str]:
    return [field.strip().strip('"') for field in line.strip().split(separator)]


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _columns(path: Path, head: list, separator: str | None, width: int) -> tuple[int, ...]:
    """Which of `width` columns are x, y, z, from the lines above the points, last line first.

    Raises:
      ValueError: a header names columns, but not x, y, z, or more than there are; or it is a line of
        one or two words.
    """
    for _, line in reversed(head):
        for names in _namings(line, separator):
            axes = [_axis(name) for name in names]
            wide = len(names) <= width if _is_data(line) else len(names) == width
            if set("xyz") <= set(axes) and wide:
                return tuple(axes.index(axis) for axis in "xyz")
    for number, line in head:
        names = _split(_joined(line, separator), separator)
        if _is_data(line) and len(names) < 3:
            raise ValueError(
                f"{path}, line {number}: '{' '.join(names)}' is not a point: write x y z on each line."
            )
        if _is_data(line) and len(names) > width and set("xyz") <= set(map(_axis, names)):
            raise ValueError(
                f"{path}, line {number}: the header has {len(names)} names for {width} columns: "
                "separate them as the columns are separated, with no spaces inside a name."
            )
        # A comment is a header only on the first line, and not if it is a remark like "by: me".
        titled = number == head[0][0] and all(_is_name(name) for name in names)
        titled = titled and not _LABEL.match(_joined(line, separator))
        if len(names) == width >= 3 and (_is_data(line) or titled):
            raise ValueError(
                f"{path}, line {number}: the header names the columns {', '.join(names)[:80]}, "
                "not x, y, z: name the columns x, y, z, or remove the header."
            )
    return (0, 1, 2)


def _namings(line: str, separator: str | None) -> list[list[str]]:
    """The names in a line: split as the points are, or as the line itself suggests.

    By tabs first, because a name may then contain spaces ("Point ID").
    """
    text = _LABEL.sub("", _joined(line, separator))
    own = _separator(text)
    by_tabs = [_split(text, "\t")] if "\t" in text and not separator else []
    return [*by_tabs, _split(text, separator), _split(_joined(text, own), own)]


def _joined(line: str, separator: str | None) -> str:
    """A line without its comment mark, and with units joined to names if spaces separate columns."""
    text = line if _is_data(line) else _MARK.sub("", line)
    return text if separator else _UNIT.sub("", text)


def _axis(name: str) -> str:
    match = _AXIS.fullmatch(name)
    return match[1].lower() if match else ""


def _is_name(field: str) -> bool:
    return any(letter.isalpha() for letter in field) and not _is_number(field)


def _fault(path: Path, numbered: list, separator: str | None, columns: tuple[int, ...]) -> str:
    for number, line in numbered:
        fields = _split(line, separator)
        if len(fields) <= max(columns):
            return (
                f"{path}, line {number}: '{line.strip()[:60]}' has {len(fields)} column(s), but a "
                "point needs 3: complete or remove the line."
            )
        bad = [fields[c] for c in columns if not _is_number(fields[c])]
        if bad:
            return (
                f"{path}, line {number}: '{bad[0][:40]}' is not a number: fix or remove the line."
            )
    return f"{path} cannot be read as text with one point per line: export it again."
