"""Candidate correspondences against a loop."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.search.matches import match_histograms

pytestmark = [pytest.mark.slow]


def shares(rng, n):
    values = rng.random((n, 9)) ** 4
    return values / values.sum(axis=1, keepdims=True)


def loop(source, reference, kept):
    likeness = np.sqrt(source) @ np.sqrt(reference).T
    forward, backward = np.argmax(likeness, axis=1), np.argmax(likeness, axis=0)
    margin = lambda row: np.sort(row)[-1] - np.sort(row)[-3]  # noqa: E731
    found = {}
    for i, j in enumerate(forward):
        found[i, j] = margin(likeness[i]) + 10 * (backward[j] == i)
    for j, i in enumerate(backward):
        found.setdefault((i, j), margin(likeness[:, j]))
    return sorted(found, key=found.get, reverse=True)[:kept]


@pytest.mark.parametrize("kept", [10, 200])
def test_against_a_loop(seed, kept):
    rng = np.random.default_rng(seed)
    source, reference = shares(rng, 30), shares(rng, 41)
    found = match_histograms(
        jnp.asarray(np.pad(source, ((0, 5), (0, 0)))),
        jnp.asarray(np.pad(reference, ((0, 3), (0, 0)))),
        jnp.arange(35) < 30,
        jnp.arange(44) < 41,
        kept=kept,
    )
    pairs = np.stack([found.source_index, found.reference_index], axis=1)[np.asarray(found.mask)]
    assert [tuple(p) for p in pairs] == loop(source, reference, kept)


def test_nothing_valid_gives_no_candidate():
    rows = jnp.ones((4, 9)) / 9
    found = match_histograms(rows, rows, jnp.zeros(4, bool), jnp.ones(4, bool), kept=6)
    assert not np.any(found.mask)
