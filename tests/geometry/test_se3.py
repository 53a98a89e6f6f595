"""SE(3) against the matrix exponential and differences of its logarithm."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxreg.geometry import se3
from jaxreg.types import RigidTransform

ANGLES = (0.0, 1e-6, 3e-3, 0.0099, 0.0101, 0.3, 0.33, 1.0, 2.5, 3.14)


def twist(rng, angle: float) -> np.ndarray:
    axis = rng.normal(size=3)
    return np.concatenate([angle * axis / np.linalg.norm(axis), rng.normal(size=3)])


def matrix(xi: np.ndarray) -> np.ndarray:
    x, y, z = xi[:3]
    algebra = np.zeros((4, 4))
    algebra[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    algebra[:3, 3] = xi[3:]
    return algebra


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_is_that_of_the_matrix_and_log_its_inverse(angle, seed):
    xi = twist(np.random.default_rng(seed), angle)
    found = se3.exp(xi)
    expected = scipy.linalg.expm(matrix(xi))
    np.testing.assert_allclose(found.rotation, expected[:3, :3], atol=1e-13)
    np.testing.assert_allclose(found.translation, expected[:3, 3], atol=1e-13)
    np.testing.assert_allclose(se3.log(found), xi, atol=1e-11)


def test_half_turns_have_a_logarithm(seed):
    rng = np.random.default_rng(seed)
    for axis in (*np.eye(3), np.array([0.6, 0.8, 0]), rng.normal(size=3)):
        omega = np.pi * axis / np.linalg.norm(axis)
        back = se3.exp(se3.log(se3.exp(np.concatenate([omega, [1, 2, 3]]))))
        np.testing.assert_allclose(
            back.rotation, se3.exp(np.append(omega, [0, 0, 0])).rotation, atol=1e-9
        )
        np.testing.assert_allclose(
            back.translation, se3.exp(np.append(omega, [1, 2, 3])).translation, atol=1e-9
        )


def test_adjoint_carries_twists(seed):
    rng = np.random.default_rng(seed)
    pose, xi = se3.exp(twist(rng, 1.2)), twist(rng, 0.4)
    left = se3.composed(se3.composed(pose, se3.exp(xi)), se3.inverted(pose))
    right = se3.exp(se3.adjoint(pose) @ xi)
    np.testing.assert_allclose(left.rotation, right.rotation, atol=1e-13)
    np.testing.assert_allclose(left.translation, right.translation, atol=1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.3, 0.32, 1.0, 2.0, 3.0])
def test_inverse_right_jacobian_is_the_derivative_of_the_matrix_logarithm(angle, seed):
    """By scipy's logarithm of the 4x4 matrix, and central differences."""
    xi, step = twist(np.random.default_rng(seed), angle), 1e-5

    def logarithm(delta):
        found = scipy.linalg.logm(scipy.linalg.expm(matrix(xi)) @ scipy.linalg.expm(matrix(delta)))
        return np.array([found[2, 1], found[0, 2], found[1, 0], *found[:3, 3]]).real

    columns = [(logarithm(step * e) - logarithm(-step * e)) / (2 * step) for e in np.eye(6)]
    found = se3.inverse_right_jacobian(xi)
    np.testing.assert_allclose(found, np.stack(columns, axis=1), atol=1e-7)


def test_jax_and_numpy_give_the_same(seed):
    rng = np.random.default_rng(seed)
    xi = np.stack([twist(rng, angle) for angle in ANGLES])

    def everything(xi):
        pose = se3.exp(xi)
        return pose, se3.log(pose), se3.adjoint(pose), se3.inverse_right_jacobian(xi)

    for one, other in zip(
        jax.tree.leaves(everything(xi)), jax.tree.leaves(jax.jit(everything)(xi)), strict=True
    ):
        np.testing.assert_allclose(other, one, atol=1e-9)


def test_derivatives_are_finite_at_the_identity_and_at_half_a_turn():
    turns = np.stack([np.eye(3), np.diag([1.0, -1, -1])])
    poses = RigidTransform(jnp.asarray(turns), jnp.ones((2, 3)))
    slope = jax.jit(
        jax.grad(lambda pose: jnp.sum(se3.log(pose)) + jnp.sum(se3.exp(0 * se3.log(pose))[1]))
    )
    for leaf in jax.tree.leaves(slope(poses)):
        assert np.isfinite(leaf).all()
