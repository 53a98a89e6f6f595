"""The pure solver against the one on the host, and its implicit derivative against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.geometry import se3
from jaxreg.graph.optimize import optimize_poses
from jaxreg.graph.pose_graph import truncated_weights
from jaxreg.graph.sparse import solve_poses
from tests.graph.graphs import graph_of, perturbed, random_poses, ring
from tests.graph.test_sparse import first_from

NODES = 6


@pytest.fixture(scope="module")
def problem():
    """A ring of six with noisy edges, two of twelve wrong, and poses to start from."""
    rng = np.random.default_rng(5)
    truth = random_poses(rng, NODES)
    graph = graph_of(rng, truth, *ring(NODES), sigma=0.03)
    return graph, first_from(perturbed(rng, truth, 0.1), truth), truth


@pytest.fixture(scope="module")
def solve():
    """Translations, and their derivative in a direction of all measured transforms: one program."""

    def solve(graph, start, direction, robust):
        def poses(scale):
            transform = se3.composed(graph.transform, se3.exp(scale * direction))
            return optimize_poses(graph._replace(transform=transform), start, robust=robust)

        found = poses(jnp.zeros(()))
        slope = jax.jacfwd(lambda scale: poses(scale).poses.translation)(jnp.zeros(()))
        return found, slope

    return jax.jit(solve, static_argnames="robust")


def direction(seed=0):
    return np.random.default_rng(seed).normal(size=(2 * NODES, 6))


@pytest.mark.slow
def test_minimum_and_derivative_are_those_of_the_host(problem, solve):
    graph, start, _ = problem
    step = 1e-4

    def host(scale):
        transform = se3.composed(graph.transform, se3.exp(scale * direction()))
        return solve_poses(graph._replace(transform=transform), start, tolerance=1e-15).poses

    found, slope = solve(graph, start, direction(), False)
    np.testing.assert_allclose(found.poses.translation, host(0.0).translation, atol=1e-8)
    np.testing.assert_allclose(found.poses.rotation, host(0.0).rotation, atol=1e-8)
    assert found.decrement < 1e-10
    expected = (host(step).translation - host(-step).translation) / (2 * step)
    np.testing.assert_allclose(slope, expected, atol=1e-5)
    assert np.abs(expected).max() > 0.1


@pytest.mark.slow
def test_wrong_edges_are_left_out(problem, solve):
    graph, start, truth = problem
    rng = np.random.default_rng(3)
    wrong = graph_of(rng, truth, graph.reference, graph.source, sigma=0.01, wrong=2)
    found, _ = solve(wrong, start, direction(), True)
    np.testing.assert_array_equal(np.round(found.weights[:2], 3), 0)
    assert found.weights[2:].min() > 0.9
    np.testing.assert_allclose(found.poses.translation, truth.translation, atol=0.05)


def test_truncated_weights_go_from_all_to_in_or_out():
    """By the definition: the minimiser of w r^2 + mu (1 - w) / (mu + w) c^2 over w in [0, 1]."""
    squared, threshold = np.array([0.1, 0.9, 1.1, 4.0, 100.0]), 1.0
    grid = np.linspace(0, 1, 200_001)
    for control in (0.01, 0.5, 3.0, 100.0):
        penalty = control * (1 - grid) / (control + grid) * threshold
        cost = grid[:, None] * squared + penalty[:, None]
        expected = grid[np.argmin(cost, axis=0)]
        np.testing.assert_allclose(
            truncated_weights(squared, threshold, control), expected, atol=2e-5
        )


@pytest.mark.slow
def test_reverse_derivatives_are_those_forward(problem):
    """Of a graph whose other arrays are numpy's, as a program has it that learns the transforms."""
    graph, start, _ = problem

    def far(scale):
        transform = se3.composed(graph.transform, se3.exp(scale * direction()))
        found = optimize_poses(graph._replace(transform=transform), start, iterations=8)
        return jnp.sum(found.poses.translation[2:] ** 2)

    forward, backward = (jax.jit(derivative(far))(0.1) for derivative in (jax.jacfwd, jax.grad))
    np.testing.assert_allclose(backward, forward, rtol=1e-9)
    assert abs(backward) > 1e-3


@pytest.mark.parametrize("robust", [False, True])
def test_a_masked_edge_has_no_weight(problem, robust):
    """As on the host; whatever stands in its place."""
    graph, start, _ = problem
    mask = np.arange(2 * NODES) != 3
    shift = np.where(mask[:, None], graph.transform.translation, np.nan)
    masked = graph._replace(transform=graph.transform._replace(translation=shift), mask=mask)
    found = optimize_poses(masked, start, robust=robust, iterations=2, cg_iterations=4)
    np.testing.assert_array_equal(found.weights == 0, ~mask)
    np.testing.assert_array_equal(
        found.weights == 0, solve_poses(masked, start, robust=robust).weights == 0
    )
    assert np.isfinite(found.poses.translation).all()


def outside(index, number):
    wrong = index.copy()
    wrong[2] = number
    return wrong


@pytest.mark.parametrize("function", [optimize_poses, solve_poses])
@pytest.mark.parametrize("name", ["source", "reference"])
@pytest.mark.parametrize("number", [-1, NODES])
def test_an_index_without_a_pose_is_named(problem, function, name, number):
    """JAX would take the last pose instead."""
    graph, start, _ = problem
    wrong = graph._replace(**{name: outside(getattr(graph, name), number)})
    with pytest.raises(
        ValueError, match=f"graph.{name} has the index {number}, .* 6 poses: number"
    ):
        function(wrong, start)


@pytest.mark.untyped
@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda g: g._replace(source=g.source.astype(float)), "graph.source has dtype float64"),
        (lambda g: g._replace(reference=g.reference[:-1]), r"graph.reference is \(11,\), but"),
        (lambda g: g._replace(information=g.information[0]), r"graph.information is \(6, 6\)"),
        (lambda g: g._replace(mask=g.mask[1:]), r"graph.mask is \(11,\)"),
        (lambda g: g._replace(mask=g.mask.astype(int)), "graph.mask must be bool"),
        (
            lambda g: g._replace(transform=jax.tree.map(lambda x: x[:3], g.transform)),
            r"graph.transform is \(3,\)",
        ),
    ],
)
def test_edges_that_do_not_fit_together_are_named_at_trace_time(problem, change, told):
    graph, start, _ = problem
    with pytest.raises(ValueError, match=told):
        jax.eval_shape(optimize_poses, change(graph), start)


@pytest.mark.untyped
def test_poses_that_do_not_fit_are_named_at_trace_time(problem):
    graph, start, _ = problem
    one = jax.tree.map(lambda x: x[0], start)
    with pytest.raises(ValueError, match=r"initial must be poses with one leading axis, got \(\)"):
        jax.eval_shape(optimize_poses, graph, one)
    with pytest.raises(ValueError, match=r"fixed must be bool of shape \(6,\)"):
        jax.eval_shape(lambda x, y: optimize_poses(x, y, fixed=jnp.zeros(5, bool)), graph, start)
    # An index that is only known in the program is no error.
    assert jax.eval_shape(optimize_poses, graph, start).weights.shape == (2 * NODES,)
