"""Parts that free space keeps apart: rooms whose walls are known, and made-up registrations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxreg
from jaxreg.scans.apart import Looks, kept_apart, looks
from jaxreg.scans.placing import place
from tests.scans.test_placing import assert_right, poses, relation, ring, sizes

OFFSET = np.array([300.0, -40.0, 7.0])


def room(rng, half: float, count: int = 4000) -> np.ndarray:
    """Points on the walls of a cube about OFFSET."""
    points = rng.uniform(-half, half, (count, 3))
    points[np.arange(count), rng.integers(3, size=count)] = half * rng.choice([-1, 1], count)
    return points + OFFSET


@pytest.mark.parametrize(("half", "through", "there"), [(2.0, 0, 1), (1.2, 1, 0), (3.0, 0, 0)])
def test_what_a_scanner_sees_of_another_room_about_it(half, through, there, seed):
    """The same room is there, a smaller one in the way, of a larger one nothing is seen."""
    rng = np.random.default_rng(seed)
    clouds = [room(rng, 2.0), room(rng, half)]
    turns = Rotation.random(2, random_state=rng).as_matrix()
    own = [(cloud - OFFSET) @ turn + OFFSET for cloud, turn in zip(clouds, turns, strict=True)]
    prepared = [jaxreg.prepare(own[0], viewpoint=OFFSET), jaxreg.prepare(own[1])]
    back = turns[0].T @ turns[1]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = back, OFFSET - back @ OFFSET
    placement = place([relation(rng, None, 1, 0, wrong=pose, noise=1e-6)], sizes(2))
    found = looks(prepared, placement)
    assert found.through[0, 1] / 200 == pytest.approx(through, abs=0.05)
    assert found.there[0, 1] / 200 == pytest.approx(there, abs=0.05)
    assert not found.through[1].any()  # where the other scanner stood is not known
    assert not found.there[1].any()


def two_rings(rng):
    """Two rings, and two pairs that lay one over the other where it does not belong, and agree."""
    truth = poses(rng, 10)
    wrong = poses(rng, 1)[0]
    relations = ring(rng, truth, range(5)) + ring(rng, truth, range(5, 10))
    for k in range(2):
        pose = np.linalg.inv(truth[k]) @ wrong @ truth[5 + k]
        relations.append(relation(rng, truth, 5 + k, k, wrong=pose))
    return truth, relations


def between_rings(through: int, there: int) -> Looks:
    across = np.zeros((10, 10), int)
    across[:5, 5:] = 1
    return Looks(through * across, there * across)


def test_two_pairs_that_agree_do_not_join_what_free_space_keeps_apart(seed):
    rng = np.random.default_rng(seed)
    truth, relations = two_rings(rng)
    joined = place(relations, sizes(10))
    assert joined.members() == (tuple(range(10)),)
    torn = kept_apart(relations, joined, between_rings(through=2, there=10))
    np.testing.assert_array_equal(np.flatnonzero(torn), [20, 21])
    found = place(relations, sizes(10), torn)
    assert found.members() == ((0, 1, 2, 3, 4), (5, 6, 7, 8, 9))
    assert "empty" in found.refusal[20]
    for members in found.members():
        assert_right(found, truth, members)


@pytest.mark.parametrize(("through", "there"), [(0, 10), (1, 60), (2, 1)])
def test_little_or_nothing_seen_through_keeps_nothing_apart(through, there, seed):
    """The last: most of what was seen, but too few points."""
    _, relations = two_rings(np.random.default_rng(seed))
    joined = place(relations, sizes(10))
    assert not kept_apart(relations, joined, between_rings(through, there)).any()
