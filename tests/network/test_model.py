"""One registration step against loops from features to transform; laws of the whole network.

T01 to T25 are the degenerate cases that every room is tested with.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.config import Config, LossConfig, ModelConfig
from jaxreg.network import losses
from jaxreg.network.features import BATCH_AXIS
from jaxreg.network.model import init_variables, iterate, register_pair
from jaxreg.types import PointCloud
from jaxreg.weights.released import load_pretrained
from tests import oracles
from tests.compiled import knn
from tests.scenes import assert_proper, draw_pair, variables_of

# Flax promotes float64 with the float32 that it starts from.
pytestmark = pytest.mark.loose

N, M, K = 20, 24, 3
SMALL = ModelConfig(
    k=K, k_matching=4, channels=(4, 8), width=8, inlier_width=4, n_inliers=12, iterations=2
)
READINGS = {
    "paper": {},
    "own 1-NN graph": {"one_nn": "own"},
    "self 1-NN": {"one_nn": "self"},
    "single neighbourhood": {"one_nn": "none", "svd": "all"},
    "lengths, next angle": {"edge": "length", "angles": "next"},
    # All points: two with the same neighbours have equal confidence, in any order.
    "raw coordinates": {"edge": "coordinates", "angles": "none", "svd": "all"},
    "with the point itself": {"include_self": True},
}


@functools.cache
def small(**changes) -> ModelConfig:
    return dataclasses.replace(SMALL, **changes)


@functools.cache
def registration(config: ModelConfig):
    return jax.jit(functools.partial(register_pair, config=Config(model=config)))


@functools.cache
def steps(config: ModelConfig):
    """Transform, steps and final variables of a pair of clouds with their masks."""

    def run(variables, source, reference):
        return iterate(variables, source, reference, config=config, observe=lambda step, _: step)

    return jax.jit(run)


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def everything(points):
    return PointCloud(points, np.ones(len(points), bool))


def assert_finite(tree):
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def assert_same(a, b, **tolerance):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, **tolerance)


def neighbors_of(points, k, config):
    idx = np.asarray(knn(points, k))
    own = np.arange(len(points))[:, None]
    return np.concatenate([own, idx], axis=1) if config.include_self else idx


def step_by_loops(variables, source, reference, config, inliers):
    """Confidence, copy, peaks, R and t of one step, from the equations."""
    params, statistics = variables["params"], variables["batch_stats"]

    def features(points):
        graph = neighbors_of(points, config.k, config)
        return oracles.dgcnn(params["features"], statistics["features"], points, graph)

    clouds = source, reference
    graphs = [np.asarray(knn(x, config.k_matching)) for x in clouds]
    nearest = [np.asarray(knn(x, 1))[:, 0] for x in clouds]
    of_points = [features(x) for x in clouds]
    distance = oracles.feature_distance(*of_points)
    of_nearest, own_graphs = None, None
    if config.one_nn == "gather":
        of_nearest = [f[i] for f, i in zip(of_points, nearest, strict=True)]
    elif config.one_nn == "self":
        of_nearest = of_points
    elif config.one_nn == "own":
        patches = [x[i] for x, i in zip(clouds, nearest, strict=True)]
        of_nearest = [features(x) for x in patches]
        own_graphs = [np.asarray(knn(x, config.k_matching)) for x in patches]
    nearest_distance = None if of_nearest is None else oracles.feature_distance(*of_nearest)
    _, dual, final = oracles.maps(distance, nearest_distance, *graphs, config.alpha, own_graphs)
    copy = final @ reference
    near = neighbors_of(source, config.k, config)
    structures = [
        oracles.geometric_structure(x, near, config.edge, config.angles) for x in (source, copy)
    ]
    confidence = oracles.inlier_confidence(params["inliers"], statistics["inliers"], *structures)
    chosen = np.arange(len(source))
    if config.svd == "top":
        # Points with the same neighbours tie in the raw coordinates, and rounding decides.
        chosen, lowest = inliers, np.sort(confidence)[-config.n_inliers]
        assert len(set(chosen)) == config.n_inliers
        assert confidence[chosen].min() >= lowest - 1e-12
    transform = oracles.procrustes(source[chosen], copy[chosen], confidence[chosen])
    return confidence, copy, dual.max(axis=1), final.max(axis=1), *transform


@pytest.mark.parametrize("reading", READINGS)
def test_a_step_equals_the_paper_s_equations_in_loops(rng, reading):
    config = small(**READINGS[reading])
    variables = variables_of(config)
    source, reference = draw_pair(rng, N, M)
    _, step, _ = steps(config)(variables, everything(source), everything(reference))
    for number in range(config.iterations):
        of_step = jax.tree.map(lambda x, number=number: np.asarray(x[number]), step)
        got = (of_step.confidence, *of_step.matches, *of_step.transform)
        got = (got[0], *of_step.matches[:3], *of_step.transform)
        # From the source that the step began with: its own earlier steps are not compared twice.
        expected = step_by_loops(
            variables, of_step.source, reference, config, inliers=of_step.inliers
        )
        names = ("confidence", "copy", "dual peak", "final peak", "rotation", "translation")
        for name, a, b in zip(names, got, expected, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-8, err_msg=f"{name}, step {number}")


def test_steps_compose_and_move_the_source(rng):
    variables = variables_of(SMALL)
    source, reference = draw_pair(rng, N, M)
    transform, step, _ = steps(SMALL)(variables, everything(source), everything(reference))
    transform, step = jax.tree.map(np.asarray, (transform, step))
    np.testing.assert_allclose(step.source[0], source, atol=1e-15)
    points = source
    for number in range(SMALL.iterations):
        np.testing.assert_allclose(step.source[number], points, atol=1e-12)
        points = points @ step.transform.rotation[number].T + step.transform.translation[number]
        np.testing.assert_allclose(step.moved[number], points, atol=1e-12)
    np.testing.assert_allclose(
        source @ transform.rotation.T + transform.translation, points, atol=1e-12
    )
    expected = np.argsort(-step.confidence[0])[: SMALL.n_inliers]
    np.testing.assert_array_equal(step.inliers[0], expected)


def test_registration_holds_the_last_step(rng):
    variables = variables_of(SMALL)
    source, reference = draw_pair(rng, N, M)
    result = registration(SMALL)(variables, source, reference)
    transform, step, _ = steps(SMALL)(variables, everything(source), everything(reference))
    np.testing.assert_allclose(result.rotation, transform.rotation, atol=1e-12)
    np.testing.assert_allclose(result.translation, transform.translation, atol=1e-12)
    expected = np.eye(4)
    expected[:3, :3], expected[:3, 3] = transform
    np.testing.assert_allclose(result.transformation, expected, atol=1e-12)
    np.testing.assert_allclose(result.confidence, step.confidence[-1], atol=1e-12)
    np.testing.assert_allclose(result.correspondences, step.matches.copy[-1], atol=1e-12)
    assert result.valid
    assert_proper(result.rotation, 1e-12)


def padded_clouds(rng, source, reference, fill):
    """Both clouds with 7 and 5 rows of `fill` at random places, their masks and valid rows."""
    result = []
    for points, extra in ((source, 7), (reference, 5)):
        rows = np.sort(rng.permutation(len(points) + extra)[: len(points)])
        padded = np.full((len(points) + extra, 3), fill)
        padded[rows] = points
        mask = np.zeros(len(padded), bool)
        mask[rows] = True
        result += [padded, mask, rows]
    return result


@pytest.mark.parametrize("fill", [0.0, 1e6, np.nan, np.inf])
@pytest.mark.parametrize("reading", ["paper", "own 1-NN graph", "single neighbourhood"])
def test_padded_equals_unpadded(rng, reading, fill):
    """T18."""
    config = small(**READINGS[reading])
    variables = variables_of(config)
    source, reference = draw_pair(rng, N, M)
    expected = registration(config)(variables, source, reference)
    a, a_mask, rows, b, b_mask, _ = padded_clouds(rng, source, reference, fill)
    result = registration(config)(variables, a, b, source_mask=a_mask, reference_mask=b_mask)
    np.testing.assert_allclose(result.transformation, expected.transformation, atol=1e-8)
    np.testing.assert_allclose(result.confidence[rows], expected.confidence, atol=1e-8)
    np.testing.assert_array_equal(result.confidence[~a_mask], 0)
    np.testing.assert_allclose(result.correspondences[rows], expected.correspondences, atol=1e-8)
    assert np.isfinite(result.correspondences).all()


@functools.cache
def gradient_of(config: ModelConfig):
    """Gradient of a function of R and t by the variables and both clouds."""

    def value(variables, source, reference, source_mask, reference_mask):
        result = register_pair(
            variables,
            source,
            reference,
            config=Config(model=config),
            source_mask=source_mask,
            reference_mask=reference_mask,
        )
        mix = jnp.sin(jnp.arange(9.0)).reshape(3, 3)
        return jnp.sum(result.rotation * mix) + jnp.sum(result.translation * mix[0])

    return jax.jit(jax.grad(value, (0, 1, 2)))


@pytest.mark.slow
@pytest.mark.parametrize("fill", [1e6, np.nan])
def test_padding_changes_no_derivative(rng, fill):
    """T18."""
    variables = variables_of(SMALL)
    source, reference = draw_pair(rng, N, M)
    expected = gradient_of(SMALL)(variables, source, reference, np.ones(N, bool), np.ones(M, bool))
    a, a_mask, a_rows, b, b_mask, b_rows = padded_clouds(rng, source, reference, fill)
    result = gradient_of(SMALL)(variables, a, b, a_mask, b_mask)
    assert_same(result[0], expected[0], rtol=1e-6, atol=1e-8)
    for gradient, wanted, rows, mask in zip(
        result[1:], expected[1:], (a_rows, b_rows), (a_mask, b_mask), strict=True
    ):
        np.testing.assert_allclose(gradient[rows], wanted, rtol=1e-6, atol=1e-8)
        np.testing.assert_array_equal(gradient[~mask], 0)


@pytest.mark.parametrize("kind", ["generic", "duplicates", "grid"])
def test_permuting_the_points_permutes_the_result(rng, kind):
    """T20; on the grid, whose features are constant, T25."""
    variables = variables_of(small(n_inliers=N))
    source, reference = draw_pair(rng, N, M)
    if kind == "duplicates":
        source, reference = np.repeat(source[::2], 2, axis=0), np.repeat(reference[::2], 2, axis=0)
    if kind == "grid":
        axis = np.arange(3.0)
        reference = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)[:M]
        source = reference[:N] + 0.25
    run = registration(small(n_inliers=N))
    result = run(variables, source, reference)
    full = np.ones(N, bool), np.ones(M, bool)
    assert_finite((result, gradient_of(SMALL)(variables, source, reference, *full)))
    p, q = rng.permutation(len(source)), rng.permutation(len(reference))
    permuted = run(variables, source[p], reference[q])
    np.testing.assert_allclose(permuted.transformation, result.transformation, atol=1e-8)
    np.testing.assert_allclose(permuted.confidence, result.confidence[p], atol=1e-8)
    np.testing.assert_allclose(permuted.correspondences, result.correspondences[p], atol=1e-8)


def test_translating_the_source_is_undone(rng):
    # Features and vector edges do not see a translation.
    variables = variables_of(SMALL)
    source, reference = draw_pair(rng, N, M)
    result = registration(SMALL)(variables, source, reference)
    shift = np.array([0.3, -2.0, 1.0])
    shifted = registration(SMALL)(variables, source + shift, reference)
    np.testing.assert_allclose(shifted.rotation, result.rotation, atol=1e-9)
    expected = result.translation - result.rotation @ shift
    np.testing.assert_allclose(shifted.translation, expected, atol=1e-9)


@pytest.mark.parametrize("valid", [(0, M), (N, 0), (0, 0)])
def test_no_valid_point_gives_the_identity_and_says_so(rng, valid):
    """T07."""
    variables = variables_of(SMALL)
    masks = [np.arange(n) < count for n, count in zip((N, M), valid, strict=True)]
    clouds = [
        np.where(mask[:, None], points, np.nan)
        for points, mask in zip(draw_pair(rng, N, M), masks, strict=True)
    ]
    options = {"source_mask": masks[0], "reference_mask": masks[1]}
    result = registration(SMALL)(variables, *clouds, **options)
    assert not result.valid
    np.testing.assert_allclose(result.transformation, np.eye(4), atol=1e-12)
    assert_finite((result, gradient_of(SMALL)(variables, *clouds, *masks)))


def test_few_valid_points_give_a_rotation(rng):
    """T06."""
    variables = variables_of(SMALL)
    source, reference = draw_pair(rng, N, M)
    for count in (1, 2, 3):
        masks = np.arange(N) < count, np.arange(M) < count
        result = registration(SMALL)(
            variables, source, reference, source_mask=masks[0], reference_mask=masks[1]
        )
        assert_proper(result.rotation)
        assert_finite((result, gradient_of(SMALL)(variables, source, reference, *masks)))


def test_a_batch_of_three_equals_three_singles(rng):
    """T19, of clouds of different sizes."""
    variables = variables_of(SMALL)
    sizes = (12, 17, 20)
    pairs = [draw_pair(rng, n, n + 2) for n in sizes]
    batch = batch_of(pairs, (N, M), np.nan)

    def one(a, b, a_mask, b_mask):
        masks = {"source_mask": a_mask, "reference_mask": b_mask}
        return register_pair(variables, a, b, config=Config(model=SMALL), **masks)

    together = jax.jit(jax.vmap(one))(*batch)
    run = registration(SMALL)
    for row in range(3):
        a, b, a_mask, b_mask = (x[row] for x in batch)
        single = run(variables, a, b, source_mask=a_mask, reference_mask=b_mask)
        for got, expected in zip(together, single, strict=True):
            np.testing.assert_allclose(got[row], expected, atol=1e-9)


def test_training_updates_statistics_of_both_networks_and_evaluation_none(rng):
    variables = variables_of(SMALL)
    clouds = [everything(x[None].repeat(2, 0)) for x in draw_pair(rng, N, M)]
    clouds = [PointCloud(x.points, np.ones(x.points.shape[:2], bool)) for x in clouds]

    def run(source, reference):
        return iterate(variables, source, reference, config=SMALL, train=True)[2]

    updated = jax.jit(jax.vmap(run, axis_name="batch", out_axes=None))(*clouds)
    assert jax.tree.structure(updated) == jax.tree.structure(variables)
    for before, after in zip(
        jax.tree.leaves(variables["batch_stats"]),
        jax.tree.leaves(updated["batch_stats"]),
        strict=True,
    ):
        assert np.abs(after - before).max() > 0
    assert_same(updated["params"], variables["params"], rtol=0)
    source, reference = draw_pair(rng, N, M)
    _, _, unchanged = steps(SMALL)(variables, everything(source), everything(reference))
    assert_same(unchanged, variables, rtol=0)


@pytest.mark.untyped
def test_static_faults_are_named(rng):
    variables = variables_of(SMALL)
    source, reference = draw_pair(rng, N, M)
    with pytest.raises(ValueError, match=r"N_c = 12 .* n = 11 points"):
        registration(SMALL)(variables, source[:11], reference)
    with pytest.raises(ValueError, match=r"k = 4 .* n = 4 points"):
        registration(SMALL)(variables, source, reference[:4])
    with pytest.raises(ValueError, match=r"\(n, 3\) .*got \(20, 2\)"):
        registration(SMALL)(variables, source[:, :2], reference)
    with pytest.raises(ValueError, match=r"use jax.vmap for a batch"):
        registration(SMALL)(variables, source[None], reference[None])


@jax.jit
@jax.jit
def trained(variables, sources, references, source_masks, reference_masks):
    """Loss, statistics and gradients of a batch in training, as `jaxreg.training` computes them."""

    def objective(variables, sources, references):
        def one(source, reference):
            def observe(step, graph):
                return losses.step_losses(
                    step, graph, source.mask, reference, config=LossConfig(), model=SMALL
                )

            _, terms, updated = iterate(
                variables, source, reference, config=SMALL, train=True, observe=observe
            )
            return losses.total_loss(terms, LossConfig()), updated["batch_stats"]

        loss, statistics = jax.vmap(one, axis_name=BATCH_AXIS, out_axes=(0, None))(
            PointCloud(sources, source_masks), PointCloud(references, reference_masks)
        )
        return jnp.sum(loss), statistics

    return jax.value_and_grad(objective, (0, 1, 2), has_aux=True)(variables, sources, references)


def batch_of(pairs, rows, fill):
    """Sources, references and their masks, valid rows first, of ragged pairs."""
    clouds = [np.full((len(pairs), n, 3), fill) for n in rows]
    masks = [np.zeros(cloud.shape[:-1], bool) for cloud in clouds]
    for number, pair in enumerate(pairs):
        for side, points in enumerate(pair):
            clouds[side][number, : len(points)] = points
            masks[side][number, : len(points)] = True
    return (*clouds, *masks)


@pytest.mark.slow
def test_the_configuration_of_another_network_is_refused(rng):
    clouds = jnp.asarray(rng.normal(size=(2, 30, 3)), jnp.float32)
    with pytest.raises(ValueError, match="another network: give it to jaxreg.peers.idam.register"):
        register_pair({}, *clouds, config=Config(network="idam"))


def test_weights_of_another_network_are_refused(rng):
    clouds = jnp.asarray(rng.normal(size=(2, 300, 3)), jnp.float32)
    variables, _ = load_pretrained("idam")
    _, config = load_pretrained("modelnet40")
    with pytest.raises(ValueError, match="'features' in .* those of another network"):
        register_pair(variables, *clouds, config=config)


def test_padding_changes_neither_the_training_loss_nor_its_gradient(rng):
    """T18."""
    variables = variables_of(SMALL)
    # No two edges parallel: an angle of 0 has a kink, and rounding chooses its side.
    pairs = [tuple(rng.uniform(-1, 1, (2, 20, 3))) for _ in range(2)]
    (loss, statistics), gradients = trained(variables, *batch_of(pairs, (20, 20), 0.0))
    (padded, other), others = trained(variables, *batch_of(pairs, (26, 26), np.nan))
    np.testing.assert_allclose(padded, loss, rtol=1e-9)
    assert_same(other, statistics, rtol=1e-9, atol=1e-12)
    assert_same(others[0], gradients[0], rtol=1e-6, atol=1e-8)
    for a, b in zip(others[1:], gradients[1:], strict=True):
        np.testing.assert_allclose(a[:, :20], b, rtol=1e-6, atol=1e-8)
        np.testing.assert_array_equal(a[:, 20:], 0)


def test_what_stands_in_the_padding_changes_no_bit_of_training(rng):
    """T18."""
    pairs = [(rng.uniform(-1, 1, (20 - i, 3)), rng.uniform(-1, 1, (15 + i, 3))) for i in range(2)]
    expected = trained(variables_of(SMALL), *batch_of(pairs, (26, 26), 0.0))
    result = trained(variables_of(SMALL), *batch_of(pairs, (26, 26), np.inf))
    jax.tree.map(np.testing.assert_array_equal, result, expected)
    assert_finite(expected)


def test_identical_clouds_train_with_finite_gradients(rng):
    """T01."""
    pairs = [2 * [rng.uniform(-1, 1, (20, 3))] for _ in range(2)]
    assert_finite(trained(variables_of(SMALL), *batch_of(pairs, (26, 26), 0.0)))


def test_in_a_batch_only_the_clouds_that_are_not_finite_are_not_valid():
    """Under vmap it cannot be an error; the transform is the identity, as of an empty cloud."""
    config = ModelConfig(channels=(4,), width=8, n_inliers=6, k=3, k_matching=3, iterations=1)
    variables = init_variables(jax.random.key(0), config)
    clouds = np.random.default_rng(0).normal(size=(3, 12, 3)).astype(np.float32)
    clouds[1, 4, 2], clouds[2, 5, 0] = np.nan, np.inf

    def run(x):
        found = register_pair(variables, x, jnp.asarray(clouds[0]), config=config)
        return jnp.sum(found.rotation), (found.valid, found.rotation)

    (_, (valid, rotation)), gradient = jax.jit(jax.vmap(jax.value_and_grad(run, has_aux=True)))(
        jnp.asarray(clouds)
    )
    assert valid.tolist() == [True, False, False]
    np.testing.assert_allclose(rotation[1:], 2 * [np.eye(3)], atol=1e-6)
    assert np.isfinite(gradient).all()
