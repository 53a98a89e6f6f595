"""Whole sequences of real scans, each turned by any rotation and in no order, by one call.

    python -m benchmarks.scans.sequences [--data-root DATA] [--sequences balm redkitchen] [--no-open3d]

aligns every sequence by `jaxreg.register_many`, and by Open3D as its reconstruction system does it (all
pairs by FPFH, RANSAC and ICP at a voxel size that suits the sensor, then its pose graph). A scan is
placed right if its pose, after an alignment of the whole to the truth, is within the tolerance of the
sensor (benchmarks.scans.sensors).
"""

import dataclasses
import json
import time
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from benchmarks import record
from benchmarks.scans.sensors import RIGHT
from jaxreg.cli import process
from jaxreg.data import data_root
from jaxreg.data.seven_scenes import read_fragment, read_pose
from jaxreg.geometry.rigid import nearest_rotation, rotation_angle_deg

VOXEL = {
    "redkitchen": 0.05,
    "balm": 0.5,
    "bunny_turntable": 0.005,
    "redkitchen_frames": 0.05,
    "kitti00": 0.5,
}
"""Metres, for Open3D."""
_FRAGMENTS = "7scene/7-scenes-redkitchen"
_OVERLAP = 0.3


class Sequence(NamedTuple):
    """Turned scans in no order, their true poses, and which overlap another by .3 or more."""

    name: str
    clouds: list[np.ndarray]
    truth: np.ndarray
    expected: np.ndarray


def sequence(root: Path, name: str) -> Sequence | None:
    """A sequence by its name; None if it, or its true poses, are not there."""
    if name == "redkitchen":
        folder = root / _FRAGMENTS
        if not folder.is_dir():
            return None
        files = [folder / f"cloud_bin_{k}.ply" for k in range(10)]
        clouds = [read_fragment(path) for path in files]
        poses, expected = np.array([read_pose(path) for path in files]), np.ones(10, bool)
    else:
        folder = root / "scans" / name
        if not (folder / "poses.json").is_file():
            return None
        table = json.loads((folder / "poses.json").read_text())
        keys = sorted((k for k in table if (folder / f"scan_{k}.npz").is_file()), key=int)
        clouds = [np.load(folder / f"scan_{k}.npz")["points"].astype(np.float64) for k in keys]
        poses = np.array([table[k] for k in keys])
        poses[:, :3, :3] = nearest_rotation(poses[:, :3, :3])
        expected = np.isin(keys, _overlapping(folder))
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    order = rng.permutation(len(clouds))
    turns = Rotation.random(len(clouds), random_state=rng).as_matrix()
    clouds = [clouds[k] @ turns[k].T for k in order]
    poses[:, :3, :3] = poses[:, :3, :3] @ turns.swapaxes(1, 2)
    return Sequence(name, clouds, poses[order], expected[order])


def _overlapping(folder: Path) -> list[str]:
    pairs = json.loads((folder / "pairs.json").read_text())["pairs"]
    near = [p for p in pairs if min(p["overlap_source"], p["overlap_reference"]) >= _OVERLAP]
    return [str(p[side]) for p in near for side in ("source", "reference")]


