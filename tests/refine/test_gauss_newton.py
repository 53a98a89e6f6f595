"""The Gauss-Newton step against numerical Jacobians and scipy's rotations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from jaxreg.geometry import rigid
from jaxreg.refine.gauss_newton import (
    gauss_newton_step,
    normal_equations,
    perturbation,
    rotation_from_vector,
    skew,
    solve_damped,
    update_left,
)
from jaxreg.types import RigidTransform


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 9.9e-3, 1.01e-2, 0.5, 3.0])
def test_rotation_equals_scipy(size, seed):
    axis = np.random.default_rng(seed).normal(size=3)
    vector = size * axis / np.linalg.norm(axis)
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rotation_from_vector(jnp.asarray(vector)), expected, atol=1e-15)


def test_rotation_derivative_at_zero_is_the_skew_matrix():
    jacobian = jax.jit(jax.jacobian(rotation_from_vector))(jnp.zeros(3))
    for i in range(3):
        np.testing.assert_allclose(jacobian[..., i], skew(jnp.eye(3)[i]), atol=1e-15)


def test_skew_is_the_cross_product(seed):
    u, v = np.random.default_rng(seed).normal(size=(2, 3))
    np.testing.assert_allclose(skew(jnp.asarray(u)) @ v, np.cross(u, v))


def test_normal_equations_equal_the_loop(seed):
    rng = np.random.default_rng(seed)
    p, q, root = rng.normal(size=(9, 3)), rng.normal(size=(9, 3)), rng.normal(size=(9, 3, 3))
    metric = root @ root.transpose(0, 2, 1)
    information, gradient = normal_equations(*map(jnp.asarray, (p, q, metric)))
    h, g = np.zeros((6, 6)), np.zeros(6)
    for i in range(9):
        cross = np.cross(np.eye(3), p[i])  # rows e_k x p: the motion of p by a rotation about e_k
        jacobian = np.concatenate([cross.T, np.eye(3)], axis=1)
        h += jacobian.T @ metric[i] @ jacobian
        g += jacobian.T @ metric[i] @ (p[i] - q[i])
    np.testing.assert_allclose(information, h)
    np.testing.assert_allclose(gradient, g)


def test_gradient_is_that_of_the_cost(seed):
    rng = np.random.default_rng(seed)
    p, q = (jnp.asarray(rng.normal(size=(9, 3))) for _ in range(2))
    metric = jnp.tile(jnp.eye(3), (9, 1, 1))
    identity = rigid.identity(jnp.float64)

    def cost(step):
        moved = rigid.apply(update_left(identity, step[:3], step[3:]), p)
        return jnp.sum((moved - q) ** 2) / 2

    np.testing.assert_allclose(
        normal_equations(p, q, metric)[1], jax.grad(cost)(jnp.zeros(6)), atol=1e-12
    )


def test_solution_is_that_of_the_system(seed):
    root, g = np.random.default_rng(seed).normal(size=(6, 6)), np.arange(6.0)
    h = root @ root.T + 10 * np.eye(6)
    expected = np.linalg.solve(h, g)
    np.testing.assert_allclose(
        jax.jit(solve_damped)(jnp.asarray(h), jnp.asarray(g)), expected, rtol=1e-3, atol=1e-5
    )


def test_nothing_to_solve_is_no_step():
    zero = jnp.zeros((6, 6)), jnp.zeros(6)
    np.testing.assert_array_equal(solve_damped(*zero), np.zeros(6))
    assert all(np.isfinite(j).all() for j in jax.jit(jax.jacobian(solve_damped, (0, 1)))(*zero))


def test_small_motion_is_found_in_one_step(seed):
    rng = np.random.default_rng(seed)
    p = jnp.asarray(rng.normal(size=(20, 3)))
    motion = update_left(rigid.identity(p.dtype), 1e-4 * p[0], 1e-4 * p[1])
    metric = jnp.tile(jnp.eye(3), (20, 1, 1))
    found = gauss_newton_step(rigid.identity(p.dtype), p, rigid.apply(motion, p), metric)
    np.testing.assert_allclose(found.rotation, motion.rotation, atol=1e-7)
    np.testing.assert_allclose(found.translation, motion.translation, atol=1e-7)


def test_perturbation_is_zero_with_the_derivative_of_the_motion(seed):
    rng = np.random.default_rng(seed)
    pose = RigidTransform(
        jnp.asarray(Rotation.random(random_state=rng).as_matrix()), 3 * jnp.ones(3)
    )

    def of_motion(motion):
        return perturbation(update_left(pose, *jnp.split(motion, 2)))

    np.testing.assert_allclose(of_motion(jnp.asarray(rng.normal(size=6))), 0, atol=1e-15)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(of_motion)(jnp.zeros(6)), np.eye(6), atol=1e-12)


def test_step_is_bounded_and_differentiable(seed):
    rng = np.random.default_rng(seed)
    p, q = (jnp.asarray(rng.normal(size=(12, 3))) for _ in range(2))
    pose = RigidTransform(rotation_from_vector(p[0]), q[0])
    metric = jnp.tile(jnp.eye(3), (12, 1, 1))

    @jax.jit
    def step(p, q, metric):
        return gauss_newton_step(pose, jnp.asarray(p), jnp.asarray(q), jnp.asarray(metric))

    far = step(p, q + 100, metric)
    np.testing.assert_allclose(np.linalg.norm(far.translation - pose.translation), 1, atol=2)
    np.testing.assert_allclose(far.rotation @ far.rotation.T, np.eye(3), atol=1e-12)
    check_grads(step, (p, q, metric), order=1, modes=("fwd", "rev"), eps=1e-6, rtol=1e-6)
