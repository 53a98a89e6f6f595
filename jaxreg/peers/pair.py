"""What every peer does with a pair: check it on the way in, make its record on the way out."""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float

from jaxreg._xla import varying_like
from jaxreg.config import Config
from jaxreg.geometry import arguments, rigid
from jaxreg.geometry.neighbors import knn, nearest_in, without_padding
from jaxreg.geometry.numerics import all_finite
from jaxreg.types import PointCloud, Registration, RigidTransform

_Settings = TypeVar("_Settings")


def settings(config: Any, section: str, kind: type[_Settings]) -> _Settings:
    """The settings of one peer: `config` itself, or its section of a whole configuration.

    Raises:
      ValueError: they are of another kind, or one of them is traced.
    """
    found = getattr(config, section) if isinstance(config, Config) else config
    arguments.settings("config", found, kind)
    return found


def clouds(
    source: Any, reference: Any, source_mask: Any, reference_mask: Any
) -> tuple[PointCloud, PointCloud]:
    """Both clouds with their padding at zero; one with a point that is not finite counts as empty.

    Raises:
      ValueError: a shape, a dtype or a mask is wrong.
    """
    source, reference = arguments.clouds(source, reference)
    masks = (
        arguments.usable("source_mask", source, source_mask),
        arguments.usable("reference_mask", reference, reference_mask),
    )
    first, second = (
        PointCloud(without_padding(points, mask), mask)
        for points, mask in zip((source, reference), masks, strict=True)
    )
    return first, second


def in_dtype(variables: Any, dtype: Any) -> Any:
    """The weights in the precision of the clouds.

    Raises:
      ValueError: `variables` have no parameters.
    """
    if "params" not in variables:  # Statistics may lack: not every network has any.
        raise ValueError(
            "variables have no 'params': give them as init_variables and jaxreg.load_pretrained do, "
            "parameters and statistics."
        )
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), variables)


def identity_of(source: PointCloud, reference: PointCloud) -> RigidTransform:
    """The pose that steps start from: it varies over a mesh as both clouds do."""
    like = source.points[0, 0] + reference.points[0, 0]
    return jax.tree.map(lambda x: varying_like(x, like), rigid.identity(like.dtype))


def registration(
    transform: RigidTransform,
    source: PointCloud,
    reference: PointCloud,
    confidence: Float[Array, "n"],
    correspondences: Float[Array, "n 3"] | None = None,
    *,
    scores: Any = None,
) -> Registration:
    """The record of a pose; the identity if a cloud has no valid point.

    Also if a number of it, or of the `scores` (a tree of arrays) behind it, is not finite, as with
    weights that diverged. A method without correspondences gets the reference points nearest to the
    moved source.
    """
    confidence = jnp.where(source.mask, confidence, 0)
    copies = None if correspondences is None else without_padding(correspondences, source.mask)
    valid = jnp.any(source.mask) & jnp.any(reference.mask)
    valid &= all_finite((*transform, confidence, copies, scores))
    transform = rigid.identity_unless(valid, transform)
    if correspondences is None:
        moved = rigid.apply(transform, source.points)
        correspondences = reference.points[nearest_in(moved, reference.points, reference.mask)]
    confidence = jnp.where(valid, confidence, 0)
    matrix = rigid.to_matrix(transform)
    return Registration(*transform, matrix, confidence, correspondences, valid)


def absolute_edges(cloud: PointCloud, k: int) -> Float[Array, "n k 6"]:
    """Coordinates of the k nearest points, the point itself among them, beside those of the point."""
    itself = jnp.arange(cloud.points.shape[0], dtype=jnp.int32)[:, None]
    others = knn(cloud.points, k - 1, cloud.mask)
    near = cloud.points[jnp.concatenate([itself, others], axis=1)]
    return jnp.concatenate([near, jnp.broadcast_to(cloud.points[:, None], near.shape)], axis=-1)


def soft_copy(scores: Float[Array, "n m"], cloud: PointCloud) -> Float[Array, "n 3"]:
    """The mean of a cloud by every row of scores, which sum to 1.

    Where all rows point to one place only rounding is left of their differences: then it is constant.
    No pose follows from rounding, and the derivative of a pose by it is as large as it is small: 1e24
    for a line with a point at the origin, in float32.
    """
    copy = jnp.matmul(scores, cloud.points, precision=Precision.HIGHEST)
    middle = jnp.mean(copy, axis=0, keepdims=True)
    rounding = 16 * jnp.finfo(copy.dtype).eps * jnp.max(jnp.abs(cloud.points))
    one_place = jnp.max(jnp.abs(copy - middle)) <= jax.lax.stop_gradient(rounding)
    return jnp.where(one_place, middle, copy)


def row_softmax(scores: Float[Array, "n m"], valid: Bool[Array, "m"]) -> Float[Array, "n m"]:
    """Softmax along the rows, over valid columns; a row of zeros if there are none."""
    scores = jnp.where(valid[None, :], scores, -jnp.inf)
    largest = jax.lax.stop_gradient(jnp.max(scores, axis=1, keepdims=True))
    weight = jnp.exp(scores - jnp.where(jnp.isfinite(largest), largest, 0))
    total = jnp.sum(weight, axis=1, keepdims=True)
    return weight / jnp.where(total > 0, total, 1)
