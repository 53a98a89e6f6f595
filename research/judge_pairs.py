"""Pairs that the judge of poses is fitted on: virtual scans of procedural rooms and shapes."""

from collections.abc import Callable, Iterator

import numpy as np
from numpy.random import Generator

from benchmarks.scans.sensors import TruePair, common_share, turned_pair
from benchmarks.scans.verdict import crop
from jaxreg.data.procedural import rooms, shapes
from jaxreg.data.procedural.scanner import Sensor, look_at, scan
from jaxreg.scans.prepare import voxel_reduced

_Made = tuple[np.ndarray, np.ndarray, np.ndarray | None, float, tuple[float, float]]
"""Source, reference, truth (None: there is none), reach, and what is right."""


def frames(rng: Generator, index: int) -> _Made:
    """Two depth images of a room from about the same place, in which things were moved."""
    room = rooms.sample_room(7, index)
    other = rooms.rearranged(room, rng, share=rng.choice([0, 0.15, 0.3]))
    size = np.ptp(room.shell.reshape(-1, 3), axis=0)
    eye = np.array([*(rng.uniform(-0.33, 0.33, 2) * size[:2]), rng.uniform(1.0, 1.8)])
    eyes = (eye, eye + rng.normal(size=3) * (0.8, 0.8, 0.15))
    azimuth = rng.uniform(0, 2 * np.pi) + np.array([0, rng.uniform(-0.9, 0.9)])
    sensor = Sensor(
        field_of_view=(1.0, 0.8), noise=rng.uniform(0.001, 0.005),
        step=rng.choice([0, 0.003, 0.01]), dropout=rng.uniform(0, 0.2),
        warp=np.radians(rng.uniform(0, 1)),
    )  # fmt: skip
    ahead = [np.array([np.cos(a), np.sin(a), rng.uniform(-0.5, 0.1)]) for a in azimuth]
    voxel = rng.uniform(0.01, 0.03)
    views = list(zip((room.surface, other.surface), eyes, ahead, strict=True))
    return *_scanned(rng, views, sensor, 20_000, voxel), 2.5 * voxel, (6.0, 0.2)


def lidar(rng: Generator, index: int) -> _Made:
    """Two scans of a room all around, from two places."""
    room = rooms.sample_room(8, index)
    size = np.ptp(room.shell.reshape(-1, 3), axis=0)[:2]
    sensor = Sensor(
        noise=rng.uniform(0.0005, 0.003), rings=int(rng.choice([0, 0, 16, 32])),
        dropout=rng.uniform(0, 0.1), warp=np.radians(rng.uniform(0, 0.3)),
    )  # fmt: skip
    voxel = rng.uniform(0.02, 0.08)
    views = []
    for _ in range(2):
        eye = np.array([*(rng.uniform(-0.35, 0.35, 2) * size), rng.uniform(1.0, 1.8)])
        views.append((room.surface, eye, np.array([1.0, 0, 0])))
    return *_scanned(rng, views, sensor, 30_000, voxel), 2.5 * voxel, (5.0, 0.3)


def turntable(rng: Generator, index: int) -> _Made:
    """Two depth images of one shape, 15 to 110 degrees apart."""
    shape = shapes.sample_surface(93, index)
    sensor = Sensor(
        field_of_view=(1.2, 1.2), noise=rng.uniform(0.0003, 0.003), step=rng.choice([0, 0.004]),
        dropout=rng.uniform(0, 0.15), warp=np.radians(rng.uniform(0, 2)),
    )  # fmt: skip
    azimuth = rng.uniform(0, 2 * np.pi)
    azimuth = azimuth + np.array([0, np.radians(rng.uniform(15, 110)) * rng.choice([-1, 1])])
    up = rng.uniform(-0.1, 0.8) + np.array([0, 0.1 * rng.normal()])
    eyes = rng.uniform(2.5, 4) * np.stack(
        [np.cos(azimuth) * np.cos(up), np.sin(azimuth) * np.cos(up), np.sin(up)], axis=1
    )
    voxel = rng.uniform(0.012, 0.03)
    views = [(shape, eye, -eye) for eye in eyes]
    return *_scanned(rng, views, sensor, 15_000, voxel), 2.5 * voxel, (6.0, 0.08)


