"""A large pose graph with wrong edges: time and accuracy beside GTSAM's, in the same run.

    python -m benchmarks.scans.pose_graphs [--poses 10000]

The poses walk up and down the aisles of a hall, floor after floor. Every pose is joined to the next one,
and to some that lie beside it; of these loops every tenth is any transform instead. Both solvers start
from the chain of neighbours, know that it is right, and use graduated non-convexity with truncated least
squares.
"""

import dataclasses
import time

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from benchmarks import record
from jaxreg.geometry import se3
from jaxreg.graph.pose_graph import CHI_SQUARED, PoseGraph
from jaxreg.graph.sparse import solve_poses
from jaxreg.graph.trees import tree_poses
from jaxreg.types import RigidTransform

_SIGMA = np.repeat([0.005, 0.02], 3)
"""Radians and metres."""
_AISLE = 25
"""Poses along an aisle."""
_AISLES = 20
"""Aisles of a floor."""


def hall(count: int, wrong: float, seed: int = 0) -> tuple[RigidTransform, PoseGraph, np.ndarray]:
    """True poses, edges, and which edges are wrong."""
    rng = np.random.default_rng(seed)
    k = np.arange(count)
    along, aisle = k % _AISLE, k // _AISLE
    place = np.stack(
        [
            np.where(aisle % 2 == 0, along, _AISLE - 1 - along),
            2.0 * (aisle % _AISLES),
            3.0 * (aisle // _AISLES),
        ],
        axis=1,
    )
    turn = Rotation.from_euler("z", 180.0 * (aisle % 2)[:, None], degrees=True)
    turn = Rotation.from_rotvec(rng.normal(scale=0.2, size=(count, 3))) * turn
    truth = RigidTransform(turn.as_matrix(), place + rng.normal(scale=0.1, size=(count, 3)))
    beside = k + 2 * (_AISLE - 1 - along) + 1
    loops = np.flatnonzero((beside < count) & (rng.random(count) < 0.8))
    reference = np.concatenate([k[:-1], k[loops]])
    source = np.concatenate([k[1:], beside[loops]])
    ends = (RigidTransform(*(part[i] for part in truth)) for i in (reference, source))
    exact = se3.between(*ends)
    noise = rng.normal(size=(len(source), 6)) * _SIGMA
    measured = se3.composed(exact, se3.exp(noise))
    bad = np.zeros(len(source), bool)
    bad[count - 1 :] = rng.random(len(loops)) < wrong
    number = int(bad.sum())
    measured.rotation[bad] = Rotation.random(number, random_state=rng).as_matrix()
    measured.translation[bad] = rng.normal(scale=5, size=(number, 3))
    information = np.repeat(np.diag(1 / _SIGMA**2)[None], len(source), 0)
    mask = np.ones(len(source), bool)
    return truth, PoseGraph(source, reference, measured, information, mask), bad


def chain(count: int, graph: PoseGraph) -> RigidTransform:
    """Poses along the neighbours."""
    return tree_poses(count, graph, np.arange(count - 1), np.array([0]))


def trajectory_error(poses: RigidTransform, truth: RigidTransform) -> float:
    """Root mean square distance from the true places, both with the first pose at the identity."""
    found, true = (
        se3.between(RigidTransform(*(part[:1] for part in p)), p) for p in (poses, truth)
    )
    return float(np.sqrt(np.mean(np.sum((found.translation - true.translation) ** 2, axis=1))))


def ours(graph: PoseGraph, start: RigidTransform) -> tuple[RigidTransform, np.ndarray]:
    trusted = np.arange(len(graph.source)) < len(start.translation) - 1
    found = solve_poses(graph, start, robust=True, trusted=trusted)
    return found.poses, found.weights < 0.5


def gtsam_s(graph: PoseGraph, start: RigidTransform) -> tuple[RigidTransform, np.ndarray]:
    import gtsam

    factors, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Diagonal.Sigmas(_SIGMA)
    count = len(start.translation)
    for k in range(count):
        initial.insert(k, gtsam.Pose3(gtsam.Rot3(start.rotation[k]), start.translation[k]))
    for k in range(len(graph.source)):
        pose = gtsam.Pose3(gtsam.Rot3(graph.transform.rotation[k]), graph.transform.translation[k])
        ends = int(graph.reference[k]), int(graph.source[k])
        factors.add(gtsam.BetweenFactorPose3(*ends, pose, noise))
    first = initial.atPose3(0)
    factors.add(gtsam.PriorFactorPose3(0, first, gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    params = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers([*range(count - 1), len(graph.source)])
    optimizer = gtsam.GncLMOptimizer(factors, initial, params)
    # GTSAM's threshold is on half the squared error.
    optimizer.setInlierCostThresholds(CHI_SQUARED / 2)
    found = optimizer.optimize()
    weights = np.asarray(optimizer.getWeights())[: len(graph.source)]
    matrices = np.array([found.atPose3(k).matrix() for k in range(count)])
    return RigidTransform(matrices[:, :3, :3], matrices[:, :3, 3]), weights < 0.5


COLUMNS = {
    "poses": "poses",
    "edges": "edges",
    "wrong": "wrong edges",
    "refused": "wrong and refused",
    "lost": "right and refused",
    "ate": "root mean square error of the places, m",
    "seconds": "s",
    "cpu_seconds": "processor s",
}


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    poses: int = 10_000
    wrong: float = 0.1
    """Share of the loops that are wrong."""
    record: bool = True
    """Write benchmarks/results/pose_graphs.json."""


def main(options: Options) -> None:
    """Solve the graph by both and print a table."""
    truth, graph, bad = hall(options.poses, options.wrong)
    start = chain(options.poses, graph)
    rows = {}
    for name, solve in {"jaxreg": ours, "gtsam": gtsam_s}.items():
        begin, cpu = time.perf_counter(), time.process_time()
        poses, refused = solve(graph, start)
        rows[name] = {
            "label": name,
            "poses": options.poses,
            "edges": len(graph.source),
            "wrong": int(bad.sum()),
            "refused": int((refused & bad).sum()),
            "lost": int((refused & ~bad).sum()),
            "ate": trajectory_error(poses, truth),
            "seconds": time.perf_counter() - begin,
            "cpu_seconds": time.process_time() - cpu,
        }
        print(rows[name], flush=True)
    if options.record:
        record.write(
            "pose_graphs",
            question="How long does a large pose graph with wrong edges take?",
            command=record.command("benchmarks.scans.pose_graphs"),
            columns=COLUMNS,
            rows=rows,
        )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
