"""Make two clouds to register from one shape, on the device: a pure function of a key and a cloud.

The order is: sample, move the reference, crop, shuffle, jitter, append outliers. Every stage draws
from its own key, in float32. So switching one stage on (outliers, say) changes nothing in the
others, and the same key gives the same pair with and without 64-bit mode.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxreg.config import PairConfig, check_options
from jaxreg.data import crops
from jaxreg.geometry import arguments, rigid
from jaxreg.geometry.neighbors import without_padding
from jaxreg.types import Pair, PointCloud, RigidTransform

_OUTLIER_STD, _OUTLIER_CLIP = 0.5, 1.0


class _CloudKeys(NamedTuple):
    crop: PRNGKeyArray
    order: PRNGKeyArray
    jitter: PRNGKeyArray
    outlier_index: PRNGKeyArray
    outlier_noise: PRNGKeyArray


class _Keys(NamedTuple):
    sampling: PRNGKeyArray
    angles: PRNGKeyArray
    axis: PRNGKeyArray
    translation: PRNGKeyArray
    source: _CloudKeys
    reference: _CloudKeys


def _split(key: PRNGKeyArray) -> _Keys:
    """All keys from one split: each additional split costs about 0.1 s of compilation."""
    keys = jax.random.split(key, 14)
    return _Keys(*keys[:4], source=_CloudKeys(*keys[4:9]), reference=_CloudKeys(*keys[9:]))


def pair_sizes(config: PairConfig, shape_points: int) -> tuple[int, int]:
    """Static sizes ``(n, m)`` of source and reference for shapes of `shape_points` points.

    Raises:
      ValueError: the shape has too few points for `points` or `kept`, or a size is not positive.
    """
    size = _kept(config, _available(config, shape_points)) + config.outliers
    return size, size


def make_pair(
    key: PRNGKeyArray,
    shape: Float[Array, "p 3"],
    config: PairConfig,
    shape_mask: Bool[Array, "p"] | None = None,
) -> Pair:
    """Make two clouds to register from one shape, and their transform, ``reference = R source + t``.

    `config` is static; vmap over keys and shapes for a batch. The masks are True everywhere unless
    `shape_mask` leaves fewer valid points than a cloud has rows: no crop prefers padding to a valid
    point, and the rows are then valid points of the shape, padding and outliers, in this order.

    Crops: `viewpoint` keeps the points nearest to one far viewpoint, the *same* for both clouds
    although the reference has already moved, so the clouds overlap in part. `half-space` keeps the
    points farthest along a random direction; a shared direction is fixed in the source's frame and
    turns with the reference, so the same physical part remains in both clouds. With
    `independent_crops` each cloud has its own viewpoint or direction.

    Raises:
      ValueError: the shape is not (p, 3) of float32 or float64, its mask not (p,) of bools, a number
        of `config` makes no sense, or the sizes do not fit: see `pair_sizes`.
    """
    arguments.settings("config", config, PairConfig)
    shape = arguments.cloud("shape", shape)
    shape_mask = arguments.mask("shape_mask", shape_mask, shape.shape[0])
    pair_sizes(config, shape.shape[0])
    check_options("pairs", config)
    keys = _split(key)
    mask = jnp.ones(shape.shape[0], bool) if shape_mask is None else shape_mask
    clean = PointCloud(without_padding(shape, shape_mask), mask)
    source, still = _draw_clouds(keys.sampling, clean, config)
    return _move_and_crop(keys, source, still, config)


def make_pair_from_scans(
    key: PRNGKeyArray,
    source: PointCloud,
    reference: PointCloud,
    config: PairConfig,
    transform: RigidTransform | None = None,
) -> Pair:
    """`make_pair` for two given clouds in one frame, such as two scans that are already aligned.

    The reference is moved by `transform`, or by a random one. `points` and `sampling` are not used:
    all points go to the crop.

    Raises:
      ValueError: `kept` is larger than one of the clouds, or `outliers` is negative.
    """
    for name, cloud in (("source", source), ("reference", reference)):
        arguments.cloud(f"{name}.points", cloud.points)
        arguments.mask(f"{name}.mask", cloud.mask, cloud.points.shape[0])
        _kept(config, cloud.points.shape[0])
    check_options("pairs", config)
    keys = _split(key)
    source = source._replace(points=without_padding(*source))
    reference = reference._replace(points=without_padding(*reference))
    return _move_and_crop(keys, source, reference, config, transform)


def _move_and_crop(
    keys: _Keys,
    source: PointCloud,
    still: PointCloud,
    config: PairConfig,
    transform: RigidTransform | None = None,
) -> Pair:
    """The pair of two clouds in one frame; `still` is the reference before its motion."""
    if transform is None:
        transform = _draw_transform(keys, config, source.points.dtype)
    reference = still._replace(points=rigid.apply(transform, still.points))
    scores = _crop_scores(keys, source, still, reference, config)
    source = _finish(keys.source, source, scores[0], config)
    reference = _finish(keys.reference, reference, scores[1], config)
    return Pair(source, reference, transform)


def _kept(config: PairConfig, available: int) -> int:
    """Points of a cloud of `available` points after the crop."""
    if config.outliers < 0:
        raise ValueError(f"outliers = {config.outliers} is negative: choose 0 or more.")
    if config.crop == "none":
        return available
    if not 1 <= config.kept <= available:
        raise ValueError(
            f"kept = {config.kept}, but each cloud has {available} points "
            f"before the crop (sampling = '{config.sampling}'): choose 1 <= kept <= {available}, "
            "crop = 'none', or shapes with more points."
        )
    return config.kept


def _available(config: PairConfig, shape_points: int) -> int:
    """Points of each cloud before the crop."""
    if config.sampling == "disjoint":
        available = min(config.points, shape_points // 2)
    else:
        available = config.points
    if not 1 <= available <= shape_points:
        raise ValueError(
            f"points = {config.points} cannot be taken from a shape of {shape_points} points with "
            f"sampling = '{config.sampling}': choose another `points`, or shapes with more points."
        )
    return available


def _draw_transform(keys: _Keys, config: PairConfig, dtype) -> RigidTransform:
    """Angles and translation as drawn in float32, composed in `dtype`."""
    half = config.translation_max
    translation = jax.random.uniform(keys.translation, (3,), jnp.float32, -half, half)
    return RigidTransform(_draw_rotation(keys, config, dtype), translation.astype(dtype))


def _draw_rotation(keys: _Keys, config: PairConfig, dtype) -> Float[Array, "3 3"]:
    """`euler`: R = Rx Ry Rz of three angles U[0, max]; `axis-angle`; `full`: uniform on SO(3)."""
    largest = np.float32(np.deg2rad(config.rotation_max_deg))
    angles = jax.random.uniform(keys.angles, (3,), jnp.float32, 0.0, largest).astype(dtype)
    if config.rotation == "euler":
        # Lower case is extrinsic: about z first, about x last.
        return Rotation.from_euler("zyx", angles[::-1]).as_matrix().astype(dtype)
    normal = jax.random.normal(keys.axis, (4,), jnp.float32).astype(dtype)
    if config.rotation == "full":
        rotation = Rotation.from_quat(normal / jnp.linalg.norm(normal))
    else:
        rotation = Rotation.from_rotvec(angles[0] * normal[:3] / jnp.linalg.norm(normal[:3]))
    return rotation.as_matrix().astype(dtype)


def _draw_clouds(
    key: PRNGKeyArray, shape: PointCloud, config: PairConfig
) -> tuple[PointCloud, PointCloud]:
    """The two clouds before any motion: the same points, or two random draws that share none."""
    available = _available(config, shape.mask.shape[0])
    if config.sampling == "copy":
        cloud = _take(shape, jnp.argsort(~shape.mask, stable=True)[:available])
        return cloud, cloud
    order = _shuffled(key, shape.mask)
    # Every other rank of the order, so the valid points of a padded shape are halved too.
    return _take(shape, order[0::2][:available]), _take(shape, order[1::2][:available])


def _crop_scores(
    keys: _Keys,
    source: PointCloud,
    still: PointCloud,
    reference: PointCloud,
    config: PairConfig,
) -> tuple[Float[Array, "n"] | None, Float[Array, "m"] | None]:
    """Which points a crop keeps: those with the largest scores. `still` is the unmoved reference."""
    if config.crop == "none":
        return None, None
    draw = crops.viewpoint if config.crop == "viewpoint" else crops.direction
    first = draw(keys.source.crop)
    second = draw(keys.reference.crop) if config.independent_crops else first
    if config.crop == "viewpoint":
        return crops.nearness(source.points, first), crops.nearness(reference.points, second)
    return crops.along(source.points, first), crops.along(still.points, second)


def _finish(
    keys: _CloudKeys, cloud: PointCloud, score: Float[Array, "n"] | None, config: PairConfig
) -> PointCloud:
    """Crop by score, shuffle, jitter, append outliers."""
    if score is not None:
        score = jnp.where(cloud.mask, score, -jnp.inf)
        cloud = _take(cloud, jax.lax.top_k(score, config.kept)[1])
    cloud = _take(cloud, _shuffled(keys.order, cloud.mask))
    if config.jitter > 0:
        noise = _noise(keys.jitter, cloud.points, config.jitter, config.jitter_clip)
        cloud = cloud._replace(points=cloud.points + noise)
    return _append_outliers(keys, cloud, config.outliers) if config.outliers else cloud


def _append_outliers(keys: _CloudKeys, cloud: PointCloud, count: int) -> PointCloud:
    """`count` more points: random valid points of the cloud + N(0, 0.5), clipped to +-1."""
    valid = jnp.maximum(jnp.sum(cloud.mask, dtype=jnp.int32), 1)
    added = _take(cloud, jax.random.randint(keys.outlier_index, (count,), 0, valid, jnp.int32))
    points = added.points + _noise(keys.outlier_noise, added.points, _OUTLIER_STD, _OUTLIER_CLIP)
    return PointCloud(
        jnp.concatenate([cloud.points, points]), jnp.concatenate([cloud.mask, added.mask])
    )


def _noise(
    key: PRNGKeyArray, points: Float[Array, "n 3"], std: float, clip: float
) -> Float[Array, "n 3"]:
    noise = std * jax.random.normal(key, points.shape, jnp.float32)
    return jnp.clip(noise, -clip, clip).astype(points.dtype)


def _shuffled(key: PRNGKeyArray, mask: Bool[Array, "n"]) -> Int[Array, "n"]:
    """A random order of the rows, the valid ones first."""
    rank = jax.random.uniform(key, mask.shape, jnp.float32)
    return jnp.argsort(jnp.where(mask, rank, 1.0))


def _take(cloud: PointCloud, index: Int[Array, "m"]) -> PointCloud:
    return PointCloud(cloud.points[index], cloud.mask[index])


def shape_points(pairs: PairConfig) -> int:
    """Points that a shape must have, if its source can choose."""
    return (2 if pairs.sampling == "disjoint" else 1) * pairs.points
