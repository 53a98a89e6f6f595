"""The README's blocks run as they stand, in Python and in the shell, and print what they say."""

import json
import re
from decimal import Decimal
from pathlib import Path

import pytest

from jaxreg.cli import process
from tests.pages import compare, run_blocks

pytestmark = [pytest.mark.float32, pytest.mark.loose]

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def test_blocks_print_what_they_say(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(process, "enable_compilation_cache", lambda **_: None)
    ran = []
    for match, printed in run_blocks(TEXT):
        if printed is not None:
            assert match[3], f"a block without its output: {match[2]}"
            compare(match[3], printed)
            ran.append(match[1])
    assert ran.count("python") >= 3
    assert "sh" in ran


def tables(heading: str) -> list[list[list[str]]]:
    """The tables of a section, without their heads: rows of cells."""
    section = TEXT.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    found = re.findall(r"(?:^\|.*\n)+", section, re.MULTILINE)
    return [
        [[cell.strip() for cell in row.strip("|").split("|")] for row in block.splitlines()[2:]]
        for block in found
    ]


def measured(name: str) -> dict[str, dict]:
    """The rows of benchmarks/results/NAME.json by what RESULTS.md calls them."""
    record = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return {row.get("label", key): row for key, row in record["rows"].items()}


def is_shown_as(value: float, text: str) -> bool:
    """Whether `text` is the value rounded to as many digits as it has."""
    last_digit = Decimal(1).scaleb(Decimal(text).as_tuple().exponent)
    return 2 * abs(Decimal(str(value)) - Decimal(text)) <= last_digit


def test_numbers_of_the_paper_are_those_measured():
    rows = tables("Results")[0]
    assert len(rows) == 3
    columns = ("pairs", "network_mae_r", "paper", "network_worst", "network_recall")
    for label, *cells in rows:
        row = measured("paper")[label]
        for cell, column in zip(cells, columns, strict=True):
            assert is_shown_as(row[column], cell), f"{label}, {column}: {row[column]}"


def test_all_methods_for_two_scans_stand_with_what_they_reached():
    shown = {label: int(right) for label, right in tables("Results")[1]}
    assert shown == {label: row["full_right"] for label, row in measured("scans").items()}


def test_limits_are_those_measured():
    limits = TEXT.partition("\n## Limits\n")[2].partition("\n## ")[0]
    crops = measured("protocols")
    for percent in ("70", "50"):
        text = re.search(rf"(0\.\d+) of (?:the crops|those) of {percent} %", limits)[1]
        assert is_shown_as(crops[f"crops of {percent} %"]["mean_5deg"], text), text
    ends = measured("verdict")["ModelNet40: two ends of one shape"]
    assert f"in {ends['wrong_called_success']} of {ends['pairs']} pairs" in limits


@pytest.mark.parametrize(("value", "text", "yes"), [
    (4.13e-05, "4.1e-05", True), (4.16e-05, "4.1e-05", False), (0.442, "0.44", True),
    (2468, "2468", True), (0.495, "0.50", True), (0.48, "0.50", False),
])  # fmt: skip
def test_numbers_are_compared_by_rounding(value, text, yes):
    assert is_shown_as(value, text) == yes


def test_every_file_that_is_named_exists():
    named = re.findall(r"\]\((?!https?:)([^)]+)\)", TEXT) + re.findall(r"configs/\w+\.toml", TEXT)
    assert len(named) > 4
    assert [name for name in named if not (ROOT / name.partition("#")[0]).exists()] == []


def test_it_is_short():
    assert len(TEXT.split()) <= 900
