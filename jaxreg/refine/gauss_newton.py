"""One Gauss-Newton step on a rigid pose: linearise, solve a damped 6x6 system, update.

The cost is ``sum_i r_i^T M_i r_i`` with ``r_i = R x_i + t - y_i``. The metric ``M_i`` decides the
kind of ICP: ``w I`` point to point, ``w n n^T`` point to plane, ``w (C_y + R C_x R^T)^-1``
generalised.
"""

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float

from jaxreg.geometry.numerics import safe_norm
from jaxreg.geometry.se3 import skew
from jaxreg.geometry.small_linear import inverse_definite
from jaxreg.types import RigidTransform

_DAMPING = 1e-5
"""Added to the diagonal, in units of its mean. Ten times the rounding error of the sums in float32:
it keeps a motion that the pairs do not constrain (along a plane, about a sphere) finite and near
zero."""
_LARGEST_ROTATION = 0.5
"""Largest rotation of one step, in radians. A linearisation is not valid beyond it."""
_LARGEST_TRANSLATION = 1.0
"""Largest translation of one step, in units of the frame."""


def gauss_newton_step(
    pose: RigidTransform,
    moved: Float[Array, "p 3"],
    target: Float[Array, "p 3"],
    metric: Float[Array, "p 3 3"],
    motions: Float[Array, "6 f"] | None = None,
) -> RigidTransform:
    """The pose after one damped step on pairs `moved` (already under `pose`) and `target`.

    `motions` is a basis of the motions (rotation vector, translation) that are unknown; None: all.
    """
    information, gradient = normal_equations(moved, target, metric)
    if motions is None:
        step = -solve_damped(information, gradient)
    else:
        part = jnp.matmul(information, motions, precision=Precision.HIGHEST)
        part = jnp.matmul(motions.T, part, precision=Precision.HIGHEST)
        force = jnp.matmul(motions.T, gradient, precision=Precision.HIGHEST)
        step = -jnp.matmul(motions, solve_damped(part, force), precision=Precision.HIGHEST)
    rotation, translation = jnp.split(step, 2)
    rotation = _shortened(rotation, _LARGEST_ROTATION)
    return update_left(pose, rotation, _shortened(translation, _LARGEST_TRANSLATION))


def normal_equations(
    moved: Float[Array, "p 3"], target: Float[Array, "p 3"], metric: Float[Array, "p 3 3"]
) -> tuple[Float[Array, "6 6"], Float[Array, "6"]]:
    """``H = sum_i J_i^T M_i J_i`` and ``g = sum_i J_i^T M_i r_i``, rotation before translation.

    ``J_i = [-[p_i]_x, I]`` is the derivative of the moved point ``p_i`` by a rotation vector and a
    translation applied from the left, ``exp(omega) p + v``. The metrics carry the weights.
    """
    p = moved
    zero, one = jnp.zeros_like(p[:, 0]), jnp.ones_like(p[:, 0])
    jacobian = jnp.stack(
        [
            jnp.stack([zero, p[:, 2], -p[:, 1], one, zero, zero], axis=-1),
            jnp.stack([-p[:, 2], zero, p[:, 0], zero, one, zero], axis=-1),
            jnp.stack([p[:, 1], -p[:, 0], zero, zero, zero, one], axis=-1),
        ],
        axis=1,
    )
    weighted = jnp.matmul(metric, jacobian, precision=Precision.HIGHEST)
    weighted = weighted.reshape(-1, 6).T
    information = jnp.matmul(weighted, jacobian.reshape(-1, 6), precision=Precision.HIGHEST)
    residual = (moved - target).reshape(-1)
    return information, jnp.matmul(weighted, residual, precision=Precision.HIGHEST)


def solve_damped(
    information: Float[Array, "f f"], gradient: Float[Array, "f"]
) -> Float[Array, "f"]:
    """``(H + d I)^-1 g`` with ``d`` in proportion to the mean of H's diagonal; 0 where H is 0."""
    unknowns = information.shape[0]
    mean = jnp.trace(information) / unknowns
    scale = jnp.where(mean > 0, mean, 1)
    damped = information / scale + _DAMPING * jnp.eye(unknowns, dtype=information.dtype)
    return jnp.matmul(inverse_definite(damped), gradient / scale, precision=Precision.HIGHEST)


def update_left(
    pose: RigidTransform, rotation: Float[Array, "3"], translation: Float[Array, "3"]
) -> RigidTransform:
    """``(exp(omega) R, exp(omega) t + v)``, with R kept orthogonal to rounding."""
    turn = rotation_from_vector(rotation)
    product = jnp.matmul(turn, pose.rotation, precision=Precision.HIGHEST)
    # A Newton step towards the nearest orthogonal matrix, or a chain of products drifts away.
    gram = jnp.matmul(product.T, product, precision=Precision.HIGHEST)
    correction = 1.5 * jnp.eye(3, dtype=gram.dtype) - 0.5 * gram
    shift = jnp.matmul(turn, pose.translation, precision=Precision.HIGHEST) + translation
    return RigidTransform(jnp.matmul(product, correction, precision=Precision.HIGHEST), shift)


def perturbation(pose: RigidTransform) -> Float[Array, "6"]:
    """Zero, with the derivative of the motion ``(omega, v)`` of `update_left` that moves `pose`."""
    fixed = jax.lax.stop_gradient(pose)
    turn = jnp.matmul(pose.rotation, fixed.rotation.T, precision=Precision.HIGHEST)
    # At the identity the skew part has the derivative of the logarithm.
    skew_part = (turn - turn.T) / 2
    rotation = jnp.stack([skew_part[2, 1], skew_part[0, 2], skew_part[1, 0]])
    turned = jnp.matmul(turn, fixed.translation, precision=Precision.HIGHEST)
    return jnp.concatenate([rotation, pose.translation - turned])


def rotation_from_vector(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """``exp([omega]_x)`` by Rodrigues' formula, smooth at zero (radians)."""
    squared = jnp.sum(vector * vector)
    small = squared < 1e-4
    safe = jnp.where(small, 1, squared)
    angle = jnp.sqrt(safe)
    # Series where the quotients lose their digits; the next terms are below 1e-16 there.
    sine = jnp.where(
        small, 1 - squared / 6 * (1 - squared / 20 * (1 - squared / 42)), jnp.sin(angle) / angle
    )
    cosine = jnp.where(
        small,
        0.5 - squared / 24 * (1 - squared / 30 * (1 - squared / 56)),
        (1 - jnp.cos(angle)) / safe,
    )
    cross = skew(vector)
    squared_cross = jnp.matmul(cross, cross, precision=Precision.HIGHEST)
    return jnp.eye(3, dtype=vector.dtype) + sine * cross + cosine * squared_cross


def _shortened(vector: Float[Array, "3"], largest: float) -> Float[Array, "3"]:
    return vector * (largest / jnp.maximum(safe_norm(vector), largest))
