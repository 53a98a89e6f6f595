"""What it gains to know that both scans are level: the same pairs with and without being told.

    python -m benchmarks.scans.known [--pairs 40]

Procedural shapes, two samplings each that share no point, turned about the vertical axis by any angle:
whole, with noise, and crops. Every pair is registered by `jaxreg.register`, once with nothing known and
once with `known="upright"`. Seconds are those of the processor, medians after the first pair.
"""

import dataclasses
import time

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

import jaxreg
from benchmarks import record
from jaxreg.cli.process import enable_compilation_cache
from jaxreg.data.procedural import shapes

WITHIN_DEG, WITHIN = 5.0, 0.1
"""A pose is right within these, the length at the centroid of the source."""
PROTOCOLS = {
    "resampled": ("resampled", 1.0, 0.0),
    "jitter": ("resampled, jitter 0.01", 1.0, 0.01),
    "crops70": ("crops of 70 %", 0.7, 0.0),
    "crops50": ("crops of 50 %", 0.5, 0.0),
}
TOLD = {"nothing": None, "upright": "upright"}
COLUMNS = {
    f"{name}_{what}": f"{told}: {words}"
    for name, told in (("nothing", "nothing known"), ("upright", "upright"))
    for what, words in (
        ("right", "right"),
        ("success", "right and a success"),
        ("wrong", "wrong and a success"),
        ("seconds", "seconds"),
    )
}


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    pairs: int = 40
    """Pairs of a protocol."""
    seed: int = 5
    points: int = 2048
    """Points of a shape, half of them in each cloud before the crop."""
    record: bool = True
    """Write benchmarks/results/known.json."""


def drawn(index: int, kept: float, noise: float, options: Options):
    """Source, reference, and the true rotation and translation."""
    rng = np.random.default_rng([options.seed, index])
    cloud = shapes.sample_shape(910, 50_000 + index, points=options.points).astype(np.float64)
    halves = np.split(rng.permutation(cloud), 2)
    halves = [half + rng.normal(size=half.shape) * noise for half in halves]
    source, reference = (_cropped(half, rng, kept) for half in halves)
    rotation = Rotation.from_euler("z", rng.uniform(-180, 180), degrees=True).as_matrix()
    shift = rng.uniform(-1, 1, 3)
    return source, reference @ rotation.T + shift, rotation, shift


def _cropped(points: np.ndarray, rng: np.random.Generator, kept: float) -> np.ndarray:
    along = points @ rng.normal(size=3)
    return points[along >= np.quantile(along, 1 - kept)]


def is_right(found, source: np.ndarray, rotation: np.ndarray, shift: np.ndarray) -> bool:
    """Whether the pose is within WITHIN_DEG and WITHIN."""
    chord = np.linalg.norm(found.rotation - rotation) / 8**0.5
    centre = source.mean(axis=0)
    off = (found.rotation - rotation) @ centre + found.translation - shift
    angle = np.degrees(2 * np.arcsin(min(1.0, chord)))
    return bool(angle < WITHIN_DEG and np.linalg.norm(off) < WITHIN)


def measured(kept: float, noise: float, options: Options) -> dict[str, float]:
    """The row of one protocol."""
    row = {}
    for name, known in TOLD.items():
        right, success, seconds = [], [], []
        for index in range(options.pairs):
            source, reference, *truth = drawn(index, kept, noise, options)
            begin = time.process_time()
            found = jaxreg.register(source, reference, known=known)
            seconds.append(time.process_time() - begin)
            right.append(is_right(found, source, *truth))
            success.append(found.success)
        good, sure = np.array(right), np.array(success)
        row |= {
            f"{name}_right": int(good.sum()),
            f"{name}_success": int(np.sum(good & sure)),
            f"{name}_wrong": int(np.sum(~good & sure)),
            f"{name}_seconds": round(float(np.median(seconds[1:] or seconds)), 2),
        }
    return row


def main(options: Options) -> None:
    """Print a line for every protocol, and write the table."""
    enable_compilation_cache()
    rows = {}
    for protocol, (label, kept, noise) in PROTOCOLS.items():
        rows[protocol] = {"label": label} | measured(kept, noise, options)
        print(rows[protocol], flush=True)
    if options.record:
        path = record.write(
            "known",
            question="What does it gain to know that both scans are level?",
            command=record.command("benchmarks.scans.known"),
            columns=COLUMNS,
            rows=rows,
            setting={"pairs": options.pairs},
        )
        print(path)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
