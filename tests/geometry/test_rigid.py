"""Rigid transforms against numpy's 4x4 matrices and the axioms of a group."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.geometry import rigid
from jaxreg.types import RigidTransform

apply, compose, inverse, to_matrix, from_matrix = (
    jax.jit(function)
    for function in (
        rigid.apply,
        rigid.compose,
        rigid.inverse,
        rigid.to_matrix,
        rigid.from_matrix,
    )
)


def draw(rng) -> RigidTransform:
    return RigidTransform(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))


def matrix(transform: RigidTransform) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = transform
    return result


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def test_apply_maps_source_to_reference(rng):
    transform, points = draw(rng), rng.normal(size=(7, 3))
    expected = [transform.rotation @ x + transform.translation for x in points]
    np.testing.assert_allclose(apply(transform, points), expected, atol=1e-14)
    np.testing.assert_allclose(apply(transform, points[0]), expected[0], atol=1e-14)
    quarter = RigidTransform(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([0.0, 0, 5]))
    np.testing.assert_allclose(apply(quarter, np.array([1.0, 0, 0])), [0, 1, 5])


def test_compose_and_inverse_are_those_of_matrices(rng):
    first, second = draw(rng), draw(rng)
    both = compose(second, first)
    np.testing.assert_allclose(matrix(both), matrix(second) @ matrix(first), atol=1e-14)
    back = inverse(first)
    np.testing.assert_allclose(matrix(back), np.linalg.inv(matrix(first)), atol=1e-13)
    nothing = compose(back, first)
    np.testing.assert_allclose(matrix(nothing), np.eye(4), atol=1e-14)


def test_composition_is_associative_and_applies_the_first_first(rng):
    a, b, c = draw(rng), draw(rng), draw(rng)
    points = rng.normal(size=(5, 3))
    left = compose(compose(c, b), a)
    right = compose(c, compose(b, a))
    np.testing.assert_allclose(matrix(left), matrix(right), atol=1e-14)
    stepwise = apply(c, apply(b, apply(a, points)))
    np.testing.assert_allclose(apply(left, points), stepwise, atol=1e-13)


def test_matrices_there_and_back(rng):
    transform = draw(rng)
    np.testing.assert_array_equal(to_matrix(transform), matrix(transform))
    back = from_matrix(matrix(transform))
    np.testing.assert_array_equal(back.rotation, transform.rotation)
    np.testing.assert_array_equal(back.translation, transform.translation)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_identity_moves_nothing_and_keeps_the_dtype(dtype, rng):
    points = rng.normal(size=(4, 3)).astype(dtype)
    moved = apply(rigid.identity(dtype), points)
    assert moved.dtype == dtype
    np.testing.assert_array_equal(moved, points)
