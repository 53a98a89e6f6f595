"""From registrations of pairs to the poses of many scans: which pairs to believe, and what follows.

A pair is believed for its own probability and for how it agrees with others: three pairs of three scans
that lead back to where they began are hardly right or wrong by chance.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse import csgraph

from jaxreg.geometry import se3
from jaxreg.graph.pose_graph import CHI_SQUARED, PoseGraph, squared_errors
from jaxreg.graph.sparse import pose_covariances, solve_poses
from jaxreg.graph.trees import components, spanning_tree, tree_poses, triangle_errors, triangles
from jaxreg.scans.relation import Relation
from jaxreg.scans.verdict import RIVAL
from jaxreg.types import RigidTransform

SURE = 0.9
"""A scan hangs on a pair that is right with this probability, or on several that agree."""
_CONSIDERED = 0.02
"""Pairs of a smaller probability are not looked at: there are many, and nearly all are wrong."""
_MODEL = 0.3
"""What scans of one place differ by beyond their noise (moved things, bent depth, a moving sensor), in
reaches (`max_correspondence_distance`): one standard deviation of a pair's translation."""
_BY_CHANCE = 0.05
"""How often three pairs, one of them wrong, close a triangle at least: a foreign scan that fits one
view of a thing fits the next view in the same wrong way."""
_UNLIKELY = 0.1
_ENOUGH = 30
"""Pairs, or triangles, from which a share is estimated; of fewer it is taken as usual."""
_EM_ROUNDS, _AS_IF = 50, 2.0
"""Rounds of the estimate of a share, and the observations that what is expected counts for."""
_VOTE, _PART = 3.0, 5
"""Largest log odds with which a pair speaks for or against those that lay its scans over each other,
and the scans of a part of which so many pairs can be expected that their silence says something."""
_CLOSED = 0.98
"""How often three right pairs close one."""
_AMONG_RIVALS = 0.5
"""How often three pairs close one of which two have rivals: of a vase on a turntable every turn looks
right, and the search takes the least of them each time, which agree."""
_ROUNDS = 8
_LARGEST_ODDS = 12.0
"""Log odds beyond which nothing speaks for or against a pair."""


class Sizes(NamedTuple):
    """Of every scan: its centre and radius, in the unit of the input."""

    centre: Float[np.ndarray, "n 3"]
    radius: Float[np.ndarray, "n"]


class Placement(NamedTuple):
    """Where scans are. Scans of one group are in one frame, that of its first scan.

    `group` numbers the groups by size, -1 for a scan alone. `probability` is that of a scan's pose in
    its group, `covariance` is about its own centre, in the axes of its group (NaN if alone).
    `posterior` is the probability of each pair in view of all others, `used` says which pairs the
    poses come from, `refusal` why the others do not count. `part` numbers the parts that more than one
    sure pair holds together: between parts of a group a single mistake would be enough.
    """

    poses: RigidTransform
    group: Int[np.ndarray, "n"]
    probability: Float[np.ndarray, "n"]
    covariance: Float[np.ndarray, "n 6 6"]
    posterior: Float[np.ndarray, "e"]
    used: Bool[np.ndarray, "e"]
    refusal: tuple[str, ...]
    part: Int[np.ndarray, "n"]

    def members(self) -> tuple[tuple[int, ...], ...]:
        """The scans of every group, the largest group first."""
        return tuple(
            tuple(np.flatnonzero(self.group == k).tolist()) for k in range(self.group.max() + 1)
        )


