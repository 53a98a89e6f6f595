"""What only dense points show: mirror images and other sizes, and that right poses are left alone."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.scans import dense, prepare
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.pair import register
from jaxreg.types import RigidTransform
from tests.scenes import moved, pose

NARROW = RegisterConfig(wide=None)


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def plates(rng, n, noise=0.003):
    """Samples of a plate, a wall at one end of it and two unlike pegs: no symmetry."""
    sizes = np.array([[2.0, 1.2, 0.0], [0.0, 1.2, 1.0], [0.3, 0.2, 0.5], [0.5, 0.3, 0.25]])
    corners = np.array([[-1.0, -0.6, 0.0], [-1.0, -0.6, 0.0], [0.3, 0.1, 0.0], [0.2, -0.5, 0.0]])
    which = rng.choice(4, n, p=[0.5, 0.25, 0.12, 0.13])
    u = rng.uniform(size=(n, 3))
    pegs = which > 1
    face = rng.integers(0, 3, n)
    u[pegs, face[pegs]] = rng.integers(0, 2, pegs.sum())
    return corners[which] + u * sizes[which] + rng.normal(scale=noise, size=(n, 3))


def stone(rng, n):
    """Samples of a closed body with bumps, the same for every `rng`."""
    form = np.random.default_rng(5)
    bumps = form.normal(size=(8, 3))
    bumps /= np.linalg.norm(bumps, axis=1, keepdims=True)
    heights = form.uniform(-0.2, 0.3, 8)
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * (1 + np.exp(6 * (directions @ bumps.T - 1)) @ heights)[:, None]


def prepared(points):
    return prepare.prepare(points, config=NARROW)


IDENTITY = RigidTransform(np.eye(3), np.zeros(3))


def between(source, reference, pose):
    """A pose of the clouds as one of the centred clouds."""
    shift = pose.rotation @ source.centre + pose.translation - reference.centre
    return RigidTransform(pose.rotation, shift)


def test_the_right_pose_of_two_samplings_agrees(rng):
    source, reference = (prepared(plates(rng, 6000)) for _ in range(2))
    found = dense.agreement(source, reference, between(source, reference, IDENTITY))
    assert found.compared > 0.95
    assert found.off < 0.02
    assert not found.suspicious


def test_points_that_lie_off_are_those_that_are_counted(rng):
    """A tenth of the points is lifted off its surface by twenty noise levels."""
    points = plates(rng, 6000)
    lifted = plates(rng, 6000)
    chosen = (lifted[:, 0] > 0.55) & (lifted[:, 2] < 0.02)
    lifted[chosen, 2] += 0.05
    source, reference = prepared(lifted), prepared(points)
    found = dense.agreement(source, reference, between(source, reference, IDENTITY))
    # Patches at the edges of the lifted part are as thick as it is high: these do not count.
    assert 0.5 * chosen.mean() < found.off < chosen.mean() + 0.02
    assert found.suspicious


@pytest.mark.parametrize("factor", [0.9, 1.06])
def test_another_size_is_found_from_a_pose_nearby(rng, factor):
    source, reference = prepared(plates(rng, 6000)), prepared(factor * plates(rng, 6000))
    turn = Rotation.from_rotvec([0.01, -0.02, 0.01]).as_matrix()
    start = between(source, reference, RigidTransform(turn, np.full(3, 0.01)))
    now = dense.agreement(source, reference, start)
    scale, then = dense.at_another_size(source, reference, start, 0.2)
    assert scale == pytest.approx(factor, abs=0.003)
    assert dense.size_text(scale, now, then) == f"The source fits at {scale:.3f} of its size."
    assert not dense.size_text(1.001, now, then)
    assert not dense.size_text(scale, now, now)


SHEARED = np.array([[1.0, 0.08, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("change", [np.diag([1.0, 1.07, 0.96]), SHEARED], ids=["axes", "shear"])
def test_a_stretch_is_found_from_a_pose_nearby(rng, change):
    source, reference = prepared(stone(rng, 6000)), prepared(stone(rng, 6000) @ change.T)
    start = between(source, reference, IDENTITY)
    now = dense.agreement(source, reference, start)
    sizes, then = dense.stretched(source, reference, start, 0.2)
    np.testing.assert_allclose(sizes, np.linalg.svd(change, compute_uv=False), atol=0.006)
    assert then.off < 0.1 * now.off
    told = dense.stretch_text(sizes, now, then)
    assert f"stretched, at {sizes.min():.3f} to {sizes.max():.3f} of its size" in told
    assert not dense.stretch_text(sizes, now, now)
    assert not dense.stretch_text(np.array([1.3, 1.301, 1.302]), now, then)
    assert not dense.stretch_text(np.array([1.0, 1.0, 0.02]), now, then)


def test_a_stretch_that_the_surfaces_do_not_show_is_none(rng):
    """A plate with edges out of sight may be stretched along itself: it stays as it is."""
    clouds = [rng.uniform(-1, 1, (6000, 3)) * [1, 1, 0.002] for _ in range(2)]
    source, reference = map(prepared, clouds)
    sizes, _ = dense.stretched(source, reference, between(source, reference, IDENTITY), 0.1)
    assert sizes[0] == pytest.approx(1, abs=0.05)


def test_a_bent_surface_is_of_another_shape(rng):
    source, reference = plates(rng, 6000), plates(rng, 6000)
    reference[:, 2] += 0.3 * reference[:, 0] ** 2
    source, reference = prepared(source), prepared(reference)
    bent = dense.agreement(source, reference, between(source, reference, IDENTITY))
    assert "of another shape" in dense.different_text(bent)
    assert not dense.different_text(bent._replace(compared=0.8))
    assert not dense.different_text(bent._replace(off=0.1))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "told"),
    [
        (np.diag([1.0, -1.0, 1.0]), "mirrored source fits better"),
        (1.05 * np.eye(3), "The source fits at 1.0"),
        (np.diag([1.0, 1.0, 1.1]), "of another shape: it fits stretched"),
        (SHEARED, "of another shape: it fits stretched"),
    ],
)
def test_a_mirror_image_and_another_size_or_shape_are_no_success(rng, change, told):
    reference = moved(stone(rng, 6000) @ change.T, *pose(rng))
    found = register(stone(rng, 6000), reference, config=NARROW)
    assert not found.success
    assert found.probability == 0
    assert told in found.reason


def test_a_part_that_moved_is_no_other_cause(rng):
    """One peg is elsewhere: neither a mirror image nor a size explains it."""
    points = plates(rng, 6000)
    pegs = (points[:, 0] > 0.25) & (points[:, 1] > 0.05) & (points[:, 2] > 0.02)
    points[pegs] += [0.15, 0.1, 0.0]
    found = register(plates(rng, 6000), points, config=NARROW)
    assert found.success
    np.testing.assert_allclose(found.transformation, np.eye(4), atol=0.01)


@pytest.mark.parametrize("count", [1000, 6000])
@pytest.mark.parametrize("scale", [0.95, 1.0, 1.05])
def test_a_part_a_little_larger_or_smaller_is_told_at_any_number_of_points(rng, count, scale):
    source, reference = plates(rng, count), scale * plates(rng, count)
    rotation, shift = pose(rng, 180.0)
    found = register(source, moved(reference, rotation, shift), config=NARROW)
    assert found.success == (scale == 1)
    if scale != 1:
        told = float(found.reason.split("fits at ")[1].split()[0])
        assert told == pytest.approx(scale, abs=0.02)
