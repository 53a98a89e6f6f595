"""Evaluation: pairs do not depend on the batch, and the last batch is cut, not padded into means."""

import jax
import numpy as np
import pytest

from jaxreg import evaluation
from jaxreg.config import PairConfig
from jaxreg.types import RigidTransform

pytestmark = pytest.mark.float32

PAIRS = PairConfig(points=16, kept=12)


@pytest.fixture
def shapes(seed):
    return np.random.default_rng(seed).normal(size=(5, 16, 3)).astype(np.float32)


def batches(shapes, batch):
    return evaluation.pair_batches(shapes, evaluation.test_key(3), config=PAIRS, batch=batch)


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
    predicted, truth, seconds = evaluation.evaluate_method(cheat, batches(shapes, 2), done.append)
    assert sum(done) == 5
    assert predicted.rotation.shape == (5, 3, 3)
    jax.tree.map(np.testing.assert_array_equal, predicted, truth)
    jax.tree.map(
        np.testing.assert_array_equal, truth, evaluation.true_transforms(batches(shapes, 3))
    )
    assert seconds >= 0


def test_identity_is_the_identity(shapes):
    pair, _ = next(batches(shapes, 5))
    transform = evaluation.identity_method(pair)
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

    transforms = evaluation.host_method(method)(pair)
    assert sizes == [(9, 12)] * 5
    np.testing.assert_array_equal(transforms.translation[:, 0], np.arange(1, 6))


def test_icp_undoes_a_small_motion(seed):
    shapes = np.random.default_rng(seed).normal(size=(2, 64, 3)).astype(np.float32)
    easy = PairConfig(points=64, kept=64, crop="none", rotation_max_deg=3.0, translation_max=0.02)
    stream = evaluation.pair_batches(shapes, evaluation.test_key(0), config=easy, batch=2)
    predicted, truth, _ = evaluation.evaluate_method(evaluation.icp_method, stream)
    np.testing.assert_allclose(predicted.rotation, truth.rotation, atol=1e-4)
    np.testing.assert_allclose(predicted.translation, truth.translation, atol=1e-4)
