"""The poses of a graph as a pure function: for `jit`, `vmap` and derivatives.

Levenberg-Marquardt with conjugate gradients: memory grows with the edges, nothing is factored. On
the host `sparse` solves the same problem by a sparse factorisation, which long chains need.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float

from jaxreg.geometry.small_linear import inverse_definite
from jaxreg.graph.pose_graph import (
    NormalEquations,
    PoseGraph,
    linearize,
    retract,
    squared_errors,
    truncated_weights,
)
from jaxreg.types import RigidTransform

CHI_SQUARED = 16.8
"""Of the residuals of right edges, which have 6 degrees of freedom, 1 % are larger."""
_DAMPING = 1e-6
"""The first damping, in units of the diagonal."""
_ROUNDS = 40
"""Steps of the control of `truncated_weights`, each 1.4 times the last one."""


class OptimizedPoses(NamedTuple):
    """Poses that minimise the cost of a graph, and how.

    `weights` are those of the edges (1 without `robust`), `squared_errors` their ``e^T Omega e``;
    `gradient` is the largest entry of the gradient at the end, relative to that of the diagonal.
    """

    poses: RigidTransform
    weights: Float[Array, "e"]
    squared_errors: Float[Array, "e"]
    gradient: Float[Array, ""]


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
    one, since otherwise all of them could move together. With `robust` edges whose error exceeds
    `threshold` are left out, by graduated non-convexity (truncated least squares; Yang et al., 2020).
    `iterations` are steps of Levenberg-Marquardt (a robust start takes two a round besides), each with
    at most `cg_iterations` of preconditioned conjugate gradients (None: 6 n, but 500 at most).

    Derivatives by `graph.transform` and `graph.information` are those of the minimum, by the implicit
    function theorem with the weights held; they need a converged result, so float64. A derivative by a
    transform is one by its matrix entries; there is none by `initial`.
    """
    held = _held(fixed, initial)
    most = min(6 * initial.translation.shape[0], 500) if cg_iterations is None else cg_iterations
    still = jax.lax.stop_gradient(graph)
    poses = jax.lax.stop_gradient(initial)
    weights = jnp.ones_like(still.information[:, 0, 0])
    if robust:
        poses, weights = _graduated(still, poses, held, threshold, most)
    poses = _levenberg(still, poses, held, weights, iterations, most)
    step = _implicit_step(graph, poses, held, weights, most)
    poses = retract(poses, step)
    squared = squared_errors(graph, poses)
    return OptimizedPoses(poses, weights, squared, _relative_gradient(graph, poses, held, weights))


def _held(fixed: Bool[Array, "n"] | None, poses: RigidTransform) -> Bool[Array, "n"]:
    count = poses.translation.shape[0]
    return jnp.arange(count) == 0 if fixed is None else jnp.asarray(fixed)


def _graduated(graph, poses, held, threshold, most):
    """Poses and weights after the control has grown from convex to truncated."""
    largest = jnp.max(squared_errors(graph, poses))
    first = threshold / jnp.maximum(2 * largest - threshold, 1e-3 * threshold)

    def round_(k, state):
        poses, _ = state
        control = first * (1e6 / first) ** (k / (_ROUNDS - 1))
        weights = truncated_weights(squared_errors(graph, poses), threshold, control)
        return _levenberg(graph, poses, held, weights, 2, most), weights

    weights = jnp.ones_like(graph.information[:, 0, 0])
    return jax.lax.fori_loop(0, _ROUNDS, round_, (poses, weights))


def _levenberg(graph, poses, held, weights, iterations: int, most: int) -> RigidTransform:
    """Steps that lower the cost; a step that does not is taken back, and the next one damped more."""

    def cost_of(poses):
        return jnp.sum(weights * squared_errors(graph, poses))

    def iterate(_, state):
        poses, cost, damping = state
        equations = _grounded(linearize(graph, poses, weights), held, graph)
        new = retract(poses, _solved(equations, graph, held, damping, most))
        new_cost = cost_of(new)
        better = new_cost <= cost
        poses = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, poses)
        damping = jnp.where(better, damping / 10, jnp.maximum(damping, 1e-9) * 30)
        return poses, jnp.where(better, new_cost, cost), damping

    start = poses, cost_of(poses), jnp.asarray(_DAMPING, poses.translation.dtype)
    return jax.lax.fori_loop(0, iterations, iterate, start)[0]


def _grounded(equations: NormalEquations, held, graph: PoseGraph) -> NormalEquations:
    """The equations with the poses that are held taken out."""
    gradient = jnp.where(held[:, None], 0, equations.gradient)
    eye = jnp.eye(6, dtype=gradient.dtype)
    alone = held | (jnp.trace(equations.diagonal, axis1=1, axis2=2) <= 0)
    diagonal = jnp.where(alone[:, None, None], eye, equations.diagonal)
    cut = held[graph.source] | held[graph.reference]
    return NormalEquations(gradient, diagonal, jnp.where(cut[:, None, None], 0, equations.coupling))


def _solved(equations: NormalEquations, graph: PoseGraph, held, damping, most: int):
    """``(H + damping diag(H))^-1 (-g)`` by conjugate gradients, each node's own block as a guide."""
    scaled = jnp.einsum("nii->ni", equations.diagonal) * damping
    blocks = equations.diagonal + jax.vmap(jnp.diag)(scaled)
    inverses = jax.vmap(inverse_definite)(blocks)

    def times(x):
        y = _each(blocks, x)
        y = y.at[graph.reference].add(_each(equations.coupling, x[graph.source]))
        return y.at[graph.source].add(_each(equations.coupling.mT, x[graph.reference]))

    found, _ = jax.scipy.sparse.linalg.cg(
        times, -equations.gradient, M=lambda x: _each(inverses, x), tol=1e-9, maxiter=most
    )
    return found


def _each(blocks: Float[Array, "k 6 6"], vectors: Float[Array, "k 6"]) -> Float[Array, "k 6"]:
    return jnp.einsum("kij,kj->ki", blocks, vectors, precision=Precision.HIGHEST)


def _implicit_step(graph, poses, held, weights, most: int) -> Float[Array, "n 6"]:
    """Zero, with the derivative of the minimum by the graph: ``-H^-1 dg``, H the exact Hessian."""
    zero = jnp.zeros((poses.translation.shape[0], 6), poses.translation.dtype)
    still = jax.lax.stop_gradient(graph)
    equations = _grounded(linearize(still, poses, weights), held, still)
    inverses = jax.vmap(inverse_definite)(equations.diagonal)

    def slope(step):
        cost = lambda step: jnp.sum(weights * squared_errors(graph, retract(poses, step))) / 2  # noqa: E731
        # What is held moves nothing, or the derivative would not be symmetric.
        return jnp.where(held[:, None], step, jax.grad(cost)(jnp.where(held[:, None], 0, step)))

    def tangent_solve(linear, y):
        return jax.scipy.sparse.linalg.cg(
            linear, y, M=lambda x: _each(inverses, x), tol=1e-12, maxiter=most
        )[0]

    return jax.lax.custom_root(slope, zero, lambda _, start: start, tangent_solve)


def _relative_gradient(graph, poses, held, weights) -> Float[Array, ""]:
    equations = jax.lax.stop_gradient(_grounded(linearize(graph, poses, weights), held, graph))
    scale = jnp.sqrt(jnp.max(jnp.einsum("nii->ni", equations.diagonal), axis=1))
    return jnp.max(jnp.abs(equations.gradient) / scale[:, None])
