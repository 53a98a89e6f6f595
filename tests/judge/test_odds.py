"""From evidence to probabilities: the formulas of the module, and cases that leave no doubt."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.data.procedural import shapes
from jaxreg.judge.evidence import Evidence
from jaxreg.judge.odds import INTERCEPT, WEIGHTS, chances, features, log_odds, probabilities
from jaxreg.types import RigidTransform
from tests.judge.clouds import examined, partners, random_pose, read

NOTHING = Evidence(0, 0, 1.2, 1.0, 0.5, 0, 0, 0, 0, 0, 0)
"""Of two clouds that lie far from each other."""


def stacked(rng, *shape) -> Evidence:
    return Evidence(*rng.uniform(0, 1, (len(Evidence._fields), *shape)))


def test_shares_and_lengths_count_by_their_logarithm(seed):
    found = stacked(np.random.default_rng(seed), 7)
    told = features(found)
    for name in ("distance", "rough_distance"):
        np.testing.assert_allclose(getattr(told, name), np.log(getattr(found, name)), rtol=1e-12)
    for name in ("smaller", "larger"):
        # Near the logarithm where there is a share, and finite where there is none.
        share = getattr(found, name)
        assert np.all(np.abs(getattr(told, name) - np.log(share)) < 0.01 / share)
    np.testing.assert_allclose(told.held, np.log10(found.held), rtol=1e-12)
    for name in (
        "rough_facing",
        "disagreement",
        "beside",
        "unseen",
        "rough",
        "ends",
        "sparse",
    ):
        np.testing.assert_array_equal(getattr(told, name), getattr(found, name))
    np.testing.assert_array_equal(told.same, np.minimum(found.same, 0.5))


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_log_odds_are_a_weighted_sum_over_leading_axes(seed, shape):
    found = stacked(np.random.default_rng(seed), *shape)
    weighed = [w * np.asarray(f) for w, f in zip(WEIGHTS, features(found), strict=True)]
    np.testing.assert_allclose(log_odds(found), INTERCEPT + sum(weighed), rtol=1e-9)


def test_nothing_near_is_finite_and_unlikely():
    score = log_odds(Evidence(*map(jnp.float32, NOTHING)))
    assert np.isfinite(score)
    assert probabilities(score[None])[0] < 0.1


def test_a_right_pose_is_likelier_than_any_other(seed):
    rng = np.random.default_rng(seed)
    cloud = shapes.sample_shape(5, 9, points=1000).astype(np.float64)
    source, reference = (examined(points) for points in (cloud[:500], cloud[500:]))
    right = RigidTransform(np.eye(3), np.zeros(3))
    poses = [right, *(random_pose(rng, shift=0.3) for _ in range(20))]
    found = [read(p, source, reference, *partners(p, source, reference)) for p in poses]
    scores = np.array([log_odds(evidence) for evidence in found])
    chances = np.asarray(probabilities(scores))
    assert chances[0] > 0.8
    assert scores[1:].max() < scores[0] - 2


def test_probabilities_are_those_of_the_head_of_the_file(seed):
    scores = np.random.default_rng(seed).normal(0, 3, 6)
    found = np.asarray(probabilities(scores))
    none = 1 / (1 + np.exp(scores).sum())
    np.testing.assert_allclose(found, np.exp(scores) * none, rtol=1e-12)
    assert found.sum() + none == pytest.approx(1, abs=1e-12)


def test_poses_that_agree_equally_well_share_the_chance():
    found = np.asarray(probabilities(np.array([5.0, 5.0, -40.0])))
    assert found[0] == found[1] == pytest.approx(0.5, abs=0.01)
    assert found[2] < 1e-15
    assert probabilities(np.array([0.0]))[0] == pytest.approx(0.5)  # the other half: none


def test_what_is_not_counted_has_no_chance_and_takes_none(seed):
    rng = np.random.default_rng(seed)
    scores, counted = rng.normal(0, 3, 6), np.array([True, False, True, True, False, False])
    found = np.asarray(probabilities(scores, jnp.asarray(counted)))
    assert not found[~counted].any()
    np.testing.assert_allclose(found[counted], probabilities(scores[counted]), rtol=1e-12)
    assert not probabilities(scores, jnp.zeros(6, bool)).any()


def test_large_scores_do_not_overflow():
    found = np.asarray(probabilities(np.float32([1e4, 1e4 - 1, -1e4])))
    np.testing.assert_allclose(found, [1 / (1 + np.exp(-1)), 1 / (1 + np.e), 0], rtol=1e-5)


def test_chances_on_the_host_are_the_same_probabilities(seed):
    scores = np.random.default_rng(seed).normal(scale=5, size=9)
    exact = np.exp(scores) / (1 + np.exp(scores).sum())
    np.testing.assert_allclose(chances(scores), exact, rtol=1e-12)
    np.testing.assert_allclose(probabilities(scores), exact, rtol=1e-12)
    assert chances(np.array([-np.inf, 800.0])).tolist() == [0, 1]


def test_any_number_of_poses_is_judged_without_a_compilation(caplog):
    with jax.log_compiles(True), caplog.at_level("WARNING", logger="jax"):
        for count in (2, 13, 31):
            chances(np.zeros(count))
        assert not caplog.records
        probabilities(np.zeros(37))
    assert caplog.records
