"""Clouds, poses and networks that the tests of several rooms share, and what a proper rotation is."""

import functools

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.config import ModelConfig
from jaxreg.network.model import init_variables


def shape(rng, n=300) -> np.ndarray:
    """Points of a surface without symmetry: three plates of different sizes and a rod."""
    uv = rng.uniform(size=(4, n // 4, 2))
    zero = np.zeros(n // 4)
    return np.concatenate(
        [
            np.stack([2 * uv[0, :, 0], uv[0, :, 1], zero], axis=1),
            np.stack([2 * uv[1, :, 0], zero, 0.6 * uv[1, :, 1]], axis=1),
            np.stack([zero + 0.3, uv[2, :, 0], 0.8 * uv[2, :, 1]], axis=1),
            np.stack([1.5 + 0 * zero, 0.7 + 0 * zero, 1.2 * uv[3, :, 0]], axis=1),
        ]
    )


def revolved(rng, name, n=200) -> np.ndarray:
    """Points of a circle, cylinder or sphere of radius 1."""
    if name == "sphere":
        points = rng.normal(size=(n, 3))
        return points / np.linalg.norm(points, axis=1, keepdims=True)
    turn = rng.uniform(0, 2 * np.pi, n)
    height = rng.uniform(-2, 2, n) if name == "cylinder" else 0 * turn
    return np.stack([np.cos(turn), np.sin(turn), height], axis=1)


def pose(rng, largest=40.0):
    """A rotation matrix of three angles up to `largest` degrees, and a translation."""
    angles = rng.uniform(0, largest, 3)
    return Rotation.from_euler("zyx", angles, degrees=True).as_matrix(), rng.uniform(-0.5, 0.5, 3)


def moved(points, rotation, translation):
    return points @ np.asarray(rotation).T + np.asarray(translation)


def angle_deg(a, b) -> float:
    return float(np.degrees(2 * np.arcsin(np.linalg.norm(a - b) / np.sqrt(8))))


def assert_proper(rotation, tolerance=1e-9):
    assert np.isfinite(rotation).all()
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=tolerance)
    assert np.linalg.det(rotation) == pytest.approx(1, abs=tolerance)


def draw_pair(rng, n, m):
    """Two clouds that share most points, the second moved by a small random pose."""
    points = rng.uniform(-1, 1, (max(n, m), 3))
    turn = Rotation.from_euler("zyx", rng.uniform(0, 0.5, 3)).as_matrix()
    return points[:n], points[:m] @ turn.T + rng.uniform(-0.3, 0.3, 3)


@functools.cache
def variables_of(config: ModelConfig):
    """Parameters and statistics of a network, away from their initial zeros and ones."""
    rng = np.random.default_rng(0)  # Of some other seeds no unit is alive, and no pose defined.
    shapes = jax.eval_shape(lambda: init_variables(jax.random.key(0), config))
    variables = jax.tree.map(lambda x: rng.normal(0, 0.4, x.shape), shapes)
    positive = jax.tree.map(lambda x: 0.5 + np.abs(x), variables["batch_stats"])
    return {"params": variables["params"], "batch_stats": positive}
