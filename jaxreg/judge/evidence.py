"""What two clouds show for and against a pose: the one reading that ranks poses and judges them.

A right pose and a wrong one may overlap equally. What tells them apart is the fine structure: under
the right pose points that lie near the other cloud lie *on* its surface, also where that is rough,
and face its way; under a wrong one two surfaces only cross. All lengths are in spacings of the
coarser cloud, so that the reading depends on neither unit nor density.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int

from jaxreg.geometry.numerics import safe_sqrt
from jaxreg.geometry.small_linear import inverse_definite
from jaxreg.judge.surface import Examined, every
from jaxreg.types import RigidTransform

NEAR = 3.0
"""Points within this many spacings of the other cloud are read as near it."""
REACH = 6.0
"""Points farther off than NEAR and within this lie beside the other cloud. The nearest point of a
point that lies farther off may be any other."""
_UNSEEN = 2.0
"""Points between this and REACH off the interior of the other surface should have been seen there."""
ROUGH = 0.02
"""Surface variation above which a neighbourhood is rough; the plane of a wall has less."""
_APART, _ACROSS = 1.0, 0.7
"""A near point disagrees where it is this many spacings off the plane, or its cosine is below."""
_FEW, _MORE = 20.0, 50.0
"""Points that the priors of means and of shares count for, so that a handful says little."""
_SAME = 0.02
"""Two points so many spacings apart are one point: copies of a cloud share them, scans hardly any."""
_MANY = 4096
"""Clouds of fewer points than these show less."""
_LEAST = 1e-6
"""Of `held`, where nothing resists a motion."""


class Evidence(NamedTuple):
    """What one pose shows; numbers without a unit, or arrays of them with leading axes.

    `smaller` and `larger` are the shares of the points that lie near the other cloud: of the cloud
    that has less of them, and of the other. `distance` is the mean distance of near points from
    the plane of their partner, in spacings, and `rough_distance` that of points whose surface is
    rough, there or at the partner; `rough_facing` is the mean cosine of the two normals there.
    `disagreement` is the share of near points that lie off the plane or face another way, the more
    heavily weighed the rarer their direction is in their cloud (a wall agrees with every wall);
    points without a normal, and those whose partner has none, do not count for it.
    Per near point, `beside` is the number of points that lie just off the other cloud, and `unseen`
    that of those just off its *interior*: if a scan does not end there, it should have seen these
    points, too. `rough` is the share of near points that are rough, `ends` the share whose partner
    lies where its surface ends. `held` is how strongly the near surfaces resist the motion that they
    resist least; 4/15 for surfaces that face all directions everywhere, 0 for a plane.
    `same` is the share of the points that coincide with one of the other cloud, of the cloud that
    has more of them: 0 for two scans, 1 for a copy. `sparse` grows from 0 for clouds of 4,096 points
    to 1 for clouds of hardly any.
    """

    smaller: Float[Any, "*k"]
    larger: Float[Any, "*k"]
    distance: Float[Any, "*k"]
    rough_distance: Float[Any, "*k"]
    rough_facing: Float[Any, "*k"]
    disagreement: Float[Any, "*k"]
    beside: Float[Any, "*k"]
    unseen: Float[Any, "*k"]
    rough: Float[Any, "*k"]
    ends: Float[Any, "*k"]
    held: Float[Any, "*k"]
    same: Float[Any, "*k"] = 0.0
    sparse: Float[Any, "*k"] = 0.0


def read_evidence(
    pose: RigidTransform,
    source: Examined,
    reference: Examined,
    there: Int[Array, "p"],
    back: Int[Array, "q"],
    *,
    step: int = 1,
) -> Evidence:
    """The evidence for a pose; ``there[i]`` is the reference point nearest to source point i under it.

    ``back[j]`` is the source point nearest to reference point j. Both clouds are in one frame. With a
    `step`, `there` and `back` are those of every `step`-th point, and only these are read.
    Pure: any number of poses by `jax.vmap`. Padding (`mask` False) changes nothing.
    """
    turned = pose.rotation.T
    moved = source._replace(
        points=jnp.matmul(source.points, turned, precision=Precision.HIGHEST)
        + pose.translation[None, :],
        normals=jnp.matmul(source.normals, turned, precision=Precision.HIGHEST),
    )
    spacing = jnp.maximum(source.spacing, reference.spacing)
    few, fewer = every(moved, step), every(reference, step)
    one = _one_way(few, reference, there, spacing)
    other = _one_way(fewer, moved, back, spacing)
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), one, other)
    near, rough = both.near, both.near & both.rough
    sides = ((one, few), (other, fewer))
    shares = [_share(side.near, side, cloud.mask) for side, cloud in sides]
    copied = [_share(side.same, side, cloud.mask) for side, cloud in sides]
    points = [_count(cloud.mask, spacing) for cloud in (source, reference)]
    seen = _count(near, both.across)
    off = (both.across > _APART) | (both.cosine < _ACROSS)
    return Evidence(
        smaller=jnp.minimum(*shares),
        larger=jnp.maximum(*shares),
        distance=_mean(both.across, near, prior=1.2),
        rough_distance=_mean(both.across, rough, prior=1.0),
        rough_facing=_mean(both.cosine, rough, prior=0.5),
        disagreement=_sum(both.rarity, near & off) / (_sum(both.rarity, near) + _MORE),
        beside=_count(both.beside, both.across) / (seen + _MORE),
        unseen=jnp.sum(both.unseen) / (seen + _MORE),
        rough=_count(rough, both.across) / (seen + _FEW),
        ends=_sum(both.ends, near) / (seen + _MORE),
        held=_held(few.points, reference.normals[there], one.near),
        same=jnp.maximum(*copied),
        sparse=jnp.maximum(1 - jnp.minimum(*points) / _MANY, 0),
    )


class _Side(NamedTuple):
    """Of every point of one cloud: whether it is near the other, and how well it agrees there."""

    near: Bool[Array, "n"]
    same: Bool[Array, "n"]
    beside: Bool[Array, "n"]
    unseen: Float[Array, "n"]
    ends: Float[Array, "n"]
    rough: Bool[Array, "n"]
    across: Float[Array, "n"]
    cosine: Float[Array, "n"]
    rarity: Float[Array, "n"]


def _one_way(moved: Examined, other: Examined, partner: Int[Array, "n"], spacing: Array) -> _Side:
    residual = moved.points - other.points[partner]
    normal = other.normals[partner]
    far = jnp.sqrt(jnp.sum(residual**2, axis=1)) / spacing
    across = jnp.abs(jnp.sum(residual * normal, axis=1)) / spacing
    valid = moved.mask & other.mask[partner]
    return _Side(
        near=valid & (far < NEAR),
        same=valid & (far < _SAME),
        beside=valid & (far > NEAR) & (far < REACH),
        unseen=jnp.where(valid & (far > _UNSEEN) & (far < REACH), other.interior[partner], 0),
        ends=1 - other.interior[partner],
        rough=jnp.maximum(moved.variation, other.variation[partner]) > ROUGH,
        across=jnp.minimum(across, NEAR),
        cosine=jnp.abs(jnp.sum(moved.normals * normal, axis=1)),
        # Where no normal is known, nothing faces another way.
        rarity=jnp.where(_known(moved.normals) & _known(normal), moved.rarity, 0),
    )


def _known(normals: Float[Array, "n 3"]) -> Bool[Array, "n"]:
    return jnp.any(normals != 0, axis=1)


def _sum(values: Array, chosen: Array) -> Array:
    return jnp.sum(jnp.where(chosen, values, 0))


def _mean(values: Array, chosen: Array, *, prior: float) -> Array:
    return (_sum(values, chosen) + prior * _FEW) / (_count(chosen, values) + _FEW)


def _share(chosen: Array, side: _Side, mask: Array) -> Array:
    return _count(chosen, side.across) / jnp.maximum(_count(mask, side.across), 1)


def _count(chosen: Array, like: Array) -> Array:
    return jnp.sum(chosen, dtype=like.dtype)


def _held(
    points: Float[Array, "n 3"], normals: Float[Array, "n 3"], near: Bool[Array, "n"]
) -> Array:
    """``6 / trace(A^-1)`` of the mean A of ``J^T n n^T J`` over near points, about their centroid.

    The harmonic mean of the eigenvalues of A, which follows the smallest one and needs no
    decomposition (LAPACK calls of a batch wait for each other).
    """
    weight = near.astype(points.dtype)
    count = jnp.maximum(jnp.sum(weight), 1)
    centre = jnp.sum(weight[:, None] * points, axis=0) / count
    centred = (points - centre[None, :]) * weight[:, None]
    radius = safe_sqrt(jnp.sum(centred**2) / count) + 1e-12
    rows = jnp.concatenate([jnp.cross(centred / radius, normals), normals], axis=1)
    rows = rows * weight[:, None]
    mean = jnp.matmul(rows.T, rows, precision=Precision.HIGHEST) / count
    damped = mean + _LEAST * jnp.eye(6, dtype=points.dtype)
    return 6 / jnp.trace(inverse_definite(damped)) - _LEAST
