"""A later call of `jaxreg.register` on two scans of 50,000 points, and what a user would pick instead.

    python -m benchmarks.speed.second_call [--old CHECKOUT] [--rounds 5]

Fragments of 7Scenes *redkitchen* that overlap by half or more, thinned or filled to 50,000 points and
turned. Prepared clouds and arrays by this library, arrays by an older checkout of it, and Open3D's
RANSAC + ICP at the voxel size that suits these scans take turns, each in fresh processes, since which of
two processes is the quicker one is partly chance (docs/notes/0055). A process counts with the least of
ten calls on each pair. Ratios are within a round. By the clock, since all use all cores.
"""

import dataclasses
import json
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
import tyro
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from benchmarks import record
from benchmarks.scans import red_kitchen
from benchmarks.speed import processes
from jaxreg.data import data_root

_POINTS = 50_000
_AROUND = 7
_LABELS = {
    "prepared": "`jaxreg.register`, prepared clouds",
    "arrays": "`jaxreg.register`, arrays",
    "old": "the older checkout, arrays",
    "open3d": "Open3D FPFH + RANSAC + ICP",
}
COLUMNS = {
    "s": "s, median of the pairs",
    "s_max": "s, longest pair",
    "of_open3d": "of Open3D's time, median",
    "of_open3d_max": "of Open3D's time, longest pair",
    "of_old": "of the older checkout's time, median",
    "of_old_max": "of the older checkout's time, longest pair",
}


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    old: Path | None = None
    """An older checkout of this project; none: the others only."""
    rounds: int = 5
    """Fresh processes of each."""
    pairs: int = 5
    data_root: str | None = None
    record: bool = True
    """Write the table to benchmarks/results/."""


def filled(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """As many points as asked for: some of them, or all and others between one and a neighbour."""
    rows = rng.permutation(len(points))[:_POINTS]
    some = rng.integers(len(points), size=_POINTS - len(rows))
    near = cKDTree(points).query(points[some], k=_AROUND)[1]
    other = near[np.arange(len(some)), rng.integers(1, _AROUND, size=len(some))]
    along = rng.uniform(size=(len(some), 1))
    return np.concatenate([points[rows], points[some] + along * (points[other] - points[some])])


def write_pairs(path: Path, options: Options) -> None:
    """The clouds of all pairs, for every process the same."""
    folder = Path(data_root(options.data_root)) / "7scene" / "7-scenes-redkitchen"
    cases = red_kitchen.read_cases(folder, "full", red_kitchen.Options(pairs=options.pairs))
    rng = np.random.default_rng(0)
    np.savez(path, *(filled(x, rng) for case in cases for x in (case.source, case.reference)))


def seconds(kind: str, path: Path, root: Path) -> list[float]:
    """Of the quickest call on each pair, in a fresh process of a checkout.

    Raises:
      RuntimeError: the process failed; the message ends with what it wrote.
    """
    script = Path(__file__).with_name("calls.py")
    command = [sys.executable, "-P", str(script), kind, str(path)]
    environment = os.environ | {"PYTHONPATH": str(root.resolve())}
    done = processes.finished(command, environment=environment)
    return json.loads(done.output.splitlines()[-1])


def rows(taken: dict[str, list[list[float]]]) -> dict[str, dict[str, str | float]]:
    """The cells of every kind, from its seconds by round and pair: medians over the rounds first."""
    times = {kind: np.array(rounds) for kind, rounds in taken.items()}

    def ratios(kind: str, to: str) -> dict[str, float]:
        if to not in times or to == kind:
            return {}
        of_pairs = np.median(times[kind] / times[to], axis=0)
        return {f"of_{to}": float(np.median(of_pairs)), f"of_{to}_max": float(of_pairs.max())}

    def cells(kind: str) -> dict[str, str | float]:
        of_pairs = np.median(times[kind], axis=0)
        return {
            "label": _LABELS[kind],
            "s": float(np.median(of_pairs)),
            "s_max": float(of_pairs.max()),
            **ratios(kind, "open3d"),
            **ratios(kind, "old"),
        }

    return {kind: cells(kind) for kind in taken}


def main(options: Options) -> None:
    """Takes turns, prints every round, and the table."""
    kinds = {"prepared": processes.ROOT, "arrays": processes.ROOT, "open3d": processes.ROOT}
    if options.old is not None:
        kinds["old"] = options.old
    taken = {kind: [] for kind in kinds}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clouds.npz"
        write_pairs(path, options)
        for _ in range(options.rounds):
            for kind, root in kinds.items():
                function = "arrays" if kind == "old" else kind
                taken[kind].append(seconds(function, path, root))
            print({k: [f"{x:.3f}" for x in rounds[-1]] for k, rounds in taken.items()}, flush=True)
    table = rows(taken)
    for cells in table.values():
        print(cells)
    if options.record:
        record.write(
            "second_call",
            question="How long does a later call on two scans of 50,000 points take?",
            command=record.command("benchmarks.speed.second_call"),
            columns=COLUMNS,
            rows=table,
            setting={"points": _POINTS, "rounds": options.rounds, "pairs": options.pairs},
        )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