def errors(
    poses: np.ndarray, truth: np.ndarray, centres: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Degrees, and metres of every scan's centre, after the whole was aligned with the truth.

    The alignment is the best of those that each scan proposes, by the median error: a wrong scan then
    does not spoil the others.
    """
    a = np.einsum("kij,kj->ki", poses[:, :3, :3], centres) + poses[:, :3, 3]
    b = np.einsum("kij,kj->ki", truth[:, :3, :3], centres) + truth[:, :3, 3]

    def of(turn: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        shift = np.average(b - a @ turn.T, axis=0, weights=weights)
        turned = rotation_angle_deg(turn @ poses[:, :3, :3], truth[:, :3, :3])
        return turned, np.linalg.norm(a @ turn.T + shift - b, axis=1)

    ones = np.ones(len(poses))
    proposals = [t[:3, :3] @ p[:3, :3].T for t, p in zip(truth, poses, strict=True)]
    found = [of(turn, ones) for turn in proposals]
    best = min(range(len(found)), key=lambda k: np.median(found[k][0]))
    inside = found[best][0] < 3 * np.median(found[best][0]) + 1e-6
    turn = nearest_rotation(np.mean([proposals[k] for k in np.flatnonzero(inside)], axis=0))
    return of(turn, inside.astype(float))


def score(sequence: Sequence, poses: np.ndarray, placed: np.ndarray) -> dict:
    """Counts and errors of poses (n, 4, 4) of the scans that are `placed`."""
    kept = np.flatnonzero(placed)
    counts = {"scans": len(poses), "expected": int(sequence.expected.sum())}
    if len(kept) < 2:
        return counts | {"placed": len(kept), "right": 0, "wrong": len(kept)}
    centres = np.array([cloud.mean(axis=0) for cloud in sequence.clouds])
    turned, moved = errors(poses[kept], sequence.truth[kept], centres[kept])
    degrees, metres = RIGHT[sequence.name]
    right = (turned < degrees) & (moved < metres)
    return counts | {
        "placed": len(kept),
        "right": int(right.sum()),
        "wrong": int((~right).sum()),
        "median_deg": float(np.median(turned)),
        "worst_deg": float(turned.max()),
        "median_m": float(np.median(moved)),
        "worst_m": float(moved.max()),
    }


def jaxreg_row(found: Sequence) -> dict:
    from jaxreg.scans.many import register_many

    begin, cpu = time.perf_counter(), time.process_time()
    alignment = register_many(found.clouds)
    seconds, cpu = time.perf_counter() - begin, time.process_time() - cpu
    placed = np.zeros(len(found.clouds), bool)
    placed[list(alignment.groups[0]) if alignment.groups else []] = True
    row = score(found, alignment.transformation, placed)
    return row | {
        "groups": len(alignment.groups),
        "pairs": len(alignment.pairs),
        "seconds": seconds,
        "cpu_seconds": cpu,
    }


def open3d_row(found: Sequence) -> dict:
    """Open3D's reconstruction system on scans without order: every pair, then its pose graph."""
    import open3d as o3d

    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    o3d.utility.random.seed(0)
    voxel, registration = VOXEL[found.name], o3d.pipelines.registration
    begin, cpu = time.perf_counter(), time.process_time()
    clouds, features = [], []
    for points in found.clouds:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(voxel)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel, 30))
        near = o3d.geometry.KDTreeSearchParamHybrid(5 * voxel, 100)
        clouds.append(cloud)
        features.append(registration.compute_fpfh_feature(cloud, near))
    count, edges = len(clouds), []
    for i in range(count):
        for j in range(i + 1, count):
            edge = _open3d_pair(registration, clouds, features, i, j, voxel)
            edges += [edge] if edge is not None else []
    graph = registration.PoseGraph()
    poses, placed = _open3d_start(count, edges)
    for pose in poses:
        graph.nodes.append(registration.PoseGraphNode(pose))
    for i, j, transform, information, _ in edges:
        graph.edges.append(registration.PoseGraphEdge(i, j, transform, information, uncertain=True))
    registration.global_optimization(
        graph,
        registration.GlobalOptimizationLevenbergMarquardt(),
        registration.GlobalOptimizationConvergenceCriteria(),
        registration.GlobalOptimizationOption(
            max_correspondence_distance=1.4 * voxel, edge_prune_threshold=0.25, reference_node=0
        ),
    )
    poses = np.array([node.pose for node in graph.nodes])
    row = score(found, poses, placed)
    return row | {
        "groups": 1,
        "pairs": count * (count - 1) // 2,
        "seconds": time.perf_counter() - begin,
        "cpu_seconds": time.process_time() - cpu,
    }


