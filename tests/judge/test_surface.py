"""What the judge knows about one cloud, against plain numpy and trees."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxreg.judge.surface import every
from tests.judge.clouds import arbitrary, examined, examined_as, neighbors_of
from tests.scenes import shape


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def test_variation_is_the_share_of_the_smallest_eigenvalue(rng):
    """Where the normal is the eigenvector: everywhere but on the rod, which has none."""
    points = shape(rng, 300)
    found = np.asarray(examined(points).variation)
    near = np.concatenate([np.arange(300)[:, None], neighbors_of(points)], axis=1)
    for i in range(0, 225, 5):
        values = np.linalg.eigvalsh(np.cov(points[near[i]].T, bias=True))
        if values[1] - values[0] > 2e-3 * values.sum():
            assert found[i] == pytest.approx(values[0] / values.sum(), abs=1e-9)
    assert (found >= 0).all()
    assert (found <= 1 / 3).all()


def test_a_plane_has_no_variation_and_a_ball_much(rng):
    plane, ball = rng.normal(size=(2, 200, 3))
    normal = np.array([0.48, 0.6, 0.64])
    plane -= np.outer(plane @ normal, normal)
    assert examined(plane).variation.max() < 1e-12
    # No direction of an isotropic neighbourhood has less than another: a third each.
    up = np.tile(normal, (200, 1))
    assert np.mean(examined(ball, up, k=199).variation) == pytest.approx(1 / 3, abs=0.1)


def test_rarity_is_one_over_the_share_that_faces_the_same_way(rng):
    """A wall is common, its edge is not; signs do not matter, and a wild normal counts as one in 50."""
    normals = np.tile([0.0, 0.0, 1.0], (200, 1))
    normals[150:199] = [0.6, 0.8, 0.0]
    normals[199] = [1.0, 0.0, 0.0]
    normals[:150] += rng.normal(0, 0.02, (150, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= rng.choice([-1.0, 1.0], (200, 1))
    found = examined(rng.normal(size=(200, 3)), normals).rarity
    expected = np.repeat([200 / 150, 200 / 49, 50.0], [150, 49, 1])
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_a_surface_ends_at_its_edge_and_not_inside():
    axis = np.linspace(-1, 1, 15)
    grid = np.stack([*np.meshgrid(axis, axis), np.zeros((15, 15))], axis=-1).reshape(-1, 3)
    interior = np.asarray(examined(grid).interior).reshape(15, 15)
    assert interior[4:-4, 4:-4].min() > 0.9
    assert max(interior[0].max(), interior[:, 0].max(), interior[-1].max()) < 0.1


@pytest.mark.parametrize("k", [2, 4, 16])
def test_spacing_is_the_median_distance_to_the_fourth_neighbour(rng, k):
    points = rng.normal(size=(151, 3))  # one of them is the median
    nearest = cKDTree(points).query(points, k=5)[0]
    expected = np.median(nearest[:, min(k, 4)])
    assert examined(points, points, k=k).spacing == pytest.approx(expected, rel=1e-12)


def test_padding_changes_nothing_whatever_it_holds(rng):
    points = shape(rng, 160)
    alone = examined(points)
    neighbors = np.concatenate([neighbors_of(points), np.full((5, 16), 3, np.int32)])
    fill = np.array([np.nan, 1e9, -np.inf])
    given = [
        jnp.asarray(np.concatenate([part, np.tile(fill, (5, 1))]))
        for part in (points, alone.normals)
    ]
    found = examined_as(*given, jnp.asarray(neighbors), jnp.arange(165) < 160)
    for name, value in found._asdict().items():
        assert np.isfinite(value).all(), name
        part = value if name == "spacing" else value[:160]
        np.testing.assert_allclose(part, getattr(alone, name), atol=1e-12, err_msg=name)


def test_a_cloud_without_a_point_is_finite(rng):
    points = jnp.asarray(rng.normal(size=(30, 3)))
    found = examined_as(points, points, neighbors_of(points), jnp.zeros(30, bool))
    assert all(np.isfinite(value).all() for value in found)
    assert found.spacing == 0


def test_every_nth_point_keeps_the_spacing_of_all(rng):
    cloud = arbitrary(rng, 20, 0.25)
    found = every(cloud, 3)
    for name in set(found._fields) - {"spacing"}:
        np.testing.assert_array_equal(
            getattr(found, name), [getattr(cloud, name)[i] for i in range(0, 20, 3)]
        )
    assert found.spacing == 0.25
