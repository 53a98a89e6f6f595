"""What holds for every peer: padding, empty clouds, many pairs, and the loss."""

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
    rng = np.random.default_rng(seed)
    variables = draw_variables(MODULES[name], SMALL[name], rng)
    source, reference = rng.uniform(-1, 1, (13, 3)), rng.uniform(-1, 1, (11, 3))
    whole = program(name)(variables, source, reference, np.ones(13, bool), np.ones(11, bool))
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


def mean_loss(params, statistics, sources, references, truths, *, name):
    config = Config(network=name, **{name: SMALL[name]})

    def one(source, reference, truth):
        variables = {"params": params, "batch_stats": statistics}
        return by_name.loss(variables, source, reference, truth, config=config)[0]

    return jnp.mean(jax.vmap(one, axis_name=BATCH_AXIS)(sources, references, truths))


@pytest.mark.parametrize("name", [n for n in by_name.TRAINED if n != "paper"])
def test_a_loss_has_the_gradient_that_differences_say_and_padding_leaves_it_alone(name, seed):
    rng = np.random.default_rng(seed)
    variables = draw_variables(MODULES[name], SMALL[name], rng)
    identity = RigidTransform(np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)))
    points = rng.uniform(-1, 1, (2, 12, 3))
    noise = rng.normal(0, 0.02, (2, 12, 3)) + (np.arange(12) % 2)[None, :, None]
    clouds = (
        PointCloud(points, np.ones((2, 12), bool)),
        PointCloud(points + noise, np.ones((2, 12), bool)),
    )
    value = jax.jit(functools.partial(mean_loss, name=name))
    gradient = jax.jit(jax.grad(functools.partial(mean_loss, name=name)))
    rest = (variables["batch_stats"], *clouds, identity)
    found = gradient(variables["params"], *rest)
    direction = jax.tree.map(lambda x: rng.normal(size=x.shape), variables["params"])
    along = sum(
        jnp.vdot(g, d) for g, d in zip(*map(jax.tree.leaves, (found, direction)), strict=True)
    )
    step = 1e-6
    ahead, behind = (
        value(jax.tree.map(lambda x, d, s=s: x + s * d, variables["params"], direction), *rest)
        for s in (step, -step)
    )
    np.testing.assert_allclose(along, (ahead - behind) / (2 * step), rtol=2e-4, atol=1e-6)
    for leaf in jax.tree.leaves(found):
        assert np.isfinite(leaf).all()

    hidden = [
        PointCloud(np.concatenate([x.points, np.full((2, 12, 3), np.nan)], axis=1),
                   np.concatenate([x.mask, np.zeros((2, 12), bool)], axis=1))
        for x in clouds
    ]  # fmt: skip
    if (
        name != "idam"
    ):  # It keeps a share of the rows in training, and the pairs there have no padding.
        again = value(variables["params"], rest[0], *hidden, identity)
        np.testing.assert_allclose(again, value(variables["params"], *rest), rtol=1e-9)


def test_the_softmax_of_a_row_is_over_valid_columns(seed):
    scores = np.random.default_rng(seed).normal(size=(5, 7))
    valid = np.arange(7) < 4
    found = np.asarray(pair.row_softmax(jnp.asarray(scores), jnp.asarray(valid)))
    np.testing.assert_allclose(found[:, :4], softmax_rows(scores[:, :4]), atol=1e-12)
    np.testing.assert_array_equal(found[:, 4:], 0)
    np.testing.assert_array_equal(pair.row_softmax(jnp.asarray(scores), jnp.zeros(7, bool)), 0)
