"""Which pairs are proposed: alike ones, and those that lie over each other, against plain distances."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural import shapes
from jaxreg.scans import proposals
from jaxreg.scans.prepare import prepare

TABLE, PLANT = 9, 22


@pytest.fixture(scope="module")
def clouds():
    """Two samplings of a table and two of a plant, each turned, on 300 points."""
    rng = np.random.default_rng(3)
    parts = [
        part
        for family in (TABLE, PLANT)
        for part in np.split(shapes.sample_shape(1, family, points=600).astype(np.float64), 2)
    ]
    turns = Rotation.random(4, random_state=rng).as_matrix()
    return [part @ turn.T + 5 for part, turn in zip(parts, turns, strict=True)], turns


def test_scans_of_one_thing_are_most_alike(clouds):
    score = proposals.likeness([prepare(cloud) for cloud in clouds[0]])
    np.testing.assert_array_equal(score, score.T)
    assert proposals.most_alike(score, 1) == {(0, 1), (2, 3)}


def test_successive_scans_are_those_in_time_and_none_across_a_pause():
    # In time: 2, 0, 3, then a pause of 100 usual steps, then 1, 4.
    times = np.array([11.0, 111.0, 10.0, 12.0, 112.0])
    assert proposals.successive(times) == {(0, 2), (0, 3), (2, 3), (1, 4)}
    evenly = proposals.successive(np.arange(4.0))
    assert evenly == {(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)}
    assert proposals.successive(np.zeros(3)) == {(0, 1), (1, 2), (0, 2)}


def test_scans_at_the_same_time_are_no_measure_of_a_pause():
    """Of three scanners that take a scan each at every tick."""

    def next_two(first, last):
        return {(i, j) for i in range(first, last) for j in (i + 1, i + 2) if j < last}

    ticks = np.repeat(np.arange(3.0), 3)
    assert proposals.successive(ticks) == next_two(0, 9)
    paused = np.concatenate([ticks, ticks + 100])
    assert proposals.successive(paused) == next_two(0, 9) | next_two(9, 18)


def test_the_most_alike_are_those_of_a_full_sort(seed):
    rng = np.random.default_rng(seed)
    score = rng.normal(size=(7, 7))
    score += score.T
    expected = set()
    for i in range(7):
        others = sorted((j for j in range(7) if j != i), key=lambda j: -score[i, j])
        expected |= {(min(i, j), max(i, j)) for j in others[:2]}
    assert proposals.most_alike(score, 2) == expected
    every = {(i, j) for j in range(7) for i in range(j)}
    assert proposals.most_alike(score, 20) == every


def test_overlap_is_the_share_of_near_points(clouds):
    points, turns = clouds
    prepared = [prepare(cloud) for cloud in points]
    poses = np.repeat(np.eye(4)[None], 4, 0)
    poses[:, :3, :3] = turns.swapaxes(1, 2)
    poses[:, :3, 3] = -np.einsum("kij,j->ki", poses[:, :3, :3], np.full(3, 5.0))
    poses[1, 0, 3] += 0.7
    poses[3, 0, 3] += 50.0
    found = proposals.overlaps(prepared, dict(enumerate(poses)))
    assert set(found) == {(0, 1), (0, 2), (1, 2)}
    # With 300 points nothing is thinned out.
    one, other = (points[k] @ poses[k, :3, :3].T + poses[k, :3, 3] for k in (0, 1))
    reach = 1.5 * max(spacing(one), spacing(other))
    apart = cdist(one, other)
    shares = [(apart.min(axis=axis) < reach).mean() for axis in (0, 1)]
    assert found[0, 1] == pytest.approx(min(shares))
    assert 0.05 < found[0, 1] < 0.95


def spacing(points):
    return np.median(np.sort(cdist(points, points), axis=1)[:, 4])
