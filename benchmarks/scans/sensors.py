"""Pairs of real scans of many sensors, whose truth is known: every source is turned by any rotation.

    python -m benchmarks.scans.sensors [--data-root DATA] [--sensors balm bunny_turntable]

registers every pair by `jaxreg.register`. A data set is a folder of `scans/` (pairs.json, and
scan_K.npz with `points`), or the fragments of 7Scenes with their official lists of pairs.
"""

import dataclasses
import itertools
import json
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import tyro
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks import record
from jaxreg.cli import process
from jaxreg.data import data_root
from jaxreg.data.seven_scenes import read_fragment
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.types import RigidTransform

if TYPE_CHECKING:
    from jaxreg.scans.result import ScanRegistration

BINS = 10
"""Of equal width, in the calibration error and the reliability diagram."""
LOW = 0.3
"""Pairs that overlap by less than this are reported apart."""
RIGHT = {
    "balm": (5.0, 0.5),
    "bunny_turntable": (5.0, 0.010),
    "redkitchen_frames": (8.0, 0.25),
    "kitti00": (5.0, 1.0),
    "opencalib": (5.0, 0.8),
    "redkitchen_lomatch": (15.0, 0.3),
    "redkitchen": (15.0, 0.3),
}
"""Within how many degrees, and metres at the overlap's centroid, a pose is right: the truth of a
data set is good to about a third of that."""
SEEN_FROM_ORIGIN = ("balm", "redkitchen_frames", "kitti00", "opencalib")
_LISTS = {"redkitchen_lomatch": "gt_3dlomatch.log", "redkitchen": "gt.log"}
_FRAGMENTS = "7scene/7-scenes-redkitchen"
_FRAGMENT_REACH = 0.05


class TruePair(NamedTuple):
    """Two clouds, the pose that maps the source to the reference, and what is right."""

    name: str
    source: np.ndarray
    reference: np.ndarray
    truth: np.ndarray | None
    overlap: float
    within: tuple[float, float]
    """Degrees, and metres at `centre`."""
    centre: np.ndarray

    def is_right(self, pose: RigidTransform, times: float = 1.0) -> bool:
        """Whether a pose is within `times` the tolerance."""
        if self.truth is None:
            return False
        angle = rotation_angle_deg(pose.rotation, self.truth[:3, :3])
        change = (pose.rotation - self.truth[:3, :3]) @ self.centre
        moved = np.linalg.norm(change + pose.translation - self.truth[:3, 3])
        return bool(angle < times * self.within[0] and moved < times * self.within[1])


def true_pairs(root: Path, sensor: str) -> Iterator[TruePair]:
    """The pairs of a data set, in its order; none if it is not there."""
    listed = _listed(root, sensor) if sensor in _LISTS else _drawn(root, sensor)
    for number, (source, reference, truth, overlap, reach) in enumerate(listed):
        name = f"{sensor}/{number}"
        rng = np.random.default_rng(zlib.crc32(name.encode()))
        yield turned_pair(rng, name, source, reference, truth, overlap, RIGHT[sensor], reach)


def turned_pair(
    rng: np.random.Generator, name, source, reference, truth, overlap, within, reach
) -> TruePair:
    """A pair with its source turned by any rotation; `truth` is None where nothing is common.

    Errors are measured at the centroid of the overlapping part.
    """
    turn = Rotation.random(random_state=rng).as_matrix()
    source = source @ turn.T
    centre = source.mean(axis=0)
    if truth is not None:
        truth = truth.copy()
        truth[:3, :3] = truth[:3, :3] @ turn.T
        near = (
            cKDTree(reference).query(_moved(source, truth), distance_upper_bound=reach)[0] < np.inf
        )
        centre = source[near].mean(axis=0) if near.any() else centre
    return TruePair(name, source, reference, truth, overlap, within, centre)


def common_share(source, reference, truth: np.ndarray, reach: float) -> float:
    """Share of the points of either cloud, the smaller of the two, within `reach` of the other."""
    moved = _moved(source, truth)
    return min(
        float((cKDTree(b).query(a)[0] < reach).mean())
        for a, b in ((moved, reference), (reference, moved))
    )


def _drawn(root: Path, sensor: str):
    folder = root / "scans" / sensor
    if not folder.is_dir():
        return
    content = json.loads((folder / "pairs.json").read_text())
    for pair in content["pairs"]:
        clouds = [
            np.load(folder / f"scan_{pair[side]}.npz")["points"].astype(np.float64)
            for side in ("source", "reference")
        ]
        overlap = min(pair["overlap_source"], pair["overlap_reference"])
        yield *clouds, np.array(pair["T"], np.float64), overlap, content["reach"]


def _listed(root: Path, sensor: str):
    folder = root / _FRAGMENTS
    if not folder.is_dir():
        return
    for first, second, truth in logged_pairs(folder / _LISTS[sensor]):
        reference, source = (read_fragment(folder / f"cloud_bin_{i}.ply") for i in (first, second))
        overlap = common_share(source, reference, truth, _FRAGMENT_REACH)
        yield source, reference, truth, overlap, _FRAGMENT_REACH


def logged_pairs(path: Path) -> Iterator[tuple[int, int, np.ndarray]]:
    """(i, j, T) of a log of 3DMatch; T maps fragment j into the frame of fragment i."""
    lines = path.read_text().splitlines()
    for k in range(0, len(lines) - 4, 5):
        i, j = (int(word) for word in lines[k].split()[:2])
        yield i, j, np.array([row.split() for row in lines[k + 1 : k + 5]], float)


