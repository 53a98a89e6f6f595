"""The loop of all three methods: pair, weight, step; and the two ways to differentiate its result.

The methods differ in what they know about a surface, in the cost of a residual (`Method.cost`), and
in how they lower the cost of given pairs (`Method.step`). Everything else is here.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float

from jaxreg._xla import varying_like
from jaxreg.geometry import arguments, frame, rigid
from jaxreg.geometry.numerics import safe_sqrt
from jaxreg.geometry.procrustes import special_procrustes
from jaxreg.geometry.small_linear import singular_vectors
from jaxreg.refine.config import RefineConfig, check_options
from jaxreg.refine.correspondences import Pairs, closest_pairs, with_neighbors
from jaxreg.refine.cost import Method, Scene, match
from jaxreg.refine.gauss_newton import normal_equations, perturbation, update_left
from jaxreg.refine.robust import Weighting, widenings
from jaxreg.types import Refinement, RigidTransform

_LEAST_PULL = 1e-3
"""If an iteration takes back less than this share of a motion, the pairs leave the motion free."""
_ORTHOGONAL = 1e-3
"""Largest entry of ``R^T R - I`` in a start that stays as it is: rounding, half precision's as well."""


class Problem(NamedTuple):
    """A start and a scene in their frame; neighbours if points have more than one partner."""

    where: frame.Frame
    start: RigidTransform
    scene: Scene
    source_mask: Bool[Array, "n"] | None
    reference_mask: Bool[Array, "m"] | None
    neighbors: tuple[Array, Array] | None = None


def set_up(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    initial: RigidTransform | None,
    source_mask: Bool[Array, "n"] | None,
    reference_mask: Bool[Array, "m"] | None,
    config: RefineConfig,
    max_correspondence_distance: Float[Array, ""] | float | None,
    kernel_scale: Float[Array, ""] | float | None,
) -> Problem:
    """The problem in the frame, its surfaces still unknown.

    Raises:
      ValueError: a shape or an option is wrong.
    """
    check_options(config)
    if initial is not None:
        initial = _rotating(arguments.transform("initial", initial))
    where, x, y = frame.enter(source, reference, source_mask, reference_mask)
    if max_correspondence_distance is None:
        max_correspondence_distance = config.max_correspondence_distance
    largest = arguments.scalar("max_correspondence_distance", max_correspondence_distance, x.dtype)
    width = (
        None if kernel_scale is None else arguments.scalar("kernel_scale", kernel_scale, x.dtype)
    )
    weighting = Weighting(config.kernel, width, largest, config.trim)
    scene = Scene(x, y, None, None, weighting.in_units_of(where.length))
    start = frame.transform_in(where, initial)
    return Problem(where, start, scene, source_mask, reference_mask)


def _rotating(start: RigidTransform) -> RigidTransform:
    """The start, or what turns like it where its matrix is no rotation: the nearest one; NaN stays.

    A step turns the pose it starts from, so a mirror would remain one, and zeros would remain zeros;
    what is only known in a compiled program cannot be an error.
    """
    rotation = jnp.asarray(start.rotation)
    gram = jnp.matmul(rotation.T, rotation, precision=Precision.HIGHEST)
    unlike = jnp.max(jnp.abs(gram - jnp.eye(3, dtype=gram.dtype))) > _ORTHOGONAL
    mirrored = jnp.sum(rotation[0] * jnp.cross(rotation[1], rotation[2])) < 0
    nearest = special_procrustes(rotation.T)
    return start._replace(rotation=jnp.where(unlike | mirrored, nearest, rotation))


def solve(problem: Problem, method: Method, *, config: RefineConfig) -> Refinement:
    """The pose after `config.iterations` of `method` from the start, and how well it fits there.

    If no pair is left, the pose stays as it is.
    """
    implicit = config.gradient == "implicit"
    pose, change = _iterate(_held(problem) if implicit else problem, method, config)
    if implicit:
        pose = at_fixed_point(problem, method, pose, config=config)
    return _report(problem, method, pose, change < config.tolerance)


def _iterate(
    problem: Problem, method: Method, config: RefineConfig
) -> tuple[RigidTransform, Float[Array, ""]]:
    """The last pose, and how much the last step changed it."""

    def step(pose: RigidTransform, widening: Array):
        pairs = _pairs(problem, pose, config)
        new = method.step(pose, match(problem.scene, pose, pairs, method, widening))
        return new, change_of_pose(pose, new)

    dtype = problem.scene.source.dtype
    widths = jnp.asarray(widenings(config.iterations, config.kernel_annealing, dtype))
    rotation, shift = problem.start
    start = RigidTransform(varying_like(rotation, shift[0]), shift)
    pose, changes = jax.lax.scan(step, start, widths)
    return pose, changes[-1]


