"""RESULTS.md, from its template and the numbers of benchmarks/results/*.json.

    python -m benchmarks.render            # writes RESULTS.md
    python -m benchmarks.render --check    # status 1, and the difference, where it is out of date

The template holds the sentences; every number in them is a placeholder, `{{ scans.jaxreg.right }}`:
the file, the row, the column. `{{ table("scans") }}` is a table, `{{ source("scans") }}` the line
below it. `bare_numbers` finds a number that was typed by hand.
"""

import dataclasses
import difflib
import functools
import json
import re
import sys
from collections.abc import Iterator, Sequence
from decimal import Decimal
from pathlib import Path

import tyro

from benchmarks.record import FOLDER, Value

TEMPLATE = FOLDER / "RESULTS.template.md"
RESULTS = Path(__file__).parents[1] / "RESULTS.md"

NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d[\d,]*)?\.?\d+(?:e[-+]?\d+)?(?!\w)")
QUOTED = re.compile(r"`[^`]*`|\]\([^)]*\)")
"""Code and the targets of links: what a reader types or follows, no finding."""
NAMES = re.compile(
    r"\b(?:Eqs?\. \d+|7Scenes|ModelNet40|Open3D|SC2-PCR|float32|float64|1-NN|N_c|L_\w+)"
)
"""Names with a digit in them."""


def load(folder: Path = FOLDER) -> dict[str, dict]:
    """The records of a folder by the names of their files."""
    paths = sorted(folder.glob("*.json"))
    return {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in paths}


def values(*names: str, folder: Path = FOLDER) -> list[float]:
    """Every number of the rows and settings of these records, or of all of them."""
    records = load(folder)
    parts = [records[name] for name in names or records]
    cells = [row.values() for part in parts for row in _rows(part).values()]
    return [value for row in cells for value in row if isinstance(value, int | float)]


def number(value: Value, form: str = "%.3g") -> str:
    """A value as it is shown: whole numbers in full, "-" for what was not measured."""
    if value is None:
        return "-"
    return str(value) if isinstance(value, str | int) else form % value


def table(
    record: dict,
    columns: Sequence[str] = (),
    rows: Sequence[str] = (),
    **forms: str,
) -> str:
    """A Markdown table of these columns and rows (none named is all); `forms` are per column."""
    columns, rows = columns or list(record["columns"]), rows or list(record["rows"])
    lines = [["", *(record["columns"][key] for key in columns)], ["---"] * (len(columns) + 1)]
    for key in rows:
        row = record["rows"][key]
        cells = [number(row.get(column), forms.get(column, "%.3g")) for column in columns]
        lines.append([row.get("label", key), *cells])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def source(record: dict) -> str:
    """Where a table comes from, as one line."""
    words = f"`{record['command']}`, commit {record['commit']}, {record['date']}"
    words += ", transcribed" if record.get("transcribed") else ""
    return f"{words}. {record['note']}" if record.get("note") else f"{words}."


def render(template: str, records: dict[str, dict]) -> str:
    """The template with its placeholders filled in.

    Raises:
      jinja2.UndefinedError: where a placeholder names what no record has.
    """
    return _environment(records).from_string(template).render()


def bare_numbers(template: str) -> list[tuple[int, str]]:
    """(line, number) of every number of a template that does not come from a record."""
    found = []
    for line, kind, text in _environment({}).lex(template):
        if kind == "data":
            for offset, part in enumerate(text.split("\n")):
                words = NAMES.sub("", QUOTED.sub("", part))
                found += [(line + offset, token) for token in re.findall(r"\S*\d\S*", words)]
        elif kind in ("integer", "float", "string") and NUMBER.fullmatch(text.strip("\"' ")):
            found.append((line, text))
    return found


def stands(token: str, known: Sequence[float]) -> bool:
    """Whether one of these values, rounded as the token is, gives the token."""
    shown = Decimal(token.replace(",", ""))
    half = Decimal(5).scaleb(int(shown.as_tuple().exponent) - 1)
    return any(abs(Decimal(repr(value)) - shown) <= half for value in known)


def unknown_numbers(markdown: str, *names: str, folder: Path = FOLDER) -> list[tuple[int, str]]:
    """(line, number) of every number in the tables of a page that stands in none of these records.

    For a page without placeholders, such as the README: `assert unknown_numbers(text) == []`.
    """
    known = values(*names, folder=folder)
    return [(line, token) for line, token in table_numbers(markdown) if not stands(token, known)]


def table_numbers(markdown: str) -> list[tuple[int, str]]:
    """(line, number) of every number in the bodies of the tables of a page, code left out."""
    return [
        (line, token)
        for line, text in _table_bodies(markdown)
        for token in NUMBER.findall(NAMES.sub("", QUOTED.sub("", text)))
    ]


def _table_bodies(markdown: str) -> Iterator[tuple[int, str]]:
    """The lines below a `|---|`, numbered from 1."""
    inside = False
    for line, text in enumerate(markdown.splitlines(), 1):
        rule = re.fullmatch(r"\|[\s:|-]+\|", text.strip()) and "-" in text
        inside = text.startswith("|") and (inside or bool(rule))
        if inside and not rule:
            yield line, text


def _rows(record: dict) -> dict[str, dict[str, Value]]:
    return record["rows"] | {"setting": record.get("setting", {})}


def _field(records: dict[str, dict], field: str, name: str) -> str:
    return records[name][field]


def _environment(records: dict[str, dict]):
    import jinja2  # of the extra `dev`; a benchmark that prints a table does without

    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, keep_trailing_newline=True, finalize=number
    )
    environment.globals = {name: _rows(record) for name, record in records.items()} | {
        "table": lambda name, **options: table(records[name], **options),
        "source": lambda name: source(records[name]),
        **{
            field: functools.partial(_field, records, field)
            for field in ("question", "command", "commit", "machine")
        },
    }
    return environment


@dataclasses.dataclass(frozen=True)
class Options:
    """What to do."""

    check: bool = False
    """Write nothing; status 1 and the difference where RESULTS.md is out of date."""


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    template = TEMPLATE.read_text(encoding="utf-8")
    if bare := bare_numbers(template):
        lines = [f"{TEMPLATE.name}:{line}: {token} comes from no record" for line, token in bare]
        sys.exit("\n".join(lines))
    text = render(template, load())
    if not options.check:
        RESULTS.write_text(text, encoding="utf-8")
        return
    written = RESULTS.read_text(encoding="utf-8")
    if written != text:
        parts = (x.splitlines(keepends=True) for x in (written, text))
        sys.stdout.writelines(difflib.unified_diff(*parts, "RESULTS.md", "rendered"))
        sys.exit(1)


if __name__ == "__main__":
    main()