def crops(rng: Generator, index: int) -> _Made:
    """Own crops of 50 to 100 % of two samplings, every second one noisy."""
    cloud = shapes.sample_shape(91, index, points=2048).astype(np.float64)
    cloud = cloud[rng.permutation(len(cloud))]
    share = rng.choice([0.5, 0.7, 0.7, 1.0])
    pair = [crop(half, rng, share) for half in np.split(cloud, 2)]
    if index % 2:
        pair = [x + np.clip(0.01 * rng.normal(size=x.shape), -0.05, 0.05) for x in pair]
    return *pair, np.eye(4), 0.06, (5.0, 0.1)


def ends(rng: Generator, index: int) -> _Made:
    """The two ends of one shape, which share no surface."""
    cloud = shapes.sample_shape(92, index, points=4096).astype(np.float64)
    along = rng.normal(size=3)
    return _cut(cloud, along, 0, 0.45), _cut(cloud, along, 0.55, 1), None, 0.06, (5.0, 0.1)


def unrelated(rng: Generator, index: int) -> _Made:
    """Views of two shapes, or of two rooms."""
    make = (turntable, frames)[index % 2]
    source, _, _, reach, within = make(rng, 2 * index)
    return source, make(rng, 2 * index + 1)[1], None, reach, within


def contained(rng: Generator, index: int) -> _Made:
    """A part of a room, cut around a point, in the scan of the whole room."""
    source, reference, truth, reach, within = lidar(rng, index)
    centre = source[rng.integers(len(source))]
    distance = np.linalg.norm(source - centre, axis=1)
    part = source[distance < np.quantile(distance, rng.uniform(0.1, 0.4))]
    return part, reference, truth, reach, within


KINDS: dict[str, Callable[[Generator, int], _Made]] = {
    "frames": frames, "lidar": lidar, "turntable": turntable, "crops": crops, "ends": ends,
    "unrelated": unrelated, "contained": contained,
}  # fmt: skip


def made_pairs(kind: str, count: int, seed: int = 0) -> Iterator[TruePair]:
    """Pairs of a kind, two thirds of the views with an overlap below .35, each turned by any rotation."""
    for index in range(count):
        for attempt in range(30):
            rng = np.random.default_rng((seed, sum(map(ord, kind)), index, attempt))
            source, reference, truth, reach, within = KINDS[kind](rng, index)
            if min(len(source), len(reference)) < 200:
                continue
            overlap = 0.0 if truth is None else common_share(source, reference, truth, reach)
            small = rng.random() < 0.65
            if kind not in ("frames", "lidar", "turntable"):
                break
            if (0.08 < overlap < 0.35) if small else overlap > 0.25:
                break
        else:
            continue
        name = f"{kind}/{index}"
        yield turned_pair(rng, name, source, reference, truth, overlap, within, reach)


def _scanned(rng: Generator, views, sensor: Sensor, points: int, voxel: float):
    clouds, poses = [], []
    for surface, eye, ahead in views:
        facing = look_at(eye, eye + ahead)
        seen = scan(rng, surface, eye, facing, sensor, points=points)
        clouds.append(voxel_reduced(seen, voxel) if len(seen) else seen)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = facing, eye
        poses.append(pose)
    return *clouds, np.linalg.inv(poses[1]) @ poses[0]


def _cut(cloud: np.ndarray, along: np.ndarray, low: float, high: float) -> np.ndarray:
    place = cloud @ along
    return cloud[(place >= np.quantile(place, low)) & (place <= np.quantile(place, high))]
