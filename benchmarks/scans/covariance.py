"""Whether the covariance of `jaxreg.register` is as large as its errors: NEES on the protocols.

    python -m benchmarks.scans.covariance [--pairs 64] [--seeds 11 17 19]

The normalised estimation error squared of a pose is its squared error weighed by the inverse of the
covariance that was said; divided by the six degrees of freedom its mean is 1 where the covariance is
right, and its median .89 (normal errors). Pairs of `benchmarks.scans.protocols`, without the
rotation-symmetric categories; right poses, within 5 degrees and .1.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np
import tyro

from benchmarks import record
from benchmarks.scans import protocols, sensors
from jaxreg.cli.process import enable_compilation_cache
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.scans.pair import register
from jaxreg.scans.result import ScanRegistration
from jaxreg.types import Pair

COLUMNS = {
    "pairs": "pairs",
    "right": "right",
    "mean": "mean NEES",
    "median": "median NEES",
    "above_3": "share above 3",
}


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    protocols: tuple[str, ...] = tuple(protocols.PROTOCOLS)
    pairs: int = 64
    seeds: tuple[int, ...] = (11, 17, 19)
    per_category: int = 6
    data_root: str | None = None
    record: bool = True
    """Write the table to benchmarks/results/."""


def nees(found: ScanRegistration, pair: Pair) -> float | None:
    """That of `benchmarks.scans.sensors`; None for a pose that is wrong."""
    truth = np.eye(4)
    truth[:3, :3], truth[:3, 3] = (np.asarray(part) for part in pair.transform)
    angle = rotation_angle_deg(found.rotation, truth[:3, :3])
    if angle > 5 or np.linalg.norm(truth[:3, 3] - found.translation) > 0.1:
        return None
    return sensors.nees(found, truth, np.asarray(pair.reference.points, np.float64).mean(axis=0))


def measure(protocol: str, shapes: protocols.Shapes, options: Options) -> Iterator[float | None]:
    """The NEES of every pair."""
    config = protocols.pairs_of(protocol)
    for seed in options.seeds:
        for row, pair in protocols.draw_pairs(
            config, shapes, pairs=options.pairs, seed=seed, turned=True
        ):
            if shapes.categories[row] not in protocols.SYMMETRIC:
                clouds = (np.asarray(cloud.points, np.float64) for cloud in pair[:2])
                yield nees(register(*clouds), pair)


def summary(found: list[float | None]) -> dict[str, float | int]:
    """The cells of a protocol."""
    right = np.array([x for x in found if x is not None])
    return {
        "pairs": len(found),
        "right": len(right),
        "mean": float(right.mean()),
        "median": float(np.median(right)),
        "above_3": float(np.mean(right > 3)),
    }


def main(options: Options) -> None:
    """Print a line for every protocol, and write the table."""
    enable_compilation_cache()
    shapes = protocols.read_shapes(options.data_root, options.per_category)
    rows = {}
    for protocol in options.protocols:
        cells = summary(list(measure(protocol, shapes, options)))
        rows[record.key(protocol)] = {"label": protocols.PROTOCOLS[protocol]} | cells
        print(rows[record.key(protocol)], flush=True)
    if options.record:
        record.write(
            "covariance",
            question="Is the covariance as large as the errors?",
            command=record.command("benchmarks.scans.covariance"),
            columns=COLUMNS,
            rows=rows,
        )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
