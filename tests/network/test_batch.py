"""Many pairs in a stream: every result against `register_pair` of that pair alone."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg import register_batch, register_pair
from jaxreg.config import ModelConfig
from jaxreg.network import batch
from jaxreg.network.model import init_variables

pytestmark = pytest.mark.float32

CONFIG = ModelConfig(channels=(8, 8), width=16, n_inliers=20, iterations=1)
SIZES = [(40, 44), (60, 50), (90, 41), (41, 40), (44, 200)]
"""Three buckets: (64, 64) three times, (96, 96) and (64, 224)."""


@pytest.fixture(scope="module")
def variables():
    return init_variables(jax.random.key(0), CONFIG)


def clouds(seed, sizes):
    rng = np.random.default_rng(seed)
    return [rng.normal(size=(n, 3)).astype(np.float32) for n in sizes]


one = jax.jit(functools.partial(register_pair, config=CONFIG))


def alone(variables, source, reference, **masks):
    given = jax.tree.map(jnp.asarray, (source, reference, masks))
    return one(variables, *given[:2], **given[2])


def close(found, want):
    assert found.confidence.shape == want.confidence.shape
    for one, other in zip(found, want, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-4)


@pytest.mark.parametrize("together", [None, 2])
def test_ragged_pairs_come_back_in_order_with_one_program_a_bucket(variables, seed, together):
    columns = enumerate(zip(*SIZES, strict=True))
    sources, references = (clouds(seed + side, sizes) for side, sizes in columns)
    before = batch._registered._cache_size()
    found = list(register_batch(variables, sources, references, config=CONFIG, together=together))
    assert batch._registered._cache_size() - before == 3
    assert len(found) == len(SIZES)
    for result, source, reference in zip(found, sources, references, strict=True):
        close(result, alone(variables, source, reference))
    list(
        register_batch(variables, sources[::-1], references[::-1], config=CONFIG, together=together)
    )
    assert batch._registered._cache_size() - before == 3


def test_padded_arrays_take_their_masks(variables, seed):
    sources, references = (np.stack(clouds(seed + side, [44, 44])) for side in (0, 1))
    mask = np.arange(44)[None, :] < np.array([[44], [40]])
    sources[1, 40:] = np.nan
    found = list(register_batch(variables, sources, references, config=CONFIG, source_masks=mask))
    close(found[1], alone(variables, sources[1], references[1], source_mask=mask[1]))
    assert (found[1].confidence[40:] == 0).all()


def test_a_stream_without_end_is_read_as_it_is_needed(variables, seed):
    source, reference = clouds(seed, [40, 44])
    read = itertools.count()

    def stream():
        while next(read) >= 0:
            yield source

    results = register_batch(variables, stream(), itertools.repeat(reference), config=CONFIG)
    assert len(list(itertools.islice(results, 3))) == 3
    assert next(read) == 3


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"references": 1}, r"there is no references\[1\]"),
        ({"sources": [np.zeros((5, 2), np.float32)] * 2}, r"sources\[0\] has shape \(5, 2\)"),
        ({"sources": [np.zeros((5, 3), int)] * 2}, r"sources\[0\] has .*int64.*float32 or float64"),
        ({"source_masks": [np.ones(40, int)] * 2}, r"source_masks\[0\] has .*int64.*bools"),
    ],
)
def test_wrong_input_is_named_by_its_number(variables, seed, change, told):
    given = {"sources": clouds(seed, [40, 40]), "references": clouds(seed, [44, 44])}
    if change.get("references") == 1:
        change = {"references": given["references"][:1]}
    with pytest.raises(ValueError, match=told):
        list(register_batch(variables, **(given | change), config=CONFIG))
