"""Is it fast? Time, compile time and memory of the library, against what one would pick instead.

    python -m benchmarks.speed.speed [--parts forward stages ...] [--points 768 1434] [--cores 1]

All figures of a table come from one run in which the candidates take turns, so ratios hold on a
machine that does other work too; the seconds hold on a quiet one only. The candidates are the library
with its released weights, alone and eight pairs at once; the equations as one would first write
them (`benchmarks/paper/transcription.py`), compiled as JAX does by default; and classical registration by
Open3D and small_gicp where the extra `baselines` is installed. Pairs are procedural shapes by the
ModelNet40 protocol: three quarters kept, up to 45 degrees an axis.

`forward`   milliseconds a pair, pairs a second and the error, at every size
`training`  a training step of 768 points, and its gradient alone
`stages`    time and counted arithmetic of every stage, against the machine's matrix product
`programs`  compile time and peak memory of a fresh process for each program
`first`     a fresh process to its first result, with an empty and with a warm compilation cache
`accuracy`  the same evaluation with each optimisation taken away
"""

import dataclasses
import os
import sys
from typing import Literal

import tyro
from rich.console import Console
from rich.table import Table

from benchmarks import record
from benchmarks.paper import accuracy
from benchmarks.speed import candidates, processes, records, stages
from jaxreg.cli.process import restart_with_huge_pages

Part = Literal["forward", "training", "stages", "programs", "first", "accuracy"]
CONSOLE = Console(width=110)


@dataclasses.dataclass(frozen=True)
class Options:
    """What to measure."""

    parts: tuple[Part, ...] = ("forward", "training", "stages", "programs", "first", "accuracy")
    points: tuple[int, ...] = (768, 1434, 2048, 4096)
    """Sizes of the clouds in `forward`; the other parts take the first."""
    batch: int = 8
    """Pairs at once."""
    transcription_points: int = 1434
    """Largest size at which the equations as written are timed too."""
    accuracy_pairs: int = 64
    """Pairs of `accuracy`."""
    rounds: int = 5
    """Timed runs of every candidate."""
    seconds: float = 10.0
    """A candidate that has used up this time is not run again."""
    cores: int = 0
    """Run on so many cores; 0 is all."""
    huge_pages: bool = False
    """Run in memory pages of 2 MB, as train.py does on Linux."""
    record: bool = True
    """Write the tables to benchmarks/results/: `speed` and `sizes` (with --cores 1 `speed_one_core`),
    `stages`, `processes` and `accuracy`."""


def show_registration(points: int, options: Options) -> list[dict]:
    """The table of one size, times in units of the library's beside them; returns its rows."""
    rows, missing = candidates.register(
        points,
        batch=options.batch,
        rounds=options.rounds,
        seconds=options.seconds,
        transcription=points <= options.transcription_points,
    )
    shown = [
        {
            "": row["candidate"],
            "ms/pair (min)": f"{1e3 * row['minimum']:.1f}",
            "median": f"{1e3 * row['median']:.1f}",
            "pairs/s": f"{1 / row['minimum']:.1f}",
            "x first row": f"{row['minimum'] / rows[0]['minimum']:.2f}",
            "median error, deg": f"{row['median_error_deg']:.5f}",
            "worst": f"{row['worst_error_deg']:.5f}",
        }
        for row in rows
    ]
    CONSOLE.print(simple_table(f"registration, {points} points", shown))
    for reason in missing:
        CONSOLE.print(reason, soft_wrap=True)
    return rows


def show_training(options: Options) -> list[dict]:
    """The table of the training step; returns its rows."""
    points, batch = options.points[0], options.batch
    rows = processes.run(
        "train",
        huge_pages=True,
        points=points,
        batch=batch,
        rounds=options.rounds,
        seconds=2 * options.seconds,
    )["rows"]
    shown = [
        {
            "": row["candidate"],
            "ms/pair (min)": f"{1e3 * row['minimum']:.1f}",
            "median": f"{1e3 * row['median']:.1f}",
            "x first row": f"{row['minimum'] / rows[0]['minimum']:.2f}",
        }
        for row in rows
    ]
    CONSOLE.print(simple_table(f"training, {points} points, batch {batch}", shown))
    return rows


def simple_table(title: str, rows: list[dict]) -> Table:
    """A table of rows of equal keys: seconds to two digits, the rest as it is."""
    table = Table(title=title, title_justify="left")
    for number, name in enumerate(rows[0]):
        first = number == 0
        table.add_column(name, justify="left" if first else "right", no_wrap=first)
    for row in rows:
        table.add_row(*(f"{x:.3g}" if isinstance(x, float) else str(x) for x in row.values()))
    return table


