"""What holds for every peer: padding, empty clouds, many pairs, and the loss."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.config import Config
from jaxreg.network.features import BATCH_AXIS
from jaxreg.peers import by_name, pair
from jaxreg.types import PointCloud, RigidTransform
from tests.oracles import softmax_rows
from tests.peers.small import MODULES, SMALL, draw_variables

pytestmark = pytest.mark.loose


@functools.cache
def program(name):
    def run(variables, source, reference, source_mask, reference_mask):
        return MODULES[name].register(
            variables,
            source,
            reference,
            config=SMALL[name],
            source_mask=source_mask,
            reference_mask=reference_mask,
        )

    return jax.jit(run)


def padded(points, rows):
    """The cloud with NaN below it, and its mask."""
    count = len(points)
    return np.concatenate([points, np.full((rows - count, 3), np.nan)]), np.arange(rows) < count


@pytest.mark.parametrize("name", MODULES)
def test_padding_changes_nothing_and_an_empty_cloud_gives_the_identity(name, seed):
    rng, every = np.random.default_rng(seed), (np.ones(13, bool), np.ones(11, bool))
    for _ in range(20):
        variables = draw_variables(MODULES[name], SMALL[name], rng)
        source, reference = rng.uniform(-1, 1, (13, 3)), rng.uniform(-1, 1, (11, 3))
        whole = program(name)(variables, source, reference, *every)
        # Random weights may let all points correspond to one or two: of that no rotation follows.
        nudged = program(name)(variables, source * (1 + 1e-10), reference, *every)
        if np.abs(nudged.rotation - whole.rotation).max() < 1e-8:
            break
    (longer, source_mask), (other, reference_mask) = padded(source, 16), padded(reference, 15)
    found = program(name)(variables, longer, other, source_mask, reference_mask)
    for part in ("rotation", "translation", "transformation"):
        np.testing.assert_allclose(getattr(found, part), getattr(whole, part), atol=1e-7)
    np.testing.assert_allclose(found.confidence[:13], whole.confidence, atol=1e-7)
    np.testing.assert_allclose(found.correspondences[:13], whole.correspondences, atol=1e-6)
    np.testing.assert_array_equal(found.confidence[13:], 0)
    assert found.valid
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-9)

    for masks in (((source_mask & False), reference_mask), (source_mask, reference_mask & False)):
        empty = program(name)(variables, longer, other, *masks)
        assert not empty.valid
        np.testing.assert_array_equal(empty.transformation, np.eye(4))
        np.testing.assert_array_equal(empty.confidence, 0)


ONE_STEP = {
    "idam": dataclasses.replace(SMALL["idam"], iterations=1),
    "rpmnet": dataclasses.replace(SMALL["rpmnet"], train_iterations=1),
    "fmr": SMALL["fmr"],
}
"""A later step of the first two starts from a pose that is a constant of the derivative, and no
difference says that."""


def losses(params, statistics, pairs, *, name):
    """The loss of a batch, and the sum of its terms without a part that is constant by design."""
    config = Config(network=name, **{name: ONE_STEP[name]})

    def one(source, reference, truth):
        variables = {"params": params, "batch_stats": statistics}
        loss, terms, _ = by_name.loss(variables, source, reference, truth, config=config)
        return loss, sum(value for key, value in terms.items() if key != "significance")

    return jnp.mean(jnp.stack(jax.vmap(one, axis_name=BATCH_AXIS)(*pairs)), axis=1)


@pytest.mark.parametrize("name", ONE_STEP)
def test_a_loss_has_the_gradient_that_differences_say(name, seed):
    rng = np.random.default_rng(seed)
    variables = draw_variables(MODULES[name], ONE_STEP[name], rng)
    identity = RigidTransform(np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)))
    points = rng.uniform(-1, 1, (2, 12, 3))
    # Every other point has a partner.
    others = points + rng.normal(0, 0.02, (2, 12, 3)) + (np.arange(12) % 2)[None, :, None]
    clouds = (PointCloud(x, np.ones((2, 12), bool)) for x in (points, others))
    pairs = (*clouds, identity)
    run = jax.jit(jax.jacrev(functools.partial(losses, name=name)))
    value = jax.jit(functools.partial(losses, name=name))
    found = run(variables["params"], variables["batch_stats"], pairs)
    for leaf in jax.tree.leaves(found):
        assert np.isfinite(leaf).all()
    direction = jax.tree.map(lambda x: rng.normal(size=x.shape), variables["params"])
    leaves = zip(*map(jax.tree.leaves, (found, direction)), strict=True)
    along = sum(np.sum(np.asarray(g)[1] * d) for g, d in leaves)
    step = 1e-6
    ahead, behind = (
        value(
            jax.tree.map(lambda x, d, s=s: x + s * d, variables["params"], direction),
            variables["batch_stats"],
            pairs,
        )[1]
        for s in (step, -step)
    )
    np.testing.assert_allclose(along, (ahead - behind) / (2 * step), rtol=1e-4, atol=1e-6)


def test_a_copy_in_one_place_is_constant_and_another_is_the_mean(seed):
    rng = np.random.default_rng(seed)
    points = np.concatenate([np.zeros((1, 3)), rng.normal(size=(5, 3))])
    cloud = PointCloud(jnp.asarray(points), jnp.ones(6, bool))
    scores = softmax_rows(rng.normal(size=(4, 6)))
    found = pair.soft_copy(jnp.asarray(scores), cloud)
    np.testing.assert_allclose(found, scores @ points, atol=1e-14)
    # All rows point to the origin, but for weights that are less than rounding.
    nearly = np.eye(6)[np.zeros(4, int)] + 1e-30 * scores
    gap, change = jax.jvp(
        lambda s: jnp.ptp(pair.soft_copy(s, cloud), axis=0), (jnp.asarray(nearly),), (scores,)
    )
    np.testing.assert_array_equal(gap, 0)
    np.testing.assert_array_equal(change, 0)


def test_the_softmax_of_a_row_is_over_valid_columns(seed):
    scores = np.random.default_rng(seed).normal(size=(5, 7))
    valid = np.arange(7) < 4
    found = np.asarray(pair.row_softmax(jnp.asarray(scores), jnp.asarray(valid)))
    np.testing.assert_allclose(found[:, :4], softmax_rows(scores[:, :4]), atol=1e-12)
    np.testing.assert_array_equal(found[:, 4:], 0)
    np.testing.assert_array_equal(pair.row_softmax(jnp.asarray(scores), jnp.zeros(7, bool)), 0)
