"""Two scans of which one is at another size: photogrammetry without a scale, a model in another unit.

The size is one more unknown. It is tried in steps that a search of rigid poses bridges, and estimated
where the pose is right, on the distances from the planes of the other cloud, with its deviation.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from jaxreg.geometry import se3
from jaxreg.scans import planes
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.known import Known
from jaxreg.scans.prepare import Prepared
from jaxreg.scans.result import ScanRegistration, centred, in_unit, matrix_of, out_of, resized
from jaxreg.types import RigidTransform

_STEP = 1.12
"""Ratio of neighbouring sizes: a search finds poses of clouds whose sizes differ by half of it."""
_EACH_WAY = 5
"""Steps from the ratio of the radii, up and down: to a factor of 1.8."""
_SURE = 0.9
"""No more sizes are tried at this probability."""
_SAMPLE = 6000
_ITERATIONS, _ROUNDS = 24, 2
_REACH = 0.1
"""How far off points may lie at the size that was tried, in radii of the reference."""

Run = Callable[[Prepared, Prepared, RegisterConfig, RigidTransform | None, Known], ScanRegistration]


def registered(
    source: Prepared,
    reference: Prepared,
    config: RegisterConfig,
    start: RigidTransform | None,
    known: Known,
    *,
    run: Run,
    flat: bool,
) -> ScanRegistration:
    """The registration with the scale as an unknown; `run` is that of clouds of one size.

    With a `start` the size is sought from 1 on.
    """
    if start is not None:
        size, pose = 1.0, start
    else:
        size, pose = _tried(source, reference, config, known, run)
    for _ in range(_ROUNDS):
        change, pose, sigma = _fitted((resized(source, size), reference), pose, known, flat)
        size *= change
    sized = resized(source, size)
    found = run(sized, reference, config, None if start is None else pose, known)
    if start is None and not found.success and not found.alternatives:
        # What the search of that size does not find again stands as it was fitted.
        found = run(sized, reference, config, pose, known)
    return dataclasses.replace(
        found,
        transformation=matrix_of(RigidTransform(size * found.rotation, found.translation)),
        scale=size,
        scale_sigma=size * sigma,
    )


def _tried(
    source: Prepared, reference: Prepared, config: RegisterConfig, known: Known, run: Run
) -> tuple[float, RigidTransform]:
    """The size at which the pose is likeliest, and that pose."""
    ratio = reference.radius / source.radius
    steps = sorted(range(-_EACH_WAY, _EACH_WAY + 1), key=abs)
    quick = dataclasses.replace(config, wide=None)
    best, size, pose = -1.0, ratio, RigidTransform(np.eye(3), np.zeros(3))
    for step in steps:
        tried = ratio * _STEP**step
        found = run(resized(source, tried), reference, quick, None, known)
        if found.probability > best:
            best, size, pose = found.probability, tried, found.transform
        if best >= _SURE:
            break
    return size, pose


def _fitted(
    clouds: tuple[Prepared, Prepared], pose: RigidTransform, known: Known, flat: bool
) -> tuple[float, RigidTransform, float]:
    """The size and pose at which most points lie on the other surface; the size's relative sigma.

    A thin or curved part lies inside the plane through its points, so that the fit makes the cloud
    whose points are taken too small. Taken both ways, the two errors cancel.
    """
    source, reference = clouds
    found = _one_way(clouds, pose, known, flat)
    back = _one_way((reference, source), se3.inverted(pose), known, flat)
    scale = math.sqrt(found.scale / back.scale)
    # Of the clouds as given: the centre of the source moves with its size.
    fit = in_unit(found.pose, reference.radius)
    return (
        scale,
        out_of((resized(source, scale), reference), fit),
        float(np.sqrt((found.covariance[6, 6] + back.covariance[6, 6]) / 4)),
    )


def _one_way(
    clouds: tuple[Prepared, Prepared], pose: RigidTransform, known: Known, flat: bool
) -> planes.Fitted:
    """The points of the first cloud on the planes of the second, whose radius is the unit."""
    moving, fixed = clouds
    unit = fixed.radius
    inner = centred(clouds, pose)
    some = fixed.points[:: max(1, len(fixed.points) // 2000)]
    patches = planes.patches(fixed.points, fixed.tree, some)
    narrowest = min(planes.TUKEY * max(2 * float(np.median(patches.noise)), 1e-6), _REACH)
    return planes.fitted(
        moving.points[moving.rows(_SAMPLE)] * (moving.radius / unit),
        planes.Surface(fixed.points, fixed.tree, count=8, flat=True) if flat else fixed.surface,
        RigidTransform(inner.rotation, inner.translation / unit),
        np.geomspace(_REACH, narrowest, _ITERATIONS),
        motions=np.eye(6)[:, [2, 3, 4]] if flat else known.motions,
        scale=1.0,
    )
