"""Rigid transforms against numpy's 4x4 matrices and the axioms of a group."""

import re
import sys

import jax
import jax.numpy as jnp
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


def draw_many(rng, *batch) -> RigidTransform:
    count = int(np.prod(batch))
    rotations = Rotation.random(count, rng=rng).as_matrix()
    return RigidTransform(rotations.reshape(*batch, 3, 3), rng.normal(size=(*batch, 3)))


def test_leading_axes_are_a_loop_over_them(rng):
    many, others = draw_many(rng, 2, 4), draw_many(rng, 2, 4)
    points = rng.normal(size=(2, 4, 5, 3))
    moved, both, back = apply(many, points), compose(many, others), inverse(many)
    matrices = to_matrix(many)
    for index in np.ndindex(2, 4):
        one, other = (
            RigidTransform(t.rotation[index], t.translation[index]) for t in (many, others)
        )
        expected = points[index] @ one.rotation.T + one.translation
        np.testing.assert_allclose(moved[index], expected, atol=1e-14)
        np.testing.assert_array_equal(matrices[index], matrix(one))
        product = matrix(one) @ matrix(other)
        np.testing.assert_allclose(both.rotation[index], product[:3, :3], atol=1e-14)
        np.testing.assert_allclose(both.translation[index], product[:3, 3], atol=1e-14)
        inverted = np.linalg.inv(matrix(one))
        np.testing.assert_allclose(back.rotation[index], inverted[:3, :3], atol=1e-13)
        np.testing.assert_allclose(back.translation[index], inverted[:3, 3], atol=1e-13)
    again = from_matrix(matrices)
    np.testing.assert_array_equal(again.rotation, many.rotation)
    np.testing.assert_array_equal(again.translation, many.translation)


def test_one_transform_composes_with_many_and_moves_points_of_any_shape(rng):
    one, many = draw(rng), draw_many(rng, 4)
    left, right = compose(one, many), compose(many, one)
    for i in range(4):
        other = matrix(RigidTransform(many.rotation[i], many.translation[i]))
        for found, expected in ((left, matrix(one) @ other), (right, other @ matrix(one))):
            np.testing.assert_allclose(found.rotation[i], expected[:3, :3], atol=1e-14)
            np.testing.assert_allclose(found.translation[i], expected[:3, 3], atol=1e-14)
    points = rng.normal(size=(2, 0, 5, 3))
    assert apply(one, points).shape == points.shape
    points = rng.normal(size=(2, 6, 5, 3))
    expected = points @ one.rotation.T + one.translation
    np.testing.assert_allclose(apply(one, points), expected, atol=1e-14)
    assert apply(many, points[0, :4, 0]).shape == (4, 3)


@pytest.mark.untyped
def test_axes_that_do_not_fit_are_named(rng):
    many = draw_many(rng, 4)
    crooked = RigidTransform(np.eye(3), np.zeros((4, 3)))
    for call, message in (
        (lambda: apply(many, np.zeros((5, 3))), "leading axes (4,) cannot move points (5, 3)"),
        (lambda: apply(draw(rng), np.zeros((5, 4))), "points must have shape (..., 3), got (5, 4)"),
        (lambda: apply(crooked, np.zeros((5, 3))), "not (3, 3) and (4, 3)"),
        (lambda: compose(many, draw_many(rng, 3)), "leading axes (4,) and (3,) do not match"),
        (lambda: compose(many, crooked), "not (3, 3) and (4, 3)"),
        (lambda: inverse(crooked), "not (3, 3) and (4, 3)"),
        (lambda: to_matrix(crooked), "not (3, 3) and (4, 3)"),
        (lambda: from_matrix(np.zeros((3, 4))), "shape (..., 4, 4), not (3, 4)"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            call()


@pytest.fixture
def jaxlie():
    """The library, which promotes ranks."""
    library = pytest.importorskip("jaxlie", reason="jaxlie (the extra [dev]) is not installed")
    with jax.numpy_rank_promotion("allow"):
        yield library


@pytest.mark.loose
def test_jaxlie_there_and_back(rng, jaxlie):
    for transform in (draw(rng), draw_many(rng, 4)):
        transform = jax.tree.map(jnp.asarray, transform)
        pose = jax.jit(rigid.to_jaxlie)(transform)
        assert isinstance(pose, jaxlie.SE3)
        np.testing.assert_allclose(pose.as_matrix(), to_matrix(transform), atol=1e-14)
        back = jax.jit(rigid.from_jaxlie)(pose)
        np.testing.assert_allclose(back.rotation, transform.rotation, atol=1e-14)
        np.testing.assert_array_equal(back.translation, transform.translation)
        point = rng.normal(size=transform.translation.shape)
        np.testing.assert_allclose(pose.apply(point), apply(transform, point), atol=1e-14)


@pytest.mark.loose
def test_jaxlie_is_differentiable_both_ways(rng, jaxlie):
    step = jnp.asarray(rng.normal(size=6))

    def by_jaxlie(step):
        return jaxlie.SE3.exp(step).apply(jnp.ones(3))

    def there_and_back(step):
        transform = rigid.from_jaxlie(jaxlie.SE3.exp(step))
        return rigid.from_jaxlie(rigid.to_jaxlie(transform))

    def by_jaxreg(step):
        return rigid.apply(there_and_back(step), jnp.ones(3))

    expected = jax.jacobian(by_jaxlie)(step)
    np.testing.assert_allclose(jax.jacfwd(by_jaxreg)(step), expected, atol=1e-12)
    np.testing.assert_allclose(jax.jacrev(by_jaxreg)(step), expected, atol=1e-12)


def test_a_missing_jaxlie_is_named(monkeypatch, rng):
    monkeypatch.setitem(sys.modules, "jaxlie", None)
    with pytest.raises(ImportError, match="to_jaxlie needs jaxlie: pip install jaxlie"):
        rigid.to_jaxlie(draw(rng))


def test_angle_between_rotations_is_scipy_s(seed):
    one, other = (Rotation.random(20, random_state=seed + i) for i in range(2))
    expected = np.degrees((one * other.inv()).magnitude())
    angle = rigid.rotation_angle_deg(one.as_matrix(), other.as_matrix())
    np.testing.assert_allclose(angle, expected, rtol=1e-10)
    tiny = Rotation.from_rotvec([[1e-9, 0, 0]]).as_matrix()
    np.testing.assert_allclose(rigid.rotation_angle_deg(tiny, np.eye(3)[None]), np.degrees(1e-9))
