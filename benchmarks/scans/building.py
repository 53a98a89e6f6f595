"""A building that is walked around once, a tenth of the scans from another building: 100 scans in no order.

    python -m benchmarks.scans.building [--scans 100] [--foreign 10]

Twenty rooms of any size lie in a ring around a courtyard, as in a museum. A spinning scanner (rays cast
by Open3D, 1 cm of noise) stands every metre or so of the 100 m, and ends where it began. The scans
are turned by any rotation and shuffled; it is known where in each scan the scanner stood. `ate` is the root mean square distance of the scanner from its
true places, after the best rigid alignment, with and without the joint refinement at the end.
"""

import dataclasses
import tempfile
import time
from typing import NamedTuple

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from benchmarks import record
from jaxreg.cli import process
from jaxreg.data.procedural.rooms import sample_room
from jaxreg.data.procedural.surfaces import Triangles, box, place, union
from jaxreg.scans.many import Alignment, register_many

_SIDES = (28.0, 22.0)
"""Lengths of the loop, in metres."""
_INNER, _OUTER = 1.7, (1.9, 4.5)
"""From the loop to the walls around the courtyard, and to those of the rooms on the other side."""
_DOOR, _HEIGHT, _WALL = 1.5, 3.4, 0.1
_REACH = 12.0
_RIGHT_DEG, _RIGHT = 5.0, 0.3


class Walk(NamedTuple):
    """Scans in their own frames, true poses (4x4), and whether each is of the other building."""

    clouds: list[np.ndarray]
    truth: np.ndarray
    foreign: np.ndarray


def building(seed: int) -> Triangles:
    """Rooms in a ring about the origin, a door from each to the next, the floor at 0."""
    rng = np.random.default_rng(seed)
    sides = []
    for quarter in range(4):
        along, away = _SIDES[quarter % 2] / 2, _SIDES[1 - quarter % 2] / 2
        turn = Rotation.from_euler("z", 90 * quarter, degrees=True).as_matrix()
        sides.append(place(_side(rng, along, away, 100 * seed + 20 * quarter), rotation=turn))
    return union(*sides)


def _side(rng: np.random.Generator, along: float, away: float, number: int) -> Triangles:
    """The rooms of one side of the loop, that along x at y = away, with its first corner."""
    inner, parts = away - _INNER, []
    left, end = -along - _INNER, along - _INNER
    parts.append(_slab(left, left + _WALL, inner, away + _OUTER[1]))
    parts.append(_slab(-along + _INNER, end, inner, inner + _WALL))
    while left < end - 1:
        right = min(left + rng.uniform(3.5, 7), end)
        right = end if end - right < 3 else right
        outer, low, high = away + rng.uniform(*_OUTER), away - _DOOR / 2, away + _DOOR / 2
        parts.append(_slab(left, right, outer, outer + _WALL))
        parts += [_slab(right, right + _WALL, *y) for y in ((inner, low), (high, away + _OUTER[1]))]
        for z in (-_WALL / 2, rng.uniform(2.4, 3.4)):
            size = (right - left, outer - inner, _WALL)
            parts.append(box(size, ((left + right) / 2, (inner + outer) / 2, z)))
        parts += _furniture(rng, (left, right, outer), away, number)
        left, number = right, number + 1
    return union(*parts)


def _slab(left: float, right: float, near: float, far: float) -> Triangles:
    """A piece of wall by its corners."""
    size = (right - left, far - near, _HEIGHT)
    return box(size, ((left + right) / 2, (near + far) / 2, _HEIGHT / 2))


def _furniture(rng, room: tuple[float, float, float], away: float, number: int) -> list[Triangles]:
    """Pieces along both long walls, so that the scanner passes, and things on the outer one."""
    left, right, outer = room
    found = []
    for piece in sample_room(number, 0).pieces[:8]:
        middle = piece.reshape(-1, 3).mean(axis=0) * [1, 1, 0]
        y = rng.uniform(away + 1.3, outer) if rng.random() < 0.7 else away - 1.4
        found.append(place(piece, offset=np.array([rng.uniform(left, right), y, 0]) - middle))
    for _ in range(4):
        size = rng.uniform((0.3, 0.1, 0.3), (1.5, 0.5, 1.2))
        found.append(box(size, (rng.uniform(left, right), outer, rng.uniform(0.3, 2.4))))
    return found


def places(count: int, rng: np.random.Generator) -> np.ndarray:
    """Where the scanner stands: evenly around the loop, not quite in the middle of the corridor."""
    a, b = np.array(_SIDES) / 2
    corners = np.array([[-a, -b], [a, -b], [a, b], [-a, b], [-a, -b]])
    gone = np.append(0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)))
    stops = np.linspace(0, gone[-1], count, endpoint=False)
    flat = np.stack([np.interp(stops, gone, corners[:, k]) for k in range(2)], axis=1)
    return np.column_stack([flat + rng.uniform(-0.3, 0.3, flat.shape), rng.uniform(1, 1.4, count)])