def show_stages(options: Options) -> list[dict]:
    """The table of stages; returns its rows, the last of the whole, with their share of the rate."""
    points, batch = options.points[0], options.batch
    rows, whole, rate = stages.measure(points, batch, rounds=options.rounds)
    together = sum(row["seconds"] for row in rows)
    shown = [
        {
            "stage": row["stage"],
            "calls": row["calls"],
            "MFLOP": f"{row['operations'] / 1e6:.0f}",
            "ms/pair": f"{1e3 * row['seconds']:.2f}",
            "share of time": f"{row['seconds'] / together:.0%}",
            "share of matrix rate": f"{row['operations'] / row['seconds'] / rate:.1%}",
        }
        for row in [*rows, whole]
    ]
    title = (
        f"stages, {points} points, batch {batch}: together {1e3 * together:.1f} ms a pair; "
        f"matrix product {rate / 1e9:.0f} GFLOP/s"
    )
    CONSOLE.print(simple_table(title, shown))
    return [row | {"rate": rate} for row in (*rows, whole)]


def first_results(options: Options) -> list[dict]:
    """Seconds from the start of a process to its end, with one result."""
    rows = []
    for task in ("register_pair", "register"):
        for cache, found in zip(
            ("empty", "warm"), processes.first_results(task, points=options.points[0]), strict=True
        ):
            rows.append(
                {
                    "first result": f"jaxreg.{task}",
                    "cache": cache,
                    "process, s": found["process_s"],
                    "import, s": found["import_s"],
                    "result, s": found["result_s"],
                }
            )
    return rows


def programs(options: Options) -> list[dict]:
    """Seconds to compile, and peak memory, of fresh processes that run one program.

    Compiling takes memory too: the last column is the peak of the next process, which finds the
    program in the compilation cache.
    """
    points, batch, rows = options.points[0], options.batch, []
    for program, size, name in (
        ("forward", 1, "jaxreg"),
        ("forward", batch, "jaxreg"),
        ("step", 4, "jaxreg"),
        ("step", batch, "jaxreg"),
        ("forward", batch, "transcription"),
        ("gradient", 4, "transcription"),
    ):
        first, second = processes.first_results(
            "measure",
            cached=True,
            huge_pages=program == "step",
            program=program,
            points=points,
            batch=size,
            implementation=name,
        )
        rows.append(
            {
                "program": f"{name}, {program}, batch {size}",
                "trace, s": first["trace_s"],
                "compile, s": first["compile_s"],
                "peak, MB": round(first["peak_mb"]),
                "before": round(first["before_mb"]),
                "arrays": round(first["temporary_mb"]),
                "peak, warm": round(second["peak_mb"]),
            }
        )
    return rows


def show_accuracy(options: Options) -> list[dict]:
    """The table of variants; returns its rows."""
    rows = accuracy.measure(options.points[0], options.batch, options.accuracy_pairs)
    shown = [
        {
            "": row["variant"],
            "dtype": row["dtype"],
            "MAE(R), deg": f"{row['mae_r_deg']:.2e}",
            "worst": f"{row['worst_deg']:.2e}",
            "MAE(R) - first": f"{row['difference_deg']:+.1e}",
            "farthest from it": f"{row['apart_deg']:.1e}",
        }
        for row in rows
    ]
    title = f"accuracy, {options.points[0]} points, {options.accuracy_pairs} pairs"
    CONSOLE.print(simple_table(title, shown))
    return rows


def confine(cores: int) -> None:
    """Start again on the first `cores` cores: XLA and OpenMP count the cores once, as they start."""
    allowed = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_setaffinity") else []
    if not allowed:
        sys.exit("--cores needs Linux: start the benchmark on fewer cores by other means.")
    if len(allowed) > cores:
        os.sched_setaffinity(0, allowed[:cores])
        os.execv(sys.executable, sys.orig_argv)


def main() -> None:
    """Measure the parts that are asked for, print their tables, write them."""
    options = tyro.cli(Options, description=__doc__)
    if options.huge_pages:
        restart_with_huge_pages()
    if options.cores:
        confine(options.cores)
    CONSOLE.print(f"{record.machine()}, seconds of the fastest run")
    results = measure(options)
    if options.record:
        for path in records.write(results, options):
            CONSOLE.print(str(path))


def measure(options: Options) -> dict[str, list]:
    """The rows of every part, which are printed on the way."""
    results: dict[str, list] = {}
    if "forward" in options.parts:
        results["forward"] = [show_registration(n, options) for n in options.points]
    if "training" in options.parts:
        results["training"] = show_training(options)
    if "stages" in options.parts:
        results["stages"] = show_stages(options)
    for part, title, run in (
        ("programs", "compile time and memory of a fresh process", programs),
        ("first", "a fresh process to its first result", first_results),
    ):
        if part in options.parts:
            rows = results[part] = run(options)
            CONSOLE.print(simple_table(f"{title}, {options.points[0]} points", rows))
    if "accuracy" in options.parts:
        results["accuracy"] = show_accuracy(options)
    return results


if __name__ == "__main__":
    main()
