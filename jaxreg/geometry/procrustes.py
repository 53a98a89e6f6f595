"""Weighted Procrustes: the rigid transform between corresponding points, with a custom derivative.

The derivative of the singular value decomposition divides by *differences* of singular values and is
NaN for a cube, a cylinder or a line. The rotation itself is smooth there: its derivative divides by
*sums* of singular values, which vanish only where the best rotation is not unique.
"""

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float

from jaxreg._xla import on_any_mesh
from jaxreg.geometry import arguments
from jaxreg.geometry.eigen3x3 import pseudo_inverse
from jaxreg.geometry.numerics import safe_sqrt
from jaxreg.geometry.small_linear import singular_vectors
from jaxreg.types import RigidTransform


@on_any_mesh
def weighted_procrustes(
    source: Float[Array, "n 3"], reference: Float[Array, "n 3"], weights: Float[Array, "n"]
) -> RigidTransform:
    """The rigid transform that minimises ``sum_i w_i |R x_i + t - y_i|^2`` (Eq. 13).

    `source[i]` corresponds to `reference[i]`. Weights need not be normalised; negative weights
    count as zero. R is a rotation (det +1) for every input, mirrored and degenerate ones included.
    All weights zero give the identity; a single positive weight, or a cloud in one place, gives
    ``R = I`` and t between the centroids. If the best rotation is not unique (a line, a point) R is
    one of the best, and the derivative is the one of least norm. First and higher derivatives are
    finite everywhere.

    Raises:
      ValueError: the shapes are not ``(n, 3), (n, 3), (n,)``, or the dtypes not one of float32 and
        float64.
    """
    source = arguments.cloud("source", source)
    reference = arguments.rows("reference", reference, source.shape, source)
    weights = arguments.rows("weights", weights, source.shape[:1], source)
    weights = jnp.maximum(weights, 0)
    # What weighs nothing counts for nothing, NaN and infinity as well.
    source, reference = (jnp.where(weights[:, None] > 0, x, 0) for x in (source, reference))
    largest = jnp.max(weights, initial=0)
    # Only the proportions of the weights matter; this keeps tiny and huge ones in range.
    weights = weights / jnp.where(largest > 0, largest, 1)
    total = jnp.sum(weights)
    share = (weights / jnp.where(total > 0, total, 1))[:, None]
    source_centroid = jnp.sum(share * source, axis=0)
    reference_centroid = jnp.sum(share * reference, axis=0)
    covariance = jnp.matmul(
        (share * (source - source_centroid[None, :])).T,
        reference - reference_centroid[None, :],
        precision=Precision.HIGHEST,
    )
    # Of points in one place the centroid leaves rounding, and of that no rotation follows.
    sizes = [
        jnp.max(jnp.where(weights[:, None] > 0, jnp.abs(points), 0), initial=0)
        for points in (source, reference)
    ]
    rounding = 16 * jnp.finfo(source.dtype).eps ** 2 * sizes[0] * sizes[1]
    known = jnp.max(jnp.abs(covariance)) > jax.lax.stop_gradient(rounding)
    rotation = special_procrustes(jnp.where(known, covariance, 0))
    rotated = jnp.matmul(rotation, source_centroid, precision=Precision.HIGHEST)
    return RigidTransform(rotation, reference_centroid - rotated)


def upright_procrustes(
    source: Float[Array, "n 3"],
    reference: Float[Array, "n 3"],
    weights: Float[Array, "n"],
    up: Float[Array, "3"],
) -> RigidTransform:
    """`weighted_procrustes` among the turns about the unit vector `up`.

    The angle ``atan2(up . sum_i w_i a_i x b_i, sum_i w_i (a_i . b_i - (a_i . up) (b_i . up)))`` of the
    points a, b about their weighted centroids. If no weight is positive, the angle is 0.
    """
    weights = jnp.maximum(weights, 0)
    total = jnp.sum(weights)
    share = (weights / jnp.where(total > 0, total, 1))[:, None]
    source_centroid = jnp.sum(share * source, axis=0)
    reference_centroid = jnp.sum(share * reference, axis=0)
    a, b = source - source_centroid[None, :], reference - reference_centroid[None, :]
    along = jnp.sum(a * up[None, :], axis=1) * jnp.sum(b * up[None, :], axis=1)
    cosine = jnp.sum(share[:, 0] * (jnp.sum(a * b, axis=1) - along))
    sine = jnp.sum(share * jnp.cross(a, b) * up[None, :])
    length = safe_sqrt(cosine**2 + sine**2)
    cosine = jnp.where(length > 0, cosine / jnp.where(length > 0, length, 1), 1)
    sine = jnp.where(length > 0, sine / jnp.where(length > 0, length, 1), 0)
    x, y, z = up
    zero = jnp.zeros_like(x)
    cross = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    outer = up[:, None] * up[None, :]
    rotation = cosine * jnp.eye(3, dtype=a.dtype) + sine * cross + (1 - cosine) * outer
    rotated = jnp.matmul(rotation, source_centroid, precision=Precision.HIGHEST)
    return RigidTransform(rotation, reference_centroid - rotated)


