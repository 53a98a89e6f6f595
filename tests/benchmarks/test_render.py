"""RESULTS.md holds the numbers that commands wrote, and no others."""

import datetime
import json
import re
from pathlib import Path

import jinja2
import numpy as np
import pytest

from benchmarks import record, render

TEMPLATE = render.TEMPLATE.read_text(encoding="utf-8")
RECORDS = render.load()
ROOT = Path(__file__).parents[2]


def written(folder: Path, name="scans", **changes) -> dict:
    """What `record.write` leaves behind, read again."""
    arguments = {
        "question": "How many?",
        "command": "python -m benchmarks.scans",
        "columns": {"right": "right", "error": "error, deg"},
        "rows": {"jaxreg": {"label": "`register`", "right": 20, "error": 0.86}},
        "folder": folder,
    }
    path = record.write(name, **(arguments | changes))
    return json.loads(path.read_text(encoding="utf-8"))


def test_the_results_are_what_the_template_and_the_records_give():
    assert render.RESULTS.read_text(encoding="utf-8") == render.render(TEMPLATE, RECORDS)


def test_the_results_are_short():
    assert len(render.RESULTS.read_text(encoding="utf-8").splitlines()) <= 150


def test_no_number_of_the_template_was_typed_by_hand():
    assert render.bare_numbers(TEMPLATE) == []


@pytest.mark.parametrize(
    ("typed", "found"),
    [
        ("{{ scans.jaxreg.right }} of 20 pairs", "20"),
        ("the worst is 4.1e-05,", "4.1e-05,"),
        ("a recall of .97", ".97"),
        ("3x faster", "3x"),
        ("{{ 17 }} of them", "17"),
        ("{{ scans.jaxreg.right + 0.5 }}", "0.5"),
        ('{{ "19" }} of them', '"19"'),
        ("`--pairs 20` of 30", "30"),
    ],
)
def test_a_number_typed_by_hand_is_found(typed, found):
    assert render.bare_numbers(TEMPLATE + "\n" + typed) == [(TEMPLATE.count("\n") + 2, found)]


@pytest.mark.parametrize(
    "text",
    [
        "`python -m benchmarks.scans --pairs 20`",
        "[a page](docs/notes/0002-title.md)",
        "Eq. 13 on ModelNet40 and 7Scenes, the 1-NN cloud, float32, Open3D",
        '{{ "%.2f" % scans.jaxreg.error }}',
        '{{ table("scans", columns=["full_1deg"], full_1deg="%.2f") }}',
    ],
)
def test_code_links_names_and_placeholders_are_no_numbers(text):
    assert render.bare_numbers(text) == []


@pytest.mark.parametrize("name", RECORDS)
def test_a_record_has_its_fields(name):
    entry = RECORDS[name]
    assert set(record.FIELDS) <= set(entry)
    assert set(entry) <= {*record.FIELDS, "note", "setting", "transcribed"}
    assert re.fullmatch(r"[0-9a-f]{7,}\+?", entry["commit"])
    datetime.date.fromisoformat(entry["date"])
    assert entry["question"].endswith("?")
    assert all(entry[field] for field in record.FIELDS)
    for row in entry["rows"].values():
        assert set(row) <= {"label", *entry["columns"]}
        assert all(isinstance(row[key], str) for key in TEXTS if row.get(key) is not None)
        cells = [value for key, value in row.items() if key not in TEXTS]
        assert all(value is None or isinstance(value, int | float) for value in cells)
    assert all(isinstance(value, int | float) for value in entry.get("setting", {}).values())


TEXTS = ("label", "budget", "trained_on")
"""What a row says in words."""


def test_every_note_that_is_linked_exists_and_is_in_the_index():
    notes = {path.name for path in (ROOT / "docs/notes").glob("[0-9]*.md")}
    index = (ROOT / "docs/notes/README.md").read_text(encoding="utf-8")
    assert set(re.findall(r"docs/notes/(\d{4}-[\w-]+\.md)", TEMPLATE)) <= notes
    assert set(re.findall(r"\]\((\d{4}-[\w-]+\.md)\)", index)) == notes
    assert len({name[:4] for name in notes}) == len(notes)


def test_written_is_what_was_measured(tmp_path):
    rows = {"jaxreg": {"right": np.int64(20), "error": np.float32(0.5)}, "peer": {"right": None}}
    entry = written(tmp_path, rows=rows, setting={"pairs": 20}, note="One core.")
    assert entry["rows"] == {"jaxreg": {"right": 20, "error": 0.5}, "peer": {"right": None}}
    assert (entry["note"], entry["setting"]) == ("One core.", {"pairs": 20})
    assert entry["date"] == datetime.date.today().isoformat()
    assert re.fullmatch(r"unknown|[0-9a-f]{7,}\+?", entry["commit"])
    assert re.search(r"\S, \d+ cores, \w+, Python 3\.\d+\.\d+, JAX \d", entry["machine"])


