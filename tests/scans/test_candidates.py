"""Candidates on the host: judged as in the search, refined, and of poses that are one the best."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg.geometry import frame
from jaxreg.judge.evidence import Evidence, read_evidence
from jaxreg.judge.odds import log_odds
from jaxreg.scans import candidates, prepare
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.surfaces import pose_problem
from jaxreg.search.nearest import nearest_packed
from jaxreg.types import RigidTransform
from tests.judge.clouds import assert_same, random_pose
from tests.scenes import angle_deg, moved, shape


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def stacked(poses) -> RigidTransform:
    return RigidTransform(*map(np.stack, zip(*poses, strict=True)))


def problem_of(source, reference):
    config = RegisterConfig(search_points=256)
    sides = (prepare.prepare(points, config=config) for points in (source, reference))
    return pose_problem(*sides, config)


@pytest.mark.parametrize("count", [1, 5])
def test_the_trees_of_the_host_show_the_same_as_all_distances(rng, count):
    """One definition: the poses of `register` are read as those of the search."""
    clouds = problem_of(shape(rng, 520), shape(rng, 400) + 3).clouds()
    poses = [random_pose(rng, angle=0.8, shift=0.4) for _ in range(count)]
    found, score = clouds.judge(stacked(poses))
    assert score.shape == found.held.shape == (count,)
    source, reference = (
        cloud._replace(points=cloud.points * index.scale, spacing=cloud.spacing * index.scale)
        for cloud, index in zip(clouds.examined, clouds[:2], strict=True)
    )

    @jax.jit
    def exhaustive(pose):
        moved = source.points @ pose.rotation.T + pose.translation[None]
        there = nearest_packed(moved, reference.points, reference.mask)
        back = nearest_packed(reference.points, moved, source.mask)
        return read_evidence(pose, source, reference, there, back)

    for i, pose in enumerate(poses):
        expected = exhaustive(RigidTransform(*map(jnp.asarray, pose)))
        assert expected.smaller > 0
        assert expected.beside > 0
        one = jax.tree.map(lambda x, i=i: x[i], found)
        assert_same(one, expected, tolerance=1e-6)
        assert score[i] == pytest.approx(float(log_odds(expected)), rel=1e-6)


def test_candidates_are_refined_and_the_right_one_comes_first(rng):
    points, turn = shape(rng, 600), Rotation.random(rng=rng).as_matrix()
    problem = problem_of(points[::2], moved(points[1::2], turn, [1.0, 2.0, 3.0]))
    near = Rotation.from_rotvec([0.04, -0.03, 0.05]).as_matrix() @ turn
    wrong = [Rotation.random(rng=rng).as_matrix() for _ in range(7)]
    poses = stacked([(rotation, np.zeros(3)) for rotation in (*wrong, near)])
    found = candidates.judged(
        problem.clouds(), poses, np.arange(8.0), distance=2 * problem.spacing, most=6
    )
    assert len(found.score) <= 6
    assert angle_deg(found.poses.rotation[0], turn) < 1 < angle_deg(near, turn)
    assert np.all(np.diff(found.score) <= 0)
    products = found.poses.rotation @ np.swapaxes(found.poses.rotation, 1, 2)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-12)
    evidence, score = problem.clouds().judge(found.poses)
    np.testing.assert_allclose(score, found.score, rtol=1e-9)
    assert_same(evidence, found.evidence)


def some(rng, count):
    """Poses in clusters some of which touch, evidence that tells them apart, and scores."""
    turns = Rotation.from_rotvec(rng.uniform(-0.2, 0.2, (count, 3))).as_matrix()
    poses = RigidTransform(turns, rng.uniform(-0.1, 0.1, (count, 3)))
    score = rng.normal(size=count)
    return poses, Evidence(*[10 * score + k for k in range(len(Evidence._fields))]), score


def test_half_turns_lay_an_even_grid_on_itself(rng):
    """The three half turns of a cuboid of points, from a pose that lays the source on the reference."""
    grid = np.stack(np.meshgrid(*map(np.arange, (7.0, 9.0, 12.0))), axis=-1).reshape(-1, 3)
    pose = random_pose(rng, angle=2.0, shift=5.0)
    problem = problem_of(grid, grid @ pose.rotation.T + pose.translation)
    start = frame.transform_in(problem.where, pose)
    points = problem.source.points * (problem.source.radius / float(problem.where.length))
    nudged = start._replace(translation=start.translation + 0.01)
    others = (nudged, 3.0), (start._replace(translation=start.translation + 1), -50.0)
    found = candidates.with_half_turns(problem.clouds(), points, start, others)
    # The one that is hardly moved is the pose itself; the best come first.
    assert len(found) == 4
    assert found[-1] == others[1]
    _, straight = problem.clouds().judge(jax.tree.map(lambda leaf: leaf[None], start))
    for turned, score in found[:3]:
        turned = frame.transform_out(problem.where, turned)
        back = (grid @ turned.rotation.T + turned.translation - pose.translation) @ pose.rotation
        assert cKDTree(grid).query(back)[0].max() < 1e-6
        assert np.abs(back - grid).max() > 5
        assert score == pytest.approx(straight[0], abs=2)


def test_distinct_poses_are_the_best_of_those_that_are_one(rng):
    """Greedily: a pose stays unless a better one turns by less than 6 degrees and lies within 0.1."""
    poses, evidence, score = some(rng, 40)
    kept = []
    for i in sorted(range(40), key=lambda i: -score[i]):
        gaps = (
            (
                angle_deg(poses.rotation[i], poses.rotation[j]) <= 6
                and np.linalg.norm(poses.translation[i] - poses.translation[j]) <= 0.1
            )
            for j in kept
        )
        if not any(gaps):
            kept.append(i)
    assert 3 < len(kept) < 40
    found = candidates.ranked(poses, evidence, score)
    np.testing.assert_array_equal(found.score, score[kept])
    np.testing.assert_array_equal(found.poses.rotation, poses.rotation[kept])
    np.testing.assert_array_equal(found.evidence.ends, evidence.ends[kept])


def test_merged_is_the_ranking_of_both(rng):
    one, other = (candidates.ranked(*some(rng, 15)) for _ in range(2))
    found = candidates.merged(one, other)
    expected = candidates.ranked(
        RigidTransform(*(np.concatenate(p) for p in zip(one.poses, other.poses, strict=True))),
        Evidence(*(np.concatenate(e) for e in zip(one.evidence, other.evidence, strict=True))),
        np.concatenate([one.score, other.score]),
    )
    np.testing.assert_array_equal(found.score, expected.score)
    np.testing.assert_array_equal(found.poses.translation, expected.poses.translation)
    again = candidates.merged(one, one)
    np.testing.assert_array_equal(again.score, one.score)