@on_any_mesh
def robust_procrustes(
    source: Float[Array, "n 3"],
    reference: Float[Array, "n 3"],
    weights: Float[Array, "n"],
    *,
    rounds: int,
) -> RigidTransform:
    """`weighted_procrustes`, then `rounds` more times with less weight on pairs that do not fit.

    Each round multiplies the given weights by Geman and McClure's ``(s^2 / (s^2 + r_i^2))^2`` of the
    residuals ``r_i = |R x_i + t - y_i|`` of the previous solution. ``s`` is three times their
    median, so it needs no tuning. On a thin shape a single wrong pair among hundreds would turn the
    others about its axis; here it loses its pull. With no rounds this is Eq. 13.

    Raises:
      ValueError: as `weighted_procrustes`, or `rounds` is negative or not static.
    """
    rounds = arguments.count("rounds", rounds)

    def again(transform: RigidTransform, _):
        forgiving = geman_mcclure_weights(source, reference, weights, transform)
        return weighted_procrustes(source, reference, jnp.maximum(weights, 0) * forgiving), None

    plain = weighted_procrustes(source, reference, weights)
    return plain if rounds == 0 else jax.lax.scan(again, plain, length=rounds)[0]


def geman_mcclure_weights(
    source: Float[Array, "n 3"],
    reference: Float[Array, "n 3"],
    weights: Float[Array, "n"],
    transform: RigidTransform,
) -> Float[Array, "n"]:
    """``(s^2 / (s^2 + r_i^2))^2`` with s three times the median residual of positive weights."""
    error = jnp.matmul(source, transform.rotation.T, precision=Precision.HIGHEST)
    square = jnp.sum((error + transform.translation[None, :] - reference) ** 2, axis=1)
    counts = weights > 0
    ordered = jnp.sort(jnp.where(counts, square, jnp.inf))
    middle = jnp.maximum(jnp.sum(counts, dtype=jnp.int32) - 1, 0) // 2
    median = jnp.where(jnp.any(counts), ordered[middle], 0)
    # Exact pairs leave nothing but rounding, which is not a scale to judge others by.
    rounding = 16 * jnp.finfo(source.dtype).eps * jnp.max(jnp.abs(reference))
    floor = jnp.maximum(jax.lax.stop_gradient(rounding), jnp.finfo(source.dtype).tiny ** 0.25)
    scale = 9 * median + floor**2
    # In units of itself: the derivative of the quotient has the square of the scale below, which for
    # points at the origin is no number any more.
    unit = jax.lax.stop_gradient(scale)
    scale, square = scale / unit, square / unit
    return (scale / (scale + square)) ** 2


def special_procrustes(covariance: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The rotation R that maximises ``trace(R H)`` for a covariance ``H = sum_i w_i x_i y_i^T``."""
    # R does not depend on the scale of H, so the scale may be a constant of the derivative.
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(covariance)))
    return _rotation(covariance / jnp.where(scale > 0, scale, 1))


@jax.custom_jvp
def _rotation(covariance: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """By the unit quaternion q that maximises ``q^T N q`` = trace(R H) (Horn, 1987).

    N is symmetric and 4x4. Its eigenvalues are sums of three singular values of H with signs, so a
    multiple of the identity makes it positive semi-definite. With H = 0 every q is as good as
    another, and the rotations leave the first one: the identity.
    """
    across = covariance - covariance.T
    trace = jnp.trace(covariance)
    unit = jnp.eye(3, dtype=covariance.dtype)
    axial = jnp.stack([across[1, 2], across[2, 0], across[0, 1]])
    horn = jnp.block(
        [[trace[None, None], axial[None, :]],
         [axial[:, None], covariance + covariance.T - trace * unit]]
    )  # fmt: skip
    shift = jnp.sqrt(3 * jnp.sum(covariance**2))
    scaled, vectors = singular_vectors(horn + shift * jnp.eye(4, dtype=horn.dtype))
    w, x, y, z = q = vectors[:, jnp.argmax(jnp.sum(scaled**2, axis=0))]
    zero = jnp.zeros_like(w)
    turn = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    left, right = (jnp.concatenate([-q[1:, None], w * unit + t], axis=1) for t in (turn, -turn))
    rotation = jnp.matmul(left, right.T, precision=Precision.HIGHEST)
    # One Newton step towards the nearest orthogonal matrix: float32 rotations are orthogonal to
    # 1e-6 only, which a chain of iterations would add up.
    gram = jnp.matmul(rotation.T, rotation, precision=Precision.HIGHEST)
    return jnp.matmul(
        rotation, 1.5 * jnp.eye(3, dtype=gram.dtype) - 0.5 * gram, precision=Precision.HIGHEST
    )


@_rotation.defjvp
def _rotation_jvp(primals, tangents):
    """``dR = [w]_x R`` with ``(trace(A) I - A) w = x`` and ``A = R H``.

    At the optimum A is symmetric. Differentiating that, with ``dR = Omega R`` and Omega skew, gives
    ``Omega A + A Omega = (R dH)^T - R dH``, and for symmetric A the left side is the skew matrix of
    ``(trace(A) I - A) w``. Its eigenvalues are the sums of two (signed) singular values. The pseudo-
    inverse leaves out those that vanish; it is differentiable to every order.
    """
    (covariance,), (covariance_dot,) = primals, tangents
    rotation = _rotation(covariance)
    a = jnp.matmul(rotation, covariance, precision=Precision.HIGHEST)
    a = (a + a.T) / 2
    system = jnp.trace(a) * jnp.eye(3, dtype=a.dtype) - a
    skew = jnp.matmul(rotation, covariance_dot, precision=Precision.HIGHEST)
    skew = skew.T - skew
    axial = jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]])
    omega = jnp.matmul(pseudo_inverse(system), axial, precision=Precision.HIGHEST)
    return rotation, jnp.cross(omega[None, :], rotation.T).T
