"""Histograms against a loop over pairs, and the laws of a local descriptor."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg.search.descriptors import BINS, fpfh, outward

pytestmark = [pytest.mark.slow]

RADIUS = 0.7


@pytest.fixture
def cloud(seed):
    rng = np.random.default_rng(seed)
    points, normals = rng.normal(size=(2, 60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return 0.5 * points, normals, cKDTree(0.5 * points).query(0.5 * points, k=13)[1][:, 1:]


def loop(points, normals, neighbors, radius):
    """The definition of Rusu et al., with the counts shared between two bins."""
    n = len(points)
    simple = np.zeros((n, 3, BINS))
    for i in range(n):
        for j in neighbors[i]:
            line = points[j] - points[i]
            if np.linalg.norm(line) >= radius:
                continue
            line = line / np.linalg.norm(line)
            a, b, toward = i, j, line
            if abs(normals[i] @ line) < abs(normals[j] @ line):
                a, b, toward = j, i, -line
            u = normals[a]
            v = np.cross(toward, u)
            v /= np.linalg.norm(v)
            w = np.cross(u, v)
            theta = np.arctan2(w @ normals[b], u @ normals[b]) / np.pi
            for row, value in enumerate((theta, v @ normals[b], u @ toward)):
                place = np.clip((value + 1) / 2 * BINS - 0.5, 0, BINS - 1)
                low = int(np.floor(place))
                simple[i, row, low] += 1 - (place - low)
                if low + 1 < BINS:
                    simple[i, row, low + 1] += place - low
    share = lambda h: h / np.maximum(h.sum(axis=-1, keepdims=True), 1e-300)  # noqa: E731
    simple = share(simple)
    result = simple.copy()
    for i in range(n):
        pairs = [(np.linalg.norm(points[j] - points[i]), j) for j in neighbors[i]]
        weights = [(1 / max(d, 0.05 * radius), j) for d, j in pairs if d < radius]
        if weights:
            result[i] += sum(w * simple[j] for w, j in weights) / sum(w for w, _ in weights)
    return share(result).reshape(n, -1)


def test_against_a_loop(cloud):
    found = fpfh(*map(jnp.asarray, cloud), RADIUS, jnp.ones(60, bool))
    np.testing.assert_allclose(found, loop(*cloud, RADIUS), atol=1e-10)


def test_rigid_motion_changes_nothing(cloud, seed):
    points, normals, neighbors = cloud
    turn = Rotation.random(random_state=seed).as_matrix()
    args = (jnp.asarray(neighbors), RADIUS, jnp.ones(60, bool))
    before = fpfh(jnp.asarray(points), jnp.asarray(normals), *args)
    after = fpfh(jnp.asarray(points @ turn.T + 3), jnp.asarray(normals @ turn.T), *args)
    np.testing.assert_allclose(after, before, atol=1e-6)


def test_padding_reaches_nothing(cloud):
    points, normals, neighbors = (np.asarray(x) for x in cloud)
    padded = np.concatenate([neighbors, np.tile(np.arange(60, 64)[:, None], (1, 12))])
    found = fpfh(
        jnp.asarray(np.concatenate([points, np.full((4, 3), 9.0)])),
        jnp.asarray(np.concatenate([normals, np.zeros((4, 3))])),
        jnp.asarray(padded),
        RADIUS,
        jnp.arange(64) < 60,
    )
    np.testing.assert_allclose(found[:60], loop(*cloud, RADIUS), atol=1e-10)
    assert not np.any(found[60:])


def test_coincident_points_and_missing_normals_are_finite():
    points, index = jnp.zeros((5, 3)), jnp.array([[1], [0], [0], [0], [0]])
    assert np.isfinite(fpfh(points, jnp.zeros((5, 3)), index, 1.0, jnp.ones(5, bool))).all()


def test_outward_normals_of_a_ball(seed):
    points = np.random.default_rng(seed).normal(size=(200, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    neighbors = cKDTree(points).query(points, k=9)[1][:, 1:]
    signs = np.where(np.arange(200) % 2, 1.0, -1.0)[:, None]
    turned = outward(jnp.asarray(points), jnp.asarray(points * signs), jnp.asarray(neighbors))
    np.testing.assert_allclose(turned, points, atol=1e-12)
