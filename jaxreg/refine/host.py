"""Refinement from the host: numpy in and out, up to a million points, any offset and unit."""

from functools import partial
from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.geometry import frame
from jaxreg.geometry.frame import Frame
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.gicp import gicp
from jaxreg.refine.kdtree import Method, index_cloud, iterate, padded_size
from jaxreg.refine.point_to_plane import point_to_plane
from jaxreg.refine.point_to_point import icp
from jaxreg.refine.robust import Kernel, Weighting, check_options, widenings
from jaxreg.refine.uncertainty import PoseUncertainty, pose_uncertainty, uncertainty_of_pairs
from jaxreg.types import RigidTransform

_DEFAULT = RefineConfig()


class Refined(NamedTuple):
    """A pose in float64 (numpy), how it was found, and how well it is determined.

    `converged`: the last step was below the tolerance. Brute force takes all of its iterations and
    does not look: None.
    """

    transform: RigidTransform
    iterations: int
    converged: bool | None
    uncertainty: PoseUncertainty


def refine(
    source: np.ndarray,
    reference: np.ndarray,
    *,
    method: Method = _DEFAULT.method,
    initial: RigidTransform | None = None,
    iterations: int = _DEFAULT.iterations,
    max_distance: float = _DEFAULT.max_distance,
    trim: float = _DEFAULT.trim,
    kernel: Kernel = _DEFAULT.kernel,
    scale: float | None = None,
    anneal: float = _DEFAULT.anneal,
    both_directions: bool = _DEFAULT.both_directions,
    neighbors: int = _DEFAULT.neighbors,
    thickness: float = _DEFAULT.thickness,
    edges: bool = _DEFAULT.edges,
    tolerance: float = _DEFAULT.tolerance,
    dense_limit: int = _DEFAULT.dense_limit,
) -> Refined:
    """Refine `initial` (the identity) to the pose of `source` (n, 3) in the frame of `reference`.

    Centred and scaled in float64, solved in JAX's default precision, composed in float64. Options
    are those of `icp`, `point_to_plane` and `gicp`; clouds of at most `dense_limit` points are
    solved by these functions, larger ones by a k-d tree, which stops when a step turns by less than
    `tolerance` radians and moves by less than as many radii of the cloud. Above 30,000 points every
    k-th one comes first, and then all of them for up to `iterations` more.

    Raises:
      ValueError: a cloud is not (n, 3), not numeric, holds NaN or infinity, or has not more than
        `neighbors` points; or an option is wrong.
    """
    check_options(iterations=iterations, trim=trim, anneal=anneal)
    if method not in get_args(Method):
        raise ValueError(f"method must be one of {', '.join(get_args(Method))}, got {method!r}.")
    source = _checked("source", source, neighbors)
    reference = _checked("reference", reference, neighbors)
    where, x, y = _enter(source, reference)
    start = _pose_in(where, initial)
    weighting = Weighting(kernel, scale, max_distance, trim).in_units_of(where.length)
    if max(len(x), len(y)) <= dense_limit:
        pose, uncertainty = _dense(
            *_padded(x), *_padded(y), start, weighting.scale, weighting.max_distance,
            method=method, kernel=kernel, trim=trim, iterations=iterations, anneal=anneal,
            both_directions=both_directions, neighbors=neighbors, thickness=thickness, edges=edges,
        )  # fmt: skip
        return Refined(_pose_out(where, pose), iterations, None, _in_units(uncertainty, where))
    source_cloud = index_cloud(x, neighbors=neighbors)
    reference_cloud = index_cloud(y, neighbors=neighbors)
    pose, taken, converged, pairs = iterate(
        start, source_cloud, reference_cloud, weighting,
        widenings(iterations, anneal, np.dtype("float32")),
        method=method, thickness=thickness, edges=edges, both_directions=both_directions,
        tolerance=tolerance,
    )  # fmt: skip
    moved, _ = _padded(x @ pose.rotation.T + pose.translation)
    # One pair for every point of the source, as `pose_uncertainty` has them: the way back sees the
    # same distances again.
    pairs = pairs._replace(mask=pairs.mask & (np.arange(len(pairs.mask)) < len(x)))
    uncertainty = _uncertainty(
        moved, reference_cloud.padded, reference_cloud.normals, pairs,
        weighting.scale, weighting.max_distance, kernel=kernel, trim=trim,
    )  # fmt: skip
    return Refined(_pose_out(where, pose), taken, converged, _in_units(uncertainty, where))


_STATIC = ("method", "kernel", "trim", "iterations", "anneal", "both_directions", "neighbors")


@partial(jax.jit, static_argnames=(*_STATIC, "thickness", "edges"))
def _dense(
    x, x_mask, y, y_mask, start, scale, max_distance, *,
    method, kernel, trim, iterations, anneal, both_directions, neighbors, thickness, edges,
):  # fmt: skip
    masks = {"source_mask": x_mask, "reference_mask": y_mask}
    weights = {"scale": scale, "max_distance": max_distance, "kernel": kernel, "trim": trim}
    loop = {"iterations": iterations, "anneal": anneal, "both_directions": both_directions}
    options = masks | weights | loop | {"initial": start}
    if method == "icp":
        pose = icp(x, y, **options)
    elif method == "point_to_plane":
        pose = point_to_plane(x, y, neighbors=neighbors, **options)
    else:
        pose = gicp(x, y, neighbors=neighbors, thickness=thickness, edges=edges, **options)
    return pose, pose_uncertainty(pose, x, y, neighbors=neighbors, **masks, **weights)


@partial(jax.jit, static_argnames=("kernel", "trim"))
def _uncertainty(moved, reference, normals, pairs, scale, max_distance, *, kernel, trim):
    where = Frame(jnp.zeros(3), jnp.zeros(3), jnp.ones(()))
    weighting = Weighting(kernel, scale, max_distance, trim)
    return uncertainty_of_pairs(where, moved, reference, normals, pairs, weighting)


def _checked(name: str, points: np.ndarray, neighbors: int) -> np.ndarray:
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
    if len(points) <= neighbors:
        raise ValueError(
            f"{name} has {len(points)} points; normals of {neighbors} neighbours need more: give "
            "more points, or choose fewer `neighbors`."
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
