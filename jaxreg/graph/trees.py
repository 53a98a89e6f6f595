"""What a pose graph starts from: its parts, its most probable spanning tree, its short cycles."""

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse import csgraph

from jaxreg.geometry import se3
from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.types import RigidTransform


def components(
    count: int, source: Int[np.ndarray, "e"], reference: Int[np.ndarray, "e"]
) -> Int[np.ndarray, "n"]:
    """For each of `count` nodes the number of its connected part, in the order of first nodes."""
    edges = sparse.coo_matrix((np.ones(len(source)), (source, reference)), shape=(count, count))
    return csgraph.connected_components(edges, directed=False)[1]


def spanning_tree(
    count: int,
    source: Int[np.ndarray, "e"],
    reference: Int[np.ndarray, "e"],
    cost: Float[np.ndarray, "e"],
) -> Int[np.ndarray, "t"]:
    """The edges of a spanning forest with the smallest sum of costs (positive)."""
    if len(source) == 0:
        return np.empty(0, np.int64)
    low, high = np.minimum(source, reference), np.maximum(source, reference)
    # Of parallel edges the cheapest; csgraph would add them up.
    order = np.lexsort([cost, high, low])
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(low[order]) != 0) | (np.diff(high[order]) != 0)
    edges = order[first]
    shape = (count, count)
    number = sparse.csr_matrix((edges + 1, (low[edges], high[edges])), shape=shape)
    weights = sparse.csr_matrix(
        (np.maximum(cost[edges], 1e-12), (low[edges], high[edges])), shape=shape
    )
    tree = csgraph.minimum_spanning_tree(weights).tocoo()
    return np.asarray(number[tree.row, tree.col]).ravel().astype(np.int64) - 1


def tree_poses(
    count: int, graph: PoseGraph, tree: Int[np.ndarray, "t"], roots: Int[np.ndarray, "r"]
) -> RigidTransform:
    """Every node's pose along the edges of a forest, from `roots`, whose poses are the identity.

    Nodes that no root reaches have NaN.
    """
    rotation, translation = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
    rotation[roots], translation[roots] = np.eye(3), 0
    neighbors: dict[int, list[tuple[int, int, bool]]] = {}
    for edge in tree.tolist():
        s, r = int(graph.source[edge]), int(graph.reference[edge])
        neighbors.setdefault(r, []).append((s, edge, True))
        neighbors.setdefault(s, []).append((r, edge, False))
    waiting = [int(root) for root in roots]
    while waiting:
        here = waiting.pop()
        for there, edge, forward in neighbors.get(here, ()):
            if np.isnan(translation[there, 0]):
                turn, shift = graph.transform.rotation[edge], graph.transform.translation[edge]
                if not forward:
                    turn, shift = turn.T, -turn.T @ shift
                rotation[there] = rotation[here] @ turn
                translation[there] = rotation[here] @ shift + translation[here]
                waiting.append(there)
    return RigidTransform(rotation, translation)


def triangles(
    source: Int[np.ndarray, "e"], reference: Int[np.ndarray, "e"], count: int
) -> Int[np.ndarray, "t 3"]:
    """All triples of edges that close a triangle; parallel edges each make their own."""
    ends = np.stack([np.minimum(source, reference), np.maximum(source, reference)], axis=1)
    at: dict[tuple[int, int], list[int]] = {}
    for edge, (i, j) in enumerate(ends.tolist()):
        at.setdefault((i, j), []).append(edge)
    above: dict[int, list[int]] = {}
    for i, j in at:
        above.setdefault(i, []).append(j)
    found = [
        (one, other, third)
        for (i, j), first in at.items()
        for k in above.get(j, ())
        if (i, k) in at
        for one in first
        for other in at[j, k]
        for third in at[i, k]
    ]
    return np.array(found, np.int64).reshape(-1, 3)


def triangle_errors(graph: PoseGraph, found: Int[np.ndarray, "t 3"]) -> Float[np.ndarray, "t"]:
    """For every triangle ``e^T S^-1 e`` of the way around it, S the sum of the covariances.

    With nodes i < j < k, ``A`` from j to i, ``B`` from k to j and ``C`` from k to i, ``e`` is the
    logarithm of ``C^-1 A B``. Of right edges chi squared with 6 degrees.
    """
    if len(found) == 0:
        return np.empty(0)
    low = np.minimum(graph.source, graph.reference)
    covariance = np.linalg.inv(graph.information)
    (a, spread_a), (b, spread_b), (c, spread_c) = (
        _downwards(graph, low, covariance, found[:, k]) for k in range(3)
    )
    error = se3.log(se3.between(c, se3.composed(a, b)))
    carried = se3.adjoint(se3.inverted(b))
    total = spread_c + spread_b + carried @ spread_a @ carried.mT
    return np.sum(error * np.linalg.solve(total, error[..., None])[..., 0], axis=1)


def _downwards(graph: PoseGraph, low: np.ndarray, covariance: np.ndarray, edges: np.ndarray):
    """Transform and covariance of edges, from the node of higher number to the lower."""
    given = RigidTransform(*(part[edges] for part in graph.transform))
    up = (graph.source[edges] == low[edges])[:, None]
    back, carried = se3.inverted(given), se3.adjoint(given)
    turned = carried @ covariance[edges] @ carried.mT
    transform = RigidTransform(
        np.where(up[..., None], back.rotation, given.rotation),
        np.where(up, back.translation, given.translation),
    )
    return transform, np.where(up[..., None], turned, covariance[edges])
