"""Register two scans: numpy in, numpy out, any sizes and any unit."""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np

from jaxreg.geometry.clouds import check_pose
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.judge.evidence import Evidence
from jaxreg.scans import few, free_space, inside, masks, planar, prepare, similar, surfaces
from jaxreg.scans.config import RegisterConfig, checked
from jaxreg.scans.known import Fact, Known, known_of
from jaxreg.scans.prepare import Prepared
from jaxreg.scans.result import Accuracy, ScanRegistration, Verdict, assembled, centred, widened
from jaxreg.types import RigidTransform

_POINT, _SMALLEST = 1e-6, 1e-100
"""Of a cloud that is smaller than this share of the other, the other tells nothing: between two of its
points there is room for all of it. Below the second share numbers end before sizes do."""
_BEYOND_DEG = 1.0
"""The refinement of a pose at the limit may turn it so much farther."""


def register(
    source: object,
    reference: object,
    *,
    initial: object = None,
    max_rotation_deg: float | None = None,
    known: Fact | Sequence[Fact] | None = None,
    up: object = "z",
    scale: bool = False,
    mask: object = None,
    weights: object = None,
    viewpoint: object = None,
    nonfinite: Literal["raise", "drop"] = "raise",
    strays: Literal["drop", "keep", "raise"] = "drop",
    config: RegisterConfig | None = None,
) -> ScanRegistration:
    """Register two scans: the transform ``y = R x + t`` from source to reference, with a verdict.

    The clouds are array-likes (n, 3) and (m, 3) in one unit, or results of `jaxreg.prepare`; size,
    order of the points and origin do not matter. (n, 2) and (m, 2), or clouds of one z each, are
    registered in the plane: a turn about z and two shifts, whose covariance has zeros elsewhere.
    Clouds of at most 60 points each (targets, fiducials, stems) are matched point by point: the poses
    on which most points agree are sought among all triples, and `evidence` is a `FewEvidence`.

    `initial` (4x4 or a `RigidTransform`) starts from a known pose. The search is skipped, so the only
    rival poses (`alternatives`) are those along motions that the surfaces hardly resist, as that of
    a vase turned about its axis. `max_rotation_deg` is the largest rotation to consider (None: any);
    it decides between the poses of a symmetric shape, and a result beyond it by more than a degree is
    no success.
    `known` says what is known of the pair: "upright", both scans have the axis `up` ("x", "y", "z"
    or a vector) upwards, so that the source is turned about it alone; "inside", the source lies
    wholly in the reference, which shows far more; or both. With `scale` the size of the source is
    unknown, too: ``y = scale R x + t``, with `scale` and its standard deviation in the result.

    `mask` (n,) of booleans leaves out points of the source that are known to have moved; a pair of
    masks is of both clouds. `weights` (n,) say how much the points of the source count in the last
    stage; of at most 60 points all count alike. `viewpoint` (3,) is where the scanner of each cloud
    stood, in the cloud's own coordinates; a pair of them is of source and reference, None of an
    unknown one. Poses that put points between a scanner and what it measured are then held to be
    wrong. `nonfinite` and `strays` say what to do with rows that are NaN or infinite, and with a few
    points that lie ten times as far from the middle as all others. The same input gives the same bits
    on one machine with as many cores.

    Raises:
      ValueError: a cloud is not a numeric (n, 3) array with at least three finite points (the
        message names the row), `initial` is not rigid or turns too far, an option is out of range, or a
        cloud was prepared with another configuration.
    """
    config = checked(config)
    facts = known_of(known, up, max_rotation_deg)
    start = None if initial is None else facts.start(check_pose(initial, "initial"))
    first, second = (
        prepare.prepared(
            cloud,
            viewpoint=place,
            nonfinite=nonfinite,
            strays=strays,
            config=config,
            name=name,
            caller="jaxreg.register",
        )
        for cloud, name, place in zip(
            (source, reference), ("source", "reference"), free_space.places(viewpoint), strict=True
        )
    )
    _check_dimensions((source, reference), (first, second))
    if mask is None and weights is None:
        return register_prepared(first, second, config, start=start, known=facts, scale=scale)
    parts, facts = _taking_part((first, second), mask, weights, facts, config)
    found = register_prepared(*parts, config, start=start, known=facts, scale=scale)
    return widened(found, (first, second), parts[1].centre)


def _taking_part(
    clouds: tuple[Prepared, Prepared], mask: object, weights: object, known: Known, config
) -> tuple[tuple[Prepared, Prepared], Known]:
    """The clouds without the points that take no part, and how much those of the source count."""
    chosen = list(masks.masks_of(mask, (len(clouds[0].kept), len(clouds[1].kept))))
    given = None if weights is None else masks.weights_of(weights, len(clouds[0].kept))
    if given is not None:
        chosen[0] = chosen[0] & (given > 0)
    for cloud, rows, name in zip(clouds, chosen, ("source", "reference"), strict=True):
        masks.check_enough(rows & cloud.kept, name)
    first, second = (
        prepare.part(cloud, rows, config) for cloud, rows in zip(clouds, chosen, strict=True)
    )
    if given is None:
        return (first, second), known
    return (first, second), known._replace(
        weights=masks.of_points(given[chosen[0] & clouds[0].kept], first)
    )


