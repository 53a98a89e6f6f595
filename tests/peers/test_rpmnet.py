"""RPM-Net's stages against numpy, and its whole against a pose that good features would give."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural import shapes
from jaxreg.peers import rpmnet
from jaxreg.types import PointCloud
from tests import oracles
from tests.peers.small import SMALL, draw_variables

pytestmark = pytest.mark.loose


def everything(points):
    return PointCloud(jnp.asarray(points), jnp.ones(len(points), bool))


def sinkhorn(affinity, rounds):
    """In the matrix with a slack row and column, which are not made to sum to 1 themselves."""
    n, m = affinity.shape
    matrix = np.ones((n + 1, m + 1))
    matrix[:n, :m] = np.exp(affinity)
    for _ in range(rounds):
        matrix[:n] /= matrix[:n].sum(axis=1, keepdims=True)
        matrix[:, :m] /= matrix[:, :m].sum(axis=0, keepdims=True)
    return matrix[:n, :m]


def test_sinkhorn_is_that_of_the_padded_matrix(seed):
    affinity = 3 * np.random.default_rng(seed).normal(size=(6, 8))
    valid = np.ones((6, 8), bool)
    found = rpmnet.sinkhorn(jnp.asarray(affinity), jnp.asarray(valid), rounds=5)
    np.testing.assert_allclose(found, sinkhorn(affinity, 5), rtol=1e-9)
    assert (np.asarray(found).sum(axis=1) < 1).all()
    valid[4:, :] = valid[:, 7:] = False
    found = rpmnet.sinkhorn(jnp.asarray(affinity), jnp.asarray(valid), rounds=5)
    np.testing.assert_allclose(found[:4, :7], sinkhorn(affinity[:4, :7], 5), rtol=1e-9)
    np.testing.assert_array_equal(np.asarray(found)[~valid], 0)


def test_a_neighbourhood_is_the_first_points_within_the_radius(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (30, 3))
    config = SMALL["rpmnet"].__class__(radius=0.6, neighbors=5, k_normals=6)
    found = rpmnet.neighborhoods(everything(points), config=config)
    outward = np.asarray(rpmnet.oriented_normals(everything(points), k=6))
    assert (np.sum(outward * (points - points.mean(axis=0)), axis=1) > 0).all()
    for i, x in enumerate(points):
        near = [j for j, y in enumerate(points) if j != i and np.linalg.norm(x - y) <= 0.6][:5]
        near += [i] * (5 - len(near))
        np.testing.assert_array_equal(found.neighbors[i], near)
        for r, j in enumerate(near):
            d = points[j] - x
            expected = [
                oracles.angle(outward[i], d),
                oracles.angle(outward[j], d),
                oracles.angle(outward[i], outward[j]),
                np.linalg.norm(d),
            ]
            np.testing.assert_allclose(found.ppf[i, r], expected, atol=1e-9)


def test_a_motion_of_the_cloud_leaves_its_point_pair_features_alone(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (30, 3))
    moved = points @ Rotation.random(rng=rng).as_matrix().T + rng.normal(size=3)
    both = [rpmnet.neighborhoods(everything(x), config=SMALL["rpmnet"]) for x in (points, moved)]
    np.testing.assert_array_equal(both[0].neighbors, both[1].neighbors)
    np.testing.assert_allclose(both[0].ppf, both[1].ppf, atol=1e-7)


def test_group_norm_is_that_of_numpy(seed):
    rng = np.random.default_rng(seed)
    x, mask = rng.normal(2, 3, size=(9, 2, 8)), np.arange(9) < 6
    params = {"scale": rng.normal(size=8), "bias": rng.normal(size=8)}
    norm = rpmnet._GroupNorm(4)
    found = norm.apply({"params": params}, jnp.asarray(x), jnp.asarray(mask)[:, None])
    grouped = x[:6].reshape(12, 4, 2)
    mean = grouped.mean(axis=(0, 2), keepdims=True)
    normal = (grouped - mean) / np.sqrt(grouped.var(axis=(0, 2), keepdims=True) + 1e-5)
    expected = normal.reshape(6, 2, 8) * params["scale"] + params["bias"]
    np.testing.assert_allclose(found[:6], expected, atol=1e-9)


def test_the_last_step_is_procrustes_of_its_own_matches(seed):
    rng = np.random.default_rng(seed)
    variables = draw_variables(rpmnet, SMALL["rpmnet"], rng)
    source = shapes.sample_shape(0, 3, points=24).astype(float)
    reference = source[:20] + 0.01 * rng.normal(size=(20, 3))
    register = jax.jit(rpmnet.register, static_argnames="config")
    found = register(variables, source, reference, config=SMALL["rpmnet"])
    assert (np.asarray(found.confidence) <= 1 + 1e-12).all()
    rotation, translation = oracles.procrustes(
        source, np.asarray(found.correspondences), np.asarray(found.confidence)
    )
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-6)
    np.testing.assert_allclose(found.translation, translation, atol=1e-6)
