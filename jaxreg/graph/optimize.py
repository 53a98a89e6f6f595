"""The poses of a graph as a pure function: for `jit`, `vmap` and derivatives.

Levenberg-Marquardt with conjugate gradients: memory grows with the edges, nothing is factored. On
the host `sparse` solves the same problem by a sparse factorisation, which long chains need.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import export
from jaxtyping import Array, Bool, Float

from jaxreg._xla import on_any_mesh, varying_like
from jaxreg.geometry import se3
from jaxreg.geometry.small_linear import inverse_definite
from jaxreg.graph.pose_graph import (
    CHI_SQUARED,
    PoseGraph,
    check_graph,
    edge_equations,
    retract,
    squared_errors,
    truncated_weights,
)
from jaxreg.types import RigidTransform

_DAMPING = 1e-6
"""The first damping, in units of the diagonal."""
_ROUNDS = 80
"""Iterations in which the control of `truncated_weights` grows, from convex to ..."""
_LAST_CONTROL = 1e4
"""... this, where edges are in or out."""


class OptimizedPoses(NamedTuple):
    """Poses that minimise the cost of a graph.

    `weights` are those of the edges (1 without `robust`, 0 where an edge is masked), `squared_errors`
    their ``e^T Omega e``.
    `decrement` is how much another Gauss-Newton step would lower the cost, relative to it: small if
    the iterations converged.
    """

    poses: RigidTransform
    weights: Float[Array, "e"]
    squared_errors: Float[Array, "e"]
    decrement: Float[Array, ""]


export.register_namedtuple_serialization(OptimizedPoses, serialized_name="jaxreg.OptimizedPoses")


class _Blocks(NamedTuple):
    """Normal equations in blocks: a row a node, and of `coupling` an edge."""

    gradient: Float[Array, "n 6"]
    diagonal: Float[Array, "n 6 6"]
    coupling: Float[Array, "e 6 6"]


class _State(NamedTuple):
    poses: RigidTransform
    squared: Float[Array, "e"]
    weights: Float[Array, "e"]
    damping: Float[Array, ""]


@on_any_mesh
def optimize_poses(
    graph: PoseGraph,
    initial: RigidTransform,
    *,
    fixed: Bool[Array, "n"] | None = None,
    robust: bool = False,
    threshold: Float[Array, ""] | float = CHI_SQUARED,
    iterations: int = 20,
    cg_iterations: int | None = None,
) -> OptimizedPoses:
    """The poses with the smallest ``sum_e w_e e^T Omega_e e``; see `PoseGraph`.

    `initial` are start poses (leading axis n). Poses where `fixed` is True stay; None fixes the first
    one, since otherwise all of them could move together. With `robust`, edges whose error exceeds
    `threshold` are left out by graduated non-convexity (truncated least squares; Yang et al., 2020), in
    80 iterations before the others. `iterations` are steps of Levenberg-Marquardt, each with at most
    `cg_iterations` of preconditioned conjugate gradients (None: 6 n, but 500 at most).

    Derivatives by `graph.transform` and `graph.information` are those of the minimum, by the implicit
    function theorem with the weights held; they need a converged result, so float64. There is none by
    `initial`.

    Raises:
      ValueError: an array has another shape than `PoseGraph` says, or an index, where it is not traced,
        is out of range.
    """
    check_graph(graph, initial, fixed=fixed)
    kinds = [jnp.result_type(x) for x in (*graph.transform, graph.information, *initial)]
    if len(set(kinds)) > 1 or kinds[0] not in (jnp.float32, jnp.float64):
        raise ValueError(
            f"transforms, information and initial poses have the dtypes {', '.join(map(str, kinds))}: "
            "give all of them in float32, or in float64."
        )
    # Where some are numpy's, others must not be traced by numpy.
    graph, initial = jax.tree.map(jnp.asarray, (graph, initial))
    count = initial.translation.shape[0]
    held = jnp.arange(count) == 0 if fixed is None else jnp.asarray(fixed)
    most = min(6 * count, 500) if cg_iterations is None else cg_iterations
    still, start = jax.lax.stop_gradient((graph, initial))
    squared = squared_errors(still, start)
    first = threshold / jnp.maximum(2 * jnp.max(squared) - threshold, 1e-3 * threshold)
    rounds = _ROUNDS if robust else 0
    counted = still.mask.astype(squared.dtype)

    def iterate(k, state: _State) -> _State:
        control = first * (_LAST_CONTROL / first) ** (jnp.minimum(k, rounds) / max(rounds, 1))
        weights = state.weights
        if robust:
            graduated = truncated_weights(state.squared, threshold, control)
            weights = jnp.where(k <= rounds, counted * graduated, state.weights)
        return _step(still, held, state._replace(weights=weights.astype(squared.dtype)), most)

    state = _State(start, squared, counted, jnp.asarray(_DAMPING, squared.dtype))
    state = jax.tree.map(lambda x: varying_like(x, jnp.sum(squared)), state)
    state = jax.lax.fori_loop(0, rounds + iterations, iterate, state)
    step, decrement = _implicit_step(graph, state.poses, held, state.weights, most)
    poses = retract(state.poses, step)
    return OptimizedPoses(poses, state.weights, squared_errors(graph, poses), decrement)


def _step(graph: PoseGraph, held, state: _State, most: int) -> _State:
    """One step; if it does not lower the cost it is taken back, and the next one damped more."""
    blocks = _blocks(graph, state.poses, held, state.weights)
    new = retract(state.poses, _solved(blocks, graph, state.damping, most))
    squared = squared_errors(graph, new)
    better = jnp.sum(state.weights * (squared - state.squared)) <= 0
    poses, squared = jax.tree.map(
        lambda a, b: jnp.where(better, a, b), (new, squared), (state.poses, state.squared)
    )
    damping = jnp.where(
        better, jnp.maximum(state.damping / 10, 1e-9), jnp.minimum(state.damping * 30, 1e3)
    )
    return _State(poses, squared, state.weights, damping)


def _blocks(graph: PoseGraph, poses: RigidTransform, held, weights) -> _Blocks:
    """The normal equations with the poses that are held taken out."""
    found = edge_equations(graph, poses, weights)
    count, dtype = poses.translation.shape[0], found.coupling.dtype
    gradient, diagonal = jnp.zeros((count, 6), dtype), jnp.zeros((count, 6, 6), dtype)
    for side, index in enumerate((graph.source, graph.reference)):
        gradient = gradient.at[index].add(found.gradient[side])
        diagonal = diagonal.at[index].add(found.diagonal[side])
    alone = held | (jnp.trace(diagonal, axis1=1, axis2=2) <= 0)
    diagonal = jnp.where(alone[:, None, None], jnp.eye(6, dtype=dtype)[None], diagonal)
    cut = held[graph.source] | held[graph.reference]
    coupling = jnp.where(cut[:, None, None], 0, found.coupling)
    return _Blocks(jnp.where(held[:, None], 0, gradient), diagonal, coupling)


def _solved(blocks: _Blocks, graph: PoseGraph, damping, most: int) -> Float[Array, "n 6"]:
    """``(H + damping diag(H))^-1 (-g)`` by conjugate gradients, each node's own block as a guide."""
    eye = jnp.eye(6, dtype=blocks.diagonal.dtype)[None]
    diagonal = blocks.diagonal * (1 + damping * eye)
    inverses = jax.vmap(inverse_definite)(diagonal)

    def times(x):
        y = se3.applied(diagonal, x)
        y = y.at[graph.reference].add(se3.applied(blocks.coupling, x[graph.source]))
        return y.at[graph.source].add(se3.applied(blocks.coupling.mT, x[graph.reference]))

    return jax.scipy.sparse.linalg.cg(
        times, -blocks.gradient, M=lambda x: se3.applied(inverses, x), tol=1e-9, maxiter=most
    )[0]


