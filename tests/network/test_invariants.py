"""Edges and angles against loops, and what a rigid motion may not change."""

import functools

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.network import invariants
from tests import oracles
from tests.compiled import knn

K = 4
EDGES, ANGLES = ("vector", "length", "coordinates"), ("all", "next", "none")


@functools.cache
def structure(edge, angles):
    return jax.jit(functools.partial(invariants.geometric_structure, edge=edge, angles=angles))


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def cloud(rng, n=12):
    points = rng.normal(size=(n, 3))
    points[1] = points[0]  # A zero edge.
    return points, np.asarray(knn(points, K))


@pytest.mark.parametrize("edge", EDGES)
@pytest.mark.parametrize("angles", ANGLES)
def test_structure_neighbour_by_neighbour(rng, edge, angles):
    points, neighbors = cloud(rng)
    result = structure(edge, angles)(points, neighbors)
    expected = oracles.geometric_structure(points, neighbors, edge, angles)
    size = {"vector": 3, "coordinates": 3, "length": 1}[edge] + {"all": K, "next": 1, "none": 0}[
        angles
    ]
    assert result.shape == (12, K, size)
    np.testing.assert_allclose(result, expected, atol=1e-12)


@pytest.mark.parametrize("angles", ANGLES)
def test_lengths_and_angles_are_invariant_to_rigid_motion(rng, angles):
    points, neighbors = cloud(rng)
    moved = points @ Rotation.random(rng=rng).as_matrix().T + rng.normal(size=3)
    before, after = (structure("length", angles)(x, neighbors) for x in (points, moved))
    np.testing.assert_allclose(after, before, atol=1e-12)


def test_vectors_turn_with_the_cloud_and_ignore_translation(rng):
    points, neighbors = cloud(rng)
    rotation = Rotation.random(rng=rng).as_matrix()
    before = structure("vector", "none")(points, neighbors)
    after = structure("vector", "none")(points @ rotation.T + 3.0, neighbors)
    np.testing.assert_allclose(after, before @ rotation.T, atol=1e-12)


def test_angles_of_all_pairs_are_symmetric_with_zero_diagonal(rng):
    points, neighbors = cloud(rng)
    angles = np.asarray(structure("length", "all")(points, neighbors))[..., 1:]
    np.testing.assert_array_equal(angles, np.swapaxes(angles, 1, 2))
    np.testing.assert_array_equal(np.diagonal(angles, axis1=1, axis2=2), 0)
    assert ((angles >= 0) & (angles <= np.pi)).all()


def test_reordering_the_neighbours_reorders_the_structure(rng):
    points, neighbors = cloud(rng)
    order = rng.permutation(K)
    result = np.asarray(structure("length", "all")(points, neighbors))
    permuted = np.asarray(structure("length", "all")(points, neighbors[:, order]))
    np.testing.assert_array_equal(permuted[..., 0], result[:, order, 0])
    np.testing.assert_array_equal(permuted[..., 1:], result[:, order][..., 1:][..., order])


@pytest.mark.parametrize("angles", ANGLES)
def test_a_single_neighbour(rng, angles):
    points, neighbors = cloud(rng)
    result = structure("vector", angles)(points, neighbors[:, :1])
    expected = oracles.geometric_structure(points, neighbors[:, :1], "vector", angles)
    np.testing.assert_allclose(result, expected, atol=1e-12)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_copies_on_one_place_up_to_rounding_make_no_angles(rng, dtype):
    # A matching that cannot tell points apart gives all of them one copy, but for the last digit.
    place = rng.normal(size=3).astype(dtype)
    copies = place * (1 + np.finfo(dtype).eps * rng.integers(-3, 4, (12, 3))).astype(dtype)
    _, neighbors = cloud(rng)
    run = structure("length", "all")
    np.testing.assert_array_equal(run(copies, neighbors)[..., 1:], 0)
    gradient = jax.jit(jax.grad(lambda x, idx: run(x, idx)[..., 1:].sum()))
    np.testing.assert_array_equal(gradient(copies, neighbors), 0)
    # Small clouds far from the origin keep their angles as long as they have digits.
    small = 1 + 1e-3 * rng.normal(size=(12, 3))
    expected = oracles.geometric_structure(small, neighbors, "length", "all")
    np.testing.assert_allclose(run(small, neighbors), expected, atol=1e-9)
