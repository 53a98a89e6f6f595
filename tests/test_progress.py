"""Tables, and the progress of a run with and without a terminal."""

import io

import numpy as np
from rich.console import Console

from jaxreg import progress
from jaxreg.evaluation import table

RESULT = {
    "method": "icp",
    "pairs": 256,
    "mae_r_deg": 0.00123,
    "mie_r_deg_float32_acos": 0.0195,
    "recall_1deg": 1.0,
    "seconds_per_pair": None,
}


def text_of(results, title=None) -> str:
    console = Console(file=io.StringIO(), width=120)
    console.print(table.results_table(results, title=title))
    return console.file.getvalue()


def test_one_result_is_a_row_a_metric():
    text = text_of([RESULT], title="unseen objects")
    lines = [line for line in text.splitlines() if "MAE(R)" in line]
    assert len(lines) == 1
    assert "0.00123" in lines[0]
    assert "unseen objects" in text
    assert "icp" in text
    assert "s / pair" not in text, "a metric that no result has is left out"


def test_several_results_are_a_row_each_and_gaps_are_shown():
    text = text_of([RESULT, RESULT | {"method": "x", "seconds_per_pair": 2}])
    rows = [line for line in text.splitlines() if "256" in line]
    assert len(rows) == 2
    assert "icp" in rows[0]
    assert " - " in rows[0]
    assert "2.0000" in rows[1]


def run(console, entries, total):
    with progress.training_progress(total, console=console) as update:
        for entry in entries:
            update(entry)
    return console.file.getvalue()


def test_without_a_terminal_there_is_a_line_at_the_start_each_validation_and_the_end():
    entries = [{"step": step, "loss": 2.0} for step in range(1, 101)]
    entries[49]["val_mie_r_deg"] = 0.125
    lines = run(Console(file=io.StringIO(), width=40), entries, 100).splitlines()
    assert [line.split()[1] for line in lines] == ["1/100", "50/100", "100/100"]
    assert "error" not in lines[0]
    assert "left" not in lines[0], "one step says nothing of the time of a step"
    assert "error 0.125 deg" in lines[1]
    assert "left" in lines[1]
    assert "error 0.125 deg" in lines[2], "the last known error stays"


def test_without_a_terminal_there_is_a_line_every_twenty_seconds(monkeypatch):
    clock = iter(np.arange(0, 1000, 7.0))
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(clock)))
    # A resumed run: its clock starts at step 91.
    entries = [{"step": step, "loss": 2.0} for step in range(91, 101)]
    lines = run(Console(file=io.StringIO(), width=40), entries, 100).splitlines()
    assert [line.split()[1] for line in lines] == ["91/100", "94/100", "97/100", "100/100"]
    assert "about 42 s left" in lines[1], "7 s a step"


def test_on_a_terminal_there_is_a_bar_with_loss_error_and_time():
    console = Console(file=io.StringIO(), width=100, force_terminal=True, color_system=None)
    entries = [{"step": step, "loss": 2.0, "val_mie_r_deg": 0.5} for step in range(51, 101)]
    text = run(console, entries, 100)
    for part in ("compiling", "100/100", "loss 2", "error 0.5 deg", "left", "0:00:0"):
        assert part in text


def test_the_loss_shown_is_a_running_mean():
    entries = [{"step": 1, "loss": 1.0}, {"step": 2, "loss": 2.0}]
    lines = run(Console(file=io.StringIO()), entries, 2).splitlines()
    assert "loss 1.05" in lines[1]


def count(console, parts, total, monkeypatch, seconds_a_part):
    clock = iter(range(0, 10**6, seconds_a_part))
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(clock)))
    with progress.counting_progress(total, "icp", console=console) as advance:
        for part in parts:
            advance(part)
    return console.file.getvalue().splitlines()


def test_counting_without_a_terminal_prints_lines_and_the_throughput(monkeypatch):
    console = Console(file=io.StringIO(), width=40)
    # The clock is read at the start, at every part, and at the end.
    lines = count(console, [8, 8, 8, 4], 28, monkeypatch, seconds_a_part=15)
    assert [line.split()[1] for line in lines[:-1]] == ["8/28", "24/28"]
    # 16 pairs in 30 s after the first part, so 4 in 7.5.
    assert lines[1] == "pairs 24/28  icp  about 8 s left"
    assert lines[-1] == "icp: 28 pairs in 75.0 s, 0.4 pairs/s"


def test_counting_on_a_terminal_is_a_bar_and_the_throughput_stays():
    console = Console(file=io.StringIO(), width=100, force_terminal=True, color_system=None)
    with progress.counting_progress(12, "icp", console=console) as advance:
        for part in (8, 4):
            advance(part)
    text = console.file.getvalue()
    assert "12/12" in text
    assert "icp: 12 pairs in" in text.splitlines()[-1]