def test_rows_that_stay_keep_the_commit_that_made_them():
    """Also where two runs, one after the other, leave them out."""
    first = record.kept({"commit": "aaaaaaa", "note": "Shapes."}, ["icp", "fgr"])
    assert first == "Not made in this run, but at commit aaaaaaa: figures of icp, fgr. Shapes."
    assert record.kept({"commit": "bbbbbbb", "note": first}, ["icp", "fgr"]) == first
    other = record.kept({"commit": "bbbbbbb", "note": first}, ["icp"])
    assert other is not None
    assert other.startswith("Not made in this run, but at commit bbbbbbb: figures of icp. Not made")
    assert record.kept({"commit": "bbbbbbb"}, []) is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rows": {"items": {"right": 1}}}, "'items' cannot be named"),
        ({"rows": {"open3d icp": {"right": 1}}}, "'open3d icp' cannot be named"),
        ({"rows": {"jaxreg": {"wrong": 1}}}, r"values without a column: \['wrong'\]"),
        ({"rows": {"jaxreg": {"error": float("nan")}}}, "JSON compliant"),
    ],
)
def test_what_a_template_cannot_name_is_refused(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        written(tmp_path, **changes)


def test_a_placeholder_is_filled_in_and_a_strange_one_is_an_error(tmp_path):
    records = {"scans": written(tmp_path, setting={"pairs": 20})}
    text = (
        "{{ scans.jaxreg.right }} of {{ scans.setting.pairs }}, {{ '%.1f' % scans.jaxreg.error }}"
    )
    assert render.render(text, records) == "20 of 20, 0.9"
    for wrong in ("{{ scans.peer.right }}", "{{ scans.jaxreg.wrong }}", "{{ speed.jaxreg.ms }}"):
        with pytest.raises(jinja2.UndefinedError):
            render.render(wrong, records)


def test_a_table_shows_the_columns_and_rows_that_are_asked_for(tmp_path):
    rows = {"jaxreg": {"label": "`register`", "right": 20, "error": 1.0}, "peer": {"right": None}}
    entry = written(tmp_path, rows=rows)
    assert render.table(entry, ["right"]).splitlines() == [
        "|  | right |",
        "| --- | --- |",
        "| `register` | 20 |",
        "| peer | - |",
    ]
    assert render.table(entry, rows=["jaxreg"], error="%.2f").endswith("| `register` | 20 | 1.00 |")


@pytest.mark.parametrize(
    ("token", "stands"),
    [("4.1e-05", True), ("4.2e-05", False), ("0.00004", True), ("17", True), ("18", False)]
    + [(".81", True), ("0.807", True), ("0.8", True), ("0.808", False), ("2,468", True)],
)
def test_a_number_stands_where_a_value_rounds_to_it(token, stands):
    assert render.stands(token, [4.13e-05, 17, 0.807, 2468]) is stands


def test_numbers_of_a_readme_that_no_record_has_are_found(tmp_path):
    written(tmp_path)
    page = "20 or 21\n\n| | right |\n|---|---|\n| `--pairs 7` | 20 of 20 |\n| peer | {} |\n"
    assert render.unknown_numbers(page.format(0.9), folder=tmp_path) == []
    assert render.unknown_numbers(page.format(19), folder=tmp_path) == [(6, "19")]
    assert render.table_numbers(page.format(19)) == [(5, "20"), (5, "20"), (6, "19")]


def test_the_values_are_those_of_rows_and_settings(tmp_path):
    written(tmp_path, setting={"pairs": 40})
    written(tmp_path, name="other")
    assert render.values("scans", folder=tmp_path) == [20, 0.86, 40]
    assert render.values(folder=tmp_path) == [20, 0.86, 20, 0.86, 40]


def test_check_tells_a_difference_by_its_status(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(render, "RESULTS", tmp_path / "RESULTS.md")
    monkeypatch.setattr("sys.argv", ["render"])
    render.main()
    monkeypatch.setattr("sys.argv", ["render", "--check"])
    render.main()
    render.RESULTS.write_text(render.RESULTS.read_text().replace("2468", "2469"))
    with pytest.raises(SystemExit, match="1"):
        render.main()
    assert "-| unseen objects | 2469 |" in capsys.readouterr().out