def place(
    relations: list[Relation], sizes: Sizes, apart: Bool[np.ndarray, "e"] | None = None
) -> Placement:
    """Believe or refuse every pair, and solve for the poses of all scans.

    Pairs that are `apart` are refused: they join parts that free space keeps apart.
    """
    count = len(sizes.radius)
    graph, unit = pair_graph(relations, sizes)
    how = np.array([relation.how for relation in relations])
    prior = _at_base_rate(np.array([r.probability for r in relations], np.float64), how)
    apart = np.zeros(len(relations), bool) if apart is None else apart
    looked_at = (prior >= _CONSIDERED) & ~apart
    graph = graph._replace(mask=looked_at)
    # A pose that other pairs gave closes their triangles, whether these are right or not.
    witnesses = np.flatnonzero(looked_at & (how != "start"))
    found = triangles(graph.source[witnesses], graph.reference[witnesses], count)
    found = witnesses[found]
    closed = triangle_errors(graph, found) <= CHI_SQUARED
    rivals = np.array([relation.rivals >= RIVAL for relation in relations], bool)
    by_chance = np.full(len(found), _closed_by_chance(prior, found, closed))
    by_chance[rivals[found].sum(axis=1) >= 2] = _AMONG_RIVALS
    posterior = _posterior(prior, found, closed, by_chance)
    poses, errors = _robust_poses(graph, posterior, count)
    agrees = errors <= CHI_SQUARED
    # Nor is a pair with a start a witness that agrees with where it was put, unless it fits there.
    posterior = _confirmed(graph, posterior, (how != "start") | (prior >= 0.5), agrees, count)
    used = looked_at & agrees & (posterior >= SURE)
    refuted = _refuted(graph, used, prior, how == "start", count)
    posterior = np.where(refuted, np.minimum(posterior, 0.01), posterior)
    used &= ~refuted
    group = _groups(graph, used, count)
    used &= (group[graph.source] >= 0) & (group[graph.source] == group[graph.reference])
    first = np.array([np.flatnonzero(group == k)[0] for k in range(group.max() + 1)], np.int64)
    fixed = group < 0
    fixed[first] = True
    kept = graph._replace(mask=used)
    start = _regrounded(kept, posterior, first, count)
    solved = solve_poses(kept, start, fixed=fixed)
    spread = max(1.0, _excess(solved.squared_errors[used], count - int(fixed.sum())))
    covariance = pose_covariances(kept, solved.poses, fixed=fixed) * spread
    covariance[group < 0] = np.nan
    return Placement(
        _in_units(solved.poses, sizes, unit, group, first),
        group,
        _chances(graph, used, posterior, group, first),
        _about_centres(covariance, solved.poses, unit),
        posterior,
        used,
        tuple(_refusals(relations, used, apart, agrees, refuted, posterior)),
        _parts(graph, used & (prior >= SURE), count),
    )


def pair_graph(relations: list[Relation], sizes: Sizes) -> tuple[PoseGraph, float]:
    """The pairs as edges between centred scans, and the unit of their lengths.

    Of scans in map coordinates a rotation about the origin would move them by kilometres.
    """
    unit = float(np.median(sizes.radius))
    source, reference = (
        np.array([getattr(r, name) for r in relations], np.int64)
        for name in ("source", "reference")
    )
    matrix = np.array([r.transformation for r in relations], np.float64).reshape(-1, 4, 4)
    turn = matrix[:, :3, :3]
    shift = se3.applied(turn, sizes.centre[source]) + matrix[:, :3, 3] - sizes.centre[reference]
    transform = RigidTransform(turn, shift / unit)
    covariance = np.array([r.covariance for r in relations], np.float64).reshape(-1, 6, 6)
    known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    covariance = np.where(known[:, None, None], covariance, 0)
    scaling = np.repeat([1.0, 1 / unit], 3)
    carried = se3.adjoint(se3.inverted(transform))
    covariance = carried @ (covariance * np.outer(scaling, scaling)) @ carried.mT
    reach = np.array([r.max_correspondence_distance for r in relations], np.float64)
    smaller = np.minimum(sizes.radius[source], sizes.radius[reference])
    floor = np.stack([_MODEL * reach / smaller] * 3 + [_MODEL * reach / unit] * 3, axis=1)
    floor = np.maximum(floor.reshape(-1, 6), 1e-6)
    covariance = covariance + floor[:, :, None] ** 2 * np.eye(6)
    everything = np.ones(len(source), bool)
    return PoseGraph(source, reference, transform, np.linalg.inv(covariance), everything), unit


