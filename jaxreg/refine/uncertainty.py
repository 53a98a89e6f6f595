"""How well surfaces determine a pose: its 6x6 covariance, and the motions they leave free.

Both are computed from distances to the reference's planes, whichever method found the pose, because
a point may slide along a surface unnoticed.
"""

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jaxtyping import Array, Bool, Float, Int

from jaxreg._xla import on_any_mesh
from jaxreg.geometry import arguments, frame, rigid
from jaxreg.geometry.neighbors import knn
from jaxreg.geometry.normals import normals
from jaxreg.geometry.small_linear import singular_vectors
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.correspondences import Pairs, closest_pairs
from jaxreg.refine.cost import Scene, match
from jaxreg.refine.gauss_newton import normal_equations
from jaxreg.refine.point_to_plane import POINT_TO_PLANE
from jaxreg.refine.robust import Weighting, pair_curvatures
from jaxreg.refine.solve import set_up
from jaxreg.types import RigidTransform

WEAK = 0.01
"""A motion is weak if a unit of it changes the distances to the surfaces by less than this in the
mean square (1/3 for surfaces that face all directions)."""
_SMALLEST_EIGENVALUE = 1e-6
"""Floor of the eigenvalues of the information matrix, relative to the largest: a free motion has a
huge variance instead of an infinite one."""
_BOTH_NOISY = 1.9
"""Variance of a pose between two scans, for 1 if only the source were noisy. Two where a reference
point tells as much as a source point; planes average over the reference's."""
_PATCH = 30
"""Pairs of a patch: about twice the neighbours that share a plane."""
_BINS = 1024
"""Numbers for patches."""
LEAST_SPREAD = 0.25
"""The least spread of the slopes of patches in any motion, in units of what independent errors would
give. Few patches, or some that happen to agree, would say that a motion is known exactly."""
_LEAST_CURVATURE = 0.1
"""Of E[psi']; below it the residuals are all outliers."""
_PITCH = 0.1
"""Translation along the axis per radian, in radii of the cloud, that makes a rotation a screw."""


class PoseUncertainty(NamedTuple):
    """What the pairs show about a small motion ``(omega, v)`` of the moved source.

    The motion is ``y -> exp(omega) (y - centre) + centre + v``: rotation vector (radians) first,
    then translation (unit of the clouds), both in the axes of the reference; `centre` is the
    centroid of the reference. `information` is ``sum_i w_i J_i^T n_i n_i^T J_i``, `covariance` its
    inverse times `variance`, the weighted mean square of the distances to the planes. `length` is
    the radius that makes rotations and translations comparable, `weight` is ``sum_i w_i``.
    """

    information: Float[Any, "6 6"]
    covariance: Float[Any, "6 6"]
    variance: Float[Any, ""]
    weight: Float[Any, ""]
    centre: Float[Any, "3"]
    length: Float[Any, ""]


export.register_namedtuple_serialization(PoseUncertainty, serialized_name="jaxreg.PoseUncertainty")


class WeakDirection(NamedTuple):
    """A motion that barely changes any distance between the surfaces.

    `axis` is a unit vector, `point` a point of the axis of a rotation or screw (for a translation:
    the centre of the cloud). `strength` is the mean square change of the distances per unit motion
    (a rotation moves a point one radius away by one radius); 1/3 is that of a ball of surfaces.
    """

    kind: Literal["rotation", "translation", "screw"]
    axis: np.ndarray
    point: np.ndarray
    strength: float

    @property
    def name(self) -> str:
        """In words: "rotation about axis (0.00, 0.00, 1.00)"."""
        axis = ", ".join(f"{value:.2f}" for value in np.round(self.axis, 2) + 0.0)
        verb = {"rotation": "rotation about axis", "screw": "screw motion about axis"}
        return f"{verb.get(self.kind, 'translation along')} ({axis})"


