import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxreg.search.hypotheses import Separation, best_of, pick_distinct, pose_hypotheses, screen
from jaxreg.search.nearest import nearest_grid
from jaxreg.search.surface import Surface
from jaxreg.types import RigidTransform


def test_right_candidates_give_the_pose_among_wrong_ones(seed):
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=rng).as_matrix()
    p = rng.normal(size=(60, 3))
    q = np.where(np.arange(60)[:, None] < 20, p @ turn.T + 2, rng.normal(size=(60, 3)))
    change = np.abs(np.linalg.norm(p[:, None] - p, axis=2) - np.linalg.norm(q[:, None] - q, axis=2))
    first = np.maximum(0, 1 - (change / 0.05) ** 2) * (1 - np.eye(60))
    poses = pose_hypotheses(*map(jnp.asarray, (p, q, first)), seeds=40, consensus_size=8)
    assert len(poses.rotation) == 40
    np.testing.assert_allclose(poses.rotation[:20], np.tile(turn, (20, 1, 1)), atol=0.05)
    np.testing.assert_allclose(poses.translation[:20], 2, atol=0.1)
    np.testing.assert_allclose(np.linalg.det(poses.rotation), 1, atol=1e-9)


def sphere(rng, n):
    points = rng.normal(size=(n, 3))
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    points = jnp.asarray(points)
    return Surface(points, points, jnp.zeros(n), jnp.zeros((n, 1)), jnp.arange(n) < n - 5)


def test_screening_prefers_the_pose_that_overlays_the_surfaces(seed):
    rng = np.random.default_rng(seed)
    source, reference = sphere(rng, 100), sphere(rng, 400)
    shifts = jnp.asarray([[0.0, 0, 0], [0.3, 0, 0], [3.0, 0, 0]])
    poses = RigidTransform(jnp.tile(jnp.eye(3), (3, 1, 1)), shifts)
    grid = nearest_grid(reference.points, reference.mask, cells=24, margin=0.1)
    score = np.asarray(screen(poses, source, reference, grid, width=0.1))
    assert 0.5 < score[0] < 1
    assert score[0] > 1.5 * score[1] > 0
    assert score[2] < 1e-6


def test_distinct_poses_are_a_greedy_choice(seed):
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(rng.normal(size=(40, 3)))
    translation, score = rng.normal(size=(40, 3)), rng.uniform(size=40)
    poses = RigidTransform(jnp.asarray(rotation.as_matrix()), jnp.asarray(translation))
    found = pick_distinct(poses, jnp.asarray(score), count=5, apart=Separation(1.0, 1.5))
    left, expected = list(np.argsort(-score)), []
    while len(expected) < 5:
        best = left[0]
        expected.append(best)
        same = lambda k, b=best: (  # noqa: E731
            (rotation[b].inv() * rotation[k]).magnitude() < 1.0
            and np.linalg.norm(translation[b] - translation[k]) < 1.5
        )
        left = [k for k in left if not same(k)]
    assert found.tolist() == expected
    assert np.array_equal(best_of(poses, found).translation, translation[expected])


def test_a_second_round_begins_when_no_distinct_pose_is_left():
    """Two places with two poses each, and one far away that is not allowed."""
    shifts = jnp.asarray([[0.0, 0, 0], [0.1, 0, 0], [5, 0, 0], [5.1, 0, 0], [9, 0, 0]])
    poses = RigidTransform(jnp.tile(jnp.eye(3), (5, 1, 1)), shifts)
    score, allowed = jnp.asarray([1.0, 4, 3, 2, 9]), jnp.asarray([True] * 4 + [False])
    found = pick_distinct(poses, score, allowed, count=4, apart=Separation(0.1, 1.0))
    assert found.tolist() == [1, 2, 4, 1]
    assert pick_distinct(poses, score, count=3, apart=Separation(0.1, 1.0)).tolist() == [4, 1, 2]