def scanned(rng, surface: Triangles, eye: np.ndarray, turn: np.ndarray, points: int) -> np.ndarray:
    """What a scanner at `eye` with rotation `turn` measures, in its own frame."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    triangles = np.arange(3 * len(surface), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(surface.reshape(-1, 3).astype(np.float32), triangles)
    azimuth, height = rng.uniform(-np.pi, np.pi, points), rng.uniform(-0.6, 0.6, points)
    flat = np.cos(height)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(height)], axis=1)
    cast = np.concatenate([np.broadcast_to(eye, rays.shape), rays], axis=1).astype(np.float32)
    distance = scene.cast_rays(o3d.core.Tensor(cast))["t_hit"].numpy().astype(np.float64)
    seen = distance < _REACH
    measured = distance[seen] + rng.normal(0, 0.01, seen.sum())
    return (rays[seen] * measured[:, None]) @ turn


def walk(scans: int, foreign: int, points: int, seed: int = 0) -> Walk:
    """The walk around the building, and the first steps of one around another, shuffled."""
    rng = np.random.default_rng([seed, 6])
    clouds, truth = [], []
    for number, count in enumerate((scans - foreign, foreign)):
        surface = building(2 * seed + number)
        for eye in places(scans - foreign, rng)[:count]:
            turn = Rotation.random(random_state=rng).as_matrix()
            clouds.append(scanned(rng, surface, eye, turn, points))
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = turn, eye
            truth.append(pose)
    order = rng.permutation(scans)
    is_foreign = np.arange(scans) >= scans - foreign
    return Walk([clouds[k] for k in order], np.array(truth)[order], is_foreign[order])


def trajectory_errors(found: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Degrees and metres of every pose after the rigid alignment that fits the places best."""
    a, b = found[:, :3, 3], truth[:, :3, 3]
    turn, _ = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))
    moved = turn.apply(a - a.mean(axis=0)) + b.mean(axis=0)
    apart = Rotation.from_matrix(truth[:, :3, :3]).inv() * turn
    turned = (apart * Rotation.from_matrix(found[:, :3, :3])).magnitude()
    return np.degrees(turned), np.linalg.norm(moved - b, axis=1)


def row(walked: Walk, alignment: Alignment) -> dict:
    """Counts of the largest group, and its errors."""
    group = np.array(alignment.groups[0] if alignment.groups else (), int)
    own = group[~walked.foreign[group]]
    turned, moved = trajectory_errors(alignment.transformation[own], walked.truth[own])
    right = (turned < _RIGHT_DEG) & (moved < _RIGHT)
    return {
        "scans": len(walked.clouds),
        "own": int((~walked.foreign).sum()),
        "right": int(right.sum()),
        "wrong": int((~right).sum()),
        "foreign": int(walked.foreign[group].sum()),
        "groups": len(alignment.groups),
        "ate": float(np.sqrt(np.mean(moved**2))),
        "worst": float(moved.max()),
        "worst_deg": float(turned.max()),
        "pairs": len(alignment.pairs),
    }


COLUMNS = {
    "scans": "scans",
    "own": "of the building",
    "right": "placed right",
    "wrong": "placed wrong",
    "foreign": "of the other building, placed with it",
    "groups": "groups",
    "ate": "ATE, m",
    "worst": "largest error, m",
    "worst_deg": "largest, degrees",
    "pairs": "pairs registered",
    "seconds": "s",
    "cpu_seconds": "processor s",
}


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    scans: int = 100
    foreign: int = 10
    points: int = 8000
    """Rays of a scan."""
    seed: int = 0
    work: str | None = None
    """Keep finished pairs in this folder, and go on from what is there; the times are then not right."""
    record: bool = True
    """Write benchmarks/results/building.json."""


def main(options: Options) -> None:
    """Align the walk with and without the joint refinement, and print a table."""
    process.enable_compilation_cache(least_seconds=0.0)
    walked = walk(options.scans, options.foreign, options.points, options.seed)
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        work = options.work or folder
        for name, joint in {"graph": False, "joint": True}.items():
            begin, cpu = time.perf_counter(), time.process_time()
            alignment = register_many(
                walked.clouds, viewpoints=[np.zeros(3)] * len(walked.clouds), joint=joint, work=work
            )
            spent = {
                "seconds": time.perf_counter() - begin,
                "cpu_seconds": time.process_time() - cpu,
            }
            label = "pose graph alone" if not joint else "and joint refinement (pairs kept)"
            rows[name] = {"label": label} | row(walked, alignment) | spent
            print(rows[name], flush=True)
    if options.record:
        record.write(
            "building",
            question="Are the scans of a loop through a building placed, and foreign ones left out?",
            command=record.command("benchmarks.scans.building"),
            columns=COLUMNS,
            rows=rows,
            setting={"right_deg": _RIGHT_DEG, "right_m": _RIGHT},
        )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
