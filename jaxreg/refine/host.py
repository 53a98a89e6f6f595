"""Refinement on the host: numpy in and out, up to a million points, any offset and unit."""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxreg._xla import from_host
from jaxreg.geometry import frame
from jaxreg.geometry.clouds import check_points
from jaxreg.geometry.rigid import nearest_rotation
from jaxreg.refine.config import RefineConfig, check_options
from jaxreg.refine.kdtree import IndexedCloud, index_cloud, iterate
from jaxreg.refine.robust import Weighting
from jaxreg.refine.uncertainty import PoseUncertainty, scan_covariance, uncertainty_of_pairs
from jaxreg.types import RigidTransform


class Refined(NamedTuple):
    """A pose in float64 (numpy), how it was found, and how well it is determined.

    `converged`: the last step was below the tolerance; None if nothing was refined.
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
    config: RefineConfig = RefineConfig(),  # noqa: B008 (frozen)
) -> Refined:
    """Refine `initial` (the identity) to the pose of `source` (n, 3) in the frame of `reference`.

    Centred and scaled in float64, solved in JAX's default precision, composed in float64, with
    corresponding points from a k-d tree. It stops when a step turns by less than `config.tolerance`
    radians and moves by less than as many radii of the cloud. Above 30,000 points it first refines
    with every k-th one, then with all of them for up to `config.iterations` more.

    Raises:
      ValueError: a cloud is not (n, 3), not numeric, contains NaN or infinity, or has fewer than
        three points; or an option is wrong.
    """
    clouds = [
        check_points(p, name)[0] for p, name in ((source, "source"), (reference, "reference"))
    ]
    (source_centre, source_radius), (reference_centre, reference_radius) = map(
        frame.measure, clouds
    )
    length = math.hypot(source_radius, reference_radius) / math.sqrt(2) or 1.0
    where = frame.Frame(source_centre, reference_centre, length)
    indexed = (
        index_cloud((points - centre) / length, k=config.k)
        for points, centre in zip(clouds, (source_centre, reference_centre), strict=True)
    )
    if initial is None:
        initial = RigidTransform(np.eye(3), np.zeros(3))
    start = RigidTransform(*(np.asarray(part, np.float64) for part in initial))
    found = refine_indexed(
        *indexed,
        initial=frame.transform_in(where, start),
        distance=config.max_correspondence_distance / length,
        config=config,
    )
    return found._replace(
        transform=frame.transform_out(where, found.transform),
        uncertainty=in_units(found.uncertainty, where),
    )


def refine_indexed(
    source: IndexedCloud,
    reference: IndexedCloud,
    *,
    initial: RigidTransform,
    distance: float,
    config: RefineConfig,
    more: int = 0,
    motions: Float[np.ndarray, "6 f"] | None = None,
) -> Refined:
    """The same for indexed clouds in one frame: nothing is checked, thinned, indexed or scaled again.

    `distance` is the largest between corresponding points, in the unit of the frame. A pose that
    still moves after `config.iterations` has up to `more` of them. `motions` is a basis of the unknown
    motions (rotation vector, translation) in the frame; None: all of them.
    """
    check_options(config)
    weighting = Weighting(config.kernel, None, float(distance), config.trim)
    pose, taken, converged, pairs = iterate(
        initial, source, reference, weighting, config=config, more=more, motions=motions
    )
    # Until here it is orthogonal only to float32.
    pose = RigidTransform(nearest_rotation(pose.rotation), pose.translation)
    # One pair for every point of the source, as in `pose_uncertainty`: in reverse the distances are
    # the same again.
    forward = np.arange(len(pairs.mask)) < len(source.points)
    uncertainty = _uncertainty(
        pose, source.padded, source.scale, reference.padded, reference.scale, reference.normals,
        pairs._replace(mask=pairs.mask & forward), weighting.max_correspondence_distance,
        kernel=config.kernel, trim=config.trim,
    )  # fmt: skip
    values = PoseUncertainty(*(np.asarray(leaf, np.float64) for leaf in uncertainty))
    return Refined(pose, taken, converged, values)


def unrefined(pose: RigidTransform) -> Refined:
    """A pose as it is, without any knowledge of how good it is."""
    pose = RigidTransform(nearest_rotation(pose.rotation), pose.translation)
    zero, one = np.zeros(()), np.ones(())
    unknown = PoseUncertainty(np.zeros((6, 6)), np.zeros((6, 6)), zero, zero, np.zeros(3), one)
    return Refined(pose, 0, None, unknown)


def in_units(uncertainty: PoseUncertainty, where: frame.Frame) -> PoseUncertainty:
    """The uncertainty in a frame as one in the unit of the clouds, about the same point."""
    length = float(where.length)
    units = np.repeat([1.0, length], 3)
    scaling = np.outer(units, units)
    return PoseUncertainty(
        information=uncertainty.information / scaling * length**2,
        covariance=uncertainty.covariance * scaling,
        variance=uncertainty.variance * length**2,
        weight=uncertainty.weight,
        centre=where.reference_centre + uncertainty.centre * length,
        length=uncertainty.length * length,
    )


@from_host
@partial(jax.jit, static_argnames=("kernel", "trim"))
def _uncertainty(
    pose, source, source_scale, reference, reference_scale, normals, pairs, distance, *,
    kernel, trim,
):  # fmt: skip
    pose = RigidTransform(*(part.astype(source.dtype) for part in pose))
    x, y = source * source_scale, reference * reference_scale
    moved = jnp.matmul(x, pose.rotation.T, precision="highest") + pose.translation[None, :]
    zero = jnp.zeros(3, x.dtype)
    where = frame.Frame(zero, zero, jnp.ones((), x.dtype))
    weighting = Weighting(kernel, None, distance, trim)
    found = uncertainty_of_pairs(where, moved, y, normals, pairs, weighting)
    covariance = scan_covariance(moved, y, normals, pairs, weighting, zero)
    return found._replace(covariance=jnp.where(found.weight > 0, covariance, 0))
