"""What people see of a run: tables of results, and its progress with and without a terminal."""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

_SECONDS_BETWEEN_LINES = 20.0


@contextlib.contextmanager
def training_progress(
    total: int, *, console: Console | None = None
) -> Iterator[Callable[[Mapping[str, float]], None]]:
    """Shows a run of `total` steps; call what it yields with the logged entry of every step.

    An entry needs `step` and `loss`; `val_mie_r_deg`, where it stands, is shown as the validation
    error until the next. On a terminal this is a bar with the time left, elsewhere a line now and
    then and at every validation. A resumed run starts the bar, and the clock, at its first step.
    """
    console = console or Console()
    show = _bar if console.is_terminal else _lines
    with show(total, console) as update:
        yield update


@contextlib.contextmanager
def _bar(total: int, console: Console) -> Iterator[Callable[[Mapping[str, float]], None]]:
    columns = (
        MofNCompleteColumn(),
        BarColumn(bar_width=None),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    # The period is long enough that a validation between two steps does not upset the estimate.
    with Progress(*columns, console=console, speed_estimate_period=120) as progress:
        task = progress.add_task("compiling the training step", total=total)
        status = _Status()
        yield lambda entry: progress.update(
            task, completed=int(entry["step"]), description=status.text(entry)
        )


@contextlib.contextmanager
def _lines(total: int, console: Console) -> Iterator[Callable[[Mapping[str, float]], None]]:
    status, begin = _Status(), None
    last = float("-inf")

    def update(entry: Mapping[str, float]) -> None:
        nonlocal begin, last
        now, step, text = time.monotonic(), int(entry["step"]), status.text(entry)
        begin = begin or (now, step)
        if now - last < _SECONDS_BETWEEN_LINES and "val_mie_r_deg" not in entry and step != total:
            return
        last = now
        left = (total - step) * (now - begin[0]) / max(step - begin[1], 1)
        timing = f"  about {left:.0f} s left" if step > begin[1] else ""
        console.print(f"step {step}/{total}  {text}{timing}", highlight=False, soft_wrap=True)

    yield update


class _Status:
    """The running mean of the loss and the last validation error, as text."""

    def __init__(self) -> None:
        self.loss, self.error = None, ""

    def text(self, entry: Mapping[str, float]) -> str:
        loss = entry["loss"]
        self.loss = loss if self.loss is None else 0.95 * self.loss + 0.05 * loss
        if "val_mie_r_deg" in entry:
            self.error = f"  error {entry['val_mie_r_deg']:.3g} deg"
        return f"loss {self.loss:.4g}{self.error}"


@contextlib.contextmanager
def counting_progress(
    total: int, label: str, *, console: Console | None = None
) -> Iterator[Callable[[int], None]]:
    """Shows how many of `total` pairs are done, and at the end how many that was a second.

    Call what it yields with each number of new ones. On a terminal this is a bar with the time left,
    elsewhere a line now and then. The throughput is that of the whole run: compiling, and making the
    pairs, are in it.
    """
    console, begin = console or Console(), time.monotonic()
    show = _counting_bar if console.is_terminal else _counting_lines
    with show(total, label, console) as advance:
        yield advance
    text = f"{label}: {_throughput(total, time.monotonic() - begin)}"
    console.print(text, highlight=False, soft_wrap=True)


def _throughput(pairs: int, seconds: float) -> str:
    return f"{pairs} pairs in {seconds:.1f} s, {pairs / max(seconds, 1e-9):.1f} pairs/s"


@contextlib.contextmanager
def _counting_bar(total: int, label: str, console: Console) -> Iterator[Callable[[int], None]]:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn("pairs, left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(label, total=total)
        yield lambda new: progress.advance(task, new)


@contextlib.contextmanager
def _counting_lines(total: int, label: str, console: Console) -> Iterator[Callable[[int], None]]:
    done, begin = 0, time.monotonic()
    last = begin

    def advance(new: int) -> None:
        nonlocal done, last
        done, now = done + new, time.monotonic()
        if now - last < _SECONDS_BETWEEN_LINES or done >= total:
            return
        last, left = now, (total - done) * (now - begin) / done
        text = f"{label}: {done}/{total}, {_throughput(done, now - begin)}, about {left:.0f} s left"
        console.print(text, highlight=False, soft_wrap=True)

    yield advance
