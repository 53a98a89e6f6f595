"""The poses of two sets of a few unordered points, from all triples of them.

So few points show no surface, but three pairs of them fix a pose. Every triple of one cloud is laid
on every triple of the other whose sides are as long, the pairs that then agree are counted, and the
pose is fitted to all of them. What speaks for a pose is how seldom chance would give as many pairs
with as small a residual (the a-contrario reasoning of Desolneux, Moisan and Morel, 2000; for poses
Moisan and Stival, 2004): no tolerance has to be given.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.distance import cdist
from scipy.special import gammaln

from jaxreg.geometry import trees
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.scans.known import best_turn, turns_about
from jaxreg.types import RigidTransform

_TOLERANCES = (1e-3, 4e-3, 1.6e-2, 5e-2)
"""Differences of lengths that are tried in turn, in diameters of the larger cloud."""
EXACT = 1e-5
"""No residual counts as smaller, in diameters: what decides below it is rounding."""
_WORK = (1_000_000, 15_000_000)
"""Most comparisons of lengths at one tolerance: first of a few of the triples, then, if these give no
convincing pose, of all triples of 25 points and some of more."""
_POSES = (3000, 12_000)
"""Most triples that are laid on one another at one tolerance, first and then."""
_ALL_AT_FIRST = 12
"""Of so many points the first comparisons are of all triples."""
_LOOKED_AT, _REFITTED = 400, 60
"""Poses with most pairs of which the pairs are looked at, and that are fitted to all of theirs."""
_GLANCE = 16
"""So many points tell which poses are worth a look at all of them."""
_ROUNDS = 4
_THIN = 0.02
"""Triangles that are less wide than this (in diameters) fix no rotation."""
_DOUBT = math.log(1e3)
"""A pose that one in a thousand unrelated pairs of clouds would give is as likely right as wrong."""
_APART = 6.0
"""Poses that move a point so many residuals apart are different."""


class Solution(NamedTuple):
    """A pose (source to reference), its pairs (rows of source and reference), and how good they are.

    `residual` is the largest distance of a pair, `squares` the sum of the squares of all, `log_chance`
    the natural logarithm of the number of poses this good that unrelated points would give.
    """

    pose: RigidTransform
    pairs: Int[np.ndarray, "k 2"]
    residual: float
    squares: float
    log_chance: float

    @property
    def log_odds(self) -> float:
        """How much speaks for the pose, as `jaxreg.judge.odds.probabilities` takes it."""
        return -self.log_chance - _DOUBT


def solutions(
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    *,
    up: Float[np.ndarray, "3"] | None = None,
    max_rotation_deg: float = 180.0,
    initial: RigidTransform | None = None,
) -> list[Solution]:
    """The distinct poses that pair three or more points, the least likely by chance first.

    With `up`, a unit vector, only turns about it. If `initial` is given, only what is near it.
    """
    middle = source.mean(axis=0), reference.mean(axis=0)
    x, y = source - middle[0], reference - middle[1]
    problem = _Problem(
        x, y, cdist(x, x), cdist(y, y), _widths(y), up, flat=up is not None and _is_flat(x, y, up)
    )
    if initial is not None:
        shift = initial.rotation @ middle[0] + initial.translation - middle[1]
        start = RigidTransform(initial.rotation[None], shift[None])
        found = _best([_refitted(problem, start, 0.05 * problem.diameter)], problem)
    else:
        found = _searched(problem, max_rotation_deg)
    return [
        one._replace(
            pose=one.pose._replace(
                translation=one.pose.translation + middle[1] - one.pose.rotation @ middle[0]
            )
        )
        for one in found
    ]


class _Problem(NamedTuple):
    """Centred points, the lengths between them, and what is known of the pose."""

    source: Float[np.ndarray, "n 3"]
    reference: Float[np.ndarray, "m 3"]
    source_lengths: Float[np.ndarray, "n n"]
    reference_lengths: Float[np.ndarray, "m m"]
    widths: Float[np.ndarray, "3"]
    up: Float[np.ndarray, "3"] | None
    flat: bool

    @property
    def diameter(self) -> float:
        return max(float(self.source_lengths.max()), float(self.reference_lengths.max()))

    @property
    def swapped(self) -> "_Problem":
        x, y, a, b = self[:4]
        return self._replace(source=y, reference=x, source_lengths=b, reference_lengths=a)


def _is_flat(x: np.ndarray, y: np.ndarray, up: np.ndarray) -> bool:
    return bool(max(np.ptp(x @ up), np.ptp(y @ up)) <= 1e-9 * max(np.ptp(x), np.ptp(y)))


def _searched(problem: _Problem, max_rotation_deg: float) -> list[Solution]:
    """The poses at the first tolerance that leaves room for the residual of a convincing one."""
    found: list[Solution] = []
    if problem.diameter == 0:
        return found
    fewest = min(len(problem.source), len(problem.reference))
    for effort in range(1 if fewest <= _ALL_AT_FIRST else 2):
        for tolerance in problem.diameter * np.array(_TOLERANCES):
            poses = _allowed(_laid_on(problem, float(tolerance), effort), max_rotation_deg)
            if len(poses.rotation):
                found = _best([_refitted(problem, poses, 2 * tolerance), found], problem)
            if found and found[0].log_odds > 0 and tolerance > 4 * found[0].residual:
                return found
        if found and found[0].log_odds > 0:
            break
    return found


def _allowed(poses: RigidTransform, max_rotation_deg: float) -> RigidTransform:
    """Those that turn by little enough; all of them where none does."""
    rows = rotation_angle_deg(poses.rotation, np.eye(3)[None]) <= max_rotation_deg + 0.1
    rows = rows if rows.any() else np.ones_like(rows)
    return RigidTransform(poses.rotation[rows], poses.translation[rows])


def _laid_on(problem: _Problem, tolerance: float, effort: int) -> RigidTransform:
    """A pose for every triple of the source and every triple of the reference with equal sides."""
    if len(problem.source) > len(problem.reference):
        return _inverse(_laid_on(problem.swapped, tolerance, effort))
    a, b = problem.source_lengths, problem.reference_lengths
    first, second = np.nonzero(~np.eye(len(b), dtype=bool))
    order = np.argsort(b[first, second])
    first, second, length = first[order], second[order], b[first[order], second[order]]
    triples = _triples(problem)
    side = a[triples[:, 0], triples[:, 1]]
    low, high = (np.searchsorted(length, side + s * tolerance) for s in (-1, 1))
    most = max(1, int(np.searchsorted(np.cumsum((high - low) * len(b)), _WORK[effort])))
    triples, low, high = triples[:most], low[:most], high[:most]
    row = np.repeat(np.arange(len(triples)), high - low)
    offset = np.arange(len(row)) - np.repeat(np.cumsum(high - low) - (high - low), high - low)
    pair = low[row] + offset
    laid = []
    for rows, pairs in zip(_blocks(row, len(b)), _blocks(pair, len(b)), strict=True):
        i, j, k = triples[rows].T
        one, other = first[pairs], second[pairs]
        fits = (np.abs(b[one] - a[i, k][:, None]) <= tolerance) & (
            np.abs(b[other] - a[j, k][:, None]) <= tolerance
        )
        number, third = np.nonzero(fits)
        laid.append(np.stack([rows[number], one[number], other[number], third], axis=1))
        if sum(map(len, laid)) > _POSES[effort]:
            break
    found = np.concatenate([*laid, np.zeros((0, 4), np.int64)])[: _POSES[effort]]
    x, y = problem.source[triples[found[:, 0]]], problem.reference[found[:, 1:]]
    return _fitted(x, y, problem.up)


def _triples(problem: _Problem) -> Int[np.ndarray, "t 3"]:
    """All triples that fix a rotation, in an order without a pattern; the first side is the longest."""
    n, a = len(problem.source), problem.source_lengths
    i, j, k = (index.ravel() for index in np.meshgrid(*[np.arange(n)] * 3, indexing="ij"))
    longest = (i < j) & (k != i) & (k != j) & (a[i, j] >= a[i, k]) & (a[i, j] >= a[j, k])
    i, j, k = i[longest], j[longest], k[longest]
    x = problem.source
    area = np.linalg.norm(np.cross(x[j] - x[i], x[k] - x[i]), axis=1)
    wide = area >= _THIN * problem.diameter * a[i, j]
    wide |= problem.up is not None
    triples = np.stack([i, j, k], axis=1)[wide & (a[i, j] > 0)]
    return np.random.default_rng(0).permutation(triples)


def _blocks(values: np.ndarray, width: int) -> list[np.ndarray]:
    return np.array_split(values, max(1, len(values) * width // 2_000_000))


def _fitted(
    x: Float[np.ndarray, "b k 3"], y: Float[np.ndarray, "b k 3"], up: np.ndarray | None
) -> RigidTransform:
    """The least-squares pose of every set of pairs; with `up` of those that turn about it."""
    a, b = x.mean(axis=1), y.mean(axis=1)
    moment = np.einsum("bki,bkj->bij", y - b[:, None], x - a[:, None])
    if up is None:
        u, _, vt = np.linalg.svd(moment)
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
        rotation = u @ vt
    else:
        rotation = turns_about(up, best_turn(moment, up))
    return RigidTransform(rotation, b - np.einsum("bij,bj->bi", rotation, a))


def _refitted(problem: _Problem, poses: RigidTransform, reach: float) -> list[Solution]:
    """Those with most pairs within `reach`, fitted to the pairs that chance explains least."""
    best = _with_most_pairs(problem, poses, reach)
    solved, seen = [], set()
    for index in best:
        if len(solved) == _REFITTED:
            break
        pose = RigidTransform(poses.rotation[index], poses.translation[index])
        pairs = _partners(problem, pose, reach)[0]
        key = pairs[np.argsort(pairs[:, 0])].tobytes()
        # Most of the poses of one solution have the same pairs.
        if len(pairs) < 3 or key in seen:
            continue
        seen.add(key)
        solved.append(_solution(problem, pose, reach))
    return [one for one in solved if one is not None]


def _with_most_pairs(problem: _Problem, poses: RigidTransform, reach: float) -> list[int]:
    """The poses that bring most points of the source near one of the reference, the best first."""
    tree = trees.Tree(problem.reference)
    chosen = np.arange(len(poses.rotation))
    step = -(-len(problem.source) // _GLANCE)
    # First by some of the points, where there are many poses.
    for some, most in ((problem.source[::step], 4 * _LOOKED_AT), (problem.source, _LOOKED_AT)):
        if len(chosen) > most:
            moved = np.einsum("bij,nj->bni", poses.rotation[chosen], some)
            moved += poses.translation[chosen][:, None]
            near = np.minimum(trees.nearest(tree, moved, within=reach)[0] / reach, 1)
            score = np.sum(1 - near**2, axis=1)
            chosen = chosen[np.argsort(-score, kind="stable")[:most]]
    return chosen.tolist()


def _partners(
    problem: _Problem, pose: RigidTransform, reach: float
) -> tuple[Int[np.ndarray, "k 2"], Float[np.ndarray, "k"]]:
    """Pairs of points each of which is the other's nearest, and their distances, the nearest first."""
    moved = problem.source @ pose.rotation.T + pose.translation
    distance = cdist(moved, problem.reference)
    to, back = distance.argmin(axis=1), distance.argmin(axis=0)
    rows = np.flatnonzero(back[to] == np.arange(len(to)))
    near = distance[rows, to[rows]]
    order = np.argsort(near, kind="stable")
    order = order[near[order] <= reach]
    return np.stack([rows, to[rows]], axis=1)[order], near[order]


