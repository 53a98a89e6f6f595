"""Time and memory of one registration against the size of the clouds, as a picture and a table.

    python -m benchmarks.speed.scaling [--points 256 512 ...] [--limit-mb 6000] [--picture scaling.png]

Every size has a process of its own, so that its peak of memory is its own too. A size whose program
says that it needs more than the limit is not run, and the table says what it would need. The last
line gives the exponent b of ``time = a N^b`` from 1024 points on; 2 is what N x N maps must cost.
"""

import dataclasses
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import tyro

from benchmarks import record
from benchmarks.speed import processes

_FROM = 1024


@dataclasses.dataclass(frozen=True)
class Options:
    """What to measure."""

    points: tuple[int, ...] = (256, 512, 768, 1024, 1434, 2048, 4096, 8192, 16384)
    """Sizes: N points in the source, N in the reference."""
    rounds: int = 3
    """Timed runs of every size; the fastest counts."""
    limit_mb: float = 6000.0
    """Sizes that need more memory than this are left out."""
    picture: str = ""
    """Draw the curves to this PNG file."""
    record: bool = True
    """Write the table to benchmarks/results/."""


def measure(points: int, options: Options) -> dict:
    """One size: what `processes.measure` finds, or what stood in the way."""
    try:
        found = processes.run(
            "measure",
            program="forward",
            points=points,
            batch=1,
            rounds=options.rounds,
            limit_mb=options.limit_mb,
        )
    except RuntimeError as error:
        found = {"failure": str(error).splitlines()[-1]}
    return found | {"points": points}


def line(found: dict) -> str:
    """A row of the table, in Markdown."""
    if "seconds" not in found:
        reason = found.get("failure") or f"needs {found['needs_mb']:.0f} MB, more than the limit"
        return f"| {found['points']} | {reason} | | | |"
    return (
        f"| {found['points']} | {1e3 * found['seconds']:.1f} | {found['peak_mb']:.0f} "
        f"| {found['temporary_mb']:.0f} | {found['trace_s'] + found['compile_s']:.1f} |"
    )


def exponent(points: list[int], values: list[float]) -> float:
    """The exponent b of ``value = a points^b`` by least squares on the logarithms."""
    return float(np.polyfit(np.log(points), np.log(values), 1)[0])


def exponents(rows: list[dict]) -> dict[str, float]:
    """Those of time and of the program's own memory; none where fewer than two sizes are large."""
    large = [row for row in rows if row["points"] >= _FROM]
    if len(large) < 2:
        return {}
    points = [row["points"] for row in large]
    return {
        f"{name}_exponent": exponent(points, [row[key] for row in large])
        for name, key in (("time", "seconds"), ("memory", "temporary_mb"))
    }


def summary(rows: list[dict]) -> str:
    """The exponents as a sentence."""
    found = exponents(rows)
    if not found:
        return f"No exponent: fewer than two sizes from {_FROM} points on."
    return (
        f"From {_FROM} points on, time grows as N^{found['time_exponent']:.2f} and the memory of the "
        f"program's own arrays as N^{found['memory_exponent']:.2f}."
    )


def write(rows: list[dict]) -> Path:
    """The record `scaling`: a row a size."""
    table = {
        f"n{row['points']}": {
            "label": f"{row['points']} points",
            "ms": 1e3 * row["seconds"],
            "peak": round(row["peak_mb"]),
            "arrays": round(row["temporary_mb"]),
            "compile": row["trace_s"] + row["compile_s"],
        }
        for row in rows
    }
    rounded = {key: round(value, 2) for key, value in exponents(rows).items()}
    return record.write(
        "scaling",
        question="How do time and memory grow?",
        command=record.command("benchmarks.speed.scaling"),
        columns={
            "ms": "ms a pair",
            "peak": "peak memory of the process, MB",
            "arrays": "arrays, MB",
            "compile": "compile, s",
        },
        rows=table,
        setting=rounded | {"from_points": _FROM},
    )


def draw(rows: list[dict], path: str) -> None:
    """Both curves on logarithmic axes, with a line of slope 2 through the last size."""
    figure, axes = plt.subplots(1, 2, figsize=(8, 3.4), layout="constrained")
    points = np.array([row["points"] for row in rows])
    panels = {
        "ms a pair": {"time": [1e3 * row["seconds"] for row in rows]},
        "MB": {
            "peak of the process": [row["peak_mb"] for row in rows],
            "arrays of the program": [row["temporary_mb"] for row in rows],
        },
    }
    for axis, (label, curves) in zip(axes, panels.items(), strict=True):
        for name, values in curves.items():
            axis.loglog(points, values, marker="o", label=name)
        last = next(reversed(curves.values()))[-1]
        axis.loglog(points, last * (points / points[-1]) ** 2, "k:", label="slope 2")
        axis.set(xlabel="points in each cloud", ylabel=label)
        axis.set_xticks(points[::2], [str(n) for n in points[::2]])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
        axis.legend()
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def main() -> None:
    """Measure every size, print the table as it grows, write it, draw the picture if asked."""
    options = tyro.cli(Options, description=__doc__)
    print("| points | ms a pair | peak memory, MB | arrays of the program, MB | compile, s |")
    print("|---|---|---|---|---|")
    rows = []
    for points in options.points:
        found = measure(points, options)
        print(line(found), flush=True)
        if "seconds" in found:
            rows.append(found)
    print(summary(rows))
    if options.picture and rows:
        draw(rows, options.picture)
    if options.record:
        print(write(rows))


if __name__ == "__main__":
    main()