@on_any_mesh
def pose_uncertainty(
    transform: RigidTransform,
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    reference_normals: Float[Array, "m 3"] | None = None,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
    config: RefineConfig = RefineConfig(),
    max_correspondence_distance: Float[Array, ""] | float | None = None,
    kernel_scale: Float[Array, ""] | float | None = None,
) -> PoseUncertainty:
    """Information and covariance of a pose, from nearest pairs; options as for `point_to_plane`.

    The covariance assumes that the errors of the distances are independent. It is a lower bound,
    because neighbouring points share errors. Without any pair, `weight` and everything but `centre`
    and `length` are zero.

    Raises:
      ValueError: a shape or an option is wrong, or the reference has only `config.k` points or fewer.
    """
    transform = arguments.transform("transform", transform)
    where, start, scene, *_ = set_up(
        source, reference, initial=transform, source_mask=source_mask,
        reference_mask=reference_mask, config=config,
        max_correspondence_distance=max_correspondence_distance, kernel_scale=kernel_scale,
    )  # fmt: skip
    y = scene.reference
    if reference_normals is None:
        reference_normals = normals(y, knn(y, config.k, reference_mask), reference_mask)
    reference_normals = arguments.rows("reference_normals", reference_normals, y.shape, y)
    moved = rigid.apply(start, scene.source)
    pairs = closest_pairs(moved, y, source_mask, reference_mask, both_directions=False)
    return uncertainty_of_pairs(where, moved, y, reference_normals, pairs, scene.weighting)


def about(uncertainty: PoseUncertainty, centre: Float[np.ndarray, "3"]) -> PoseUncertainty:
    """The same uncertainty for motions about another `centre` (unit of the clouds); numpy.

    A rotation ``omega`` about the old centre moves the new one by ``omega x (new - old)``.
    """
    offset = np.asarray(centre, np.float64) - np.asarray(uncertainty.centre, np.float64)
    change, back = np.eye(6), np.eye(6)
    change[3:, :3] = np.cross(np.eye(3), offset).T
    back[3:, :3] = -change[3:, :3]
    return uncertainty._replace(
        information=back.T @ np.asarray(uncertainty.information, np.float64) @ back,
        covariance=change @ np.asarray(uncertainty.covariance, np.float64) @ change.T,
        centre=np.asarray(centre, np.float64),
    )


def uncertainty_of_pairs(
    where: frame.Frame,
    moved: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    reference_normals: Float[Array, "m 3"],
    pairs: Pairs,
    weighting: Weighting,
) -> PoseUncertainty:
    """`pose_uncertainty` of given pairs of clouds in the frame."""
    scene = Scene(moved, reference, None, reference_normals, weighting)
    matched = match(scene, rigid.identity(moved.dtype), pairs, POINT_TO_PLANE)
    information, _ = normal_equations(matched.moved, matched.target, matched.metric)
    weight = jnp.sum(matched.weights)
    # Six parameters were fitted; less weight than that determines nothing.
    variance = jnp.sum(matched.weights * matched.squared) / jnp.maximum(weight - 6, 1)
    units = jnp.concatenate([jnp.ones(3, moved.dtype), jnp.full(3, where.length)])
    scaling = units[:, None] * units[None, :]
    return PoseUncertainty(
        information=information / scaling * where.length**2,
        covariance=_bounded_inverse(information) * variance * scaling,
        variance=variance * where.length**2,
        weight=weight,
        centre=where.reference_centre,
        length=where.length,
    )


