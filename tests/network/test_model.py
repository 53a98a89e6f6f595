"""One registration step against loops from features to transform; laws of the whole network."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.config import Config, ModelConfig
from jaxreg.network.model import init_variables, iterate, register_pair
from jaxreg.types import PointCloud
from tests import oracles
from tests.compiled import knn

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
def variables_of(config: ModelConfig):
    """Parameters and statistics away from their initial zeros and ones."""
    shapes = jax.eval_shape(lambda: init_variables(jax.random.key(0), config))
    rng = np.random.default_rng(0)
    variables = jax.tree.map(lambda x: rng.normal(0, 0.4, x.shape), shapes)
    positive = jax.tree.map(lambda x: 0.5 + np.abs(x), variables["batch_stats"])
    return {"params": variables["params"], "batch_stats": positive}


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


def draw_pair(rng, n=N, m=M):
    """Two clouds that share most points, `reference` moved by a random pose."""
    points = rng.uniform(-1, 1, (max(n, m), 3))
    pose = Rotation.from_euler("zyx", rng.uniform(0, 0.5, 3)).as_matrix()
    return points[:n], points[:m] @ pose.T + rng.uniform(-0.3, 0.3, 3)


def everything(points):
    return PointCloud(points, np.ones(len(points), bool))


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
    source, reference = draw_pair(rng)
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
    source, reference = draw_pair(rng)
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
    source, reference = draw_pair(rng)
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
    np.testing.assert_allclose(result.rotation @ result.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(result.rotation) == pytest.approx(1)


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
    config = small(**READINGS[reading])
    variables = variables_of(config)
    source, reference = draw_pair(rng)
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


@pytest.mark.parametrize("fill", [1e6, np.nan])
def test_padding_changes_no_derivative(rng, fill):
    variables = variables_of(SMALL)
    source, reference = draw_pair(rng)
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
    variables = variables_of(small(n_inliers=N))
    source, reference = draw_pair(rng)
    if kind == "duplicates":
        source, reference = np.repeat(source[::2], 2, axis=0), np.repeat(reference[::2], 2, axis=0)
    if kind == "grid":
        axis = np.arange(3.0)
        reference = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)[:M]
        source = reference[:N] + 0.25
    run = registration(small(n_inliers=N))
    result = run(variables, source, reference)
    p, q = rng.permutation(len(source)), rng.permutation(len(reference))
    permuted = run(variables, source[p], reference[q])
    np.testing.assert_allclose(permuted.transformation, result.transformation, atol=1e-8)
    np.testing.assert_allclose(permuted.confidence, result.confidence[p], atol=1e-8)
    np.testing.assert_allclose(permuted.correspondences, result.correspondences[p], atol=1e-8)


def test_translating_the_source_is_undone(rng):
    # Features and vector edges do not see a translation.
    variables = variables_of(SMALL)
    source, reference = draw_pair(rng)
    result = registration(SMALL)(variables, source, reference)
    shift = np.array([0.3, -2.0, 1.0])
    shifted = registration(SMALL)(variables, source + shift, reference)
    np.testing.assert_allclose(shifted.rotation, result.rotation, atol=1e-9)
    expected = result.translation - result.rotation @ shift
    np.testing.assert_allclose(shifted.translation, expected, atol=1e-9)


def test_no_valid_point_gives_the_identity_and_says_so(rng):
    variables = variables_of(SMALL)
    source, reference = draw_pair(rng)
    run = registration(SMALL)
    for masks in ((np.zeros(N, bool), np.ones(M, bool)), (np.ones(N, bool), np.zeros(M, bool))):
        result = run(variables, source, reference, source_mask=masks[0], reference_mask=masks[1])
        assert not result.valid
        np.testing.assert_allclose(result.transformation, np.eye(4), atol=1e-12)
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(result))
        gradient = gradient_of(SMALL)(variables, source, reference, *masks)
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(gradient))


def test_few_valid_points_give_a_rotation(rng):
    variables = variables_of(SMALL)
    source, reference = draw_pair(rng)
    for count in (1, 2, 3):
        masks = np.arange(N) < count, np.arange(M) < count
        result = registration(SMALL)(
            variables, source, reference, source_mask=masks[0], reference_mask=masks[1]
        )
        assert np.linalg.det(result.rotation) == pytest.approx(1)
        assert np.isfinite(result.transformation).all()
        gradient = gradient_of(SMALL)(variables, source, reference, *masks)
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(gradient))


def test_training_updates_statistics_of_both_networks_and_evaluation_none(rng):
    variables = variables_of(SMALL)
    clouds = [everything(x[None].repeat(2, 0)) for x in draw_pair(rng)]
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
    source, reference = draw_pair(rng)
    _, _, unchanged = steps(SMALL)(variables, everything(source), everything(reference))
    assert_same(unchanged, variables, rtol=0)


@pytest.mark.untyped
def test_static_faults_are_named(rng):
    variables = variables_of(SMALL)
    source, reference = draw_pair(rng)
    with pytest.raises(ValueError, match=r"N_c = 12 .* n = 11 points"):
        registration(SMALL)(variables, source[:11], reference)
    with pytest.raises(ValueError, match=r"k = 4 .* n = 4 points"):
        registration(SMALL)(variables, source, reference[:4])
    with pytest.raises(ValueError, match=r"\(n, 3\), got \(20, 2\)"):
        registration(SMALL)(variables, source[:, :2], reference)
    with pytest.raises(ValueError, match=r"use jax.vmap for a batch"):
        registration(SMALL)(variables, source[None], reference[None])
