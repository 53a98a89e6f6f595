import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.search import register_global
from jaxreg.search.config import SearchConfig
from jaxreg.search.description import compare, describe
from jaxreg.search.learned import init_network
from jaxreg.search.pipeline import enter, search_poses

pytestmark = [pytest.mark.float32]
CONFIG = SearchConfig(candidates=256, screened=24, aligned=8)


@jax.jit
def solve_and_grad(x, y, a, b):
    """The registration and the gradient of its rotation's first row: all tests share one program."""

    def total(x):
        found = register_global(x, y, source_mask=a, reference_mask=b, config=CONFIG)
        return jnp.sum(found.rotation[0]), found

    gradient, found = jax.grad(total, has_aux=True)(x)
    return found, gradient


def solve(*clouds):
    return solve_and_grad(*clouds)[0]


def shape(rng, n):
    """Three boxes of different sizes, glued: no symmetry."""
    sizes = np.array([[1.0, 0.3, 0.2], [0.3, 0.7, 0.25], [0.2, 0.25, 0.5]])
    centres = np.array([[0.0, 0, 0], [0.6, 0.4, 0], [-0.5, 0.1, 0.3]])
    box, side = rng.integers(0, 3, n), rng.integers(0, 3, n)
    points = rng.uniform(-0.5, 0.5, (n, 3))
    points[np.arange(n), side] = rng.choice([-0.5, 0.5], n)
    return points * sizes[box] + centres[box]


def box(rng, n):
    """A box of three different edges."""
    side, points = rng.integers(0, 3, n), rng.uniform(-0.5, 0.5, (n, 3))
    points[np.arange(n), side] = rng.choice([-0.5, 0.5], n)
    return points * [1.6, 1.1, 0.7]


def padded(points, rows, value):
    full = np.full((rows, 3), value, np.float32)
    full[: len(points)] = points
    return jnp.asarray(full), jnp.arange(rows) < len(points)


def make_pair(seed, scale=1.0):
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=rng).as_matrix()
    source, reference = scale * shape(rng, 380), scale * (shape(rng, 340) @ turn.T + 2)
    return source, reference, turn


def angle_deg(found, truth):
    return np.degrees(Rotation.from_matrix(np.asarray(found) @ truth.T).magnitude())


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_any_rotation_of_another_sampling_with_padding(scale, seed):
    source, reference, turn = make_pair(seed, scale)
    x, mask = padded(source, 400, np.nan)
    y, other = padded(reference, 400, np.nan)
    found = solve(x, y, mask, other)
    assert angle_deg(found.rotation, turn) < 2
    np.testing.assert_allclose(found.translation, 2 * scale, atol=0.05 * scale)
    assert bool(found.valid)
    confidence = np.asarray(found.confidence)
    assert np.all(confidence[380:] == 0)
    assert confidence[:380].mean() > 0.5
    moved = source @ np.asarray(found.rotation).T + np.asarray(found.translation)
    gap = np.linalg.norm(moved - np.asarray(found.correspondences)[:380], axis=1)
    assert np.median(gap) < 0.08 * scale


def test_matches_come_from_the_similarity_that_is_given(seed):
    """Of the four poses of a box, which fit alike, the one whose matches look alike."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=rng).as_matrix()
    source, reference = box(rng, 380), box(rng, 340)
    x, mask = padded(source @ turn, 400, np.nan)
    y, other = padded(reference, 400, np.nan)
    solve = jax.jit(
        lambda alike: register_global(
            x, y, source_mask=mask, reference_mask=other, similarity=alike, config=CONFIG
        )
    )
    for symmetry in ([1, 1, 1], [1, -1, -1], [-1, -1, 1]):
        gap = np.linalg.norm((source * symmetry)[:, None] - reference[None], axis=2)
        alike = np.full((400, 400), np.nan, np.float32)  # Padding may hold anything.
        alike[:380, :340] = 2 * np.exp(-((gap / 0.2) ** 2)) - 1
        found = solve(jnp.asarray(alike))
        assert angle_deg(found.rotation, np.diag(symmetry) @ turn) < 2


def test_a_network_matches_points_by_its_features(seed):
    """The search is that of the cosines of its features, and not that of the moments."""
    source, reference, _ = make_pair(seed)
    network = init_network(jax.random.key(seed))
    (x, mask), (y, other) = (padded(p, 400, np.nan) for p in (source, reference))
    masks = {"source_mask": mask, "reference_mask": other}

    @jax.jit
    def searches(x, y):
        _, a, b = enter(x, y, mask, other)
        described = (describe(p, m, unit=1.0) for p, m in ((a, mask), (b, other)))
        cosines = compare(*described, network=network).similarity
        return [
            search_poses(x, y, **masks, **features, config=CONFIG)
            for features in ({"network": network}, {"similarity": cosines}, {})
        ]

    of_network, of_cosines, of_moments = searches(x, y)
    np.testing.assert_allclose(of_network.score, of_cosines.score, atol=1e-3)
    assert np.abs(of_network.score - of_moments.score).max() > 0.01


def test_no_valid_point_gives_the_identity(seed):
    source, reference, _ = make_pair(seed)
    x, mask = padded(source, 400, np.nan)
    y, other = padded(reference, 400, np.nan)
    found = solve(x, y, mask & False, other)
    assert not bool(found.valid)
    np.testing.assert_allclose(found.transformation, np.eye(4), atol=1e-6)
    assert np.isfinite(found.correspondences).all()


def test_derivatives_are_finite_and_do_not_see_padding(seed):
    source, reference, _ = make_pair(seed)
    x, mask = padded(source, 400, np.nan)
    y, other = padded(reference, 400, np.nan)
    gradient = np.asarray(solve_and_grad(x, y, mask, other)[1])
    assert np.isfinite(gradient).all()
    assert np.any(gradient[:380] != 0)
    assert np.all(gradient[380:] == 0)


def test_large_clouds_end():
    """With LAPACK's eigenvectors of every point the second call waited forever on two cores.

    In a process of its own, which can be ended.
    """
    program = (
        "import jax, numpy as np; from jaxreg.search import register_global;"
        "rng = np.random.default_rng(0); run = jax.jit(register_global);"
        "clouds = [rng.normal(size=(1536, 3)).astype(np.float32) for _ in range(5)];"
        "print(sum(bool(run(x, y).valid) for x, y in zip(clouds, clouds[1:])))"
    )
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=True)
    assert done.stdout.strip() == "4"