def scan_covariance(
    moved: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    reference_normals: Float[Array, "m 3"],
    pairs: Pairs,
    weighting: Weighting,
    centre: Float[Array, "3"],
) -> Float[Array, "6 6"]:
    """Covariance of a pose between two *scans*, about `centre`: positive definite.

    `PoseUncertainty.covariance` takes the reference for exact and the residuals for independent. Of
    two scans both are noisy samples, and neighbouring points share what is wrong about a plane, so
    this is the covariance of an M-estimator whose errors come in patches (Liang and Zeger, 1986):

        B^-1 (c / (c - 6) sum_k g_k g_k^T) B^-1 * _BOTH_NOISY,

    with ``g_k`` the sum of ``psi(r_i) J_i^T n_i`` over patch k, about _PATCH pairs, and
    ``B = E[psi'] S``, ``S = sum_i J_i^T n_i n_i^T J_i``. No eigenvalue of the sum relative to S is less
    than LEAST_SPREAD ``E[psi^2]``. A constant of every derivative.
    """
    moved, reference = moved - centre[None, :], reference - centre[None, :]
    # A figure to read, not to descend on: which points share a patch is a discrete choice.
    moved, reference, reference_normals = jax.lax.stop_gradient(
        (moved, reference, reference_normals)
    )
    scene = Scene(moved, reference, None, reference_normals, weighting)
    pose = rigid.identity(moved.dtype)
    weighed = match(scene, pose, pairs, POINT_TO_PLANE)
    counts = weighed.counts
    number = jnp.maximum(jnp.sum(counts), 1).astype(moved.dtype)
    curvature = jnp.sum(pair_curvatures(weighed.squared, counts, weighting)) / number
    plain = weighting._replace(kernel="none", kernel_scale=None)
    even = match(scene._replace(weighting=plain), pose, pairs, POINT_TO_PLANE)
    stiffness, _ = normal_equations(even.moved, even.target, even.metric)
    bread = _bounded_inverse(stiffness) / jnp.maximum(curvature, _LEAST_CURVATURE)
    force = jnp.einsum("pij,pj->pi", weighed.metric, weighed.moved - weighed.target)
    slopes = jnp.concatenate([jnp.cross(weighed.moved, force), force], axis=1)
    spread = jnp.sqrt(jnp.sum(jnp.where(counts[:, None], weighed.moved**2, 0)) / number)
    patch = _patches(weighed.moved, spread * jnp.sqrt(_PATCH * 12 / number))
    ones = counts.astype(moved.dtype)
    filled = jnp.sum(jax.ops.segment_sum(ones, patch, _BINS) > 0).astype(moved.dtype)
    sums = jax.ops.segment_sum(slopes * ones[:, None], patch, _BINS)
    meat = jnp.matmul(sums.T, sums, precision="highest") * filled / jnp.maximum(filled - 6, 1)
    least = jnp.sum(jnp.where(counts, jnp.sum(force**2, axis=1), 0)) / number
    meat = _raised_to(meat, stiffness, LEAST_SPREAD * least)
    covariance = jnp.matmul(
        jnp.matmul(bread, meat, precision="highest"), bread, precision="highest"
    )
    # Exact copies leave no residual, only the rounding of their coordinates.
    rounding = (10 * jnp.finfo(moved.dtype).eps * spread) ** 2
    return _BOTH_NOISY * (covariance + covariance.T) / 2 + rounding * _bounded_inverse(stiffness)


def _raised_to(
    matrix: Float[Array, "6 6"], unit: Float[Array, "6 6"], least: Float[Array, ""]
) -> Float[Array, "6 6"]:
    """The matrix with every eigenvalue relative to `unit` (of ``M v = l U v``) at least `least`."""
    _, raised, vectors = _raised_eigenvalues(unit)
    root = vectors * jnp.sqrt(raised)[None, :]
    inverse = (vectors / jnp.sqrt(raised)[None, :]).T
    within = jnp.matmul(
        jnp.matmul(inverse, matrix, precision="highest"), inverse.T, precision="highest"
    )
    scaled, axes = singular_vectors(within)
    values = jnp.maximum(jnp.sum(axes * scaled, axis=0), least)
    half = jnp.matmul(root, axes * jnp.sqrt(values)[None, :], precision="highest")
    return jnp.matmul(half, half.T, precision="highest")


def _patches(points: Float[Array, "n 3"], edge: Float[Array, ""]) -> Int[Array, "n"]:
    """A number for the cube of an `edge` that a point lies in; some cubes share one."""
    cell = jnp.floor(points / jnp.maximum(edge, 1e-12)).astype(jnp.int32)
    mixed = cell * jnp.array([[73856093, 19349663, 83492791]], jnp.int32)
    return (mixed[:, 0] ^ mixed[:, 1] ^ mixed[:, 2]) & (_BINS - 1)


