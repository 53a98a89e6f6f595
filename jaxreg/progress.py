"""The progress of a run: a bar on a terminal, otherwise an occasional line."""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

_SECONDS_BETWEEN_LINES = 20.0

Show = Callable[[int, str, bool], None]
"""Shows how many are done, with a text; True shows it at once."""


@contextlib.contextmanager
def training_progress(
    total: int, *, console: Console | None = None
) -> Iterator[Callable[[Mapping[str, float]], None]]:
    """Shows a run of `total` steps; call what it yields with the logged entry of every step.

    An entry needs `step` and `loss`, whose running mean is shown; `val_mie_r_deg`, if present, is
    shown at once and stays as the validation error until the next. A resumed run starts the bar,
    and the clock, at its first step.
    """
    mean, error = None, ""
    begin = "compiling the training step"
    with _display(total, "step", begin, console or Console()) as show:

        def update(entry: Mapping[str, float]) -> None:
            nonlocal mean, error
            loss, validated = entry["loss"], "val_mie_r_deg" in entry
            mean = loss if mean is None else 0.95 * mean + 0.05 * loss
            if validated:
                error = f"  error {entry['val_mie_r_deg']:.3g} deg"
            step = int(entry["step"])
            show(step, f"loss {mean:.4g}{error}", validated or step == total)

        yield update


@contextlib.contextmanager
def counting_progress(
    total: int, label: str, *, console: Console | None = None
) -> Iterator[Callable[[int], None]]:
    """Shows how many of `total` pairs are done, and at the end how many per second.

    Call what it yields with each number of new ones. The throughput is that of the whole run, with
    compiling and making the pairs.
    """
    console, begin, done = console or Console(), time.monotonic(), 0
    with _display(total, "pairs", label, console) as show:

        def advance(new: int) -> None:
            nonlocal done
            done += new
            show(done, label, False)

        yield advance
    seconds = time.monotonic() - begin
    rate = total / max(seconds, 1e-9)
    text = f"{label}: {total} pairs in {seconds:.1f} s, {rate:.1f} pairs/s"
    console.print(text, highlight=False, soft_wrap=True)


@contextlib.contextmanager
def stage_progress(*, console: Console | None = None) -> Iterator[Callable[[int, int, str], None]]:
    """Shows how many of the wanted are done, and what is being done; both may grow meanwhile.

    A bar on a terminal; elsewhere a line when what is being done changes, and one every 20 seconds.
    """
    console = console or Console(stderr=True, highlight=False)
    if not console.is_terminal:
        yield _stage_lines(console)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeRemainingColumn(), console=console, transient=True) as progress:
        task = progress.add_task("", total=None)
        yield lambda done, wanted, text: progress.update(
            task, completed=done, total=wanted or None, description=text
        )


def _stage_lines(console: Console) -> Callable[[int, int, str], None]:
    last, stage = float("-inf"), ""

    def show(done: int, wanted: int, text: str) -> None:
        nonlocal last, stage
        now, kind = time.monotonic(), text.split()[0]
        if kind != stage or now - last >= _SECONDS_BETWEEN_LINES:
            last, stage = now, kind
            count = f" ({done} of {wanted})" if wanted else ""
            console.print(f"{text}{count}", highlight=False, soft_wrap=True, markup=False)

    return show


def _display(
    total: int, unit: str, text: str, console: Console
) -> contextlib.AbstractContextManager[Show]:
    return _bar(total, text, console) if console.is_terminal else _lines(total, unit, console)


@contextlib.contextmanager
def _bar(total: int, text: str, console: Console) -> Iterator[Show]:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    # The period is long, so a validation between two steps does not upset the estimate.
    with Progress(*columns, console=console, speed_estimate_period=120) as progress:
        task = progress.add_task(text, total=total)
        yield lambda done, text, _: progress.update(task, completed=done, description=text)


@contextlib.contextmanager
def _lines(total: int, unit: str, console: Console) -> Iterator[Show]:
    """The first, those asked for, and one every 20 seconds; with the time left."""
    first, last = None, float("-inf")

    def show(done: int, text: str, at_once: bool) -> None:
        nonlocal first, last
        now = time.monotonic()
        first = first or (now, done)
        if not at_once and now - last < _SECONDS_BETWEEN_LINES:
            return
        last, (begin, before) = now, first
        left = (total - done) * (now - begin) / max(done - before, 1)
        timing = f"  about {left:.0f} s left" if done > before else ""
        line = f"{unit} {done}/{total}  {text}{timing}"
        console.print(line, highlight=False, soft_wrap=True)

    yield show
