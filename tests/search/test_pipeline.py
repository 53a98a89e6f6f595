import dataclasses
import functools
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
from jaxreg.search.pipeline import enter, search_described, search_poses
from jaxreg.types import RigidTransform

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


@functools.partial(jax.jit, static_argnames="config")
def search_of(x, y, a, b, alike, also, max_angle, config=CONFIG):
    """All searches with a similarity share one program."""
    return search_poses(
        x,
        y,
        source_mask=a,
        reference_mask=b,
        similarity=alike,
        also=also,
        max_angle=max_angle,
        config=config,
    )


@pytest.fixture
def boxes(seed):
    """Two samplings of a box, padded, and which pose lays the first on the other."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(np.radians(50) * np.array([0.6, 0.0, 0.8])).as_matrix()
    source, reference = box(rng, 380), box(rng, 340)
    return padded(source @ turn, 400, np.nan), padded(reference, 400, np.nan), source, turn


def likeness(source, reference):
    """Cosines that make points alike that are near each other; NaN for padding."""
    gap = np.linalg.norm(source[:, None] - reference[None], axis=2)
    alike = np.full((400, 400), np.nan, np.float32)
    alike[: len(source), : len(reference)] = 2 * np.exp(-((gap / 0.2) ** 2)) - 1
    return jnp.asarray(alike)


UNMOVED = RigidTransform(jnp.eye(3, dtype=jnp.float32), jnp.zeros(3, jnp.float32))
SYMMETRIES = ([1, 1, 1], [1, -1, -1], [-1, -1, 1], [-1, 1, -1])


def test_matches_come_from_the_similarity_that_is_given(boxes):
    """Of the four poses of a box, which fit alike, the one whose matches look alike."""
    (x, mask), (y, other), source, turn = boxes
    for symmetry in SYMMETRIES:
        alike = likeness(source * symmetry, np.asarray(y)[:340])
        found = search_of(x, y, mask, other, alike, UNMOVED, np.float32(np.pi))
        assert angle_deg(found.poses.rotation[0], np.diag(symmetry) @ turn) < 5
        assert np.all(found.allowed)


def test_poses_beyond_the_largest_angle_come_last(boxes):
    """The matches say half a turn and 50 degrees, but only 80 are allowed."""
    (x, mask), (y, other), source, turn = boxes
    for symmetry in SYMMETRIES[1:]:
        alike = likeness(source * symmetry, np.asarray(y)[:340])
        alike = jnp.maximum(alike, likeness(source, np.asarray(y)[:340]) - 0.1)
        found = search_of(x, y, mask, other, alike, UNMOVED, np.float32(np.radians(80)))
        turned = Rotation.from_matrix(found.poses.rotation).magnitude()
        allowed, score = np.asarray(found.allowed), np.asarray(found.score)
        np.testing.assert_array_equal(allowed, turned <= np.radians(80))
        assert angle_deg(found.poses.rotation[0], turn) < 5
        assert not np.any(np.diff(allowed.astype(int)) > 0)
        for part in (score[allowed], score[~allowed]):
            assert np.all(np.diff(part) <= 0)


def test_a_pose_that_no_match_leads_to_can_be_given(boxes):
    (x, mask), (y, other), source, turn = boxes
    alike = likeness(source * [1, -1, -1], np.asarray(y)[:340])
    near = Rotation.from_matrix(turn) * Rotation.from_rotvec([0.05, 0, 0.03])
    also = RigidTransform(jnp.float32(near.as_matrix()), jnp.zeros(3, jnp.float32))
    found = search_of(x, y, mask, other, alike, also, np.float32(np.pi))
    assert min(angle_deg(rotation, turn) for rotation in found.poses.rotation) < 5


def test_described_clouds_give_the_poses_of_the_search(seed):
    """Described one by one, around their own origins, in the same unit."""
    source, reference, _ = make_pair(seed, scale=30.0)
    (x, mask), (y, other) = (padded(p, 400, np.nan) for p in (source, reference))
    masks = {"source_mask": mask, "reference_mask": other}
    centres = [points.mean(axis=0).astype(np.float32) for points in (source, reference)]
    unit = np.float32(40.0)
    config = dataclasses.replace(CONFIG, unit=float(unit))
    whole = jax.jit(lambda x, y: search_poses(x, y, **masks, config=config))(x, y)
    once = jax.jit(lambda points, mask, unit: describe(points, mask, unit=unit, config=config))
    described = once(x - centres[0][None], mask, unit), once(y - centres[1][None], other, unit)
    found = jax.jit(lambda a, b: search_described(a, b, config=config))(*described)
    np.testing.assert_allclose(found.score, whole.score, atol=2e-3)
    np.testing.assert_allclose(found.poses.rotation[0], whole.poses.rotation[0], atol=2e-3)
    inside = centres[0] @ np.asarray(found.poses.rotation[0]).T
    shift = np.asarray(found.poses.translation[0]) * unit + centres[1] - inside
    np.testing.assert_allclose(shift, whole.poses.translation[0], atol=0.1)


def test_a_network_matches_points_by_its_features(seed):
    """The search is that of the cosines of its features, and not that of the moments."""
    source, reference, _ = make_pair(seed)
    network = init_network(jax.random.key(seed))
    (x, mask), (y, other) = (padded(p, 400, np.nan) for p in (source, reference))

    @jax.jit
    def both(x, y):
        _, a, b = enter(x, y, mask, other)
        described = [describe(p, m, unit=1.0, config=CONFIG) for p, m in ((a, mask), (b, other))]
        cosines = [compare(*described, network=n).similarity for n in (network, None)]
        return search_described(*described, network=network, config=CONFIG), cosines

    of_network, cosines = both(x, y)
    of_its_cosines, of_moments = (
        search_of(x, y, mask, other, c, None, np.float32(np.pi)) for c in cosines
    )
    np.testing.assert_allclose(of_network.score, of_its_cosines.score, atol=1e-3)
    assert np.abs(of_network.score - of_moments.score).max() > 0.01


@pytest.mark.untyped
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"source_mask": np.ones(39, bool)}, "the mask of source must be bool of shape"),
        ({"reference_mask": np.ones(30)}, "the mask of reference must be bool"),
        ({"similarity": np.ones((30, 40), np.float32)}, r"shape \(40, 30\), a row for every"),
        ({"max_angle": 80}, "max_angle = 80: give an angle in"),
        ({"max_angle": 0.0}, "max_angle = 0.0"),
        ({"also": RigidTransform(np.eye(4), np.zeros(3))}, "also must be one transform"),
        ({"config": SearchConfig(radii=(0.2, 0.4))}, "choose as many radii"),
        ({"network": {"lift": np.ones((49, 64), np.float32)}}, "no weights 'far_add'"),
    ],
)
def test_what_does_not_fit_is_named(options, message):
    x, y = np.ones((40, 3), np.float32), np.ones((30, 3), np.float32)
    options = {"network": init_network(jax.random.key(0))} | options
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(lambda: search_poses(x, y, **options))


@pytest.mark.untyped
@pytest.mark.parametrize("shape", [(40, 2), (2, 40, 3), (0, 3)])
def test_what_is_no_cloud_is_named(shape):
    cloud, wrong = np.ones((40, 3), np.float32), np.ones(shape, np.float32)
    for clouds, name in (((wrong, cloud), "source"), ((cloud, wrong), "reference")):
        with pytest.raises(ValueError, match=f"{name} must have shape"):
            jax.eval_shape(lambda clouds=clouds: register_global(*clouds))
    with pytest.raises(ValueError, match="40 and 3 rows, and the search needs 4"):
        jax.eval_shape(lambda: register_global(cloud, cloud[:3]))
    with pytest.raises(ValueError, match="must be of floats, got int32"):
        jax.eval_shape(lambda: register_global(cloud.astype(np.int32), cloud))


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