def _at_base_rate(probability: Float[np.ndarray, "e"], how: np.ndarray) -> np.ndarray:
    """The probabilities where right pairs are seldom: a wide search tries hundreds, and few are right.

    `register` gives the odds of a pair that is as likely right as wrong before it is looked at. The
    share of right ones among the pairs of the wide search is estimated from their probabilities
    (Saerens, Latinne and Decaestecker, 2002), never as more than a half.
    """
    chosen = how == "wide search"
    if chosen.sum() < _ENOUGH:
        return probability
    odds, rate = np.exp(_log_odds(probability)), 0.5
    for _ in range(_EM_ROUNDS):
        at_rate = odds[chosen] * rate / (1 - rate)
        right = np.sum(at_rate / (1 + at_rate))
        rate = min(0.5, (right + _AS_IF) / (chosen.sum() + 2 * _AS_IF))
    odds = np.where(chosen, odds * rate / (1 - rate), odds)
    return odds / (1 + odds)


def _closed_by_chance(
    prior: Float[np.ndarray, "e"], found: Int[np.ndarray, "t 3"], closed: Bool[np.ndarray, "t"]
) -> float:
    """How often triangles close that have a wrong pair: where places repeat, wrong pairs agree.

    Counted where a pair is most likely wrong, whatever the triangle says.
    """
    wrong = prior[found].min(axis=1, initial=1.0) < _UNLIKELY
    if wrong.sum() < _ENOUGH:
        return _BY_CHANCE
    rate = (np.sum(wrong * closed) + _AS_IF * _BY_CHANCE) / (np.sum(wrong) + _AS_IF)
    return float(np.clip(rate, _BY_CHANCE, _AMONG_RIVALS))


def _refuted(
    graph: PoseGraph,
    used: Bool[np.ndarray, "e"],
    prior: Float[np.ndarray, "e"],
    given: Bool[np.ndarray, "e"],
    count: int,
) -> Bool[np.ndarray, "e"]:
    """Pairs that lay two parts over each other whose scans do not fit there.

    Parts hang together by sure pairs. Used pairs between two of them, and pairs that were registered
    from where these lay them (a `given` start), vote with their log odds. Of parts that one sure pair
    joins it is refused; of larger ones that only pairs join which agree, all of these.
    """
    refuted = np.zeros(len(used), bool)
    votes = np.clip(_log_odds(prior), -_VOTE, _VOTE)
    voting = used | given
    sure = used & (prior >= SURE)
    for edge in np.flatnonzero(_bridges(graph, sure, count)):
        rest = np.flatnonzero(sure & (np.arange(len(used)) != edge))
        label = components(count, graph.source[rest], graph.reference[rest])
        between = _between(graph, label, label[[graph.source[edge], graph.reference[edge]]])
        if votes[between & voting].sum() < 0:
            refuted |= between & used
    rest = np.flatnonzero(sure & ~refuted)
    label = components(count, graph.source[rest], graph.reference[rest])
    large = np.bincount(label) >= _PART
    pairs = np.stack([label[graph.source], label[graph.reference]], axis=1)
    apart = used & (pairs[:, 0] != pairs[:, 1]) & large[pairs].all(axis=1)
    for ends in np.unique(np.sort(pairs[apart], axis=1), axis=0):
        between = _between(graph, label, ends)
        if votes[between & voting].sum() < 0:
            refuted |= between & used
    return refuted


def _parts(graph: PoseGraph, sure: Bool[np.ndarray, "e"], count: int) -> Int[np.ndarray, "n"]:
    """What hangs together by sure pairs, without those that are the only way between two parts."""
    firm = np.flatnonzero(sure & ~_bridges(graph, sure, count))
    return components(count, graph.source[firm], graph.reference[firm])


def _between(graph: PoseGraph, label: np.ndarray, ends: np.ndarray) -> Bool[np.ndarray, "e"]:
    """Which pairs are of one scan with the first label of `ends` and one with the second."""
    sides = np.sort(np.stack([label[graph.source], label[graph.reference]]), axis=0)
    return (sides[0] == min(ends)) & (sides[1] == max(ends))


