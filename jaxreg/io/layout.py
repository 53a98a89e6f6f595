"""How a text file lays out its points: what parts the columns, which hold x y z, where they begin."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from jaxreg.io import columns
from jaxreg.io.decoding import number

_SAMPLE = 200
"""Lines of points that the layout is told by."""
_COMMENTS = ("#", "//", "%", "!")
_MARK = re.compile(r"^\s*[#/%!]+")
_LABEL = re.compile(r"^\s*\w+:\s")
"""As in "# columns: x y z"."""
_REMARK = re.compile(r"(?<!\d[.,])#|//")
_UNIT = re.compile(r"\s+(?=[\[(][^\W\d]+[\])])")
"""The blank in "X [m]", which parts no columns."""
_COMMA = re.compile(r"(?<![\d.,])[+-]?\d*,\d+([eE][+-]?\d+)?(?![\d.,])")
_POINT = re.compile(r"[+-]?\d*\.\d+([eE][+-]?\d+)?")
_BOTH = re.compile(r"\d,\d.*,\s")
"""As in "1,5, 2,25"."""
_JOINING = {"from", "by", "of", "for", "the", "with", "in", "at", "to", "and", "is", "are", "on"}
"""Words of a sentence, which stand in no header."""
_FACES = {"f", "vn", "vt"}
_WIDE = 20
"""Three lines of more numbers than this are three coordinates of many points."""
_LABELS = 10
"""From so many rows on whole numbers that are all unlike, beside decimals, are names of points."""
_WHOLE = re.compile(r"[+-]?\d+")
_COUNT = re.compile(r"\d{1,18}")
"""A number that `int` reads: it takes no "²", and no more than some thousands of digits."""


class Layout(NamedTuple):
    """`columns` are those of x, y, z (or x, y alone), `normals` those of a normal.

    `first` is the line of a point. `comma`: the decimal mark is a comma. `separator` None is any run
    of blanks and tabs. `count` is the number of points that a line of its own announces.
    """

    separator: str | None
    comma: bool
    columns: tuple[int, ...]
    normals: tuple[int, int, int] | None
    first: int
    count: int | None


def lines(text: str) -> Iterator[tuple[int, str]]:
    """The lines with their numbers from 1 on, without a list of them all."""
    position, count = 0, 0
    while position < len(text):
        end = text.rfind("\n", position, position + 65536) + 1 or text.find("\n", position) + 1
        end = end or len(text)
        for line in text[position:end].removesuffix("\n").split("\n"):
            count += 1
            yield count, line
        position = end


def is_data(line: str) -> bool:
    """Whether a line is neither blank nor a comment."""
    stripped = line.strip()
    return bool(stripped) and not stripped.startswith(_COMMENTS)


def parted(line: str, separator: str) -> list[str]:
    """The fields of a line as they stand; between quotes a separator parts nothing."""
    if '"' not in line:
        return line.split(separator)
    mark = re.escape(separator)
    field = rf'\s*"(?:[^"]|"")*"\s*(?={mark}|$)|[^{mark}]*'
    return re.findall(rf"(?:^|{mark})({field})", line)


def split(line: str, separator: str | None) -> list[str]:
    """The fields of a line, without blanks and quotes around them."""
    line = line.strip(" \n" if separator else None)
    fields = line.split() if separator is None else parted(line, separator)
    return [field.strip().strip('"') for field in fields]


def is_count(field: str) -> bool:
    """Whether a field is a whole number without a sign."""
    return _COUNT.fullmatch(field) is not None


def uncommented(line: str) -> str:
    """What stands before a remark; the "#" of "1.#QNAN" begins none."""
    return _REMARK.split(line, maxsplit=1)[0]


def recognised(path: Path, text: str) -> Layout | None:
    """The layout of a file; None if it contains no points.

    Raises:
      ValueError: a header names columns, but no coordinates; or what the first columns are is open.
    """
    head, data = _head(text)
    if not data:
        return None
    tail = data[(len(data) + 1) // 2 :] or data  # without what stands above the points
    separator, comma = _separator([line for _, line in tail])
    rows = [split(uncommented(line), separator) for _, line in data]
    start = next((i for i, row in enumerate(rows) if _is_point(row, comma)), None)
    if start is None:
        return _without_points(path, data, rows)
    _check_marks(path, tail, rows[start:], separator, comma)
    while start > 0 and _is_empty_point(rows[start - 1], rows[start], comma):
        start -= 1
    first, width = data[start][0], len(rows[start])
    count = next((int(row[0]) for row in rows[:start] if _announces(row)), None)
    counted = {data[i][0] for i in range(start) if _announces(rows[i])}
    above = [(n, line) for n, line in head if n < first and n not in counted and line.strip()]
    names = _names(path, above, separator, width)
    rows = [row for row in rows[start:] if _is_point(row, comma)]
    if names is not None:
        chosen, across = columns.coordinates(names), columns.normals(names)
        _check_commas(path, above, names, rows, separator)
        _check_row_names(path, above, names, rows)
    else:
        _check_turned(path, first, rows, data)
        chosen = _unnamed(path, first, rows, comma)
        across = _beside(path, rows, chosen, comma)
    return Layout(separator, comma, chosen or (0, 1, 2), across, first, count)


def _head(text: str) -> tuple[list[tuple[int, str]], list[tuple[int, str]]]:
    """All lines down to a sample of points, and which of them are data."""
    head, data = [], []
    for numbered in lines(text):
        head.append(numbered)
        if is_data(numbered[1]):
            data.append(numbered)
        if len(data) == _SAMPLE:
            break
    return head, data


def _separator(sample: list[str]) -> tuple[str | None, bool]:
    """What parts the columns (None: blanks and tabs), and whether the decimal mark is a comma."""
    sample = [uncommented(line) for line in sample]
    body = "\n".join(sample)
    strong = next((mark for mark in (";", "|") if mark in body), None)
    if strong:
        return strong, _decimal_comma(sample, strong)
    comma = _decimal_comma(sample, None) and all(_by_blanks(line) for line in sample)
    if "," in body and not comma:
        return ",", '"' in body and _decimal_comma(sample, ",")
    fields = [line.split("\t") for line in sample]
    alone = all(len(row) > 2 and not any(" " in f.strip() for f in row) for row in fields)
    return ("\t" if alone else None), comma


def _decimal_comma(sample: list[str], separator: str | None) -> bool:
    """Whether fields are numbers with a comma; what others hold, a date or a name, tells nothing."""
    fields = [field for line in sample for field in split(line, separator)]
    if separator is None:  # also where blanks and commas part "1,5, 2"
        fields = [field for field in fields if not field.endswith(",")]
    return any(map(_COMMA.fullmatch, fields)) and not any(map(_POINT.fullmatch, fields))


def _check_marks(
    path: Path,
    tail: list[tuple[int, str]],
    rows: list[list[str]],
    separator: str | None,
    comma: bool,
) -> None:
    """Raises ValueError where numbers have decimal points as well as commas, or commas part both.

    And where the lines are those of an OBJ file.
    """
    if {row[0] for row in rows} & _FACES and any(row[0] == "v" for row in rows):
        raise ValueError(f"{path} has the vertices and faces of an OBJ file: name it '.obj'.")
    fields = [field for row in rows for field in row]
    if separator in (";", "|", "\t") and not comma and any(map(_COMMA.fullmatch, fields)):
        raise ValueError(
            f"{path}, line {tail[0][0]}: some numbers have a decimal comma and some a decimal point: "
            "export the file with one of them."
        )
    plain = [uncommented(line).strip() for _, line in tail]
    both = separator == "," and all(_BOTH.search(line) for line in plain)
    if both and not any(_POINT.fullmatch(field) for field in fields):
        raise ValueError(
            f"{path}, line {tail[0][0]}: commas seem to part the columns and to be the decimal "
            "marks: export the file with decimal points, or with semicolons between the columns."
        )


def _is_empty_point(row: list[str], point: list[str], comma: bool) -> bool:
    """Whether a row above the first point is one of NaN alone: it keeps its place."""
    values = [number(field, comma=comma) for field in row]
    return len(row) == len(point) and None not in values and not any(v == v for v in values)


def _check_row_names(path: Path, above: list, names: list[str], rows: list[list[str]]) -> None:
    """Raises ValueError where a column without a name seems to number the points, as R writes it."""
    label = [row[0] for row in rows]
    if len(names) == len(rows[0]) - 1 and all(map(is_count, label)):
        steps = {int(b) - int(a) for a, b in zip(label, label[1:], strict=False)}
        if steps == {1}:
            raise ValueError(
                f"{path}, line {above[-1][0]}: {len(names)} names stand above {len(rows[0])} columns, "
                "of which the first seems to number the points: give it a name, too."
            )


def _check_turned(path: Path, first: int, rows: list[list[str]], data: list) -> None:
    """Raises ValueError where three lines hold the three coordinates of many points."""
    if len(rows) == len(data) == 3 and len(rows[0]) > _WIDE and len(set(map(len, rows))) == 1:
        raise ValueError(
            f"{path}, line {first}: three lines of {len(rows[0])} numbers each, one point per column: "
            "write one point a line."
        )


def _by_blanks(line: str) -> bool:
    """Whether blanks alone part three numbers or more, their decimal marks commas."""
    fields = line.split()
    return sum(number(field, comma=True) is not None for field in fields) >= 3


def _is_point(row: list[str], comma: bool) -> bool:
    if row[0] == "" and row[1:] == [str(i) for i in range(len(row) - 1)]:
        return False  # the header that pandas gives to columns without names
    return bool(_run([row], comma))


def _run(rows: list[list[str]], comma: bool) -> list[int]:
    """The first three or more neighbouring columns that hold numbers in all these rows."""
    width = min(map(len, rows))
    values = [[number(row[c], comma=comma) for row in rows] for c in range(width)]
    good = [None not in column and any(v == v for v in column) for column in values]
    run: list[int] = []
    for c in [*range(width), None]:
        if c is not None and good[c]:
            run.append(c)
        elif len(run) >= 3:
            return run
        else:
            run = []
    return []


def _announces(row: list[str]) -> bool:
    return len(row) == 1 and is_count(row[0])


def _without_points(path: Path, data: list, rows: list[list[str]]) -> None:
    if len(data) == 1 and columns.coordinates(rows[0]):
        return
    line, fields = data[0][0], rows[0]
    if _COMMA.search(data[-1][1]):
        raise ValueError(
            f"{path}, line {line}: '{data[0][1].strip()[:60]}' is not a point: if commas are decimal "
            "marks here, write all numbers with decimal points."
        )
    if len(fields) < 3:
        raise ValueError(
            f"{path}, line {line}: '{' '.join(fields)[:60]}' is not a point, it has {len(fields)} "
            "column(s): give x y z in a line."
        )
    raise ValueError(
        f"{path}, line {data[-1][0]}: '{data[-1][1].strip()[:60]}' is not a point: write x y z on "
        "each line."
    )


def _names(path: Path, head: list, separator: str | None, width: int) -> list[str] | None:
    """The names of the `width` columns, by the lines above the points, last line first.

    Raises:
      ValueError: a header names columns, but not x, y, z, or more than there are; or it is a line of
        one or two words.
    """
    for _, line in reversed(head):
        for names in _namings(line, separator):
            wide = len(names) <= width if is_data(line) else len(names) == width
            if wide and columns.coordinates(names):
                return names
    for line in head:
        _check_header(path, line, separator, width, first=line is head[0])
    return None


def _check_header(
    path: Path, numbered: tuple[int, str], separator: str | None, width: int, *, first: bool
) -> None:
    """Raises ValueError where a line above the points names columns that are none of x, y, z."""
    where, line = f"{path}, line {numbered[0]}", numbered[1]
    names = split(_joined(line, separator), separator)
    if is_data(line) and columns.geographic(names):
        raise ValueError(
            f"{where}: the columns are longitude and latitude, angles and no lengths: project them "
            "to metres first, to UTM for instance."
        )
    if is_data(line) and len(names) < 3:
        raise ValueError(f"{where}: '{' '.join(names)[:60]}' is not a point: give x y z in a line.")
    if is_data(line) and len(names) > width and columns.coordinates(names):
        raise ValueError(
            f"{where}: the header has {len(names)} names for {width} columns: part them by what "
            "parts the columns, with no blank inside a name."
        )
    # A comment is a header only on the first line, and not if it is a remark like "by: me".
    titled = first and all(_is_name(name) for name in names)
    titled = titled and not _LABEL.match(_joined(line, separator))
    titled = titled and not _JOINING & {name.lower() for name in names}
    if len(names) == width >= 3 and (is_data(line) or titled):
        raise ValueError(
            f"{where}: the header names the columns {', '.join(names)[:80]}, not x, y, z: call "
            "those that hold the coordinates x, y and z in this line."
        )


def _check_commas(
    path: Path, above: list, names: list[str], rows: list[list[str]], separator: str | None
) -> None:
    """Raises ValueError where commas part both the columns and the decimals."""
    doubled = separator == "," and len(rows[0]) == 2 * len(names)
    if doubled and all(_WHOLE.fullmatch(field) for field in rows[0]):
        raise ValueError(
            f"{path}, line {above[-1][0]}: {len(names)} names stand above {len(rows[0])} columns: "
            "the comma seems to be the decimal mark as well as the separator; export the file with "
            "decimal points, or with semicolons between the columns."
        )


def _unnamed(
    path: Path, first: int, rows: list[list[str]], comma: bool
) -> tuple[int, int, int] | None:
    """The first three columns of numbers; labels before them are passed over.

    Raises:
      ValueError: the first of them seems to number the points.
    """
    run = _run(rows, comma)
    if len(run) > 3 and len(rows) > 2:
        label = [row[run[0]] for row in rows]
        others = [[row[c] for row in rows] for c in run[1:4]]
        parts = [sum("." in f or "," in f for f in column) > len(rows) / 2 for column in others]
        unlike = len(label) >= _LABELS and len(set(label)) == len(label)
        if sum(parts) >= 2 and all(map(is_count, label)) and (unlike or _rises(label)):
            raise ValueError(
                f"{path}, line {first}: column {run[0] + 1} seems to number the points ({label[0]}, "
                f"{label[1]}, {label[2]} ...), and no header says so: put a line above the points "
                "that names their columns, as in 'number x y z'; or 'x y z' if it is a coordinate."
            )
    return (run[0], run[1], run[2]) if run else None


def _rises(label: list[str]) -> bool:
    values = list(map(int, label))
    return all(b > a for a, b in zip(values, values[1:], strict=False))


def _beside(
    path: Path, rows: list[list[str]], chosen: tuple[int, int, int] | None, comma: bool
) -> tuple[int, int, int] | None:
    """The three columns after x y z, or after three more (a colour), where they hold unit vectors."""
    width = min(map(len, rows))
    for after in (1, 4):
        if chosen is None or width < chosen[2] + after + 3:
            return None
        three = (chosen[2] + after, chosen[2] + after + 1, chosen[2] + after + 2)
        if all(_is_unit([number(row[c], comma=comma) for c in three]) for row in rows):
            return three
    return None


def _is_unit(vector: list[float | None]) -> bool:
    known = [value for value in vector if value is not None]
    return len(known) == len(vector) and abs(sum(value * value for value in known) - 1) <= 1e-2


def _namings(line: str, separator: str | None) -> list[list[str]]:
    """The names in a line: split as the points are, or as the line itself suggests.

    By tabs first, since blanks may then stand inside a name ("Point ID").
    """
    text = _LABEL.sub("", _joined(line, separator))
    own = next((mark for mark in (";", ",") if mark in text), None)
    by_tabs = [split(text, "\t")] if "\t" in text and separator in (None, "\t") else []
    return [*by_tabs, split(text, separator), split(_joined(text, own), own)]


def _joined(line: str, separator: str | None) -> str:
    """A line without its comment mark, and with units joined to names if blanks part columns."""
    text = line if is_data(line) else _MARK.sub("", line)
    return text if separator else _UNIT.sub("", text)


def _is_name(field: str) -> bool:
    return any(letter.isalpha() for letter in field) and number(field) is None
