"""A small scan inside a large one: a submap in a map, a part in a scene, a face on a statue.

At the density that a large cloud can be searched and judged with, the small one is a few points. So
the large one is cut into tiles of about the size of the small one to find a pose, and to judge one it
is cut to what the small one covers there.
"""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError

from jaxreg.geometry import frame, se3
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.judge.odds import chances
from jaxreg.scans import candidates, masks, prepare, repeats, surfaces
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.known import Known
from jaxreg.scans.prepare import Prepared
from jaxreg.scans.result import ScanRegistration, centred, out_of, widened
from jaxreg.types import RigidTransform

_RATIO = 1.5
"""Ratio of the radii from which one scan may lie inside the other."""
_TILE, _STRIDE = 1.5, 0.6
"""Edge of a tile, in those of the box of the small cloud, and from one to the next, in edges."""
_MARGIN = 0.03
"""How far beyond the small cloud the large one is cut, in diameters of the small one."""
_MOST = 80
"""Most tiles."""
_A_TILE, _ALL_TILES = 2, 8
"""Poses that are judged of one tile, and of all."""
_RASTERED = 20_000
"""Points of each cloud that are looked at for places where the small one fits as well."""
_FEWEST = 200
"""Points of a tile that is worth a search."""


class Nested(NamedTuple):
    """Two clouds; which of them is `large`, the source (0) or the reference (1)."""

    source: Prepared
    reference: Prepared
    large: int

    @property
    def clouds(self) -> tuple[Prepared, Prepared]:
        return self.source, self.reference

    @property
    def whole(self) -> Prepared:
        """The large cloud."""
        return self.clouds[self.large]

    @property
    def part(self) -> Prepared:
        """The small cloud."""
        return self.clouds[1 - self.large]

    def with_whole(self, cloud: Prepared) -> tuple[Prepared, Prepared]:
        """Source and reference, with this cloud in the place of the large one."""
        return (cloud, self.reference) if self.large == 0 else (self.source, cloud)


class Piece(NamedTuple):
    """A part of the large cloud, and which of the points of the large cloud it has."""

    cloud: Prepared
    points: Bool[np.ndarray, "p"]

    def problem(self, pair: Nested, config: RegisterConfig, known: Known) -> surfaces.Problem:
        """The pair with this in the place of the large cloud, and with the weights of its points."""
        if pair.large == 0 and known.weights is not None:
            known = known._replace(weights=masks.of_points(known.weights[self.points], self.cloud))
        return surfaces.pose_problem(*pair.with_whole(self.cloud), config, known)


def is_possible(source: Prepared, reference: Prepared) -> bool:
    """Whether one of the clouds is so much larger that the other may lie in it."""
    return max(source.radius, reference.radius) >= _RATIO * min(source.radius, reference.radius)


def registered(
    source: Prepared,
    reference: Prepared,
    config: RegisterConfig,
    start: RigidTransform | None,
    tried: tuple[RigidTransform, ...],
    known: Known,
) -> ScanRegistration:
    """The registration of a small scan inside a large one, judged by what the small one covers.

    The poses that were `tried` come first. If none of them convinces, there is no start and the small
    one is known to lie inside, it is searched for in tiles of the large one, which takes seconds.
    """
    large = 1 if known.inside or reference.radius >= source.radius else 0
    pair = Nested(source, reference, large)
    judged = _judged(pair, tried if start is None else (start, *tried), config, known)
    # The poses that were tried come from a search of these two in this order.
    if start is None and (pair.large == 0 or not tried):
        judged += _judged(pair, _found_in_whole(pair, config, known), config, known)
    if known.inside and start is None and _likeliest(judged) < surfaces.SURE:
        judged += _judged(pair, _found_in_tiles(pair, config, known), config, known)
    if not judged:
        return surfaces.registered(source, reference, config, start, known)
    if start is None:
        judged += _judged(pair, _repeats(pair, _distinct(judged)[0].pose, known), config, known)
    best, *others = _distinct(judged)
    poses = [frame.transform_in(best.problem.where, one.pose) for one in (best, *others)]
    scores = [one.score for one in others]
    found = surfaces.Found(poses[0], tuple(zip(poses[1:], scores, strict=True)))
    return widened(
        surfaces.finished(best.problem, found), pair.clouds, best.problem.reference.centre
    )


class _Judged(NamedTuple):
    """A pose of the clouds as given, and its log odds with what the small one covers under it."""

    pose: RigidTransform
    score: float
    problem: surfaces.Problem


def _likeliest(judged: list[_Judged]) -> float:
    return float(chances(np.array([one.score for one in judged])).max()) if judged else 0.0


def _judged(
    pair: Nested, poses: tuple[RigidTransform, ...], config: RegisterConfig, known: Known
) -> list[_Judged]:
    """The poses, each refined and judged with the part of the large cloud that the small one covers."""
    judged = []
    for pose in poses:
        # What is covered under the refined pose may be more than it was before.
        if first := _judged_once(pair, pose, config, known):
            judged.append(_judged_once(pair, first.pose, config, known) or first)
    return judged


def _judged_once(
    pair: Nested, pose: RigidTransform, config: RegisterConfig, known: Known
) -> _Judged | None:
    """One pose, refined with what it covers itself; None if that is hardly anything."""
    if (piece := covered(pair, pose, config)) is None:
        return None
    problem = piece.problem(pair, config, known)
    here = frame.transform_in(problem.where, pose)
    found = candidates.judged(
        problem.clouds(),
        RigidTransform(here.rotation[None], here.translation[None]),
        np.zeros(1),
        distance=problem.reach(),
        most=1,
        motions=problem.motions,
    )
    refined = RigidTransform(found.poses.rotation[0], found.poses.translation[0])
    out = frame.transform_out(problem.where, refined)
    return _Judged(out, float(found.score[0]), problem)