def _posterior(
    prior: Float[np.ndarray, "e"],
    found: Int[np.ndarray, "t 3"],
    closed: Bool[np.ndarray, "t"],
    by_chance: Float[np.ndarray, "t"],
) -> Float[np.ndarray, "e"]:
    """The probability of every pair given which triangles close (a few rounds of belief)."""
    start = _log_odds(prior)
    odds = start
    for _ in range(_ROUNDS):
        chance = 1 / (1 + np.exp(-odds))
        said, doubt = np.zeros(found.shape), np.zeros(found.shape)
        for k in range(3):
            others = chance[found[:, (k + 1) % 3]] * chance[found[:, (k + 2) % 3]]
            right = others * _CLOSED + (1 - others) * by_chance
            said[:, k] = np.where(closed, np.log(right / by_chance), 0)
            doubt[:, k] = np.where(closed, 0, np.log((1 - right) / (1 - by_chance)))
        # Triangles that share pairs are no independent witnesses: the best two count.
        support = _sum_of_largest_two(found.ravel(), said.ravel(), len(odds))
        against = np.bincount(found.ravel(), doubt.ravel(), len(odds)).astype(np.float64)
        # As many triangles speak against a right pair as wrong ones touch it; a wrong pair closes none.
        against = np.maximum(against, -8.0)
        odds = (odds + np.clip(start + support + against, -_LARGEST_ODDS, _LARGEST_ODDS)) / 2
    return 1 / (1 + np.exp(-odds))


def _sum_of_largest_two(
    index: Int[np.ndarray, "k"], values: Float[np.ndarray, "k"], count: int
) -> Float[np.ndarray, "c"]:
    """For each of `count` indices the sum of its two largest values, 0 where there is none."""
    order = np.lexsort([-values, index])
    index, values = index[order], values[order]
    rank = np.arange(len(index)) - np.searchsorted(index, index)
    return np.bincount(index[rank < 2], values[rank < 2], count).astype(np.float64)


def _log_odds(probability: np.ndarray) -> np.ndarray:
    p = np.clip(probability, 1e-6, 1 - 1e-4)
    return np.log(p / (1 - p))


def _robust_poses(
    graph: PoseGraph, posterior: np.ndarray, count: int
) -> tuple[RigidTransform, np.ndarray]:
    """Poses in which most of the probable pairs agree, and the error of every pair under them."""
    likely = graph.mask & (posterior >= 0.5)
    edges = np.flatnonzero(likely)
    label = components(count, graph.source[edges], graph.reference[edges])
    roots = np.unique(label, return_index=True)[1]
    start = _tree(graph, edges, posterior, roots, count)
    fixed = np.zeros(count, bool)
    fixed[roots] = True
    solved = solve_poses(graph._replace(mask=likely), start, fixed=fixed, robust=True)
    errors = squared_errors(graph, solved.poses)
    apart = label[graph.source] != label[graph.reference]
    return solved.poses, np.where(apart | ~graph.mask, np.inf, errors)


def _tree(graph: PoseGraph, edges, posterior, roots, count: int) -> RigidTransform:
    cost = 1e-3 - np.log(np.clip(posterior[edges], 1e-9, 1))
    tree = spanning_tree(count, graph.source[edges], graph.reference[edges], cost)
    return tree_poses(count, graph, edges[tree], roots)


def _confirmed(graph: PoseGraph, posterior, counts, agrees, count: int) -> np.ndarray:
    """Pairs that agree with the poses that sure ones give are as sure as these, of those that `counts`.

    A pair that is the only one between two parts agrees in any case, which says nothing.
    """
    agreeing = graph.mask & agrees
    sure = agreeing & (posterior >= SURE)
    label = components(count, graph.source[sure], graph.reference[sure])
    inside = agreeing & counts & ~_bridges(graph, sure, count)
    inside &= label[graph.source] == label[graph.reference]
    return np.where(
        inside,
        np.maximum(posterior, 0.99),
        np.where(agrees, posterior, np.minimum(posterior, 0.01)),
    )


def _bridges(graph: PoseGraph, edges: Bool[np.ndarray, "e"], count: int) -> Bool[np.ndarray, "e"]:
    """Which of these edges are the only way between what lies on their two sides."""
    adjacent: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    for edge in np.flatnonzero(edges).tolist():
        i, j = int(graph.source[edge]), int(graph.reference[edge])
        adjacent[i].append((j, edge))
        adjacent[j].append((i, edge))
    order, low = [-1] * count, [0] * count
    bridge = np.zeros(len(edges), bool)
    visited = 0
    for root in range(count):
        if order[root] >= 0:
            continue
        order[root] = low[root] = visited
        visited += 1
        stack = [(root, -1, iter(adjacent[root]))]
        while stack:
            here, came, rest = stack[-1]
            step = next(rest, None)
            if step is None:
                stack.pop()
                if stack:
                    parent = stack[-1][0]
                    low[parent] = min(low[parent], low[here])
                    bridge[came] |= low[here] > order[parent]
                continue
            there, edge = step
            if edge == came:
                continue
            if order[there] < 0:
                order[there] = low[there] = visited
                visited += 1
                stack.append((there, edge, iter(adjacent[there])))
            else:
                low[here] = min(low[here], order[there])
    return bridge