def weak_directions(
    uncertainty: PoseUncertainty, *, threshold: float = WEAK
) -> tuple[WeakDirection, ...]:
    """The translations and rotations whose `strength` is below `threshold`, weakest first (host).

    Translations are eigenvectors of the translation's block of the information. Rotations are those
    of what remains when every rotation may choose its best pivot (the Schur complement): a cylinder
    turns about its own axis, wherever its centroid lies. A plane has two translations and one
    rotation, a cylinder one of each, a sphere three rotations, an extruded profile one translation.
    """
    information = np.asarray(uncertainty.information, np.float64)
    length, weight = float(uncertainty.length), float(uncertainty.weight)
    centre = np.asarray(uncertainty.centre, np.float64)
    if weight <= 0:
        return ()
    units = np.repeat([1.0, length], 3)
    unit_free = information * np.outer(units, units) / (length**2 * weight)
    strengths, axes = np.linalg.eigh(unit_free[3:, 3:])
    found = [
        WeakDirection("translation", _upright(axis), centre, float(strength))
        for strength, axis in zip(strengths, axes.T, strict=True)
        if strength < threshold
    ]
    held = strengths >= threshold
    pivot = (axes[:, held] / strengths[held]) @ axes[:, held].T @ unit_free[3:, :3]
    turning = unit_free[:3, :3] - unit_free[:3, 3:] @ pivot
    strengths, axes = np.linalg.eigh((turning + turning.T) / 2)
    for strength, axis in zip(strengths, axes.T, strict=True):
        if strength < threshold:
            shift = -pivot @ axis
            kind = "screw" if abs(axis @ shift) > _PITCH else "rotation"
            point = centre + length * np.cross(axis, shift)
            found.append(WeakDirection(kind, _upright(axis), point, float(strength)))
    return tuple(sorted(found, key=lambda direction: direction.strength))


@jax.custom_jvp
def _bounded_inverse(information: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """The inverse with every eigenvalue raised to a floor, a constant of the derivative."""
    _, raised, vectors = _raised_eigenvalues(information)
    return jnp.matmul(vectors / raised[None, :], vectors.T, precision="highest")


@_bounded_inverse.defjvp
def _bounded_inverse_jvp(primals, tangents):
    """``V (F * (V^T dA V)) V^T`` with F the divided differences of ``1 / max(l, floor)``.

    The derivative of eigenvectors divides by the gaps of eigenvalues and is NaN at a ball or a cube;
    that of a function of the matrix is the slope of the function where two of them are equal.
    """
    values, raised, vectors = _raised_eigenvalues(primals[0])
    gap = values[:, None] - values[None, :]
    slope = (raised[:, None] - raised[None, :]) / jnp.where(gap == 0, 1, gap)
    slope = jnp.where(gap == 0, (raised == values)[:, None].astype(gap.dtype), slope)
    turned = jnp.matmul(vectors.T, (tangents[0] + tangents[0].T) / 2, precision="highest")
    change = jnp.matmul(turned, vectors, precision="highest")
    change = -slope * change / (raised[:, None] * raised[None, :])
    change = jnp.matmul(vectors, change, precision="highest")
    return _bounded_inverse(*primals), jnp.matmul(change, vectors.T, precision="highest")


def _raised_eigenvalues(information: Float[Array, "6 6"]):
    scaled, vectors = singular_vectors(information)
    values = jnp.sum(vectors * scaled, axis=0)
    largest = jnp.max(values)
    raised = jnp.maximum(values, _SMALLEST_EIGENVALUE * largest)
    return values, jnp.where(largest > 0, raised, 1), vectors


def _upright(axis: np.ndarray) -> np.ndarray:
    """The axis or its opposite, whichever has a positive largest coordinate."""
    return axis * np.sign(axis[np.argmax(np.abs(axis))])
