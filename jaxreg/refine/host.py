"""Refinement from the host: numpy in and out, up to a million points, any offset and unit."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.geometry import frame
from jaxreg.geometry.frame import Frame
from jaxreg.refine.config import RefineConfig, check_options
from jaxreg.refine.kdtree import index_cloud, iterate, padded_size
from jaxreg.refine.robust import Weighting
from jaxreg.refine.uncertainty import PoseUncertainty, uncertainty_of_pairs
from jaxreg.types import RigidTransform


class Refined(NamedTuple):
    """A pose in float64 (numpy), how it was found, and how well it is determined.

    `converged`: the last step was below the tolerance; None where nothing was refined.
    """

    transform: RigidTransform
    iterations: int
    converged: bool | None
    uncertainty: PoseUncertainty


def refine_on_host(
    source: np.ndarray,
    reference: np.ndarray,
    *,
    initial: RigidTransform | None = None,
    config: RefineConfig = RefineConfig(),
) -> Refined:
    """Refine `initial` (the identity) to the pose of `source` (n, 3) in the frame of `reference`.

    Centred and scaled in float64, solved in JAX's default precision, composed in float64. The pairs
    come from k-d trees on the host, and the iterations stop as soon as a step at the final width of
    the kernel turns by less than `config.tolerance` radians and moves by less than as many radii of
    the cloud. Above 30,000 points every k-th one comes first, and then all of them for up to
    `config.iterations` more. Partners beyond the nearest (`config.correspondences_per_point`) are
    those of the pure functions alone.

    Raises:
      ValueError: a cloud is not (n, 3), not numeric, holds NaN or infinity, or has not more than
        `config.k` points; or an option is wrong.
    """
    check_options(config)
    source = _checked("source", source, config.k)
    reference = _checked("reference", reference, config.k)
    where, x, y = _enter(source, reference)
    clouds = index_cloud(x, k=config.k), index_cloud(y, k=config.k)
    weighting = Weighting(config.kernel, None, config.max_correspondence_distance, config.trim)
    weighting = weighting.in_units_of(where.length)
    start = _pose_in(where, initial)
    pose, taken, converged, pairs = iterate(start, *clouds, weighting, config=config)
    moved, _ = _padded(x @ pose.rotation.T + pose.translation)
    # One pair for every point of the source, as `pose_uncertainty` has them: the way back sees the
    # same distances again.
    pairs = pairs._replace(mask=pairs.mask & (np.arange(len(pairs.mask)) < len(x)))
    uncertainty = _uncertainty(
        moved, clouds[1].padded, clouds[1].normals, pairs,
        weighting.kernel_scale, weighting.max_correspondence_distance,
        kernel=config.kernel, trim=config.trim,
    )  # fmt: skip
    return Refined(_pose_out(where, pose), taken, converged, _in_units(uncertainty, where))


@partial(jax.jit, static_argnames=("kernel", "trim"))
def _uncertainty(moved, reference, normals, pairs, kernel_scale, max_distance, *, kernel, trim):
    where = Frame(jnp.zeros(3), jnp.zeros(3), jnp.ones(()))
    weighting = Weighting(kernel, kernel_scale, max_distance, trim)
    return uncertainty_of_pairs(where, moved, reference, normals, pairs, weighting)


def _checked(name: str, points: np.ndarray, k: int) -> np.ndarray:
    try:
        points = np.asarray(points, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is not numeric: give an array (n, 3) of coordinates.") from None
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{name} must have shape (n, 3), got {points.shape}: give one cloud.")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise ValueError(
            f"{name} has {len(bad)} points with NaN or infinity, the first in row {bad[0]}: "
            "remove them."
        )
    if len(points) <= k:
        raise ValueError(
            f"{name} has {len(points)} points; normals of {k} neighbours need more: give "
            "more points, or choose a smaller `k`."
        )
    return points


def _enter(source: np.ndarray, reference: np.ndarray):
    """`jaxreg.geometry.frame.enter` in float64, which the device may not have."""
    centres = source.mean(axis=0), reference.mean(axis=0)
    x, y = source - centres[0], reference - centres[1]
    length = np.sqrt(((x**2).sum(axis=1).mean() + (y**2).sum(axis=1).mean()) / 2)
    length = length if length > 0 else np.float64(1)
    return frame.Frame(*centres, length), x / length, y / length


def _pose_in(where: frame.Frame, pose: RigidTransform | None) -> RigidTransform:
    pose = RigidTransform(np.eye(3), np.zeros(3)) if pose is None else pose
    return frame.pose_in(where, RigidTransform(*(np.asarray(leaf, np.float64) for leaf in pose)))


def _pose_out(where: frame.Frame, pose: RigidTransform) -> RigidTransform:
    rotation, translation = (np.asarray(leaf, np.float64) for leaf in pose)
    # It is orthogonal to float32 only, until here.
    return frame.pose_out(where, RigidTransform(frame.nearest_rotation(rotation), translation))


def _padded(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    size = padded_size(len(points))
    mask = np.arange(size) < len(points)
    return np.pad(points, ((0, size - len(points)), (0, 0))), mask


def _in_units(uncertainty: PoseUncertainty, where: frame.Frame) -> PoseUncertainty:
    """The uncertainty in the frame as one in the unit of the clouds, in float64."""
    values = PoseUncertainty(*(np.asarray(leaf, np.float64) for leaf in uncertainty))
    units = np.repeat([1.0, where.length], 3)
    scaling = np.outer(units, units)
    return PoseUncertainty(
        information=values.information / scaling * where.length**2,
        covariance=values.covariance * scaling,
        variance=values.variance * where.length**2,
        weight=values.weight,
        centre=where.reference_centre + values.centre * where.length,
        length=values.length * where.length,
    )
