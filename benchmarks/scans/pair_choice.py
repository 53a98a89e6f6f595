"""Which pairs of many scans are worth a registration: what a choice by likeness finds, and what it costs.

    python -m benchmarks.scans.pair_choice [--data-root DATA]

`register_many` tries each scan first with the few that look most like it, by descriptors that it has
anyway. With ever more partners: the share of all pairs that are tried, the share found of the pairs that
overlap by .3 in truth, and the share of the scans that hang together by them.
"""

import dataclasses

import numpy as np
import tyro

from benchmarks import record
from benchmarks.scans import building, sequences
from jaxreg.cli import process
from jaxreg.data import data_root
from jaxreg.graph.trees import components
from jaxreg.scans import proposals
from jaxreg.scans.prepare import Prepared, prepare

SEQUENCES = {"balm": "lidar", "bunny_turntable": "turntable", "redkitchen_frames": "frames"}
PARTNERS = (1, 2, 3, 4, 6, 8, 12, 16)
_OVERLAP = 0.3


def measured(clouds: list[Prepared], poses: np.ndarray, own: np.ndarray) -> dict[int, dict]:
    """Cost, recall and connection by the number of partners; scans that are `own` are of one place."""
    truth = proposals.overlaps(clouds, {int(k): poses[k] for k in np.flatnonzero(own)})
    wanted = {pair for pair, share in truth.items() if share >= _OVERLAP}
    alike, count = proposals.likeness(clouds), len(clouds)
    found = {}
    for most in PARTNERS:
        tried = proposals.most_alike(alike, most)
        good = np.array(sorted(tried & wanted)).reshape(-1, 2)
        label = components(count, good[:, 0], good[:, 1])[own]
        found[most] = {
            "cost": len(tried) / (count * (count - 1) / 2),
            "recall": len(good) / len(wanted),
            "connected": float(np.bincount(label).max() / own.sum()),
        }
    return found


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    data_root: str | None = None
    record: bool = True
    """Write benchmarks/results/pair_choice.json."""


def main(options: Options) -> None:
    """Print a line for every place and number of partners, and write the table."""
    process.enable_compilation_cache(least_seconds=0.0)
    walked = building.walk(100, 10, 8000)
    places = {"building": (walked.clouds, walked.truth, ~walked.foreign)}
    root = data_root(options.data_root)
    for name, label in SEQUENCES.items() if root is not None else ():
        if (found := sequences.sequence(root, name)) is not None:
            places[label] = (found.clouds, found.truth, np.ones(len(found.clouds), bool))
    rows: dict[str, dict] = {f"partners_{most}": {"label": str(most)} for most in PARTNERS}
    columns = {}
    for label, (clouds, poses, own) in places.items():
        curve = measured([prepare(cloud) for cloud in clouds], poses, own)
        columns |= {f"{label}_{key}": f"{label} ({len(own)} scans): {key}" for key in curve[1]}
        for most, values in curve.items():
            rows[f"partners_{most}"] |= {f"{label}_{key}": x for key, x in values.items()}
            print(label, most, values, flush=True)
    if options.record:
        record.write(
            "pair_choice",
            question="How many of the overlapping pairs does a choice by likeness find?",
            command=record.command("benchmarks.scans.pair_choice"),
            columns=columns,
            rows=rows,
            setting={"overlap": _OVERLAP},
        )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
