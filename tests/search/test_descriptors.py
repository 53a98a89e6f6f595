import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from tests.compiled import moment_descriptors, openness, standardized

RADII = (0.3, 0.6)


def bumpy(rng, n):
    uv = rng.uniform(-1, 1, (n, 2))
    return np.column_stack([uv, 0.4 * np.sin(3 * uv[:, 0]) * np.cos(2 * uv[:, 1])])


def loop_descriptor(points, radii, normal_radius):
    """The docstring of moment_descriptors, point by point."""

    def means(i, radius, values):
        weight = np.exp(-np.sum((points - points[i]) ** 2, axis=1) / (2 * (radius / 2) ** 2))
        return np.tensordot(weight / weight.sum(), values, axes=1)

    def moments(i, radius):
        centroid = means(i, radius, points)
        centred = points - centroid
        return centroid, means(i, radius, centred[:, :, None] * centred[:, None, :])

    n = len(points)
    normals = np.array([np.linalg.eigh(moments(i, normal_radius)[1])[1][:, 0] for i in range(n)])
    outer, rows = normals[:, :, None] * normals[:, None, :], []
    for i in range(n):
        row = []
        for r in radii:
            centroid, spread = moments(i, r)
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
    found = moment_descriptors(jnp.asarray(points), radii=RADII, normal_radius=0.3)
    features, normals = loop_descriptor(points, RADII, 0.3)
    np.testing.assert_allclose(found.features, features, atol=1e-6)
    np.testing.assert_allclose(np.abs(np.sum(found.normals * normals, axis=1)), 1, atol=1e-9)


def test_a_rigid_motion_changes_nothing_but_turns_the_normals(seed):
    rng = np.random.default_rng(seed)
    points, turn = bumpy(rng, 80), Rotation.random(random_state=rng).as_matrix()
    still = moment_descriptors(jnp.asarray(points), radii=RADII, normal_radius=0.3)
    moved = moment_descriptors(jnp.asarray(points @ turn.T + 5), radii=RADII, normal_radius=0.3)
    np.testing.assert_allclose(moved.features, still.features, atol=1e-6)
    aligned = np.abs(np.sum(np.asarray(moved.normals) * (still.normals @ turn.T), axis=1))
    np.testing.assert_allclose(aligned, 1, atol=1e-9)


def test_padding_changes_nothing_and_leaks_nowhere(seed):
    points = jnp.asarray(bumpy(np.random.default_rng(seed), 50))
    padded = jnp.concatenate([points, jnp.full((7, 3), jnp.nan)])
    mask = jnp.arange(57) < 50
    alone = moment_descriptors(points, radii=RADII, normal_radius=0.3)
    found = moment_descriptors(padded, mask, radii=RADII, normal_radius=0.3)
    np.testing.assert_allclose(found.features[:50], alone.features, atol=1e-6)
    assert np.isfinite(found.features).all()
    both = standardized(found.features, alone.features, mask, None)
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


def test_a_rim_is_open_and_the_inside_is_not():
    line = np.linspace(-1, 1, 41)
    plane = np.stack([*np.meshgrid(line, line), np.zeros((41, 41))], axis=-1).reshape(-1, 3)
    normals = np.tile([0.0, 0.0, 1.0], (len(plane), 1))
    mask = jnp.ones(len(plane), bool)
    found = openness(jnp.asarray(plane), jnp.asarray(normals), mask, radius=0.4)
    found = np.asarray(found).reshape(41, 41)
    assert found[20, 20] < 1e-6
    # The mean of half a normal distribution of deviation r / 2 is r / sqrt(2 pi).
    np.testing.assert_allclose(found[20, 0], 1 / np.sqrt(2 * np.pi), atol=0.05)


def test_derivatives_are_zero_and_finite(seed):
    points = jnp.asarray(bumpy(np.random.default_rng(seed), 30))
    total = lambda p: jnp.sum(moment_descriptors(p, radii=RADII, normal_radius=0.3).features)  # noqa: E731
    assert np.all(jax.jit(jax.grad(total))(points) == 0)
