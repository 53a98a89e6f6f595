import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg.geometry.neighbors import squared_distances
from tests.compiled import gaussian_normals, mean_spacing, moments, openness, standardized

RADII = (0.3, 0.6)


def bumpy(rng, n):
    uv = rng.uniform(-1, 1, (n, 2))
    return np.column_stack([uv, 0.4 * np.sin(3 * uv[:, 0]) * np.cos(2 * uv[:, 1])])


def everywhere(points):
    return jnp.ones(len(points), bool)


def described(points, mask=None, normal_radius=0.3):
    """Moments and normals of a cloud that is padded with zeros."""
    points = jnp.asarray(points)
    mask = everywhere(points) if mask is None else mask
    squared = squared_distances(points, points)
    normals = gaussian_normals(points, squared, mask, radius=normal_radius)
    return moments(points, normals, squared, mask, radii=RADII), normals


def loop_descriptor(points, radii, normal_radius):
    """The docstrings of gaussian_normals and moments, point by point."""

    def means(i, radius, values):
        weight = np.exp(-np.sum((points - points[i]) ** 2, axis=1) / (2 * (radius / 2) ** 2))
        return np.tensordot(weight / weight.sum(), values, axes=1)

    def second(i, radius):
        centroid = means(i, radius, points)
        centred = points - centroid
        return centroid, means(i, radius, centred[:, :, None] * centred[:, None, :])

    n = len(points)
    normals = np.array([np.linalg.eigh(second(i, normal_radius)[1])[1][:, 0] for i in range(n)])
    outer, rows = normals[:, :, None] * normals[:, None, :], []
    for i in range(n):
        row = []
        for r in radii:
            centroid, spread = second(i, r)
            values, vectors = np.linalg.eigh(spread)
            facing, offset, own = means(i, r, outer), centroid - points[i], normals[i]
            row += [*np.sqrt(values) / r, *np.abs(offset @ vectors) / r]
            row += [*np.sqrt(np.maximum(np.linalg.eigvalsh(facing), 0))]
            row += [np.sqrt(v @ facing @ v) for v in vectors.T]
            across = offset @ own
            row += [abs(across) / r, np.linalg.norm(offset - across * own) / r]
            row += [np.sqrt(own @ spread @ own) / r, np.sqrt(own @ facing @ own)]
        rows.append(row)
    return np.array(rows), normals


def test_equals_the_definition_point_by_point(seed):
    points = bumpy(np.random.default_rng(seed), 60)
    found, across = described(points)
    features, normals = loop_descriptor(points, RADII, 0.3)
    np.testing.assert_allclose(found, features, atol=1e-6)
    np.testing.assert_allclose(np.abs(np.sum(across * normals, axis=1)), 1, atol=1e-9)


def test_a_rigid_motion_changes_nothing_but_turns_the_normals(seed):
    rng = np.random.default_rng(seed)
    points, turn = bumpy(rng, 80), Rotation.random(random_state=rng).as_matrix()
    (still, normals), (moved, turned) = described(points), described(points @ turn.T + 0.2)
    np.testing.assert_allclose(moved, still, atol=1e-6)
    aligned = np.abs(np.sum(np.asarray(turned) * (normals @ turn.T), axis=1))
    np.testing.assert_allclose(aligned, 1, atol=1e-9)


def test_padding_changes_nothing(seed):
    points = bumpy(np.random.default_rng(seed), 50)
    mask = jnp.arange(57) < 50
    alone, _ = described(points)
    found, normals = described(np.concatenate([points, np.zeros((7, 3))]), mask)
    np.testing.assert_allclose(found[:50], alone, atol=1e-6)
    assert np.isfinite(found).all()
    assert np.all(normals[50:] == 0)
    both = standardized(found, alone, mask, None)
    np.testing.assert_allclose(both[0][:50], both[1], atol=1e-6)
    assert np.all(both[0][50:] == 0)


def test_standardized_features_have_unit_length_and_no_common_mean(seed):
    rng = np.random.default_rng(seed)
    features = [3 + 2 * rng.normal(size=(n, 5)) for n in (40, 60)]
    found = standardized(*map(jnp.asarray, features))
    both = np.concatenate(features)
    scaled = (both - both.mean(0)) / both.std(0)
    expected = scaled / np.linalg.norm(scaled, axis=1, keepdims=True)
    np.testing.assert_allclose(np.concatenate(found), expected, atol=1e-12)
    constant = standardized(jnp.ones((4, 2)), jnp.ones((3, 2)))
    assert np.all(constant[0] == 0)


def test_a_boundary_is_open_and_the_inside_is_not():
    line = np.linspace(-1, 1, 41)
    plane = np.stack([*np.meshgrid(line, line), np.zeros((41, 41))], axis=-1).reshape(-1, 3)
    normals = np.tile([0.0, 0.0, 1.0], (len(plane), 1))
    squared = squared_distances(jnp.asarray(plane), jnp.asarray(plane))
    found = openness(
        jnp.asarray(plane), jnp.asarray(normals), squared, everywhere(plane), radius=0.4
    )
    found = np.asarray(found).reshape(41, 41)
    assert found[20, 20] < 1e-6
    # The mean of half a normal distribution of deviation r / 2 is r / sqrt(2 pi).
    np.testing.assert_allclose(found[20, 0], 1 / np.sqrt(2 * np.pi), atol=0.05)


def test_spacing_is_the_mean_distance_to_the_nearest_other_point(seed):
    points = np.random.default_rng(seed).normal(size=(40, 3))
    mask = np.arange(40) < 30
    squared = jnp.asarray(squared_distances(jnp.asarray(points), jnp.asarray(points)))
    expected = np.mean(cKDTree(points[mask]).query(points[mask], 2)[0][:, 1])
    np.testing.assert_allclose(mean_spacing(squared, jnp.asarray(mask)), expected, rtol=1e-9)
    for few in (0, 1):
        assert mean_spacing(squared, jnp.arange(40) < few) == 0