def _implicit_step(graph, poses, held, weights, most: int):
    """Zero, with the derivative of the minimum, ``-H^-1 dg`` with the exact Hessian; the decrement."""
    still = jax.lax.stop_gradient(graph)
    blocks = _blocks(still, poses, held, weights)
    inverses = jax.vmap(inverse_definite)(blocks.diagonal)
    held = held[:, None]

    def slope(step):
        def cost(step):
            moved = retract(poses, jnp.where(held, 0, step))
            return jnp.sum(weights * squared_errors(graph, moved)) / 2

        # What is held moves nothing, or the derivative would not be symmetric.
        return jnp.where(held, step, jax.grad(cost)(step))

    def conjugate_gradients(linear, y):
        return jax.scipy.sparse.linalg.cg(
            linear, y, M=lambda x: se3.applied(inverses, x), tol=1e-12, maxiter=most
        )[0]

    def tangent_solve(linear, y):
        # Around `cg`, which itself puts its start and `y` in one operation, and is not transposed.
        return jax.lax.custom_linear_solve(linear, y, conjugate_gradients, symmetric=True)

    zero = jnp.zeros_like(blocks.gradient)
    step = jax.lax.custom_root(slope, zero, lambda _, start: start, tangent_solve)
    gain = jnp.sum(blocks.gradient * se3.applied(inverses, blocks.gradient))
    cost = jnp.sum(weights * squared_errors(still, poses))
    return step, gain / jnp.where(cost > 0, cost, 1)
