"""Matching in blocks of rows against the whole maps: equal values, equal derivatives, less memory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg import matching_blocks
from jaxreg.config import Config
from jaxreg.model import iterate, register_pair
from jaxreg.types import PointCloud
from tests.test_model import READINGS, draw_pair, small, variables_of

pytestmark = pytest.mark.loose


@pytest.fixture
def blocks(monkeypatch):
    """Calling it has every map cut into blocks that neither n nor m is a multiple of."""

    def cut():
        monkeypatch.setattr(matching_blocks, "LARGEST", 0)
        monkeypatch.setattr(matching_blocks, "BLOCK", 7)

    return cut


def registration_and_gradient(config, source, reference, masks):
    """Transform and last copy of a pair, and the derivatives of a sum over them."""
    variables = variables_of(config)
    target = np.random.default_rng(1).normal(size=source.shape)

    def value(variables, source, reference):
        clouds = PointCloud(source, masks[0]), PointCloud(reference, masks[1])
        transform, copies, _ = iterate(
            variables, *clouds, config=config, observe=lambda step, _: step.matches
        )
        loss = jnp.sum(jnp.where(masks[0][:, None], copies.copy[-1] * target, 0))
        return loss + jnp.sum(jnp.log(copies.dual_peak), where=masks[0]), transform

    # A new function each time: jit must trace it with the sizes of now.
    run = jax.jit(jax.value_and_grad(value, argnums=(0, 1, 2), has_aux=True))
    return run(variables, source, reference)


@pytest.mark.parametrize("reading", ["paper", "own 1-NN graph", "single neighbourhood"])
def test_blocks_equal_whole_maps_in_value_and_derivative(seed, blocks, reading):
    rng = np.random.default_rng(seed)
    source, reference = draw_pair(rng)
    masks = jnp.arange(len(source)) < 17, jnp.arange(len(reference)) < 22
    config = small(**READINGS[reading])
    whole = registration_and_gradient(config, source, reference, masks)
    blocks()
    in_blocks = registration_and_gradient(config, source, reference, masks)
    for a, b in zip(*map(jax.tree.leaves, (whole, in_blocks)), strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-7, atol=1e-9)


@pytest.mark.float32
def test_blocks_hold_one_map_instead_of_ten():
    n, config = 1536, small(width=16)
    variables = jax.tree.map(np.float32, variables_of(config))
    clouds = [jax.ShapeDtypeStruct((n, 3), np.float32)] * 2

    def memory():
        run = jax.jit(lambda s, r: register_pair(variables, s, r, config=Config(model=config)))
        return run.lower(*clouds).compile().memory_analysis().temp_size_in_bytes / (4 * n * n)

    whole = memory()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(matching_blocks, "LARGEST", n)
        patch.setattr(matching_blocks, "BLOCK", 64)
        assert memory() < 2.1 < 4 < whole
