"""Covariance against Monte Carlo, and free motions of known shapes by name."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.geometry import rigid
from jaxreg.refine import uncertainty as rooms
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.correspondences import Pairs
from jaxreg.refine.point_to_plane import point_to_plane
from jaxreg.refine.robust import Weighting
from jaxreg.refine.uncertainty import LEAST_SPREAD, scan_covariance, weak_directions
from jaxreg.types import RigidTransform
from tests.compiled import pose_uncertainty

TURN = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()


def shapes(rng, n=800):
    flat, angle, height = (
        rng.uniform(-1, 1, (n, 2)),
        rng.uniform(0, 2 * np.pi, n),
        rng.uniform(-1, 1, n),
    )
    ball = rng.normal(size=(n, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    box = rng.uniform(-1, 1, (n, 3))
    box[np.arange(n), rng.integers(0, 3, n)] = rng.choice([-1, 1], n)
    return {
        "plane": np.column_stack([flat, 0 * angle]),
        "cylinder": np.column_stack([0.5 * np.cos(angle), 0.5 * np.sin(angle), height]),
        "half cylinder": np.column_stack(
            [0.5 * np.cos(angle / 2), 0.5 * np.sin(angle / 2), height]
        ),
        "sphere": ball,
        "cap": np.column_stack([ball[:, :2], np.abs(ball[:, 2])]),
        "box": box,
    }


FREE = {
    "plane": ["rotation", "translation", "translation"],
    "cylinder": ["rotation", "translation"],
    "half cylinder": ["rotation", "translation"],
    "sphere": ["rotation"] * 3,
    "cap": ["rotation"] * 3,
    "box": [],
}


def test_about_another_centre_it_says_the_same_of_every_point(seed):
    rng = np.random.default_rng(seed)
    cloud = jnp.asarray(shapes(rng)["box"] + 0.01 * rng.normal(size=(800, 3)))
    here = pose_uncertainty(rigid.identity(cloud.dtype), cloud, cloud[::2])
    there = rooms.about(here, rng.normal(size=3))

    def of_a_point(uncertainty, point):
        """Covariance of the displacement ``omega x (point - centre) + v``."""
        turning = np.cross(np.eye(3), point - np.asarray(uncertainty.centre)).T
        rows = np.concatenate([turning, np.eye(3)], axis=1)
        return rows @ np.asarray(uncertainty.covariance) @ rows.T

    for point in rng.normal(size=(5, 3)):
        np.testing.assert_allclose(of_a_point(there, point), of_a_point(here, point), rtol=1e-9)
    np.testing.assert_allclose(
        there.information @ there.covariance, there.variance * np.eye(6), atol=1e-9
    )
    assert not np.allclose(there.covariance, here.covariance, atol=0)


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("name", FREE)
def test_free_motions_are_named(name, factor, seed):
    rng = np.random.default_rng(seed)
    points = shapes(rng)[name]
    points = factor * (points @ TURN.T + 3 + 0.003 * rng.normal(size=points.shape))
    cloud = jnp.asarray(points)
    uncertainty = pose_uncertainty(rigid.identity(cloud.dtype), cloud, cloud)
    weak = weak_directions(uncertainty)
    assert sorted(direction.kind for direction in weak) == FREE[name]
    if "cylinder" in name:
        for direction in weak:
            assert abs(direction.axis @ TURN[:, 2]) > 0.99
            assert "axis (" in direction.name or "along (" in direction.name
    if name == "half cylinder":
        point = next(d.point for d in weak if d.kind == "rotation")
        offset = np.cross(point / factor - 3, TURN[:, 2])
        assert np.linalg.norm(offset) < 0.1  # the axis is the cylinder's, not the centroid's
    if name == "plane":
        rotation = next(d for d in weak if d.kind == "rotation")
        assert abs(rotation.axis @ TURN[:, 2]) > 0.99


def test_covariance_is_that_of_repeated_measurements(seed):
    rng = np.random.default_rng(seed)
    uv = rng.uniform(-1, 1, (150, 2))
    points = np.column_stack([uv, 0.5 * np.sin(2 * uv[:, 0]) * np.cos(2 * uv[:, 1])]) + 5
    slope = np.column_stack(
        [np.cos(2 * uv[:, 0]) * np.cos(2 * uv[:, 1]), -np.sin(2 * uv[:, 0]) * np.sin(2 * uv[:, 1])]
    )
    normal = np.column_stack([-slope, np.ones(150)])
    normal = jnp.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))
    reference, sigma = jnp.asarray(points), 1e-3
    noise = sigma * rng.normal(size=(300, 150, 3))
    options = {"config": RefineConfig(kernel="none", iterations=4), "reference_normals": normal}

    def measure(noise):
        pose = point_to_plane(reference + noise, reference, **options).transform
        uncertainty = pose_uncertainty(pose, reference + noise, reference, **options)
        return pose, uncertainty

    poses, uncertainty = jax.jit(jax.vmap(measure))(jnp.asarray(noise))
    centre = points.mean(0)
    motion = np.concatenate(
        [
            Rotation.from_matrix(np.asarray(poses.rotation)).as_rotvec(),
            np.asarray(poses.translation) + np.asarray(poses.rotation) @ centre - centre,
        ],
        axis=1,
    )
    predicted = np.asarray(uncertainty.covariance).mean(0)
    np.testing.assert_allclose(motion.std(0), np.sqrt(np.diag(predicted)), rtol=0.2)
    np.testing.assert_allclose(np.asarray(uncertainty.variance).mean(), sigma**2, rtol=0.1)
    whitened = np.linalg.solve(np.linalg.cholesky(predicted), motion.T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(6), atol=0.3)


@pytest.mark.parametrize("patches", [4, 6, 200])
def test_few_patches_do_not_make_a_motion_certain(patches, seed):
    """Points in a few small places: their slopes span fewer motions than there are."""
    rng = np.random.default_rng(seed)
    count = 600
    place = rng.uniform(-1, 1, (patches, 3))[rng.integers(patches, size=count)]
    moved = place + rng.normal(scale=1e-3, size=(count, 3))
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sigma = 0.01
    reference = moved + rng.normal(scale=sigma, size=(count, 1)) * normals
    index = jnp.arange(count)
    pairs = Pairs(index, index, jnp.ones(count, bool))
    weighting = Weighting("none", None, np.inf, 1.0)
    arrays = (jnp.asarray(x, jnp.float32) for x in (moved, reference, normals))
    found = np.asarray(
        scan_covariance(*arrays, pairs, weighting, jnp.zeros(3, jnp.float32)), np.float64
    )
    rows = np.concatenate([np.cross(moved, normals), normals], axis=1)
    independent = sigma**2 * np.linalg.inv(rows.T @ rows)
    half = np.linalg.inv(np.linalg.cholesky(independent))
    least = np.linalg.eigvalsh(half @ found @ half.T).min()
    assert least > 0.8 * 1.9 * LEAST_SPREAD  # .8: what the noise of 600 points and float32 leave


def test_finite_without_pairs_and_without_normals():
    line = jnp.linspace(0, 1, 20)[:, None] * jnp.array([[1.0, 2, 3]])
    identity = rigid.identity(line.dtype)
    far = pose_uncertainty(identity, line, line + 100, max_correspondence_distance=0.1)
    assert far.weight == 0
    assert weak_directions(far) == ()
    for uncertainty in (far, pose_uncertainty(identity, line, line)):
        assert all(np.isfinite(leaf).all() for leaf in uncertainty)


def test_padding_changes_nothing(seed):
    points = jnp.asarray(shapes(np.random.default_rng(seed), 60)["box"])
    pose = RigidTransform(jnp.eye(3), jnp.array([0.01, 0.0, 0.0]))
    padded = jnp.concatenate([points, jnp.full((5, 3), jnp.nan)])
    mask = jnp.arange(65) < 60
    plain = pose_uncertainty(pose, points, points)
    masked = pose_uncertainty(pose, padded, padded, source_mask=mask, reference_mask=mask)
    for a, b in zip(plain, masked, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-15)