def _groups(graph: PoseGraph, used: np.ndarray, count: int) -> Int[np.ndarray, "n"]:
    """The number of every scan's group, the largest first; -1 for scans alone."""
    label = components(count, graph.source[used], graph.reference[used])
    sizes = np.bincount(label)
    order = np.argsort(-sizes, kind="stable")
    number = np.full(len(sizes), -1)
    number[order] = np.arange(len(sizes))
    return np.where(sizes[label] > 1, number[label], -1)


def _regrounded(graph: PoseGraph, posterior, first, count: int) -> RigidTransform:
    """Poses along the best tree of the used pairs; the identity for scans alone."""
    poses = _tree(graph, np.flatnonzero(graph.mask), posterior, first, count)
    alone = np.isnan(poses.translation[:, 0])
    return RigidTransform(
        np.where(alone[:, None, None], np.eye(3), poses.rotation),
        np.where(alone[:, None], 0.0, poses.translation),
    )


def _excess(errors: Float[np.ndarray, "u"], free: int) -> float:
    """How many times larger the errors are than the covariances say; 1 if there is no redundancy."""
    redundancy = len(errors) - free
    return float(errors.sum() / (6 * redundancy)) if redundancy > 0 else 1.0


def _in_units(poses: RigidTransform, sizes: Sizes, unit: float, group, first) -> RigidTransform:
    """Poses of the scans as they were given, in the frame of the first of their group; NaN if alone."""
    shift = unit * poses.translation - se3.applied(poses.rotation, sizes.centre)
    given = RigidTransform(poses.rotation, shift)
    ground = (
        RigidTransform(*(part[first[np.maximum(group, 0)]] for part in given))
        if len(first)
        else given
    )
    rotation, translation = se3.between(ground, given)
    alone = group < 0
    return RigidTransform(
        np.where(alone[:, None, None], np.nan, rotation),
        np.where(alone[:, None], np.nan, translation),
    )


def _about_centres(covariance: np.ndarray, poses: RigidTransform, unit: float) -> np.ndarray:
    """Of a motion of each scan about its centre, in the axes of the group and the unit of the input.

    The frames of the first scans of groups have the axes of the groups.
    """
    turn = np.zeros_like(covariance)
    turn[:, :3, :3] = poses.rotation
    turn[:, 3:, 3:] = unit * poses.rotation
    return turn @ covariance @ turn.mT


def _chances(graph: PoseGraph, used, posterior, group, first) -> Float[np.ndarray, "n"]:
    """The product of probabilities along the surest way to the first scan of the group."""
    count = len(group)
    if not len(first):
        return np.zeros(count)
    cost = 1e-9 - np.log(np.clip(posterior[used], 1e-9, 1))
    best = spanning_tree(count, graph.source[used], graph.reference[used], cost)
    edges = np.flatnonzero(used)[best]
    ways = sparse.coo_matrix(
        (cost[best], (graph.source[edges], graph.reference[edges])), shape=(count, count)
    )
    length = csgraph.dijkstra(ways.tocsr(), directed=False, indices=first, min_only=True)
    return np.where(group < 0, 0.0, np.exp(-length))


def _refusals(relations, used, apart, agrees, refuted, posterior):
    for k, relation in enumerate(relations):
        if used[k]:
            yield ""
        elif not relation.success:
            yield relation.reason
        elif apart[k]:
            yield "Where it lays them, scans on one side fill what those on the other saw to be empty."
        elif not agrees[k]:
            yield "It contradicts pairs that agree among each other."
        elif refuted[k]:
            yield "The scans on its two sides do not fit each other where it lays them."
        else:
            yield (
                "Nothing confirms it, and alone it is not sure enough: "
                f"{posterior[k]:.2f} of {SURE:g}."
            )
