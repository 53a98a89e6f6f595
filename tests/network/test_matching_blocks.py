"""Matching in blocks of rows against whole maps: equal values, equal derivatives, less memory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.config import Config
from jaxreg.network import matching_blocks
from jaxreg.network.matching import feature_distance, incidence, match, matching_maps
from jaxreg.network.matching_blocks import Branch, match_in_blocks
from jaxreg.network.model import register_pair
from tests.network.test_model import small
from tests.scenes import variables_of

N, M, C, K, ALPHA = 20, 24, 6, 3, 0.7


def whole_maps(branches, reference, valid):
    distances = [feature_distance(b.source, b.reference) for b in branches]
    graphs = [(b.source_graph, b.reference_graph) for b in branches]
    shared = len(branches) == 1 or graphs[0][0] is graphs[1][0]
    maps = matching_maps(
        distances[0],
        distances[1] if len(branches) > 1 else None,
        *graphs[0],
        alpha=ALPHA,
        nearest_graphs=None if shared else graphs[1],
        valid=valid,
    )
    return match(maps.dual, maps.final, reference)


def blocks(branches, reference, valid):
    return match_in_blocks(branches, reference, alpha=ALPHA, valid=valid)


@pytest.mark.parametrize("patch", ["single", "shared graphs", "own graphs"])
def test_blocks_equal_whole_maps_in_value_and_derivative(seed, monkeypatch, patch):
    # Neither n nor m is a multiple of the block.
    monkeypatch.setattr(matching_blocks, "BLOCK", 7)
    rng = np.random.default_rng(seed)
    count = 1 if patch == "single" else 2
    features = [(rng.normal(size=(N, C)), rng.normal(size=(M, C))) for _ in range(count)]
    drawn = [[rng.integers(0, n, (n, K)).astype(np.int32) for n in (N, M)] for _ in range(2)]
    reference, target = rng.normal(size=(M, 3)), rng.normal(size=(N, 3))
    valid = jnp.arange(M) < M - 2

    def value_and_gradient(function):
        def value(features, reference):
            graphs = [[incidence(jnp.asarray(idx)) for idx in pair] for pair in drawn]
            graphs = graphs if patch == "own graphs" else graphs[:1] * 2
            branches = tuple(Branch(*f, *g) for f, g in zip(features, graphs, strict=False))
            matches = function(branches, reference, valid)
            peaks = jnp.log(matches.dual_peak) + matches.final_peak
            return jnp.sum(matches.copy * target) + jnp.sum(peaks), matches

        return jax.jit(jax.value_and_grad(value, argnums=(0, 1), has_aux=True))(features, reference)

    expected, got = value_and_gradient(whole_maps), value_and_gradient(blocks)
    for a, b in zip(*map(jax.tree.leaves, (got, expected)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)


@pytest.mark.loose
@pytest.mark.float32
def test_large_clouds_hold_one_map_instead_of_ten(monkeypatch):
    n, config = 3072, small(width=16, iterations=1)
    variables = jax.tree.map(np.float32, variables_of(config))
    clouds = [jax.ShapeDtypeStruct((n, 3), np.float32)] * 2

    def maps_in_memory():
        run = jax.jit(lambda s, r: register_pair(variables, s, r, config=Config(model=config)))
        memory = run.lower(*clouds).compile().memory_analysis()
        return memory.temp_size_in_bytes / (4 * n * n)

    whole = maps_in_memory()
    monkeypatch.setattr(matching_blocks, "LARGEST", n)
    monkeypatch.setattr(matching_blocks, "BLOCK", 64)
    assert maps_in_memory() < 2 < 4 < whole
