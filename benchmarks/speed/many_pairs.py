"""Ten thousand pairs in a stream: resident memory, pairs a second, and programs compiled.

    python -m benchmarks.speed.many_pairs [--pairs 10000] [--picture many_pairs.png]

`register_batch` gets pairs of ragged sizes, drawn as they are read; `register` gets scans of procedural
shapes from the threads of an executor, a few pairs in flight. Each has a process of its own. Memory is
read at points of the stream that are evenly spaced: what grows with the number of pairs shows there.
"""

import dataclasses
from pathlib import Path

import matplotlib.pyplot as plt
import tyro

from benchmarks import record
from benchmarks.speed import processes

KINDS = {"register_batch": "`register_batch`", "executor": "`register` over an executor"}


@dataclasses.dataclass(frozen=True)
class Options:
    """What to measure."""

    pairs: int = 10_000
    """Pairs of `register_batch`."""
    scans: int = 500
    """Pairs of `register`, whose scans are larger."""
    points: tuple[int, int] = (200, 256)
    """Fewest and most points of a cloud of `register_batch`."""
    scan_points: tuple[int, int] = (300, 500)
    """The same of a scan of `register`."""
    picture: str = ""
    """Draw memory against pairs to this PNG file."""
    record: bool = True
    """Write the table to benchmarks/results/."""


def summary(curve: list[list[float]]) -> dict[str, float]:
    """The end of a curve of (pairs, seconds, MB), and what grew over its second half.

    The first half is left out: there the C library's heap and JAX's caches fill up.
    """
    half = curve[len(curve) // 2]
    (first, start, _), (pairs, seconds, resident) = curve[0], curve[-1]
    return {
        "pairs": round(pairs),
        "ms": 1e3 * (seconds - start) / (pairs - first),
        "first": round(curve[0][2]),
        "half": round(half[2]),
        "last": round(resident),
        "grown": round(resident - half[2], 1),
    }


def draw(curves: dict[str, list], path: str) -> None:
    """Resident memory against pairs done."""
    figure, axis = plt.subplots(figsize=(6, 3), layout="constrained")
    for kind, curve in curves.items():
        axis.plot([x[0] for x in curve], [x[2] for x in curve], label=KINDS[kind].replace("`", ""))
    axis.set(xlabel="pairs done", ylabel="resident memory, MB", ylim=(0, None))
    axis.grid(alpha=0.3)
    axis.legend()
    figure.savefig(path, dpi=120)


def write(found: dict[str, dict]) -> Path:
    """The record `many_pairs`: a row each, and the curves as numbers of the setting."""
    rows = {
        kind: {"label": KINDS[kind], **summary(told["curve"]), "programs": told["programs"]}
        for kind, told in found.items()
    }
    setting = {
        f"{kind}_mb_at_{round(pairs)}": round(mb)
        for kind, told in found.items()
        for pairs, _, mb in told["curve"]
    }
    return record.write(
        "many_pairs",
        question="What do ten thousand pairs take?",
        command=record.command("benchmarks.speed.many_pairs"),
        columns={
            "pairs": "pairs",
            "ms": "ms a pair",
            "first": "MB after the first pairs",
            "half": "MB at half",
            "last": "MB at the end",
            "grown": "MB grown over the second half",
            "programs": "programs compiled",
        },
        rows=rows,
        setting=setting,
    )


def main() -> None:
    """Both kinds, one after the other."""
    options = tyro.cli(Options, description=__doc__)
    found = {}
    for kind, pairs, points in (
        ("register_batch", options.pairs, options.points),
        ("executor", options.scans, options.scan_points),
    ):
        found[kind] = processes.run("stream", kind=kind, pairs=pairs, points=points)
        print(kind, summary(found[kind]["curve"]), found[kind]["programs"], flush=True)
    if options.picture:
        draw({kind: told["curve"] for kind, told in found.items()}, options.picture)
    if options.record:
        print(write(found))


if __name__ == "__main__":
    main()