def _solution(problem: _Problem, pose: RigidTransform, reach: float) -> Solution | None:
    """The pose fitted to the first pairs that chance explains least, until these stay the same."""
    best = None
    for _ in range(_ROUNDS):
        pairs, near = _partners(problem, pose, reach)
        if len(pairs) < 3:
            break
        chance = _log_chance(problem, near)
        count = int(np.argmin(chance)) + 3
        chosen = pairs[:count]
        x, y = problem.source[chosen[:, 0]], problem.reference[chosen[:, 1]]
        fit = _fitted(x[None], y[None], problem.up)
        pose = RigidTransform(fit.rotation[0], fit.translation[0])
        moved = x @ pose.rotation.T + pose.translation
        near = np.sort(np.linalg.norm(moved - y, axis=1))
        chance = float(_log_chance(problem, near)[-1])
        found = Solution(pose, chosen, float(near[-1]), float(np.sum(near**2)), chance)
        if best is not None and np.array_equal(best.pairs, chosen):
            break
        if best is None or found.log_chance < best.log_chance:
            best = found
    return best


def _log_chance(problem: _Problem, near: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k-2"]:
    """Of the first 3, 4, ... pairs: how many poses as good chance gives (natural logarithm).

    ``(min(n, m) - 2) C(n, k) m! / (m - k)! p^(k - f / d)``, where p is the chance that a random point
    of the reference lies within the largest distance, and a pose of f unknowns fits so many of the
    ``d k`` coordinates anyway.
    """
    n, m = len(problem.source), len(problem.reference)
    k = np.arange(3, len(near) + 1)
    largest = np.maximum(near[2:], EXACT * problem.diameter)
    share = 2 * largest[:, None] / np.maximum(problem.widths, 1e-300)
    inside = np.sum(np.log(np.minimum(1, share)), axis=1)
    free = 1.5 if problem.flat else 2.0 if problem.up is None else 4 / 3
    ways = (
        gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1) + gammaln(m + 1) - gammaln(m - k + 1)
    )
    return math.log(max(min(n, m) - 2, 1)) + ways + (k - free) * inside


def _widths(points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "3"]:
    """How far the points reach along their principal axes."""
    axes = np.linalg.svd(points - points.mean(axis=0))[2]
    return np.ptp(points @ axes.T, axis=0)


def _best(found: list[list[Solution]], problem: _Problem) -> list[Solution]:
    """The distinct ones, the best first."""
    distinct: list[Solution] = []
    for one in sorted((s for some in found for s in some), key=lambda s: s.log_chance):
        if all(_differ(one, other, problem) for other in distinct):
            distinct.append(one)
    return distinct


def _differ(one: Solution, other: Solution, problem: _Problem) -> bool:
    apart = problem.source @ (one.pose.rotation - other.pose.rotation).T
    apart = np.linalg.norm(apart + one.pose.translation - other.pose.translation, axis=1)
    least = max(one.residual, other.residual, EXACT * problem.diameter)
    return bool(apart.max() > max(_APART * least, 0.02 * problem.diameter))


def _inverse(poses: RigidTransform) -> RigidTransform:
    back = np.swapaxes(poses.rotation, 1, 2)
    return RigidTransform(back, -np.einsum("bij,bj->bi", back, poses.translation))
