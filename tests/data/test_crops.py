import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxreg.data import crops


def test_viewpoint_is_one_of_two_far_corners(seed):
    drawn = np.asarray(jax.vmap(crops.viewpoint)(jax.random.split(jax.random.key(seed), 2000)))
    positive = drawn[:, 0] > 0
    assert np.mean(positive) == pytest.approx(0.5, abs=0.05)
    offset = drawn - np.where(positive, 500, -500)[:, None]
    for axis in offset.T:  # Float32 leaves steps of 3e-5 at 500, which the test does not see.
        assert stats.kstest(axis, stats.uniform(0, 1).cdf).pvalue > 1e-3


@pytest.mark.parametrize("offset", [0.0, 4.0])
def test_order_by_distance_is_right_in_float32(offset, seed):
    rng = np.random.default_rng(seed)
    points = (rng.uniform(-1, 1, (2000, 3)) + offset).astype(np.float32)
    viewpoint = -500 + rng.random(3, np.float32)
    score = np.asarray(crops.nearness(jnp.asarray(points), jnp.asarray(viewpoint)))
    exact = np.linalg.norm(points.astype(np.float64) - viewpoint.astype(np.float64), axis=1)
    ordered = exact[np.argsort(-score)]
    assert np.all(np.maximum.accumulate(ordered) - ordered < 2e-6)


def test_nearness_is_the_squared_distance_up_to_scale_and_constant(seed):
    rng = np.random.default_rng(seed)
    points, viewpoint = rng.normal(size=(50, 3)), rng.normal(size=3) * 10
    score = np.asarray(crops.nearness(jnp.asarray(points), jnp.asarray(viewpoint)))
    norm = np.linalg.norm(viewpoint)
    expected = (norm**2 - np.sum((points - viewpoint) ** 2, axis=1)) / (2 * norm)
    np.testing.assert_allclose(score, expected, atol=1e-12)


def test_directions_are_uniform_on_the_sphere(seed):
    drawn = np.asarray(jax.vmap(crops.direction)(jax.random.split(jax.random.key(seed), 2000)))
    for axis in (drawn / np.linalg.norm(drawn, axis=1, keepdims=True)).T:
        assert stats.kstest(axis, stats.uniform(-1, 2).cdf).pvalue > 1e-3


def test_along_is_the_dot_product(seed):
    rng = np.random.default_rng(seed)
    points, direction = rng.normal(size=(50, 3)), rng.normal(size=3)
    expected = [sum(p * d for p, d in zip(point, direction, strict=True)) for point in points]
    score = crops.along(jnp.asarray(points), jnp.asarray(direction))
    np.testing.assert_allclose(score, expected, atol=1e-12)