def _open3d_pair(registration, clouds, features, i: int, j: int, voxel: float):
    """(i, j, pose of i in j, information, inliers); None where the reconstruction system drops it."""
    result = registration.registration_ransac_based_on_feature_matching(
        clouds[i], clouds[j], features[i], features[j], True, 1.4 * voxel,
        registration.TransformationEstimationPointToPoint(False), 3,
        [registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
         registration.CorrespondenceCheckerBasedOnDistance(1.4 * voxel)],
        registration.RANSACConvergenceCriteria(1_000_000, 0.999),
    )  # fmt: skip
    if np.trace(result.transformation) == 4:
        return None
    result = registration.registration_icp(
        clouds[i], clouds[j], 1.4 * voxel, result.transformation,
        registration.TransformationEstimationPointToPlane(),
    )  # fmt: skip
    information = registration.get_information_matrix_from_point_clouds(
        clouds[i], clouds[j], 1.4 * voxel, result.transformation
    )
    inliers = information[5, 5] / min(len(clouds[i].points), len(clouds[j].points))
    if inliers < 0.3:
        return None
    return i, j, result.transformation, information, inliers


def _open3d_start(count: int, edges) -> tuple[list[np.ndarray], np.ndarray]:
    """Poses along the edges with most inliers, and which scans they reach from the first of the most."""
    best: tuple[list[np.ndarray], np.ndarray] = [np.eye(4)] * count, np.zeros(count, bool)
    for root in range(count):
        poses, reached = [np.eye(4)] * count, np.zeros(count, bool)
        reached[root] = True
        while True:
            ways = [e for e in edges if reached[e[0]] != reached[e[1]]]
            if not ways:
                break
            i, j, transform, _, _ = max(ways, key=lambda e: e[4])
            if reached[j]:
                poses[i] = poses[j] @ transform
            else:
                poses[j] = poses[i] @ np.linalg.inv(transform)
            reached[[i, j]] = True
        if reached.sum() > best[1].sum():
            best = poses, reached
    return best


_FIGURES = {
    "right": "placed right",
    "wrong": "placed wrong",
    "worst_deg": "largest error, deg",
    "worst_m": "largest, m",
    "median_deg": "median, deg",
    "pairs": "pairs",
    "seconds": "s",
    "cpu_seconds": "processor s",
}
COLUMNS = {"scans": "scans", "expected": "overlap another by .3"} | {
    f"{method}_{key}": f"{label}: {words}"
    for method, label in (("jaxreg", "jaxreg"), ("open3d", "Open3D"))
    for key, words in _FIGURES.items()
}


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    data_root: str | None = None
    sequences: tuple[str, ...] = tuple(VOXEL)
    open3d: bool = True
    record: bool = True
    """Write benchmarks/results/sequences.json."""


def write(rows: dict[str, dict], old: dict) -> None:
    """The record, in which other sequences and Open3D's figures (minutes a sequence) stay as in `old`."""
    kept = old["rows"]
    others = [name for name in VOXEL if name in kept and name not in rows]
    others += [
        f"Open3D on {name}"
        for name, row in rows.items()
        if "open3d_right" in kept.get(name, {}) and "open3d_right" not in row
    ]
    merged = {
        name: kept.get(name, {}) | rows.get(name, {})
        for name in VOXEL
        if name in kept or name in rows
    }
    record.write(
        "sequences",
        question="How many scans of whole sequences are placed?",
        command=record.command("benchmarks.scans.sequences"),
        columns=COLUMNS,
        rows=merged,
        note=record.kept(old, others),
    )


def main(options: Options) -> None:
    """Align every sequence and print a table."""
    root = data_root(options.data_root)
    if root is None:
        raise SystemExit("no data: set $JAXREG_DATA or give --data-root.")
    process.enable_compilation_cache(least_seconds=0.0)
    rows = {}
    # As it stands before this run, which writes after every sequence.
    old = record.read("sequences") or {"rows": {}}
    for name in options.sequences:
        found = sequence(root, name)
        if found is None:
            continue
        methods = {"jaxreg": jaxreg_row} | ({"open3d": open3d_row} if options.open3d else {})
        rows[name] = {"label": name}
        for method, run in methods.items():
            row = run(found)
            rows[name] |= {key: row[key] for key in ("scans", "expected")}
            rows[name] |= {f"{method}_{key}": row[key] for key in _FIGURES if key in row}
            print(method, rows[name], flush=True)
        if options.record:
            write(rows, old)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
