"""The poses of a graph on the host, in float64, by a sparse factorisation: thousands of poses.

The cost and its normal equations are those of `pose_graph`, in numpy: nothing is compiled. The system
is solved by SuperLU (scipy), whose order of elimination is found once, of nodes instead of unknowns.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from jaxreg.graph.pose_graph import (
    CHI_SQUARED,
    EdgeEquations,
    PoseGraph,
    check_graph,
    edge_equations,
    retract,
    squared_errors,
    truncated_weights,
)
from jaxreg.graph.trees import components
from jaxreg.types import RigidTransform

_STEP = 1.4
"""How much the control of `truncated_weights` grows in a round (Yang et al., 2020)."""
_MOST_ROUNDS = 100
_COLUMNS = 384
"""Columns of the inverse that are solved for at once."""


class SolvedPoses(NamedTuple):
    """Poses (numpy, float64) with the smallest cost, and how they were found.

    `weights` are those of the edges, `squared_errors` their ``e^T Omega e``, `cost` the sum of the
    products; `converged` says whether the last step was small, after `iterations`.
    """

    poses: RigidTransform
    weights: Float[np.ndarray, "e"]
    squared_errors: Float[np.ndarray, "e"]
    cost: float
    iterations: int
    converged: bool


def solve_poses(
    graph: PoseGraph,
    initial: RigidTransform,
    *,
    fixed: Bool[np.ndarray, "n"] | None = None,
    robust: bool = False,
    trusted: Bool[np.ndarray, "e"] | None = None,
    threshold: float = CHI_SQUARED,
    iterations: int = 100,
    tolerance: float = 1e-10,
) -> SolvedPoses:
    """What `optimize_poses` finds, on the host and by factors; numpy in and out.

    It ends when a step lowers the cost by less than `tolerance` of it. Edges that are `trusted` are
    never left out. A node without edges keeps its pose.

    Raises:
      ValueError: an array has another shape than `PoseGraph` says, an index is out of range, or a pose
        or an edge is not finite.
    """
    check_graph(graph, initial, fixed=fixed, trusted=trusted)
    problem = _Problem.of(graph, initial, fixed)
    poses, weights = problem.start, problem.graph.mask.astype(np.float64)
    if robust:
        poses, weights = _graduated(problem, trusted, threshold)
    poses, taken, converged = _levenberg(problem, poses, weights, iterations, tolerance)
    squared = squared_errors(problem.graph, poses)
    return SolvedPoses(
        poses, weights, squared, float(np.sum(weights * squared)), taken, converged
    )  # fmt: skip


class _Problem(NamedTuple):
    """A graph in float64, the poses to start from, and where the blocks of its equations go."""

    graph: PoseGraph
    start: RigidTransform
    structure: "_Structure"

    @classmethod
    def of(cls, graph: PoseGraph, initial: RigidTransform, fixed) -> "_Problem":
        _check(graph, initial)
        start = RigidTransform(*(np.asarray(part, np.float64) for part in initial))
        graph = PoseGraph(
            np.asarray(graph.source),
            np.asarray(graph.reference),
            RigidTransform(*(np.asarray(part, np.float64) for part in graph.transform)),
            np.asarray(graph.information, np.float64),
            np.asarray(graph.mask, bool),
        )
        count = len(start.translation)
        held = np.arange(count) == 0 if fixed is None else np.asarray(fixed, bool)
        lonely = np.ones(count, bool)
        lonely[graph.source[graph.mask]] = lonely[graph.reference[graph.mask]] = False
        return cls(graph, start, _structure(graph, held | lonely))


def _check(graph: PoseGraph, initial: RigidTransform) -> None:
    kept = np.asarray(graph.mask, bool)
    if not all(np.isfinite(part).all() for part in initial):
        raise ValueError("an initial pose is not finite: give one for every scan.")
    for name, part in (("transform", graph.transform), ("information", (graph.information,))):
        if not all(np.isfinite(values[kept]).all() for values in part):
            raise ValueError(f"graph.{name} is not finite: leave such edges out, or mask them.")


class _Structure(NamedTuple):
    """The sparsity pattern. `free` are the nodes that are not held, in the order of elimination.

    Of the blocks (both diagonals, coupling, its transpose) those in `order` are added up in runs that
    begin at `starts`, to the blocks of a matrix in block rows (`indices`, `indptr`).
    """

    free: Int[np.ndarray, "f"]
    order: Int[np.ndarray, "b"]
    starts: Int[np.ndarray, "u"]
    indices: Int[np.ndarray, "u"]
    indptr: Int[np.ndarray, "r"]


def _structure(graph: PoseGraph, held: Bool[np.ndarray, "n"]) -> _Structure:
    free = np.flatnonzero(~held)
    free = free[_elimination_order(graph, held, free)]
    count = max(len(free), 1)
    number = np.full(len(held), -1)
    number[free] = np.arange(len(free))
    source, reference = number[graph.source], number[graph.reference]
    rows = np.concatenate([source, reference, reference, source])
    columns = np.concatenate([source, reference, source, reference])
    kept = np.flatnonzero((rows >= 0) & (columns >= 0) & np.tile(graph.mask, 4))
    key = rows[kept] * count + columns[kept]
    order = np.argsort(key, kind="stable")
    unique, starts = np.unique(key[order], return_index=True)
    indptr = np.searchsorted(unique, np.arange(len(free) + 1) * count)
    return _Structure(free, kept[order], starts, unique % count, indptr)


def _elimination_order(graph: PoseGraph, held, free) -> Int[np.ndarray, "f"]:
    """Nodes so that eliminating them fills in little: minimum degree of the graph itself."""
    if len(free) < 3:
        return np.arange(len(free))
    number = np.full(len(held), -1)
    number[free] = np.arange(len(free))
    ends = number[graph.source[graph.mask]], number[graph.reference[graph.mask]]
    inside = (ends[0] >= 0) & (ends[1] >= 0)
    rows, columns = ends[0][inside], ends[1][inside]
    shape = (len(free), len(free))
    half = sparse.coo_matrix((np.full(len(rows), -1e-3), (rows, columns)), shape=shape)
    degree = np.bincount(np.append(rows, columns), minlength=len(free))
    laplacian = half + half.T + sparse.diags(1.0 + degree)
    factors = splu(
        laplacian.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )  # fmt: skip
    return np.argsort(factors.perm_c)


def _graduated(problem: _Problem, trusted, threshold: float):
    """Poses and weights after the control has grown until every edge is in or out."""
    poses, mask = problem.start, problem.graph.mask
    doubtful = mask if trusted is None else mask & ~np.asarray(trusted, bool)
    squared = squared_errors(problem.graph, poses)
    largest = float(squared[doubtful].max(initial=0))
    weights = mask.astype(np.float64)
    if largest <= threshold:
        return poses, weights
    control = threshold / (2 * largest - threshold)
    for _ in range(_MOST_ROUNDS):
        weights = np.where(doubtful, truncated_weights(squared, threshold, control), 1.0 * mask)
        poses, _, _ = _levenberg(problem, poses, weights, 1, 0.0)
        squared = squared_errors(problem.graph, poses)
        if control > 1 and np.abs(weights - np.round(weights)).max() < 1e-3:
            break
        control *= _STEP
    return poses, np.where(doubtful, squared <= threshold, mask).astype(np.float64)


def _levenberg(problem: _Problem, poses, weights, iterations: int, tolerance: float):
    """Poses, number of steps, and whether the last one was small."""
    graph = problem.graph
    cost, damping = float(np.sum(weights * squared_errors(graph, poses))), 1e-9
    for taken in range(1, iterations + 1):
        matrix, gradient = _assembled(problem, edge_equations(graph, poses, weights))
        while True:
            new = retract(poses, _step(problem.structure, matrix, gradient, damping))
            new_cost = float(np.sum(weights * squared_errors(graph, new)))
            if new_cost <= cost * (1 + 1e-12):
                break
            damping = max(damping, 1e-9) * 100
            if damping > 1e6:  # Not even a tiny step down the slope: this is the minimum.
                return poses, taken, True
        small = cost - new_cost <= tolerance * max(cost, 1e-300)
        poses, cost, damping = new, new_cost, max(damping / 10, 1e-12)
        if small:
            return poses, taken, True
    return poses, iterations, False


def gauss_newton_steps(
    graph: PoseGraph, fixed: Bool[np.ndarray, "n"], equations: EdgeEquations, damping: float = 1e-9
) -> Float[np.ndarray, "n 6"]:
    """The step of every pose for equations of any cost that is a sum over the edges of a graph.

    Only `source`, `reference` and `mask` of the graph are read. `damping` is in units of the diagonal.
    """
    lonely = np.ones(len(fixed), bool)
    lonely[graph.source[graph.mask]] = lonely[graph.reference[graph.mask]] = False
    structure = _structure(graph, fixed | lonely)
    matrix, gradient = _sums(graph, structure, equations, len(fixed))
    return _step(structure, matrix, gradient, damping)


def _assembled(problem: _Problem, equations: EdgeEquations):
    return _sums(problem.graph, problem.structure, equations, len(problem.start.translation))


def _sums(graph: PoseGraph, where: _Structure, equations: EdgeEquations, count: int):
    """``H`` in the order of elimination, and ``g`` by node."""
    gradient = np.zeros((count, 6))
    for index, slope in zip((graph.source, graph.reference), equations.gradient, strict=True):
        np.add.at(gradient, index, slope)
    coupling = equations.coupling
    blocks = np.concatenate([*equations.diagonal, coupling, coupling.swapaxes(1, 2)])
    summed = np.add.reduceat(blocks[where.order], where.starts, axis=0)
    size = 6 * len(where.free)
    matrix = sparse.bsr_matrix((summed, where.indices, where.indptr), shape=(size, size))
    return matrix.tocsc(), gradient


def _step(where: _Structure, matrix, gradient: np.ndarray, damping: float) -> np.ndarray:
    step, free = np.zeros_like(gradient), where.free
    if len(free):
        found = _factors(matrix, damping).solve(-gradient[free].ravel())
        step[free] = found.reshape(-1, 6)
    return step


def _factors(matrix: sparse.csc_matrix | sparse.csc_array, damping: float) -> SuperLU:
    diagonal = matrix.diagonal()
    # A motion that nothing determines must not make it singular.
    floor = 1e-13 * diagonal.max(initial=0)
    damped = (matrix + sparse.diags(damping * diagonal + floor)).tocsc()
    return splu(
        damped, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


def pose_covariances(
    graph: PoseGraph,
    poses: RigidTransform,
    *,
    weights: Float[np.ndarray, "e"] | None = None,
    fixed: Bool[np.ndarray, "n"] | None = None,
) -> Float[np.ndarray, "n 6 6"]:
    """The covariance of every pose, of a motion ``X_k exp(xi)`` of its own frame (rotation first).

    Marginals: diagonal blocks of the inverse of the Gauss-Newton matrix, at the minimum. Zero for poses
    that are `fixed` (None: the first), NaN where no edge of positive weight leads to a fixed one.
    """
    count = len(poses.translation)
    held = np.arange(count) == 0 if fixed is None else np.asarray(fixed, bool)
    kept = np.asarray(graph.mask, bool) & (
        np.ones(len(graph.mask), bool) if weights is None else weights > 0
    )
    label = components(count, graph.source[kept], graph.reference[kept])
    tied = np.isin(label, label[held])
    problem = _Problem.of(graph._replace(mask=kept), poses, held | ~tied)
    scale = kept.astype(np.float64) if weights is None else np.where(kept, weights, 0.0)
    matrix, _ = _assembled(problem, edge_equations(problem.graph, problem.start, scale))
    free = problem.structure.free
    covariance = np.full((count, 6, 6), np.nan)
    covariance[held] = 0
    if len(free):
        covariance[free] = _inverse_diagonal(_factors(matrix, 0.0), len(free))
    return covariance


def _inverse_diagonal(factors: SuperLU, count: int) -> Float[np.ndarray, "f 6 6"]:
    """The diagonal blocks of the inverse, from some hundred of its columns at a time."""
    blocks = np.empty((count, 6, 6))
    for first in range(0, count, _COLUMNS // 6):
        nodes = np.arange(first, min(first + _COLUMNS // 6, count))
        right = np.zeros((6 * count, 6 * len(nodes)))
        rows = (6 * nodes[:, None] + np.arange(6)).ravel()
        right[rows, np.arange(len(rows))] = 1
        found = factors.solve(right)[rows].reshape(len(nodes), 6, len(nodes), 6)
        blocks[nodes] = found[np.arange(len(nodes)), :, np.arange(len(nodes))]
    return (blocks + blocks.swapaxes(1, 2)) / 2
