"""Pose graphs on the host: exact, noisy (against GTSAM and scipy), and with wrong edges."""

from pathlib import Path

import numpy as np
import pytest
import scipy.optimize

from jaxreg.geometry import se3
from jaxreg.graph.pose_graph import PoseGraph, squared_errors
from jaxreg.graph.sparse import pose_covariances, solve_poses
from jaxreg.io.poses import read_g2o
from jaxreg.types import RigidTransform
from tests.graph.graphs import graph_of, perturbed, random_poses, ring


def first_from(poses: RigidTransform, truth: RigidTransform) -> RigidTransform:
    """The poses, the first one that of the truth."""
    rotation, translation = poses.rotation.copy(), poses.translation.copy()
    rotation[0], translation[0] = truth.rotation[0], truth.translation[0]
    return RigidTransform(rotation, translation)


def test_exact_edges_give_the_true_poses(seed):
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, 12)
    graph = graph_of(rng, truth, *ring(12))
    found = solve_poses(graph, first_from(perturbed(rng, truth, 0.3), truth))
    assert found.converged
    np.testing.assert_allclose(found.poses.rotation, truth.rotation, atol=1e-9)
    np.testing.assert_allclose(found.poses.translation, truth.translation, atol=1e-9)


def test_minimum_is_that_of_scipy(seed):
    """Of the same cost, by a general least-squares solver that differentiates numerically."""
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, 5)
    graph = graph_of(rng, truth, *ring(5), sigma=0.05)
    found = solve_poses(graph, first_from(truth, truth))

    def cost(step):
        moved = se3.composed(
            found.poses, se3.exp(np.concatenate([np.zeros(6), step]).reshape(-1, 6))
        )
        return np.sqrt(np.maximum(squared_errors(graph, moved), 1e-300))

    best = scipy.optimize.least_squares(cost, np.zeros(24), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    assert 2 * best.cost == pytest.approx(found.cost, rel=1e-9)
    np.testing.assert_allclose(best.x, 0, atol=1e-5)


def test_wrong_edges_are_left_out(seed):
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, 30)
    graph = graph_of(rng, truth, *ring(30, (1, 2, 5)), sigma=0.01, wrong=15)
    start = first_from(perturbed(rng, truth, 0.1), truth)
    found = solve_poses(graph, start, robust=True)
    assert not found.weights[:15].any()
    assert found.weights[15:].mean() > 0.9
    np.testing.assert_allclose(found.poses.translation, truth.translation, atol=0.1)
    plain = solve_poses(graph, start)
    assert np.abs(plain.poses.translation - truth.translation).max() > 0.3


def test_masked_edges_and_lonely_nodes_change_nothing(seed):
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, 8)
    graph = graph_of(rng, truth, *ring(8), sigma=0.02)
    start = first_from(perturbed(rng, truth, 0.1), truth)
    found = solve_poses(graph, start)
    nan = RigidTransform(np.full((1, 3, 3), np.nan), np.full((1, 3), np.nan))
    more = PoseGraph(
        np.append(graph.source, 8), np.append(graph.reference, 1),
        RigidTransform(*(np.concatenate(parts) for parts in zip(graph.transform, nan, strict=True))),
        np.concatenate([graph.information, np.eye(6)[None]]), np.append(graph.mask, False),
    )  # fmt: skip
    lonely = RigidTransform(
        np.concatenate([start.rotation, np.eye(3)[None]]),
        np.append(start.translation, [[7, 8, 9]], 0),
    )
    with np.errstate(invalid="ignore"):
        again = solve_poses(more, lonely)
    np.testing.assert_allclose(again.poses.translation[:8], found.poses.translation, atol=1e-9)
    np.testing.assert_array_equal(again.poses.translation[8], [7, 8, 9])


def test_covariances_are_the_spread_of_the_solutions(seed):
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, 6)
    sigma, twists = 0.01, []
    for _ in range(100):
        graph = graph_of(rng, truth, *ring(6), sigma=sigma)
        found = solve_poses(graph, truth)
        twists.append(se3.log(se3.between(truth, found.poses)))
    spread = np.einsum("tni,tnj->nij", twists, twists) / 100
    told = pose_covariances(graph, truth)
    np.testing.assert_array_equal(told[0], 0)
    ratio = np.linalg.eigvals(np.linalg.solve(told[1:], spread[1:])).real
    # Of 100 draws in 6 dimensions nearly all eigenvalues lie between 0.5 and 1.6.
    assert 0.35 < ratio.min() < ratio.max() < 2.2


def test_bad_graphs_are_refused(seed):
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, 4)
    graph = graph_of(rng, truth, *ring(4))
    with pytest.raises(ValueError, match="there are 3 poses"):
        solve_poses(graph, RigidTransform(truth.rotation[:3], truth.translation[:3]))
    with pytest.raises(ValueError, match="not finite"):
        solve_poses(graph, RigidTransform(truth.rotation * np.nan, truth.translation))


@pytest.mark.parametrize("name", ["pose3example.txt", "pose3example-offdiagonal.txt"])
def test_a_public_graph_has_gtsam_s_solution(name):
    """Graphs that come with GTSAM; both minimise the same cost, so the poses agree."""
    gtsam = pytest.importorskip("gtsam")
    path = Path(gtsam.findExampleDataFile(name))
    factors, initial = gtsam.readG2o(str(path), True)
    factors.add(gtsam.NonlinearEqualityPose3(0, initial.atPose3(0)))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-15)
    params.setAbsoluteErrorTol(1e-15)
    expected = gtsam.LevenbergMarquardtOptimizer(factors, initial, params).optimize()
    vertices, edges = read_g2o(path)
    matrices = np.array([vertices[k] for k in range(len(vertices))])
    start = RigidTransform(matrices[:, :3, :3], matrices[:, :3, 3])
    transform = RigidTransform(edges.transform[:, :3, :3], edges.transform[:, :3, 3])
    graph = PoseGraph(
        edges.source,
        edges.reference,
        transform,
        edges.information,
        np.ones(len(edges.source), bool),
    )
    found = solve_poses(graph, start, tolerance=1e-15)
    theirs = np.array([expected.atPose3(k).matrix() for k in range(len(matrices))])
    assert found.cost / 2 <= factors.error(expected) * (1 + 1e-9) + 1e-12
    np.testing.assert_allclose(found.poses.rotation, theirs[:, :3, :3], atol=1e-6)
    np.testing.assert_allclose(found.poses.translation, theirs[:, :3, 3], atol=1e-6)
