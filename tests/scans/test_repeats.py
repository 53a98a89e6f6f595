"""Other places where a scan fits as well: periods and half turns, against planted copies."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural.surfaces import box, sample, union
from jaxreg.scans import repeats
from jaxreg.scans.pair import register
from jaxreg.types import RigidTransform

PLACES = np.array([[0.0, 0, 0], [1.3, 0, 0], [0, -0.9, 0.4], [-2.1, 0.7, -0.6]])
NONE = np.zeros((0, 3))
POSE = RigidTransform(np.eye(3), np.zeros(3))
CELL = 0.15
"""More than the edge of a cell of these rasters."""


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def angle_deg(one, other):
    return np.degrees(Rotation.from_matrix(one @ other.T).magnitude())


def placed(found):
    """The poses that were found, as numbers that can be compared."""
    return [(rotation, shift) for rotation, shift in zip(*found, strict=True)]


def test_all_copies_are_found_and_nothing_else(rng):
    part = rng.uniform(0, 1, size=(900, 3)) * [1, 0.7, 0.5]
    part = part[part.sum(axis=1) < 0.8]
    turn = Rotation.random(random_state=5).as_matrix()
    reference = np.concatenate([part @ turn.T + place for place in PLACES])
    poses, share = repeats.others(
        part, reference, RigidTransform(turn, PLACES[0]), axes=NONE, most=16
    )
    for place in PLACES[1:]:
        assert np.abs(poses.translation - place).max(axis=1).min() < CELL
    for rotation, shift in placed(poses):
        assert angle_deg(rotation, turn) < 1e-3
        assert np.abs(PLACES[1:] - shift).max(axis=1).min() < CELL
    assert (share > 0.8).all()
    assert (np.diff(share) <= 0).all()


def test_the_share_is_that_of_points_near_the_reference(rng):
    """The copy begins where the reference has ended."""
    part = rng.uniform(-0.5, 0.5, size=(3000, 3)) * [1, 0.7, 0.02]
    reference = np.concatenate([part, part[part[:, 1] > -0.25] + PLACES[2]])
    poses, share = repeats.others(part, reference, POSE, axes=NONE, most=4)
    near = cKDTree(reference).query(part + PLACES[2])[0] < 0.02
    at = np.abs(poses.translation - PLACES[2]).max(axis=1).argmin()
    assert np.abs(poses.translation[at] - PLACES[2]).max() < CELL
    assert share[at] == pytest.approx(near.mean(), abs=0.05)


def test_half_turns_lie_about_the_axes_or_the_upright_one(rng):
    half = rng.normal(size=(400, 3)) * [3, 2, 1]
    turns = Rotation.from_rotvec([[np.pi, 0, 0], [0, 0, np.pi]]).as_matrix()
    whole = np.concatenate([half, *(half @ turn.T for turn in turns), half * [-1, 1, -1]])
    whole -= whole.mean(axis=0)
    poses, _ = repeats.others(whole, whole, POSE, axes=repeats.axes_of(whole, None), most=16)
    about_center = [rotation for rotation, shift in placed(poses) if np.abs(shift).max() < CELL * 4]
    for turn in (*turns, np.diag([-1.0, 1, -1])):
        assert min(angle_deg(turn, found) for found in about_center) < 2
    up = np.array([0.0, 0, 1])
    for rotation, _ in placed(
        repeats.others(whole, whole, POSE, axes=repeats.axes_of(whole, up), most=16)[0]
    ):
        np.testing.assert_allclose(rotation @ up, up, atol=1e-9)


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.zeros((5, 3)), np.eye(3)[:2]])
def test_clouds_without_an_extent_have_no_places(points):
    poses, share = repeats.others(points, points, POSE, axes=repeats.axes_of(points, None), most=4)
    assert len(share) == len(poses.rotation)
    assert np.isfinite(poses.translation).all()


def test_stairs_fit_a_step_on_and_turned_by_half():
    """Steps of one size, one after the other: half a turn maps them to themselves."""
    stairs = union(*[box((0.3, 1.2, 0.18), (0.3 * i, 0, 0.18 * i)) for i in range(14)])
    noise = np.random.default_rng(7).normal(size=(2, 12_000, 3)) * 0.005
    source, reference = (
        sample(np.random.default_rng(6 + k), stairs, 12_000) + noise[k] for k in range(2)
    )
    turn = Rotation.from_euler("z", 70, degrees=True).as_matrix()
    found = register(source, reference @ turn.T)
    others = [turn.T @ other.transform.rotation for other in found.alternatives]
    turned = sorted(
        angle_deg(rotation, np.eye(3)) for rotation in (turn.T @ found.rotation, *others)
    )
    assert not found.success
    assert turned[0] < 0.5
    assert turned[-1] > 179.5
