import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.search.candidates import select_candidates


def loop_candidates(similarity, matches):
    """Margin of every distinct match of a row or a column; the row's margin where in both."""
    found = {}
    for i, row in enumerate(similarity):
        order = np.argsort(-row)
        for j in order[:matches]:
            found[i, j] = row[j] - row[order[matches]]
    for j, column in enumerate(similarity.T):
        order = np.argsort(-column)
        for i in order[:matches]:
            found.setdefault((i, j), column[i] - column[order[matches]])
    for i, j in found:
        if similarity[i].max() == similarity[i, j] == similarity[:, j].max():
            found[i, j] += 0.05
    return found


@pytest.mark.parametrize("matches", [1, 3])
def test_keeps_the_clearest_matches_once(matches, seed):
    similarity = np.random.default_rng(seed).uniform(-1, 1, (20, 30))
    expected = loop_candidates(similarity, matches)
    ranked = sorted(expected, key=expected.get, reverse=True)
    found = select_candidates(jnp.asarray(similarity), matches=matches, keep=15)
    assert np.all(found.mask)
    pairs = list(zip(found.source_index.tolist(), found.reference_index.tolist(), strict=True))
    assert pairs == ranked[:15]
    every = select_candidates(jnp.asarray(similarity), matches=matches, keep=1000)
    assert int(every.mask.sum()) == len(expected)


def test_padding_is_never_a_candidate(seed):
    similarity = np.random.default_rng(seed).uniform(-1, 1, (12, 10))
    padded = np.pad(similarity, ((0, 3), (0, 4)), constant_values=0.99)
    found = select_candidates(
        jnp.asarray(padded), jnp.arange(15) < 12, jnp.arange(14) < 10, matches=2, keep=16
    )
    alone = select_candidates(jnp.asarray(similarity), matches=2, keep=16)
    assert np.array_equal(found.source_index, alone.source_index)
    assert np.array_equal(found.reference_index, alone.reference_index)
    assert np.all(found.mask)


def test_too_few_points_are_named():
    with pytest.raises(ValueError, match="matches = 3"):
        select_candidates(jnp.ones((3, 9)), matches=3, keep=5)