def _moved(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    data_root: str | None = None
    sensors: tuple[str, ...] = ()
    """Which; none: all, with `viewpoint` those whose clouds are in the scanner's frame."""
    viewpoint: bool = False
    """Register twice, and the second time tell that the scanner stood at the origin."""
    record: bool = True
    """Write benchmarks/results/sensors.json and reliability.json; with `viewpoint` viewpoint.json."""


def measure(root: Path, sensor: str, *, viewpoint: bool = False) -> Iterator[dict]:
    """One entry per pair: whether the pose is right, believed, and whether an alternative is right."""
    from jaxreg.scans.pair import register

    place = np.zeros(3) if viewpoint and sensor in SEEN_FROM_ORIGIN else None
    for pair in true_pairs(root, sensor):
        start = time.perf_counter()
        found = register(pair.source, pair.reference, viewpoint=place)
        seconds = time.perf_counter() - start
        right = pair.is_right(found.transform)
        listed = any(pair.is_right(other.transform) for other in found.alternatives)
        yield {
            "name": pair.name,
            "low": pair.overlap < LOW,
            "right": right,
            "listed": right or listed,
            "success": found.success,
            "probability": found.probability,
            "nees": nees(found, pair.truth, pair.reference.mean(axis=0)) if right else None,
            "seconds": seconds,
        }


def nees(found: "ScanRegistration", truth: np.ndarray, centre: np.ndarray) -> float:
    """Squared error over covariance, for each of six degrees of freedom; 1 where sigma is right.

    `truth` is 4x4, `centre` what the covariance is about. The error of the truth itself is in it.
    """
    turn = truth[:3, :3] @ found.rotation.T
    shift = truth[:3, 3] - centre - turn @ (found.translation - centre)
    error = np.concatenate([Rotation.from_matrix(turn).as_rotvec(), shift])
    return float(error @ np.linalg.solve(found.covariance, error) / 6)


def summary(entries: list[dict]) -> dict:
    """Counts of a group of pairs."""
    right = np.array([e["right"] for e in entries], bool)
    success = np.array([e["success"] for e in entries], bool)
    return {
        "pairs": len(entries),
        "right": int(right.sum()),
        "listed": int(sum(e["listed"] for e in entries)),
        "believed": int(np.sum(right & success)),
        "wrong": int(np.sum(~right & success)),
        "calibration": calibration_error(entries),
        "nees": _median([e["nees"] for e in entries if e["nees"] is not None]),
        "seconds": float(np.median([e["seconds"] for e in entries])),
    }


def _median(values: list[float]) -> float | None:
    return float(np.median(values)) if values else None


def calibration_error(entries: list[dict]) -> float:
    """Expected calibration error: sum over bins of n_b / n |mean probability - share right|."""
    rows = reliability(entries).values()
    apart = [row["pairs"] * abs(row["probability"] - row["right"]) for row in rows if row["pairs"]]
    return float(sum(apart) / len(entries))


def reliability(entries: list[dict]) -> dict[str, dict]:
    """In bins of equal width: how probable the poses were said to be, and how many are right."""
    chance = np.array([e["probability"] for e in entries])
    right = np.array([e["right"] for e in entries], float)
    bins = np.minimum((chance * BINS).astype(int), BINS - 1)
    rows = {}
    for number in range(BINS):
        inside = bins == number
        found = {"probability": None, "right": None}
        if inside.any():
            found = {"probability": chance[inside].mean(), "right": right[inside].mean()}
        label = f"{number / BINS:.1f} to {(number + 1) / BINS:.1f}"
        rows[f"bin{number}"] = {"label": label, "pairs": int(inside.sum())} | found
    return rows


COLUMNS = {
    "pairs": "pairs",
    "right": "right",
    "listed": "right, or among the alternatives",
    "believed": "right and called a success",
    "wrong": "wrong and called a success",
    "calibration": "calibration error",
    "nees": "median NEES a degree of freedom",
    "seconds": "median s",
}


def main(options: Options) -> None:
    """Register all pairs of every sensor and print a table."""
    root = data_root(options.data_root)
    if root is None:
        raise SystemExit("no data: set $JAXREG_DATA or give --data-root.")
    process.enable_compilation_cache()
    rows, everything = {}, []
    sensors = options.sensors or (SEEN_FROM_ORIGIN if options.viewpoint else tuple(RIGHT))
    told = {"": False} | ({", told where the scanner stood": True} if options.viewpoint else {})
    for sensor, (words, viewpoint) in itertools.product(sensors, told.items()):
        entries = list(measure(root, sensor, viewpoint=viewpoint))
        everything += entries
        for key, label, low in (("low", "overlap below .3", True), ("high", ".3 and more", False)):
            if group := [e for e in entries if e["low"] is low]:
                name = f"{sensor}_{key}{'_told' * viewpoint}"
                rows[name] = {"label": f"{sensor}, {label}{words}"} | summary(group)
                print(rows[name], flush=True)
    if options.record:
        command = record.command("benchmarks.scans.sensors")
        if options.viewpoint:
            record.write(
                "viewpoint",
                question="What does it gain to know where the scanner stood?",
                command=command,
                columns=COLUMNS,
                rows=rows,
            )
            return
        record.write(
            "sensors",
            question="How many pairs of real scans of other sensors are registered?",
            command=command,
            columns=COLUMNS,
            rows=rows,
        )
        record.write(
            "reliability",
            question="How often is a pose of a given probability right, on real scans?",
            command=command,
            columns={"pairs": "pairs", "probability": "mean probability", "right": "share right"},
            rows=reliability(everything),
            setting={"calibration": calibration_error(everything), "pairs": len(everything)},
        )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
