"""Pairs of clouds that the tests of the search share."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation


def shape(rng, n):
    """Three boxes of different sizes, glued: no symmetry."""
    sizes = np.array([[1.0, 0.3, 0.2], [0.3, 0.7, 0.25], [0.2, 0.25, 0.5]])
    centres = np.array([[0.0, 0, 0], [0.6, 0.4, 0], [-0.5, 0.1, 0.3]])
    box, side = rng.integers(0, 3, n), rng.integers(0, 3, n)
    points = rng.uniform(-0.5, 0.5, (n, 3))
    points[np.arange(n), side] = rng.choice([-0.5, 0.5], n)
    return points * sizes[box] + centres[box]


def box(rng, n):
    """A box of three different edges."""
    side, points = rng.integers(0, 3, n), rng.uniform(-0.5, 0.5, (n, 3))
    points[np.arange(n), side] = rng.choice([-0.5, 0.5], n)
    return points * [1.6, 1.1, 0.7]


def padded(points, rows, value):
    full = np.full((rows, 3), value, np.float32)
    full[: len(points)] = points
    return jnp.asarray(full), jnp.arange(rows) < len(points)


def make_pair(seed, scale=1.0):
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=rng).as_matrix()
    source, reference = scale * shape(rng, 380), scale * (shape(rng, 340) @ turn.T + 2)
    return source, reference, turn


def angle_deg(found, truth):
    return np.degrees(Rotation.from_matrix(np.asarray(found) @ truth.T).magnitude())
