"""The four losses against loops written from Eq. 14-18; padding and the truth have no part in them."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.config import LossConfig, ModelConfig
from jaxreg.network import losses
from jaxreg.network.losses import LossTerms
from jaxreg.network.matching import Matches
from jaxreg.network.model import Step, neighborhood_graph
from jaxreg.types import PointCloud, RigidTransform
from tests import oracles
from tests.compiled import knn

N, M, K, N_C, BETA = 14, 17, 3, 6, 0.01
MODEL = ModelConfig(k=K, k_matching=K, angles="all", n_inliers=N_C)


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


@functools.cache
def compiled(name, **options):
    return jax.jit(functools.partial(getattr(losses, name), **options))


def draw_step(rng, n=N):
    """A step with a noisy copy of the source, and the source's k-NN graph."""
    source = rng.normal(size=(n, 3))
    transform = RigidTransform(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    moved = source @ transform.rotation.T + transform.translation
    copy = moved + 0.3 * rng.normal(size=(n, 3))
    neighbors = np.asarray(knn(source, K))
    inliers = rng.permutation(n)[:N_C].astype(np.int32)
    peaks = rng.uniform(0.1, 2, (2, n))
    step = Step(source, moved, transform, Matches(copy, *peaks), rng.uniform(size=n), inliers)
    return step, neighbors


@pytest.mark.parametrize("spread", [0.01, 0.1, 1.0])
def test_global_consistency_point_by_point(rng, spread):
    reference = rng.uniform(-1, 1, (M, 3))
    moved = reference[:N] + spread * rng.normal(size=(N, 3))
    result = compiled("global_consistency", beta=BETA)(
        PointCloud(moved, np.ones(N, bool)), PointCloud(reference, np.ones(M, bool))
    )
    expected = oracles.global_consistency(moved, reference, BETA)
    np.testing.assert_allclose(result, expected, rtol=1e-12)


def test_huber_of_the_squared_distance_bends_at_beta():
    x = np.array([0.0, 0.005, 0.01, 0.02, 3.0])
    expected = [oracles.huber(v, BETA) for v in x]
    np.testing.assert_allclose(compiled("huber", beta=BETA)(x), expected, rtol=1e-14)


@pytest.mark.parametrize("squared", [False, True])
def test_neighborhood_consistency_neighbour_by_neighbour(rng, squared):
    step, neighbors = draw_step(rng)
    valid = np.ones(N_C, bool)
    result = compiled("neighborhood_consistency", squared=squared)(
        step.source, step.matches.copy, step.transform, neighbors, step.inliers, valid
    )
    expected = oracles.neighborhood_consistency(
        step.source, step.matches.copy, *step.transform, neighbors, step.inliers, squared
    )
    np.testing.assert_allclose(result, expected, rtol=1e-12)


@pytest.mark.parametrize("edge", ["vector", "length", "coordinates"])
@pytest.mark.parametrize("angles", ["all", "next", "none"])
def test_geometric_consistency_neighbour_by_neighbour(rng, edge, angles):
    step, neighbors = draw_step(rng)
    config = dataclasses.replace(MODEL, edge=edge, angles=angles)
    result = compiled("geometric_consistency", config=config)(
        step.source, step.matches.copy, neighbors, step.inliers, np.ones(N_C, bool)
    )
    expected = oracles.geometric_consistency(
        step.source, step.matches.copy, neighbors, step.inliers, edge, angles
    )
    np.testing.assert_allclose(result, expected, rtol=1e-12)


def test_spatial_consistency_of_a_map(rng):
    scores, inliers = rng.uniform(0.1, 1, (N, M)), rng.permutation(N)[:N_C].astype(np.int32)
    result = compiled("spatial_consistency")(scores.max(axis=1), inliers, np.ones(N_C, bool))
    np.testing.assert_allclose(result, oracles.spatial_consistency(scores, inliers), rtol=1e-13)


@pytest.mark.parametrize(("l_in", "l_sc"), [("unsquared", "G"), ("squared", "F")])
def test_terms_of_a_step_read_what_the_configuration_says(rng, l_in, l_sc):
    step, neighbors = draw_step(rng)
    reference = rng.uniform(-1, 1, (M, 3))
    terms = step_losses(LossConfig(l_in=l_in, l_sc=l_sc), MODEL)(
        step, np.ones(N, bool), PointCloud(reference, np.ones(M, bool))
    )
    copy = step.matches.copy
    peak = step.matches.dual_peak if l_sc == "G" else step.matches.final_peak
    expected = (
        oracles.global_consistency(step.moved, reference, BETA),
        oracles.neighborhood_consistency(
            step.source, copy, *step.transform, neighbors, step.inliers, l_in == "squared"
        ),
        oracles.geometric_consistency(step.source, copy, neighbors, step.inliers, "vector", "all"),
        oracles.spatial_consistency(peak[:, None], step.inliers),
    )
    np.testing.assert_allclose(terms, expected, rtol=1e-12)


@functools.cache
def step_losses(config, model):
    def run(step, source_mask, reference):
        graph = neighborhood_graph(PointCloud(step.source, source_mask), model)
        return losses.step_losses(step, graph, source_mask, reference, config=config, model=model)

    return jax.jit(run)


def test_total_is_the_weighted_sum_over_the_steps(rng):
    terms = LossTerms(*rng.uniform(size=(4, 3)))
    config = LossConfig(global_consistency=0.5, gamma=2.0, rho=3.0, lambda_=7.0)
    weights = (0.5, 2.0, 3.0, 7.0)
    expected = sum(w * np.sum(x) for w, x in zip(weights, terms, strict=True))
    np.testing.assert_allclose(compiled("total_loss", config=config)(terms), expected, rtol=1e-14)


@pytest.mark.parametrize("name", ["global_consistency", "gamma", "rho", "lambda_"])
def test_a_term_of_weight_zero_is_zero(rng, name):
    step, _ = draw_step(rng)
    config = LossConfig(**{name: 0.0})
    reference = PointCloud(rng.uniform(-1, 1, (M, 3)), np.ones(M, bool))
    terms = step_losses(config, MODEL)(step, np.ones(N, bool), reference)
    off = ("global_consistency", "gamma", "rho", "lambda_").index(name)
    assert [float(x) == 0 for x in terms] == [i == off for i in range(4)]


def test_perfect_alignment_costs_nothing_but_sharpness(rng):
    step, _ = draw_step(rng)
    # L_gs compares vectors, which turn: only without a motion are all terms zero.
    still = step._replace(
        transform=RigidTransform(np.eye(3), np.zeros(3)),
        moved=step.source,
        matches=Matches(step.source, np.ones(N), np.ones(N)),
    )
    terms = step_losses(LossConfig(), MODEL)(
        still, np.ones(N, bool), PointCloud(step.source, np.ones(N, bool))
    )
    np.testing.assert_allclose(terms, 0, atol=1e-12)


@pytest.mark.parametrize("fill", [3.0, 1e6, np.nan])
def test_padding_changes_neither_value_nor_derivative(rng, fill):
    step, _ = draw_step(rng)
    reference = rng.uniform(-1, 1, (M, 3))

    @jax.jit
    def value_and_gradient(copy, reference, moved, step, source_mask, reference_mask):
        def value(copy, reference, moved):
            graph = neighborhood_graph(PointCloud(step.source, source_mask), MODEL)
            full = step._replace(moved=moved, matches=step.matches._replace(copy=copy))
            terms = losses.step_losses(
                full,
                graph,
                source_mask,
                PointCloud(reference, reference_mask),
                config=LossConfig(),
                model=MODEL,
            )
            return losses.total_loss(terms, LossConfig())

        return jax.value_and_grad(value, (0, 1, 2))(copy, reference, moved)

    def rows(x, extra, value):
        return np.concatenate([x, np.full((extra, *x.shape[1:]), value, x.dtype)])

    copy, moved = step.matches.copy, step.moved
    expected = value_and_gradient(copy, reference, moved, step, np.ones(N, bool), np.ones(M, bool))
    # More inliers than valid points: the rest of the list names padding, which must not count.
    padded = step._replace(
        source=rows(step.source, 5, 0.0),
        confidence=rows(step.confidence, 5, 0.0),
        matches=Matches(None, *(rows(x, 5, 0.5) for x in step.matches[1:3])),
        inliers=np.concatenate([step.inliers, [N, N + 1]]).astype(np.int32),
    )
    value, gradient = value_and_gradient(
        rows(copy, 5, 1.0),
        rows(reference, 4, fill),
        rows(moved, 5, fill),
        padded,
        np.arange(N + 5) < N,
        np.arange(M + 4) < M,
    )
    np.testing.assert_allclose(value, expected[0], rtol=1e-12)
    for got, wanted in zip(gradient, expected[1], strict=True):
        np.testing.assert_allclose(got[: len(wanted)], wanted, rtol=1e-10, atol=1e-12)
        np.testing.assert_array_equal(got[len(wanted) :], 0)


def test_no_valid_point_costs_nothing(rng):
    step, _ = draw_step(rng)
    reference = PointCloud(rng.uniform(-1, 1, (M, 3)), np.zeros(M, bool))
    terms = step_losses(LossConfig(), MODEL)(step, np.zeros(N, bool), reference)
    np.testing.assert_array_equal(terms, 0)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_dtypes_are_kept(rng, dtype):
    step, _ = draw_step(rng)
    step = jax.tree.map(lambda x: x.astype(dtype) if x.dtype.kind == "f" else x, step)
    reference = PointCloud(rng.uniform(-1, 1, (M, 3)).astype(dtype), np.ones(M, bool))
    terms = step_losses(LossConfig(), MODEL)(step, np.ones(N, bool), reference)
    assert {x.dtype for x in terms} == {jnp.dtype(dtype)}


def test_pose_error_is_the_sum_of_distances_of_valid_points(rng):
    moved, truth = rng.normal(size=(2, 9, 3))
    mask = np.arange(9) < 6
    expected = sum(np.linalg.norm(a - b) for a, b in zip(moved[:6], truth[:6], strict=True))
    holed = np.where(mask[:, None], moved, np.nan)
    value, gradient = jax.value_and_grad(
        lambda x: losses.pose_error(PointCloud(x, jnp.asarray(mask)), jnp.asarray(truth))
    )(jnp.asarray(holed))
    np.testing.assert_allclose(value, expected, rtol=1e-12)
    assert np.isfinite(gradient).all()
    np.testing.assert_allclose(np.linalg.norm(gradient[:6], axis=1), 1, rtol=1e-12)
    assert jnp.all(gradient[6:] == 0)
