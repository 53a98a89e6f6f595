"""Free space: between a scanner and the points that it measured there is nothing.

A pose that puts many points of the other cloud there is wrong, unless that much has moved. The evidence
is there only where it is known from where a cloud was seen, and holds for a scan from *one* place.
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxreg.geometry import trees
from jaxreg.types import RigidTransform

_DIRECTIONS = 20_000
"""Directions of a view are thinned to about so many."""
_AROUND = 4
"""A point counts as in front of what was measured if it is nearer than this many directions around."""
_GAP = 2.0
"""Directions that are farther from the next ones than this many steps of the view were not seen."""
_IN_FRONT = 0.15
"""Nearer to the scanner by this share of the measured distance: not noise, nor a slanted surface."""
_BLIND = 0.5
"""Nothing is said of points nearer than this many times the nearest few that a scanner measured: it may
be blind there, or what it sits on was cut away."""
_NEAREST = 0.02
_FEWEST = 30
_USUAL, _SLOPE, _MOST_FOR, _MOST_AGAINST = 0.05, 60.0, 1.5, -4.0
"""Log odds: ``slope (usual - share)`` within the bounds. Where scanners are known to be at the origin
(redkitchen frames, balm), 95 % of the right poses had a share below .03 and .06, nine tenths of the
wrong ones above .04 and .07."""
CONTRADICTED = 0.08
"""A share from which free space is told as the reason."""


class View(NamedTuple):
    """What was seen from a place: directions (in a tree) and distances, in the unit of the cloud.

    `step` is the usual distance from a direction to the fourth next one, `blind` that from which
    the scanner measures.
    """

    place: Float[np.ndarray, "3"]
    tree: trees.Tree
    distance: Float[np.ndarray, "d"]
    step: float
    blind: float


def view(points: Float[np.ndarray, "n 3"], place: Float[np.ndarray, "3"]) -> View:
    """The view of `points` from `place`, both in one frame."""
    seen = points[:: max(1, len(points) // _DIRECTIONS)] - place
    distance = np.linalg.norm(seen, axis=1)
    seen, distance = seen[distance > 0], distance[distance > 0]
    directions = seen / distance[:, None]
    tree = trees.Tree(directions)
    near = trees.neighbors(tree, directions[::5], min(_AROUND, len(seen) - 1) + 1)[0][:, -1]
    blind = _BLIND * float(np.quantile(distance, _NEAREST))
    return View(place, tree, distance, float(np.median(near)), blind)


class Look(NamedTuple):
    """Which points lie in directions that were seen.

    `through`: in front of what was measured there; `there`: about as far away. Others lie behind it.
    """

    seen: Bool[np.ndarray, "*k n"]
    through: Bool[np.ndarray, "*k n"]
    there: Bool[np.ndarray, "*k n"]


def look(view: View, points: Float[np.ndarray, "*k n 3"]) -> Look:
    """What a view says of points, in the frame and unit of its cloud."""
    apart = points - view.place
    distance = np.linalg.norm(apart, axis=-1)
    directions = apart / np.maximum(distance, np.finfo(np.float64).tiny)[..., None]
    around = min(_AROUND, len(view.distance))
    gap, index = trees.neighbors(view.tree, directions, around)
    measured = view.distance[index]
    seen = (gap[..., -1] < _GAP * view.step) & (distance > view.blind)
    through = seen & (distance < (1 - _IN_FRONT) * measured.min(axis=-1))
    there = seen & ~through & (distance < (1 + _IN_FRONT) * measured.max(axis=-1))
    return Look(seen, through, there)


def share_in_front(view: View, points: Float[np.ndarray, "*k n 3"]) -> Float[np.ndarray, "*k"]:
    """Share of the points, of those in seen directions, that lie in front of what was measured there.

    0 where fewer than thirty points lie in seen directions.
    """
    found = look(view, points)
    count = found.seen.sum(axis=-1)
    return np.where(count < _FEWEST, 0.0, found.through.sum(axis=-1) / np.maximum(count, 1))


class Sides(NamedTuple):
    """Both clouds as free space sees them: views (None: unknown from where) and points, own units.

    `scales` are these units in that of the frame of the pair.
    """

    views: tuple[View | None, View | None]
    points: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "m 3"]]
    scales: tuple[float, float]

    def share_in_front(self, poses: RigidTransform) -> Float[np.ndarray, "k"]:
        """For poses (leading axis) in the frame the larger share of either cloud; 0 without a view."""
        source, reference = (p * s for p, s in zip(self.points, self.scales, strict=True))
        there = source @ np.swapaxes(poses.rotation, -1, -2) + poses.translation[:, None]
        back = (reference - poses.translation[:, None]) @ poses.rotation
        shares = [
            share_in_front(seen, moved / scale)
            for seen, moved, scale in zip(self.views, (back, there), self.scales, strict=True)
            if seen is not None
        ]
        return functools.reduce(np.maximum, shares, np.zeros(len(poses.rotation)))

    def log_odds(self, poses: RigidTransform) -> Float[np.ndarray, "k"]:
        """What free space adds to the log odds of every pose; 0 if nothing is known."""
        if self.views == (None, None):
            return np.zeros(len(poses.rotation))
        share = self.share_in_front(poses)
        return np.clip(_SLOPE * (_USUAL - share), _MOST_AGAINST, _MOST_FOR)


def contradiction(share: float) -> str:
    """A sentence if so large a share of the points lies in front of what was measured; else empty."""
    if share < CONTRADICTED:
        return ""
    return f"{share:.0%} of the points lie in front of what the other scanner measured there."


def check_place(
    place: object, name: str, *, height: float | None = None
) -> Float[np.ndarray, "3"] | None:
    """A viewpoint (3,) as float64; None is unknown.

    Two numbers are one in the plane of a cloud whose points all have the z `height`.

    Raises:
      ValueError: it is not three finite numbers.
    """
    if place is None:
        return None
    try:
        array = np.asarray(place, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape == (2,) and height is not None:
        array = np.append(array, height)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(
            f"the viewpoint of the {name} must be three finite numbers, where its scanner stood in the "
            f"coordinates of the cloud, or None; got {place!r}."
        )
    return array


def places(viewpoint: object) -> tuple[object, object]:
    """The viewpoints of source and reference: one is of both, a pair of one each.

    Two numbers are a place in the plane.
    """
    if isinstance(viewpoint, tuple | list) and len(viewpoint) == 2:
        one, other = viewpoint
        if not (isinstance(one, int | float) and isinstance(other, int | float)):
            return one, other
    return viewpoint, viewpoint