def register_prepared(
    source: Prepared,
    reference: Prepared,
    config: RegisterConfig,
    *,
    start: RigidTransform | None = None,
    known: Known | None = None,
    scale: bool = False,
    max_rotation_deg: float | None = None,
    least: float = 0.0,
    thorough: bool = True,
) -> ScanRegistration:
    """`register` of clouds that were prepared with `config`, or with another that differs in `wide`.

    A pose whose probability is below `least` after the search is left as the search had it. Unless it
    is `thorough`, no cause is looked for where a pose does not fit, and all points are looked at only
    if the pose is likely: of many scans most pairs are wrong, and others tell which.
    """
    known = known or Known(max_rotation_deg=max_rotation_deg or 180.0)
    if flat := planar.is_planar(source, reference):
        known = known.in_the_plane()
    if not scale:
        found = _of_one_size(source, reference, config, start, known, least, thorough)
        return _within_limit(found, known)
    if few.is_few(source, reference):
        raise ValueError("scale=True needs surfaces, clouds of more than 60 points: leave it out.")
    run = _of_one_size
    found = similar.registered(source, reference, config, start, known, run=run, flat=flat)
    return _within_limit(found, known)


def _within_limit(found: ScanRegistration, known: Known) -> ScanRegistration:
    """The result, no success if it turns farther than is allowed: then no other pose was found."""
    turned = float(rotation_angle_deg(found.rotation, np.eye(3)))
    if turned <= known.max_rotation_deg + _BEYOND_DEG:
        return found
    reason = (
        f"The best pose that was found turns by {turned:.3g} degrees, more than max_rotation_deg = "
        f"{known.max_rotation_deg:g}."
    )
    return dataclasses.replace(found, success=False, probability=0.0, reason=reason)


def _of_one_size(
    source: Prepared,
    reference: Prepared,
    config: RegisterConfig,
    start: RigidTransform | None,
    known: Known,
    least: float = 0.0,
    thorough: bool = True,
) -> ScanRegistration:
    """Every kind of pair has a module of its own; here one is chosen."""
    if reason := _fixes_nothing(source, reference):
        return _unmoved(source, reference, start, reason)
    if few.is_few(source, reference) and (found := few.registered(source, reference, start, known)):
        if known.weights is not None and np.ptp(known.weights) > 0:
            raise ValueError(
                "weights need surfaces or lines, and of at most 60 points all that agree count alike: "
                "give a mask of those that take part."
            )
        return found
    if planar.is_planar(source, reference):
        return planar.registered(source, reference, config, start, known)
    if known.inside:
        return inside.registered(source, reference, config, start, (), known)
    found = surfaces.registered(
        source, reference, config, start, known, least=least, thorough=thorough
    )
    if found.success or found.probability < least or not inside.is_possible(source, reference):
        return found
    tried = (found.transform, *(other.transform for other in found.alternatives))
    return inside.registered(source, reference, config, start, tried, known)


def _fixes_nothing(source: Prepared, reference: Prepared) -> str:
    """Why no pose follows from two clouds, whatever they show; empty if one may."""
    for cloud, name in ((source, "source"), (reference, "reference")):
        if len(cloud.points) == 1:
            return f"All points of the {name} lie in one place, which fixes no pose."
    small, large = sorted((source.radius, reference.radius))
    if small >= _POINT * large:
        return ""
    names = ("source", "reference") if source.radius > small else ("reference", "source")
    return (
        f"The {names[0]} is more than {1 / _POINT:,.0f} times the size of the {names[1]}: "
        "bring both to one unit."
    )


def _unmoved(
    source: Prepared, reference: Prepared, start: RigidTransform | None, reason: str
) -> ScanRegistration:
    """The start, or the centroids laid on each other, as the result of a pair that fixes nothing."""
    given = (source, reference)
    large = max((cloud.radius for cloud in given if len(cloud.points) > 1), default=1.0)
    first, second = (
        dataclasses.replace(cloud, radius=min(max(cloud.radius, _SMALLEST * large), large))
        for cloud in given
    )
    clouds = (first, second)
    middle = RigidTransform(np.eye(3), np.zeros(3))
    return assembled(
        clouds,
        middle if start is None else centred(clouds, start),
        Verdict(False, 0.0, reason, Evidence(*np.zeros(len(Evidence._fields)).tolist())),
        Accuracy(np.full((6, 6), np.nan), (), None),
        distance=min(cloud.radius for cloud in clouds),
        overlap=0.0,
        alternatives=(),
    )


def _check_dimensions(given: tuple[object, object], clouds: tuple[Prepared, Prepared]) -> None:
    """Two columns beside three are a mistake, unless the others have one z."""
    shapes = [np.shape(cloud) if hasattr(cloud, "__len__") else () for cloud in given]  # pyright: ignore[reportArgumentType, reportCallIssue]
    flat = [len(shape) == 2 and shape[1] == 2 for shape in shapes]
    if flat[0] == flat[1] or planar.is_planar(*clouds):
        return
    name, other = ("source", "reference") if flat[0] else ("reference", "source")
    raise ValueError(
        f"{name} has shape {shapes[0 if flat[0] else 1]}, two coordinates a point, and {other} has "
        "three: give both as (n, 2) or both as (n, 3)."
    )
