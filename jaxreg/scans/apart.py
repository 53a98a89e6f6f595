"""Parts of a placement that free space keeps apart: one fills what the other's scanners saw through.

A pair knows only its own two scans, and two corners that look alike fit. Of two buildings laid over
each other all scans of one tell against all those of the other, also where they share no pair.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from jaxreg.graph.trees import triangles
from jaxreg.scans import free_space
from jaxreg.scans.placing import Placement
from jaxreg.scans.prepare import Prepared
from jaxreg.scans.relation import Relation

_POINTS = 200
"""Points of a scan that others look for."""
_SHARE, _FEWEST = 0.05, 100
"""Parts do not belong together if of the points that one saw as the other did, or saw through, more
than this share were seen through, and there are so many. Right placements of balm, kitti00 and
redkitchen frames have at most .03 for a scan and the others, a third of a sequence in a wrong place
.29 and more, two buildings laid over each other at a corner .07."""


class Looks(NamedTuple):
    """How many points of scan j scan i saw through (`through[i, j]`), and saw there (`there[i, j]`)."""

    through: Int[np.ndarray, "n n"]
    there: Int[np.ndarray, "n n"]


def looks(clouds: list[Prepared], placement: Placement) -> Looks:
    """Of the scans of one group, each from the place of its scanner; zeros where that is not known."""
    count = len(clouds)
    through, there = np.zeros((2, count, count), np.int64)
    rows = [np.linspace(0, len(c.points) - 1, _POINTS).astype(np.int64) for c in clouds]
    own = [cloud.points[row] for cloud, row in zip(clouds, rows, strict=True)]
    points = np.stack([x * c.radius + c.centre for x, c in zip(own, clouds, strict=True)])
    reach = np.linalg.norm(own, axis=-1).max(axis=-1) * [cloud.radius for cloud in clouds]
    turn, shift = placement.poses
    placed = points @ turn.mT + shift[:, None]
    middle = placed.mean(axis=1)
    for i, cloud in enumerate(clouds):
        if cloud.view is None or placement.group[i] < 0:
            continue
        near = np.linalg.norm(middle - middle[i], axis=1) < reach + reach[i]
        others = np.flatnonzero(near & (placement.group == placement.group[i]))
        others = others[others != i]
        back = (placed[others] - shift[i]) @ turn[i]
        found = free_space.look(cloud.view, (back - cloud.centre) / cloud.radius)
        through[i, others], there[i, others] = found.through.sum(axis=1), found.there.sum(axis=1)
    return Looks(through, there)


def kept_apart(
    relations: list[Relation], placement: Placement, seen: Looks
) -> Bool[np.ndarray, "e"]:
    """The used pairs that join parts which free space keeps apart.

    Scans are joined one pair after the other, those first that close most triangles: a part grows from
    within before anything joins it to others. A pair that would join two parts is refused if these
    contradict each other, and so is every other pair between them.
    """
    count = len(placement.group)
    ends = np.array([(r.source, r.reference) for r in relations], np.int64).reshape(-1, 2)
    used = np.flatnonzero(placement.used)
    closed = np.bincount(
        triangles(ends[used, 0], ends[used, 1], count).ravel(), minlength=len(used)
    )
    through, both = seen.through + seen.through.T, seen.there + seen.there.T
    both = both + through
    label, hostile = np.arange(count), np.zeros((count, count), bool)
    for edge in used[np.lexsort([-placement.posterior[used], -closed])]:
        one, other = label[ends[edge]]
        if one == other:
            continue
        across = np.ix_(label == one, label == other)
        looked = both[across].sum()
        against = looked >= _FEWEST and through[across].sum() > _SHARE * looked
        if against or hostile[across].any():
            hostile[across] = hostile.T[across] = True
        else:
            label[label == other] = one
    return placement.used & (label[ends[:, 0]] != label[ends[:, 1]])
