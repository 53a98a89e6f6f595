"""Text with a point a line: XYZ, TXT, CSV; separated by blanks, tabs, commas or semicolons."""

import io
from pathlib import Path

import numpy as np

_COMMENTS = ("#", "//")


def read(path: Path) -> np.ndarray:
    """The points (n, 3), float64. Errors as `jaxreg.io.read_cloud`.

    Columns x, y, z where a header names them, else the first three; other columns are not read.
    A first line with nothing but the number of points is skipped.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ValueError(
            f"{path} is no text file: give it the suffix of its format, or export it as text."
        ) from None
    numbered = [(number, line) for number, line in enumerate(lines, start=1) if _is_data(line)]
    if not numbered:
        return np.empty((0, 3))
    separator = _separator(numbered[min(1, len(numbered) - 1)][1])
    columns = (0, 1, 2)
    first = _split(numbered[0][1], separator)
    if not _is_number(first[0]):
        columns = _named_columns(first, path)
        numbered = numbered[1:]
    elif len(first) == 1 and len(numbered) == int(float(first[0])) + 1:
        numbered = numbered[1:]
    if not numbered:
        return np.empty((0, 3))
    try:
        text = "\n".join(line for _, line in numbered)
        return np.loadtxt(io.StringIO(text), delimiter=separator, usecols=columns, ndmin=2)
    except ValueError:
        raise ValueError(_fault(path, numbered, separator, columns)) from None


def write(path: Path, points: np.ndarray) -> None:
    """A point a line, 12 digits; a CSV file gets the header x,y,z."""
    csv = path.suffix.lower() == ".csv"
    header, delimiter = ("x,y,z", ",") if csv else ("", " ")
    np.savetxt(path, points, fmt="%.12g", delimiter=delimiter, header=header, comments="")


def _is_data(line: str) -> bool:
    stripped = line.strip()
    return bool(stripped) and not stripped.startswith(_COMMENTS)


def _separator(line: str) -> str | None:
    """The one that the line holds; None is any run of blanks and tabs."""
    return next((mark for mark in (";", ",") if mark in line), None)


def _split(line: str, separator: str | None) -> list[str]:
    return [field.strip().strip('"') for field in line.strip().split(separator)]


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _named_columns(names: list[str], path: Path) -> tuple[int, ...]:
    """Where x, y, z stand in a header, or the first three where it does not name them."""
    lower = [name.lower() for name in names]
    if set("xyz") <= set(lower):
        return tuple(lower.index(axis) for axis in "xyz")
    if len(names) < 3:
        raise ValueError(f"{path}, line 1: '{' '.join(names)}' is no point: give x y z in a line.")
    return (0, 1, 2)


def _fault(path: Path, numbered: list, separator: str | None, columns: tuple[int, ...]) -> str:
    for number, line in numbered:
        fields = _split(line, separator)
        if len(fields) <= max(columns):
            return (
                f"{path}, line {number}: '{line.strip()[:60]}' has {len(fields)} column(s), and a "
                "point needs 3: complete or remove the line."
            )
        bad = [fields[c] for c in columns if not _is_number(fields[c])]
        if bad:
            return f"{path}, line {number}: '{bad[0][:40]}' is no number: mend or remove the line."
    return f"{path} cannot be read as text with a point a line: export it again."
