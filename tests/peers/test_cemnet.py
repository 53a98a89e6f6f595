"""CEMNet against its equations in numpy, and its released weights where they are."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg.config import CEMNetConfig
from jaxreg.data.procedural import shapes
from jaxreg.peers import cemnet
from jaxreg.types import PointCloud, RigidTransform
from tests import oracles
from tests.peers.small import draw_variables

pytestmark = pytest.mark.loose

SMALL = CEMNetConfig(k=4, channels=(5, 6), width=8, hidden=(7, 5))


def everything(points):
    return PointCloud(jnp.asarray(points), jnp.ones(len(points), bool))


def test_six_numbers_are_scipy_s_angles_and_back(seed):
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-1.5, 1.5, size=3)
    # Upper case: intrinsic, so that the product is Rx Ry Rz.
    rotation = Rotation.from_euler("XYZ", angles[::-1]).as_matrix()
    numbers = np.concatenate([angles, rng.normal(size=3)])
    pose = cemnet.pose_of(jnp.asarray(numbers))
    np.testing.assert_allclose(pose.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(cemnet.numbers_of(pose), numbers, atol=1e-12)


@pytest.mark.parametrize("right_angle", [90, -90])
def test_two_angles_that_are_one_give_the_same_rotation(right_angle):
    rotation = Rotation.from_euler("XYZ", [25, right_angle, 40], degrees=True).as_matrix()
    pose = RigidTransform(jnp.asarray(rotation), jnp.zeros(3))
    np.testing.assert_allclose(
        cemnet.pose_of(cemnet.numbers_of(pose)).rotation, rotation, atol=1e-12
    )


def test_sparsemax_is_the_nearest_point_of_the_simplex(seed):
    scores = np.random.default_rng(seed).normal(size=6)
    constraint = {"type": "eq", "fun": lambda p: p.sum() - 1}
    nearest = minimize(
        lambda p: np.sum((p - scores) ** 2),
        np.full(6, 1 / 6),
        bounds=[(0, 1)] * 6,
        constraints=constraint,
        options={"ftol": 1e-14},
    ).x
    found = np.asarray(cemnet.sparsemax(jnp.asarray(scores)))
    np.testing.assert_allclose(found, nearest, atol=1e-5)
    assert found.sum() == pytest.approx(1)


def error_of(pose, source, reference, epsilon):
    """By a tree: two minus both consensuses of all points."""
    moved = source @ pose.rotation.T + pose.translation
    there, back = cKDTree(reference).query(moved)[0], cKDTree(moved).query(reference)[0]
    return 2 - sum(np.mean(np.maximum(1 - d / epsilon, 0)) for d in (there, back))


def drawn_poses(rng, count, spread):
    numbers = rng.normal(0, spread, size=(count, 6))
    return numbers, jax.vmap(cemnet.pose_of)(jnp.asarray(numbers))


def test_errors_of_many_poses_are_those_of_a_tree(seed):
    rng = np.random.default_rng(seed)
    source, reference = rng.uniform(-1, 1, (70, 3)), rng.uniform(-1, 1, (50, 3))
    _, poses = drawn_poses(rng, 9, 0.5)
    clouds = everything(source), everything(reference)
    found = jax.jit(lambda p: cemnet.alignment_error(p, clouds, *clouds, 0.4))(poses)
    expected = [
        error_of(RigidTransform(*pose), source, reference, 0.4)
        for pose in zip(*map(np.asarray, poses), strict=True)
    ]
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_the_nearest_row_is_that_of_a_tree(seed):
    rng = np.random.default_rng(seed)
    points, others = rng.uniform(-1, 1, (60, 3)), rng.uniform(-1, 1, (45, 3))
    mask = np.arange(45) < 40
    moved = tuple(jnp.asarray(points[:, i, None]) for i in range(3))
    cloud = PointCloud(jnp.asarray(others), jnp.asarray(mask))
    row = jax.jit(cemnet._nearest_row)(moved, cloud)[:, 0]
    distance, expected = cKDTree(others[:40]).query(points)
    np.testing.assert_allclose(np.linalg.norm(points - others[row], axis=1), distance, rtol=1e-2)
    assert np.mean(row == expected) > 0.9


def test_errors_in_reach_are_those_of_all_points_near_the_mean(seed):
    """On a surface as in ModelNet40, for candidates as the fourth round draws them."""
    rng = np.random.default_rng(seed)
    points = shapes.sample_shape(0, 11, points=768).astype(float)
    turn = Rotation.from_euler("zyx", [0.2, 0.1, -0.2]).as_matrix()
    reference = points @ turn.T + [0.1, 0.0, 0.2]
    mean = np.concatenate([Rotation.from_matrix(turn).as_euler("XYZ")[::-1], [0.1, 0, 0.2]])
    numbers = mean + rng.normal(0, 0.02, size=(12, 6))
    config = CEMNetConfig()
    clouds = everything(points), everything(reference)

    @jax.jit
    def run(numbers):
        near = cemnet._reachable(cemnet.pose_of(jnp.asarray(mean)), *clouds, config.reach)
        return cemnet._error_in_reach(numbers, near, *clouds, config)

    poses = jax.vmap(cemnet.pose_of)(jnp.asarray(numbers))
    expected = [
        error_of(RigidTransform(*pose), points, reference, config.epsilon)
        for pose in zip(*map(np.asarray, poses), strict=True)
    ]
    np.testing.assert_allclose(run(jnp.asarray(numbers)), expected, atol=5e-3)


def test_one_step_of_icp_is_that_of_least_squares(seed):
    rng = np.random.default_rng(seed)
    source, reference = rng.uniform(-1, 1, (40, 3)), rng.uniform(-1, 1, (50, 3))
    _, poses = drawn_poses(rng, 3, 0.2)
    step = jax.jit(lambda p: cemnet._icp_step(p, everything(source), everything(reference)))
    found = step(poses)
    for i, pose in enumerate(zip(*map(np.asarray, poses), strict=True)):
        moved = source @ np.asarray(pose[0]).T + pose[1]
        near = reference[cKDTree(reference).query(moved)[1]]
        rotation, translation = oracles.procrustes(source, near, np.ones(40))
        np.testing.assert_allclose(found.rotation[i], rotation, atol=1e-3)
        np.testing.assert_allclose(found.translation[i], translation, atol=1e-3)


def test_elites_are_the_weighted_mean_and_deviation(seed):
    rng = np.random.default_rng(seed)
    candidates, errors = rng.normal(size=(8, 6)), rng.uniform(0, 2, 8)
    share = np.asarray(cemnet.sparsemax(jnp.asarray(-errors)))
    found = cemnet.elites(jnp.asarray(candidates), jnp.asarray(errors))
    mean = np.average(candidates, axis=0, weights=share)
    deviation = np.sqrt(np.average((candidates - mean) ** 2, axis=0, weights=share))
    np.testing.assert_allclose(found.mu, mean, atol=1e-12)
    np.testing.assert_allclose(found.sigma, deviation, atol=1e-12)


def test_the_prior_is_that_of_the_equations(seed):
    rng = np.random.default_rng(seed)
    variables = draw_variables(cemnet, SMALL, rng)
    source, reference = rng.normal(size=(20, 3)), rng.normal(size=(17, 3))
    clouds = everything(source), everything(reference)
    found = jax.jit(lambda *x: cemnet.sampling_network(variables, *x, config=SMALL))(*clouds)
    features = []
    for points in (source, reference):
        params, statistics = (variables[kind]["features"] for kind in ("params", "batch_stats"))
        near = cKDTree(points).query(points, SMALL.k)[1]
        edges = [np.hstack([points[j], np.tile(p, (SMALL.k, 1))]) for p, j in zip(points, near)]  # noqa: B905
        features.append(np.array([oracles.dgcnn_of_edges(params, statistics, e) for e in edges]))
    scores = oracles.softmax_rows(-oracles.feature_distance(*features))
    pose = RigidTransform(*oracles.procrustes(source, scores @ reference, np.ones(20)))
    np.testing.assert_allclose(cemnet.pose_of(found.mu).rotation, pose.rotation, atol=1e-6)
    np.testing.assert_allclose(found.mu[3:], pose.translation, atol=1e-6)
    x = np.concatenate([f.max(axis=0) for f in features])
    params, statistics = (variables[kind]["sampling"] for kind in ("params", "batch_stats"))
    for i in range(2):
        x = oracles.dense(params[f"Dense_{i}"], x)
        x = oracles.batch_norm(params, statistics, f"BatchNorm_{i}", x)
        x = np.where(x > 0, x, 0.01 * x)
    sigma = 1 / (1 + np.exp(-oracles.dense(params["Dense_2"], x)))
    np.testing.assert_allclose(found.sigma, sigma, atol=1e-9)


@pytest.mark.peers
@pytest.mark.slow
@pytest.mark.float32
def test_the_released_weights_find_the_pose_the_same_one_every_time(peers_root):
    variables, whole = cemnet.load_weights(peers_root / "cemnet_modelnet40_n768_unseen0_noise0.npz")
    fresh = jax.eval_shape(lambda: cemnet.init_variables(jax.random.key(0), whole.cemnet))
    assert jax.tree.map(jnp.shape, variables) == jax.tree.map(jnp.shape, fresh)
    source = shapes.sample_shape(0, 7, points=512)
    turn = Rotation.from_euler("zyx", [30, 20, 40], degrees=True).as_matrix().astype(np.float32)
    reference = source @ turn.T + np.float32([0.2, -0.1, 0.3])
    register = jax.jit(cemnet.register, static_argnames="config")
    few = dataclasses.replace(whole.cemnet, candidates=200)
    found, again = (register(variables, source, reference, config=few) for _ in range(2))
    np.testing.assert_array_equal(found.rotation, again.rotation)
    error = Rotation.from_matrix(np.asarray(found.rotation, float) @ turn.T).magnitude()
    assert np.degrees(error) < 0.5
    assert np.median(found.confidence) > 0.9


def test_what_is_no_weight_file_is_named(tmp_path):
    np.savez(tmp_path / "other.npz", weight=np.zeros(3))
    with pytest.raises(ValueError, match=r"other\.npz has no array 'coarse.*CEMNet's whole"):
        cemnet.load_weights(tmp_path / "other.npz")
