"""Generalised ICP against a general minimiser, small_gicp and Open3D."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg.refine.config import RefineConfig
from tests.compiled import gicp, icp, point_to_plane


def make_pair(seed, n=600, noise=0.002):
    """Two samplings of one closed surface, 6 degrees apart."""
    rng = np.random.default_rng(seed)

    def sample():
        p = rng.normal(size=(n, 3))
        p /= np.linalg.norm(p, axis=1, keepdims=True)
        radius = 1 + 0.2 * np.sin(3 * p[:, 0]) + 0.2 * p[:, 1] * p[:, 2]
        return p * radius[:, None] * [1.0, 0.7, 0.5] + noise * rng.normal(size=(n, 3))

    axis = rng.normal(size=3)
    rotation = Rotation.from_rotvec(np.deg2rad(6) * axis / np.linalg.norm(axis)).as_matrix()
    translation = 0.03 * rng.normal(size=3)
    return sample(), sample() @ rotation.T + translation


def covariances_by_loop(points, k, epsilon):
    index = cKDTree(points).query(points, k=k + 1)[1]
    result = []
    for row in index:
        _, axes = np.linalg.eigh(np.cov(points[row].T))
        result.append(axes @ np.diag([epsilon, 1, 1]) @ axes.T)
    return np.stack(result)


def test_fixed_point_minimises_the_mahalanobis_distances(seed):
    source, reference = make_pair(seed, n=150)
    config = RefineConfig(kernel="none", iterations=80)
    pose = gicp(jnp.asarray(source), jnp.asarray(reference), config=config)
    rotation, translation = np.asarray(pose.rotation), np.asarray(pose.translation)
    moved = source @ rotation.T + translation
    index = cKDTree(reference).query(moved)[1]
    turned = rotation @ covariances_by_loop(source, 10, 1e-3) @ rotation.T
    metric = np.linalg.inv(turned + covariances_by_loop(reference, 10, 1e-3)[index])

    def cost(step):
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        residual = moved @ turn.T + step[3:] - reference[index]
        return np.einsum("ni,nij,nj->", residual, metric, residual)

    best = minimize(cost, np.zeros(6), tol=1e-14)
    np.testing.assert_allclose(best.x, 0, atol=1e-5)


@pytest.mark.slow
def test_edges_stop_a_plate_from_sliding(seed):
    """Planes see little of a slide along them; the edges of two samplings of a plate do."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 1, (2, 8, 400, 3)) * [1, 1, 0]
    offset = np.array([0.03, -0.02, 0.01])
    config = RefineConfig(
        iterations=10,
        max_correspondence_distance=0.06,
        both_directions=True,
        k=16,
        epsilon=0.01,
        correspondences_per_point=2,
    )

    def slides(edges):
        with_edges = dataclasses.replace(config, edges=edges)
        one = lambda pair: gicp(*pair, config=with_edges).transform  # noqa: E731
        pose = jax.lax.map(one, (jnp.asarray(x + offset), jnp.asarray(y)))
        centre = x.mean(axis=1) + offset
        rotation, translation = map(np.asarray, pose)
        moved = np.einsum("bij,bj->bi", rotation, centre) + translation
        return np.linalg.norm(moved - centre + offset, axis=1)

    assert np.mean(slides(edges=True)) < 0.7 * np.mean(slides(edges=False))


def test_given_covariances_need_no_neighbours():
    x = jnp.asarray(np.random.default_rng(0).normal(size=(4, 3)))
    planes = jnp.tile(jnp.diag(jnp.array([1.0, 1.0, 0.01])), (4, 1, 1))
    pose = gicp(x, x, source_covariances=planes, reference_covariances=planes)
    np.testing.assert_allclose(pose.rotation, np.eye(3), atol=1e-12)
    with pytest.raises(ValueError, match="k = 10 neighbours in a cloud of n = "):
        gicp(
            x,
            x,
            source_covariances=planes,
            reference_covariances=planes,
            config=RefineConfig(correspondences_per_point=2),
        )


@pytest.mark.parametrize("partners", [0, 12])
def test_partners_that_are_not_neighbours_are_refused(partners):
    x = jnp.zeros((20, 3))
    message = f"correspondences_per_point = {partners}: choose 1 to k \\+ 1 = 11"
    with pytest.raises(ValueError, match=message):
        gicp(x, x, config=RefineConfig(correspondences_per_point=partners))


def test_isotropic_covariances_make_it_point_to_point(seed):
    source, reference = make_pair(seed, n=150)
    identity = jnp.tile(jnp.eye(3), (150, 1, 1))
    options = {"config": RefineConfig(kernel="none", iterations=150)}
    x, y = jnp.asarray(source), jnp.asarray(reference)
    pose = gicp(x, y, source_covariances=identity, reference_covariances=identity, **options)
    expected = icp(x, y, **options)
    np.testing.assert_allclose(pose.rotation, expected.rotation, atol=1e-7)
    np.testing.assert_allclose(pose.translation, expected.translation, atol=1e-7)


def assert_agree(pose, transformation, extent):
    rotation, translation = np.asarray(pose.rotation), np.asarray(pose.translation)
    difference = Rotation.from_matrix(rotation @ transformation[:3, :3].T).magnitude()
    assert np.rad2deg(difference) < 0.05
    assert np.linalg.norm(translation - transformation[:3, 3]) < 1e-3 * extent


@pytest.mark.parametrize("number", range(5))
def test_agrees_with_small_gicp(number, seed):
    small_gicp = pytest.importorskip("small_gicp", reason="the extra [baselines] is not installed")
    source, reference = make_pair(seed + number)
    clouds = [small_gicp.PointCloud(points) for points in (reference, source)]
    for cloud in clouds:
        small_gicp.estimate_normals_covariances(cloud, num_neighbors=11)
    theirs = small_gicp.align(
        *clouds, small_gicp.KdTree(clouds[0]), registration_type="GICP",
        max_correspondence_distance=10.0, max_iterations=200,
        rotation_epsilon=1e-8, translation_epsilon=1e-8,
    )  # fmt: skip
    config = RefineConfig(kernel="none", iterations=60)
    pose = gicp(jnp.asarray(source), jnp.asarray(reference), config=config)
    assert_agree(pose, theirs.T_target_source, extent=2.0)


@pytest.mark.parametrize("method", ["icp", "point_to_plane"])
def test_agrees_with_open3d(method, seed):
    open3d = pytest.importorskip(
        "open3d", reason="the extra [baselines] is not installed", exc_type=ImportError
    )
    source, reference = make_pair(seed)
    registration = open3d.pipelines.registration
    estimation, solve = {
        "icp": (registration.TransformationEstimationPointToPoint(), icp),
        "point_to_plane": (registration.TransformationEstimationPointToPlane(), point_to_plane),
    }[method]
    clouds = [
        open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        for points in (source, reference)
    ]
    clouds[1].estimate_normals(open3d.geometry.KDTreeSearchParamKNN(11))
    theirs = registration.registration_icp(
        *clouds, 10.0, np.eye(4), estimation,
        registration.ICPConvergenceCriteria(1e-12, 1e-12, 300),
    )  # fmt: skip
    config = RefineConfig(kernel="none", iterations=150)
    pose = solve(jnp.asarray(source), jnp.asarray(reference), config=config)
    assert_agree(pose, theirs.transformation, extent=2.0)