def _repeats(pair: Nested, pose: RigidTransform, known: Known) -> tuple[RigidTransform, ...]:
    """The other poses, of the clouds as given, that lay about as much of the small one on the large."""
    here = centred(pair.clouds, pose)
    if pair.large == 0:
        here = se3.inverted(here)
    part, whole = (
        cloud.points[cloud.rows(_RASTERED)] * cloud.radius for cloud in (pair.part, pair.whole)
    )
    axes = repeats.axes_of(part, known.up)
    found, _ = repeats.others(part, whole, here, axes=axes, most=_ALL_TILES)
    if pair.large == 0:
        found = se3.inverted(found)
    allowed = rotation_angle_deg(found.rotation, np.eye(3)[None]) <= known.max_rotation_deg
    return tuple(
        out_of(pair.clouds, RigidTransform(found.rotation[i], found.translation[i]))
        for i in np.flatnonzero(allowed)
    )


def _distinct(judged: list[_Judged]) -> list[_Judged]:
    """The best first, without those that are the same as a better one."""
    chosen: list[_Judged] = []
    length = float(judged[0].problem.where.length)
    centre = judged[0].problem.source.centre
    for one in sorted(judged, key=lambda one: -one.score):
        at = one.pose.rotation @ centre + one.pose.translation
        for other in chosen:
            turned = rotation_angle_deg(one.pose.rotation, other.pose.rotation)
            moved = np.linalg.norm(at - other.pose.rotation @ centre - other.pose.translation)
            if turned <= candidates.APART_DEG and moved <= candidates.APART * length:
                break
        else:
            chosen.append(one)
    return chosen


def _found_in_whole(
    pair: Nested, config: RegisterConfig, known: Known
) -> tuple[RigidTransform, ...]:
    """The likeliest poses of the small one in the whole large one, as poses of the clouds as given."""
    known = known._replace(weights=None)
    problem = surfaces.pose_problem(pair.part, pair.whole, config, known)
    found = surfaces.searched(problem)
    poses = (found.pose, *(pose for pose, _ in found.others))
    poses = (frame.transform_out(problem.where, pose) for pose in poses[:_A_TILE])
    return tuple(pose if pair.large == 1 else se3.inverted(pose) for pose in poses)


def _found_in_tiles(
    pair: Nested, config: RegisterConfig, known: Known
) -> tuple[RigidTransform, ...]:
    """The poses that score best in the tiles of the large cloud, as poses of the clouds as given."""
    found: list[tuple[float, RigidTransform]] = []
    for tile in tiles(pair, config):
        problem = tile.problem(pair, config, known)
        poses, score = surfaces.searched_poses(problem, config.search, learned=False)
        for i in np.argsort(-score)[:_A_TILE]:
            pose = RigidTransform(poses.rotation[i], poses.translation[i])
            found.append((float(score[i]), frame.transform_out(problem.where, pose)))
    found.sort(key=lambda one: -one[0])
    return tuple(pose for _, pose in found[:_ALL_TILES])


def covered(pair: Nested, pose: RigidTransform, config: RegisterConfig) -> Piece | None:
    """The part of the large cloud that the small one covers under a pose of the clouds as given.

    None if there is hardly any.
    """
    inner = centred(pair.clouds, pose)
    points = pair.part.fine.points * pair.part.radius
    if pair.large == 1:
        placed = points @ inner.rotation.T + inner.translation
    else:
        placed = (points - inner.translation) @ inner.rotation
    margin = _MARGIN * float(np.linalg.norm(np.ptp(placed, axis=0)))
    return _cut(
        pair.whole, _within_hull(pair.whole.points * pair.whole.radius, placed, margin), config
    )


def tiles(pair: Nested, config: RegisterConfig) -> list[Piece]:
    """Pieces of the large cloud, each about as large as the small one, that overlap each other."""
    points = pair.whole.points * pair.whole.radius
    edge = _TILE * float(np.max(np.ptp(pair.part.points, axis=0))) * pair.part.radius
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    while True:
        steps = [1 + max(0, int(np.ceil((side - edge) / (_STRIDE * edge)))) for side in extent]
        if np.prod(steps) <= _MOST:
            break
        edge *= 1.1
    found = []
    for place in itertools.product(*map(range, steps)):
        room = np.maximum(extent - edge, 0)
        corner = low + room * [i / max(n - 1, 1) for i, n in zip(place, steps, strict=True)]
        inside = np.all((points >= corner - 1e-9 * edge) & (points <= corner + edge), axis=1)
        if (tile := _cut(pair.whole, inside, config)) is not None:
            found.append(tile)
    return found


def _cut(whole: Prepared, inside: Bool[np.ndarray, "p"], config: RegisterConfig) -> Piece | None:
    """A cloud of these points, in the frame of the input; None if there are hardly any."""
    if np.sum(inside) < _FEWEST:
        return None
    return Piece(prepare.of_points(whole, inside, config), inside)


def _within_hull(
    points: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "k 3"], margin: float
) -> Bool[np.ndarray, "n"]:
    """Which points lie at most `margin` outside of the convex hull of others."""
    low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    inside = np.all((points >= low) & (points <= high), axis=1)
    try:
        planes = ConvexHull(corners).equations
    except (QhullError, ValueError):
        return inside  # A flat cloud has no volume: its box does.
    near = points[inside]
    kept = np.ones(len(near), bool)
    for plane in planes:
        kept &= near @ plane[:3] + plane[3] <= margin
    inside[inside] = kept
    return inside
