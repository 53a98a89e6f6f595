"""Padded sizes and the pairs of the trees against brute force."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.geometry import rigid
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.correspondences import closest_pairs
from jaxreg.refine.kdtree import _extrapolated, index_cloud, iterate, iterate_all, tree_pairs
from jaxreg.refine.robust import Weighting
from jaxreg.types import RigidTransform


def test_the_last_width_is_used_where_a_wider_one_stands_still():
    cloud = index_cloud(np.random.default_rng(0).normal(size=(70, 3)), k=5)
    start = RigidTransform(np.eye(3), np.zeros(3))  # the right pose: no width moves it
    weighting = Weighting("geman_mcclure", None, np.inf, 1.0)
    for widest, iterations, steps in ((8.0, 2, 2), (8.0, 4, 3), (1.0, 2, 1)):
        config = RefineConfig(iterations=iterations, kernel_annealing=widest, epsilon=0.01)
        _, taken, converged, _ = iterate(start, cloud, cloud, weighting, config=config)
        assert (taken, converged) == (steps, True)


@pytest.mark.parametrize(("share", "arrives"), [(0.3, True), (0.7, True), (0.9, False)])
def test_steps_that_shrink_by_one_share_are_followed_to_their_limit(share, arrives, seed):
    rng = np.random.default_rng(seed)
    axis, shift = rng.normal(size=(2, 3))
    # Both parts have gone 1 - share^n of their way after n steps, about one axis and along it.
    axis, along = axis / np.linalg.norm(axis), 0.02 * np.linalg.norm(shift)

    def after(way):
        return RigidTransform(
            Rotation.from_rotvec(0.1 * way * axis).as_matrix(), along * way * axis
        )

    poses = [after(1 - share**n) for n in range(3)]
    kept, last = _extrapolated(poses[0], poses[1], None)
    np.testing.assert_array_equal(kept.rotation, poses[1].rotation)
    farther, none = _extrapolated(poses[1], poses[2], last)
    assert none is None  # the next step says nothing of the last
    # At most four times the step, which is all of the way up to a share of 3/4.
    limit = after(1) if arrives else after(1 - share + 4 * share * (1 - share))
    np.testing.assert_allclose(farther.rotation, limit.rotation, atol=1e-9)
    np.testing.assert_allclose(farther.translation, limit.translation, atol=1e-9)


def test_a_step_to_another_side_is_taken_as_it_is():
    there = RigidTransform(np.eye(3), np.array([1.0, 0, 0]))
    turned = RigidTransform(np.eye(3), np.array([1.0, 0.5, 0]))
    _, last = _extrapolated(RigidTransform(np.eye(3), np.zeros(3)), there, None)
    pose, last = _extrapolated(there, turned, last)
    np.testing.assert_array_equal(pose.translation, turned.translation)
    np.testing.assert_allclose(last, [0, 0, 0, 0, 0.5, 0])


@pytest.mark.parametrize("both_directions", [False, True])
def test_pairs_equal_brute_force(both_directions, seed):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(70, 3)), rng.normal(size=(90, 3))
    pose = RigidTransform(Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3))
    clouds = [index_cloud(points, k=5) for points in (x, y)]
    pairs = tree_pairs(pose, *clouds, 1, both_directions=both_directions)
    moved = rigid.apply(RigidTransform(*map(jnp.asarray, pose)), jnp.asarray(x))
    expected = closest_pairs(moved, jnp.asarray(y), None, None, both_directions=both_directions)
    count = len(expected.mask)
    np.testing.assert_array_equal(pairs.source_index[:count], expected.source_index)
    np.testing.assert_array_equal(pairs.reference_index[:count], expected.reference_index)
    assert pairs.mask[:count].all()
    assert not pairs.mask[count:].any()


def random_poses(rng, count, angle):
    turns = Rotation.from_rotvec(rng.uniform(-angle, angle, (count, 3))).as_matrix()
    return RigidTransform(turns, rng.uniform(-0.1, 0.1, (count, 3)))


def one_of(poses, i):
    return RigidTransform(poses.rotation[i], poses.translation[i])


@pytest.mark.parametrize(("method", "step"), [("gicp", 2), ("point_to_plane", 1)])
def test_many_poses_at_once_go_where_each_goes_alone(method, step, seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (2, 300, 3))
    points[..., 2] = 0.5 * np.sin(3 * points[..., 0]) * points[..., 1]
    clouds = [index_cloud(cloud, k=8)._replace(scale=0.8) for cloud in points]
    # No tolerance, so that no step is the last one before all widths were used.
    config = RefineConfig(
        method=method, iterations=4, kernel_annealing=4.0, tolerance=0.0, both_directions=True,
        epsilon=0.01,
    )  # fmt: skip
    weighting = Weighting("geman_mcclure", None, 0.3, 1.0)
    poses = random_poses(rng, 3, 0.15)
    found = iterate_all(poses, *clouds, weighting, config=config, step=step)
    for i in range(3):
        alone, taken, *_ = iterate(one_of(poses, i), *clouds, weighting, config=config, step=step)
        assert taken == 4
        assert np.abs(alone.rotation - poses.rotation[i]).max() > 1e-3
        np.testing.assert_allclose(found.rotation[i], alone.rotation, atol=1e-9)
        np.testing.assert_allclose(found.translation[i], alone.translation, atol=1e-9)


def test_points_are_moved_there_and_back(seed):
    rng = np.random.default_rng(seed)
    points, poses = rng.normal(size=(9, 3)), random_poses(rng, 4, 2.0)
    cloud = index_cloud(points, k=4)._replace(scale=2.5)
    there, back = cloud.moved_by(poses, 2), cloud.moved_back_by(poses, 2)
    assert there.shape == back.shape == (4, 5, 3)
    for i in range(4):
        turn, shift = poses.rotation[i], poses.translation[i]
        for j in range(5):
            placed = 2.5 * points[2 * j]
            np.testing.assert_allclose(there[i, j], turn @ placed + shift, atol=1e-12)
            np.testing.assert_allclose(turn @ back[i, j] + shift, placed, atol=1e-12)
        np.testing.assert_array_equal(cloud.moved_by(one_of(poses, i), 2), there[i])


def test_nearest_within_a_bound_is_the_nearest_where_that_is_near(seed):
    rng = np.random.default_rng(seed)
    points, queries = rng.normal(size=(80, 3)), 2 * rng.normal(size=(2, 60, 3))
    cloud = index_cloud(points, k=4)._replace(scale=0.5)
    gaps = np.linalg.norm(queries[:, :, None] - 0.5 * points, axis=-1)
    distance, index = cloud.nearest(queries)
    np.testing.assert_allclose(distance, gaps.min(axis=-1), rtol=1e-12)
    np.testing.assert_array_equal(index, gaps.argmin(axis=-1))
    bound = np.median(distance)
    bounded, found = cloud.nearest(queries, within=bound)
    near = distance < bound
    np.testing.assert_array_equal(bounded[near], distance[near])
    np.testing.assert_array_equal(found[near], index[near])
    assert np.isinf(bounded[distance > bound]).all()
    assert found.max() < 80  # of a far point, the index is any that exists


def test_pairs_beyond_the_bound_do_not_count(seed):
    """Of several poses, every one has the pairs that it has alone, less those too far apart."""
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(70, 3)), rng.normal(size=(90, 3))
    poses = random_poses(rng, 3, 1.0)
    clouds = [index_cloud(points, k=5) for points in (x, y)]
    both = tree_pairs(poses, *clouds, 2, both_directions=True, within=0.5)
    for i in range(3):
        pose = one_of(poses, i)
        all_of_them = tree_pairs(pose, *clouds, 2, both_directions=True)
        moved = x[all_of_them.source_index] @ pose.rotation.T + pose.translation
        gap = np.linalg.norm(moved - y[all_of_them.reference_index], axis=1)
        expected = all_of_them.mask & (gap < 0.5)
        assert 0 < expected.sum() < all_of_them.mask.sum() == 35 + 45
        np.testing.assert_array_equal(both.mask[i], expected)
        for name in ("source_index", "reference_index"):
            found, alone = getattr(both, name)[i], getattr(all_of_them, name)
            np.testing.assert_array_equal(found[expected], alone[expected])
