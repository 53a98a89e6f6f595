import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.search.config import SearchConfig
from jaxreg.search.description import compare, describe
from jaxreg.search.pipeline import search_poses
from jaxreg.search.stages import search_described
from tests.search.clouds import make_pair

FIELDS = ("points", "normals", "openness", "features", "mask", "spacing")
described = jax.jit(lambda points, mask, unit: describe(points, mask, unit=unit))
with_normals = jax.jit(lambda points, normals: describe(points, unit=1.0, normals=normals))
EVERY = jnp.ones(60, bool)


def bumpy(rng, n=60):
    uv = rng.uniform(-1, 1, (n, 2))
    return np.column_stack([uv, 0.4 * np.sin(3 * uv[:, 0]) * np.cos(2 * uv[:, 1])])


def assert_alike(found, expected, rows=slice(None)):
    for field in FIELDS:
        a, b = np.asarray(getattr(found, field)), np.asarray(getattr(expected, field))
        # Where a neighbourhood is nearly round, rounding turns its normal by more than a millionth.
        np.testing.assert_allclose(a if a.ndim == 0 else a[rows], b, atol=1e-5, err_msg=field)


def test_the_unit_is_a_unit(seed):
    points = bumpy(np.random.default_rng(seed))
    found, alone = described(8.0 * points, EVERY, 8.0), described(points, EVERY, 1.0)
    assert_alike(found, alone)
    np.testing.assert_array_equal(found.grid.index, alone.grid.index)


def test_padding_changes_nothing_and_leaks_nowhere(seed):
    points = bumpy(np.random.default_rng(seed))
    padded = np.concatenate([points, np.full((7, 3), np.nan)])
    found, alone = described(padded, jnp.arange(67) < 60, 1.0), described(points, EVERY, 1.0)
    assert_alike(found, alone, slice(60))
    np.testing.assert_array_equal(found.grid.index, alone.grid.index)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))


def test_given_normals_are_used_and_their_sign_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    points, sign = bumpy(rng), rng.choice([-1.0, 1.0], (60, 1))
    alone = described(points, EVERY, 1.0)
    found = with_normals(points, sign * alone.normals)
    np.testing.assert_array_equal(found.normals, sign * alone.normals)
    np.testing.assert_allclose(found.features, alone.features, atol=1e-9)
    turned = with_normals(points, jnp.roll(alone.normals, 1, axis=1))
    assert np.abs(turned.features - alone.features).max() > 0.1


def test_descriptions_are_constants_of_every_derivative(seed):
    points = bumpy(np.random.default_rng(seed))

    @jax.jit
    @jax.grad
    def gradient(points):
        found = describe(points, EVERY, unit=1.0)
        return jnp.sum(found.features) + jnp.sum(found.normals) + found.spacing

    assert np.all(gradient(points) == 0)


def test_cosines_are_those_of_standardised_features(seed):
    rng = np.random.default_rng(seed)
    a, b = (described(bumpy(rng), EVERY, 1.0) for _ in range(2))
    both = np.concatenate([a.features, b.features])
    both = (both - both.mean(axis=0)) / both.std(axis=0)
    both /= np.linalg.norm(both, axis=1, keepdims=True)
    found = compare(a, b)
    np.testing.assert_allclose(found.similarity, both[:60] @ both[60:].T, atol=1e-9)
    local = np.concatenate([a.features, b.features])[:, :16]
    local = (local - local.mean(axis=0)) / local.std(axis=0)
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    np.testing.assert_allclose(found.reference.local, local[60:], atol=1e-9)


@pytest.mark.slow
def test_clouds_described_one_by_one_give_the_poses_of_the_search(seed):
    """Around their own origins, in one unit; then the frame is left by hand."""
    source, reference = (points[:150] for points in make_pair(seed, scale=30.0)[:2])
    config = SearchConfig(unit=40.0, candidates=96, screened=12, aligned=4)
    centres = [points.mean(axis=0) for points in (source, reference)]
    whole = jax.jit(lambda x, y: search_poses(x, y, config=config))(source, reference)
    once = jax.jit(lambda points, unit: describe(points, unit=unit, config=config))
    both = (once(p - c, 40.0) for p, c in zip((source, reference), centres, strict=True))
    found = jax.jit(lambda a, b: search_described(a, b, config=config))(*both)
    np.testing.assert_allclose(found.score, whole.score, atol=1e-6)
    np.testing.assert_allclose(found.poses.rotation, whole.poses.rotation, atol=1e-6)
    rotation, translation = (np.asarray(part) for part in found.poses)
    shift = translation * 40 + centres[1] - rotation @ centres[0]
    np.testing.assert_allclose(shift, whole.poses.translation, atol=1e-4)


@pytest.mark.untyped
def test_what_does_not_fit_is_named():
    points = jnp.ones((9, 3))
    with pytest.raises(ValueError, match="normals must have shape"):
        describe(points, unit=1.0, normals=points[:8])
    with pytest.raises(ValueError, match="points must have shape"):
        describe(points[None], unit=1.0)
    with pytest.raises(ValueError, match="mask must be bool of shape"):
        describe(points, jnp.ones(8, bool), unit=1.0)
    one, other = (describe(points, unit=1.0, config=SearchConfig(radii=r)) for r in ((1,), (1, 2)))
    with pytest.raises(ValueError, match="describe both with the same radii"):
        compare(one, other)
