"""The cost of pairs under a pose: the part in which the methods of the ICP family differ."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import rigid
from jaxreg.refine.correspondences import Pairs
from jaxreg.refine.gauss_newton import gauss_newton_step
from jaxreg.refine.robust import Weighting, counting_pairs, pair_weights
from jaxreg.types import RigidTransform


class Scene(NamedTuple):
    """Both clouds in the frame, what is known about their surfaces, and how to weight their pairs.

    A surface is what the method needs: nothing, unit normals (n, 3) or covariances (n, 3, 3).
    """

    source: Float[Array, "n 3"]
    reference: Float[Array, "m 3"]
    source_surface: Any
    reference_surface: Any
    weighting: Weighting


class Cost(NamedTuple):
    """``M_i`` and ``r_i^T M_i r_i`` of every pair; `mask` is False if no surface is known."""

    metric: Float[Array, "p 3 3"]
    squared: Float[Array, "p"]
    mask: Bool[Array, "p"]


class Matched(NamedTuple):
    """Pairs under a pose: their points, before and after it, and their cost.

    `metric` is ``w_i M_i``, `squared` is ``r_i^T M_i r_i``, `weights` are ``w_i``; `counts` is False
    for pairs beyond the largest distance, outside the trim or without a surface.
    """

    source: Float[Array, "p 3"]
    moved: Float[Array, "p 3"]
    target: Float[Array, "p 3"]
    metric: Float[Array, "p 3 3"]
    squared: Float[Array, "p"]
    weights: Float[Array, "p"]
    counts: Bool[Array, "p"]


class Method(NamedTuple):
    """What distinguishes the methods: the cost of residuals ``r_i = moved - target``, and the step."""

    cost: Callable[[Scene, RigidTransform, Pairs, Array], Cost]
    step: Callable[[RigidTransform, Matched], RigidTransform]


def match(
    scene: Scene,
    pose: RigidTransform,
    pairs: Pairs,
    method: Method,
    widening: Float[Array, ""] | float = 1.0,
) -> Matched:
    """The pairs under a pose, weighted, with a kernel `widening` times as wide as its width."""
    source, target = scene.source[pairs.source_index], scene.reference[pairs.reference_index]
    moved = rigid.apply(pose, source)
    residual = moved - target
    distance = jnp.sum(residual**2, axis=-1)
    metric, squared, mask = method.cost(scene, pose, pairs, residual)
    weights = pair_weights(distance, squared, mask, scene.weighting, widening)
    counts = counting_pairs(distance, mask, scene.weighting)
    return Matched(source, moved, target, weights[:, None, None] * metric, squared, weights, counts)


def lower_by_gauss_newton(pose: RigidTransform, matched: Matched) -> RigidTransform:
    """One Gauss-Newton step with the metrics held fixed; without any pair the pose stays as it is."""
    return gauss_newton_step(pose, matched.moved, matched.target, matched.metric)