def _pairs(problem: Problem, pose: RigidTransform, config: RefineConfig) -> Pairs:
    scene = problem.scene
    pairs = closest_pairs(
        rigid.apply(pose, scene.source), scene.reference,
        problem.source_mask, problem.reference_mask, both_directions=config.both_directions,
    )  # fmt: skip
    if problem.neighbors is None:
        return pairs
    return with_neighbors(pairs, *problem.neighbors, forward=scene.source.shape[0])


def change_of_pose(old: RigidTransform, new: RigidTransform) -> Float[Array, ""]:
    """The larger of rotation (radians, for small ones) and translation between two poses.

    A constant of every derivative.
    """
    old, new = jax.lax.stop_gradient((old, new))
    turned = jnp.linalg.norm(new.rotation - old.rotation) / jnp.sqrt(2).astype(old.rotation.dtype)
    return jnp.maximum(turned, jnp.linalg.norm(new.translation - old.translation))


def at_fixed_point(
    problem: Problem, method: Method, pose: RigidTransform, *, config: RefineConfig
) -> RigidTransform:
    """`pose` itself, with the derivative that the fixed point of the iteration has.

    With F the iteration at the final width of the kernel and with the pairs of `pose`,
    ``pose = F(pose, clouds)`` gives ``d pose = (I - dF/dpose)^-1 dF/dclouds`` (implicit function
    theorem), in left perturbations (omega, v) of the pose. Motions that F does not oppose keep the
    derivative of the start, as they keep its value.
    """
    held = _held(problem)
    pairs = _pairs(held, pose, config)

    def iteration(problem: Problem, pose: RigidTransform) -> Float[Array, "6"]:
        return perturbation(method.step(pose, match(problem.scene, pose, pairs, method)))

    def of_pose(motion: Float[Array, "6"]) -> Float[Array, "6"]:
        return iteration(held, update_left(pose, *jnp.split(motion, 2)))

    dtype = problem.scene.source.dtype
    jacobian = jax.lax.stop_gradient(jax.jacfwd(of_pose)(jnp.zeros(6, dtype)))
    inverse, free = _inverse_and_rest(jnp.eye(6, dtype=dtype) - jacobian)
    motion = jnp.matmul(inverse, iteration(problem, pose), precision=Precision.HIGHEST)
    kept = jnp.matmul(free, perturbation(problem.start), precision=Precision.HIGHEST)
    return update_left(pose, *jnp.split(motion + kept, 2))


def _inverse_and_rest(
    matrix: Float[Array, "6 6"],
) -> tuple[Float[Array, "6 6"], Float[Array, "6 6"]]:
    """The inverse on what `matrix` acts upon, and the projector onto the rest."""
    scaled, right = singular_vectors(matrix)
    squared = jnp.sum(scaled**2, axis=0)
    acts = squared > _LEAST_PULL**2
    inverted = jnp.where(acts, 1 / jnp.where(acts, squared, 1), 0)
    inverse = jnp.matmul(right * inverted[None, :], scaled.T, precision=Precision.HIGHEST)
    rest = right * jnp.where(acts, 0, 1).astype(matrix.dtype)[None, :]
    return inverse, jnp.matmul(rest, right.T, precision=Precision.HIGHEST)


def _held(problem: Problem) -> Problem:
    """The problem as a constant of every derivative."""
    held = lambda leaf: jax.lax.stop_gradient(leaf) if isinstance(leaf, jax.Array) else leaf  # noqa: E731
    return jax.tree.map(held, problem)


def _report(
    problem: Problem, method: Method, pose: RigidTransform, converged: Bool[Array, ""]
) -> Refinement:
    """The pose in the unit of the clouds, and what the pairs of all source points show about it."""
    where, scene = problem.where, problem.scene
    moved = rigid.apply(pose, scene.source)
    pairs = closest_pairs(
        moved, scene.reference, problem.source_mask, problem.reference_mask, both_directions=False
    )
    matched = match(scene, pose, pairs, method)
    information, _ = normal_equations(matched.moved, matched.target, matched.metric)
    units = jnp.concatenate([jnp.ones(3, moved.dtype), jnp.full(3, where.length)])
    total = jnp.sum(matched.weights)
    mean = jnp.sum(matched.weights * matched.squared) / jnp.where(total > 0, total, 1)
    transform = frame.transform_out(where, pose)
    return Refinement(
        *transform,
        transformation=rigid.to_matrix(transform),
        confidence=matched.weights,
        correspondences=matched.target * where.length + where.reference_centre[None, :],
        residual=safe_sqrt(mean) * where.length,
        inliers=jnp.sum(matched.counts, dtype=jnp.int32),
        information=information / (units[:, None] * units[None, :]) * where.length**2,
        centre=where.reference_centre,
        converged=converged,
    )
