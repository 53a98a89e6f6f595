"""Evaluation: pairs do not depend on the batch, and the last batch is cut, not padded into means."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.config import ModelConfig, PairConfig
from jaxreg.data.batches import (
    given_pair_batches,
    key_of_tests,
    pair_batches,
    true_transforms,
)
from jaxreg.evaluation import methods, run
from jaxreg.network.model import init_variables
from jaxreg.refine.config import RefineConfig
from jaxreg.types import RigidTransform

pytestmark = pytest.mark.float32

PAIRS = PairConfig(points=16, kept=12)


@pytest.fixture
def shapes(seed):
    return np.random.default_rng(seed).normal(size=(5, 16, 3)).astype(np.float32)


def batches(shapes, batch):
    return pair_batches(shapes, key_of_tests(3), config=PAIRS, batch=batch)


def test_pairs_do_not_depend_on_the_size_of_the_batch(shapes):
    counted = [(pair, count) for pair, count in batches(shapes, 2)]
    assert [count for _, count in counted] == [2, 2, 1]
    small = jax.tree.map(
        lambda *x: np.concatenate(x),
        *[jax.tree.map(lambda x, c=count: np.asarray(x)[:c], pair) for pair, count in counted],
    )
    whole, _ = next(batches(shapes, 5))
    jax.tree.map(np.testing.assert_array_equal, small, jax.tree.map(np.asarray, whole))


def test_every_pair_is_counted_once_with_its_own_truth(shapes):
    def cheat(pair):
        return pair.transform

    done = []
    predicted, truth, seconds = run.evaluate_method(cheat, batches(shapes, 2), done.append)
    assert sum(done) == 5
    assert predicted.rotation.shape == (5, 3, 3)
    jax.tree.map(np.testing.assert_array_equal, predicted, truth)
    jax.tree.map(np.testing.assert_array_equal, truth, true_transforms(batches(shapes, 3)))
    assert seconds >= 0


@pytest.fixture(scope="module")
def network():
    """A small network as a method."""
    config = ModelConfig(k=3, k_matching=3, channels=(4,), width=4, n_inliers=8, iterations=1)
    variables = jax.jit(lambda: init_variables(jax.random.key(0), config))()
    return methods.network_method(variables, config)


def test_all_of_modelnet_in_constant_memory_and_one_compilation(network, seed, caplog):
    """As many pairs as ModelNet40 has test shapes; the last batch is half full."""
    shapes = np.random.default_rng(seed).normal(size=(2468, 16, 3)).astype(np.float32)
    arrays, compiled = [], []

    def progress(count):
        arrays.append(len(jax.live_arrays()))
        compiled.append(sum(text.startswith("Compiling") for text in caplog.messages))

    with jax.log_compiles():
        predicted, truth, _ = run.evaluate_method(network, batches(shapes, 8), progress)
    assert predicted.rotation.shape == truth.rotation.shape == (2468, 3, 3)
    assert len(arrays) == 309
    assert compiled[0] > 0, "the first batch compiles"
    assert set(compiled) == {compiled[0]}, "no other does, the last neither"
    assert set(arrays[1:]) == {arrays[1]}


def test_a_shorter_last_batch_and_a_hoard_would_be_seen(network, seed, caplog):
    shapes = np.random.default_rng(seed).normal(size=(20, 16, 3)).astype(np.float32)
    hoard, arrays, compiled = [], [], []

    def cut(stream):
        for pair, count in stream:
            hoard.append(jax.tree.map(lambda x, c=count: x[:c], pair))
            yield hoard[-1], count

    def progress(count):
        arrays.append(len(jax.live_arrays()))
        compiled.append(sum(text.startswith("Compiling") for text in caplog.messages))

    with jax.log_compiles():
        run.evaluate_method(network, cut(batches(shapes, 8)), progress)
    assert compiled[2] > compiled[1] == compiled[0]
    assert arrays[2] > arrays[1] > arrays[0]


def test_identity_is_the_identity(shapes):
    pair, _ = next(batches(shapes, 5))
    transform = methods.identity_method(pair)
    np.testing.assert_array_equal(transform.rotation, np.tile(np.eye(3), (5, 1, 1)))
    np.testing.assert_array_equal(transform.translation, np.zeros((5, 3)))


def test_a_host_method_sees_valid_points_only(shapes):
    pair, _ = next(batches(shapes, 5))
    mask = np.ones((5, 12), bool)
    mask[:, 9:] = False
    pair = pair._replace(source=pair.source._replace(mask=mask))
    sizes = []

    def method(source, reference):
        sizes.append((len(source), len(reference)))
        return RigidTransform(np.eye(3), np.full(3, len(sizes)))

    transforms = methods.host_method(method)(pair)
    assert sizes == [(9, 12)] * 5
    np.testing.assert_array_equal(transforms.translation[:, 0], np.arange(1, 6))


def test_icp_undoes_a_small_motion(seed):
    shapes = np.random.default_rng(seed).normal(size=(2, 64, 3)).astype(np.float32)
    easy = PairConfig(points=64, kept=64, crop="none", rotation_max_deg=3.0, translation_max=0.02)
    stream = pair_batches(shapes, key_of_tests(0), config=easy, batch=2)
    predicted, truth, _ = run.evaluate_method(methods.choose("icp").batch, stream)
    np.testing.assert_allclose(predicted.rotation, truth.rotation, atol=1e-4)
    np.testing.assert_allclose(predicted.translation, truth.translation, atol=1e-4)


@pytest.mark.parametrize("method", ["icp", "point_to_plane", "gicp"])
def test_a_refinement_mends_poses_that_are_nearly_right(method, seed):
    shapes = np.random.default_rng(seed).normal(size=(2, 64, 3)).astype(np.float32)
    easy = PairConfig(points=64, kept=64, crop="none", rotation_max_deg=30.0)
    stream = list(pair_batches(shapes, key_of_tests(0), config=easy, batch=2))

    def nearly(pair):
        return pair.transform._replace(translation=pair.transform.translation + 0.02)

    refined = methods.refined_method(nearly, methods.refinement(RefineConfig(method=method)))
    for function, lowest, highest in ((nearly, 0.01, 0.1), (refined, 0, 1e-5)):
        predicted, truth, _ = run.evaluate_method(function, iter(stream))
        error = np.abs(predicted.translation - truth.translation).max()
        assert lowest <= error <= highest


def test_a_refinement_is_given_its_configuration_the_masks_and_the_start(shapes, monkeypatch):
    config = RefineConfig("icp", iterations=7, trim=0.5, kernel="huber", k=4)
    pair, _ = next(batches(shapes, 5))
    seen = {}

    def recorded(source, reference, *, initial, source_mask, reference_mask, config):
        seen.update(config=config)
        counts = (jnp.sum(mask).astype(source.dtype) for mask in (source_mask, reference_mask))
        moved = initial.translation + jnp.stack([*counts, jnp.zeros((), source.dtype)])
        return Refined(RigidTransform(initial.rotation, moved))

    monkeypatch.setattr(methods, "refine", recorded)
    found = methods.refinement(config)(pair, pair.transform)
    assert seen["config"] is config
    counts = [pair.source.mask.sum(1), pair.reference.mask.sum(1), [0] * 5]
    added = np.stack(counts, axis=1).astype(np.float32)
    np.testing.assert_allclose(found.translation, pair.transform.translation + added, rtol=1e-6)
    np.testing.assert_array_equal(found.rotation, pair.transform.rotation)


class Refined(NamedTuple):
    transform: RigidTransform


def test_given_pairs_keep_their_pose_and_are_cropped(seed):
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(3, 16, 3)).astype(np.float32)
    matrices = np.tile(np.eye(4), (3, 1, 1))
    matrices[:, :3, :3] = Rotation.random(3, rng=rng).as_matrix()
    matrices[:, :3, 3] = rng.normal(size=(3, 3))
    target = np.einsum("nij,npj->npi", matrices[:, :3, :3], source) + matrices[:, None, :3, 3]
    config = PairConfig(kept=12)
    counted = list(
        given_pair_batches(
            (source, target.astype(np.float32)),
            matrices,
            key_of_tests(0),
            config=config,
            batch=2,
        )
    )
    assert [count for _, count in counted] == [2, 1]
    truth = true_transforms(iter(counted))
    np.testing.assert_allclose(truth.rotation, matrices[:, :3, :3], atol=1e-6)
    np.testing.assert_allclose(truth.translation, matrices[:, :3, 3], atol=1e-6)
    pair, _ = counted[0]
    for number in range(2):
        for cloud, points in ((source[number], pair.source), (target[number], pair.reference)):
            distance = np.linalg.norm(cloud[:, None] - np.asarray(points.points)[number], axis=2)
            assert points.points.shape[1] == 12
            assert distance.min(axis=0).max() < 1e-5
