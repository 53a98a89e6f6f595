"""Which pairs of many scans to try: those that look alike, and those that lie over each other."""

import numpy as np
from jaxtyping import Float

from jaxreg.geometry import trees
from jaxreg.scans.prepare import Prepared, in_steps

_SIZE = 1024
_SAMPLE = 256
"""Points whose descriptors are compared."""
_PAUSE = 10.0
"""Scans between which so many usual steps of time lie are no neighbours."""
_SHOWN = 512
"""Points that tell how far two placed scans overlap."""


def likeness(prepared: list[Prepared]) -> Float[np.ndarray, "n n"]:
    """For any two scans how alike their surfaces are: symmetric, a higher value is more alike.

    Of a sample of points of every scan the search's moments, at one scale for all; the mean cosine of
    each point's best match in the other scan, both ways.
    """
    features = _features(prepared)
    count = len(features)
    score = np.zeros((count, count))
    for i in range(count):
        for j in range(i):
            cosine = features[i] @ features[j].T
            score[i, j] = score[j, i] = (cosine.max(axis=0).mean() + cosine.max(axis=1).mean()) / 2
    return score


def most_alike(likeness: Float[np.ndarray, "n n"], most: int) -> set[tuple[int, int]]:
    """For every scan the `most` that are most like it: pairs (i, j), i < j."""
    others = likeness.copy()
    np.fill_diagonal(others, -np.inf)
    order = np.argsort(-others, axis=1, kind="stable")[:, : min(most, len(others) - 1)]
    return {(min(i, j), max(i, j)) for i, row in enumerate(order.tolist()) for j in row}


def successive(times: Float[np.ndarray, "n"]) -> set[tuple[int, int]]:
    """Of every scan the next one in time and the one after that, unless a pause lies between.

    Of the usual step only positive ones tell: several scanners may take scans at the same time.
    """
    order = np.argsort(times, kind="stable")
    steps = np.diff(times[order])
    usual = np.median(steps[steps > 0]) if (steps > 0).any() else 0.0
    part = np.concatenate([[0], np.cumsum(steps > _PAUSE * usual)])
    return {
        (min(i, j), max(i, j))
        for step in (1, 2)
        for i, j, same in zip(
            order[:-step].tolist(), order[step:].tolist(), part[:-step] == part[step:], strict=True
        )
        if same
    }


def _features(prepared: list[Prepared]) -> list[np.ndarray]:
    unit = in_steps(2 * float(np.median([cloud.radius for cloud in prepared])))
    found = []
    for cloud in prepared:
        radii = cloud.config.search.radii
        size = max(_SIZE, 1 << int(np.ceil(np.log2(len(cloud.coarse.points)))))
        described = cloud.coarse.described(unit / cloud.radius, size, radii)
        rows = np.linspace(0, len(cloud.coarse.points) - 1, _SAMPLE).astype(int)
        found.append(np.asarray(described.features, np.float64)[rows])
    everything = np.concatenate(found)
    mean, deviation = everything.mean(axis=0), everything.std(axis=0) + 1e-9
    found = [np.clip((part - mean) / deviation, -3, 3) for part in found]
    return [part / (np.linalg.norm(part, axis=1, keepdims=True) + 1e-9) for part in found]


def overlaps(
    prepared: list[Prepared], matrices: dict[int, np.ndarray]
) -> dict[tuple[int, int], float]:
    """For scans at these poses, the share of the smaller one's points near the other: (i, j), i < j."""
    clouds = {}
    for k, matrix in matrices.items():
        cloud = prepared[k]
        points = cloud.coarse.points * cloud.radius + cloud.centre
        clouds[k] = points @ matrix[:3, :3].T + matrix[:3, 3]
    tree_of = {k: trees.Tree(points) for k, points in clouds.items()}
    middles = {k: points.mean(axis=0) for k, points in clouds.items()}
    extents = {k: np.linalg.norm(p - middles[k], axis=1).max() for k, p in clouds.items()}
    found = {}
    for i in sorted(clouds):
        for j in sorted(clouds):
            if i >= j or np.linalg.norm(middles[i] - middles[j]) > extents[i] + extents[j]:
                continue
            reach = 1.5 * max(prepared[k].coarse.spacing * prepared[k].radius for k in (i, j))
            found[i, j] = min(
                _share(clouds[i], tree_of[j], reach), _share(clouds[j], tree_of[i], reach)
            )
    return found


def _share(points: np.ndarray, tree: trees.Tree, reach: float) -> float:
    rows = np.linspace(0, len(points) - 1, min(_SHOWN, len(points))).astype(int)
    distance, _ = trees.nearest(tree, points[rows], within=reach)
    return float(np.isfinite(distance).mean())
