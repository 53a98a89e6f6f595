import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.optimize import linprog
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg.config import PairConfig
from jaxreg.data import modelnet
from jaxreg.data.batches import key_of_tests, pair_batches
from jaxreg.data.pairs import make_pair, make_pair_from_scans, pair_sizes
from jaxreg.data.procedural import shapes
from jaxreg.types import PointCloud

SMALL = PairConfig(points=100, kept=75)
POSE_ONLY = PairConfig(points=2, crop="none")


drawn_pair = jax.jit(make_pair, static_argnums=2)


def random_cloud(seed, points=100, dtype=np.float64):
    return jnp.asarray(np.random.default_rng(seed).uniform(-1, 1, (points, 3)), dtype)


def many(config, shape, seed, count):
    keys = jax.random.split(jax.random.key(seed), count)
    return jax.jit(jax.vmap(lambda key: make_pair(key, shape, config)))(keys)


def rows_of(points, shape):
    """The row of `shape` that every point copies, by brute force; fails where it copies none."""
    distance = np.linalg.norm(np.asarray(points)[:, None] - np.asarray(shape)[None], axis=2)
    assert distance.min(axis=1).max() < 1e-6
    return distance.argmin(axis=1)


def unmoved(pair):
    """The reference in the frame of the source, in plain numpy."""
    return (
        np.asarray(pair.reference.points) - np.asarray(pair.transform.translation)
    ) @ np.asarray(pair.transform.rotation)


def overlap(pair):
    """Share of source points that have an exact copy in the reference."""
    points, reference = np.asarray(pair.source.points), np.asarray(pair.reference.points)
    moved = points @ np.asarray(pair.transform.rotation).T + np.asarray(pair.transform.translation)
    return np.mean(cKDTree(reference).query(moved)[0] < 1e-5)


def predecessor_overlap(shape, rng):
    """RIENet's generator in numpy loops, up to the order of the points."""
    angle = rng.uniform(0, np.pi / 4, 3)
    rotation = Rotation.from_euler("zyx", angle[::-1]).as_matrix()
    moved = shape @ rotation.T + rng.uniform(-0.5, 0.5, 3)
    viewpoint = rng.uniform(size=3) + 500 * rng.choice([1, -1])
    kept = [np.argsort(np.linalg.norm(cloud - viewpoint, axis=1))[:768] for cloud in (shape, moved)]
    return len(np.intersect1d(*kept)) / 768


# Pose


def test_euler_convention_and_distribution(seed):
    pair = many(POSE_ONLY, random_cloud(seed, 2), seed, 4000)
    rotations = np.asarray(pair.transform.rotation)
    z, y, x = Rotation.from_matrix(rotations).as_euler("zyx").T
    for angles in (x, y, z):
        assert stats.kstest(angles, stats.uniform(0, np.pi / 4).cdf).pvalue > 1e-3
    for i in range(5):
        c, s = np.cos([x[i], y[i], z[i]]), np.sin([x[i], y[i], z[i]])
        about_x = np.array([[1, 0, 0], [0, c[0], -s[0]], [0, s[0], c[0]]])
        about_y = np.array([[c[1], 0, s[1]], [0, 1, 0], [-s[1], 0, c[1]]])
        about_z = np.array([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
        np.testing.assert_allclose(rotations[i], about_x @ about_y @ about_z, atol=1e-12)


def test_translation_fills_its_cube(seed):
    config = dataclasses.replace(POSE_ONLY, translation_max=0.2)
    translations = many(config, random_cloud(seed, 2), seed, 4000).transform.translation
    for axis in np.asarray(translations).T:
        assert stats.kstest(axis, stats.uniform(-0.2, 0.4).cdf).pvalue > 1e-3


def test_axis_angle_is_uniform_in_angle_and_axis(seed):
    config = dataclasses.replace(POSE_ONLY, rotation="axis-angle", rotation_max_deg=30.0)
    rotations = np.asarray(many(config, random_cloud(seed, 2), seed, 4000).transform.rotation)
    vectors = Rotation.from_matrix(rotations).as_rotvec()
    angle = np.linalg.norm(vectors, axis=1)
    assert stats.kstest(angle, stats.uniform(0, np.pi / 6).cdf).pvalue > 1e-3
    for axis in (vectors / angle[:, None]).T:  # A coordinate of a uniform direction is uniform.
        assert stats.kstest(axis, stats.uniform(-1, 2).cdf).pvalue > 1e-3


def test_full_rotations_follow_the_measure_of_the_group(seed):
    config = dataclasses.replace(POSE_ONLY, rotation="full")
    rotations = np.asarray(many(config, random_cloud(seed, 2), seed, 4000).transform.rotation)
    angle = Rotation.from_matrix(rotations).magnitude()
    assert stats.kstest(angle, lambda a: (a - np.sin(a)) / np.pi).pvalue > 1e-3
    for entry in rotations.reshape(-1, 9).T:
        assert stats.kstest(entry, stats.uniform(-1, 2).cdf).pvalue > 1e-3


@pytest.mark.parametrize(("dtype", "tolerance"), [("float32", 1e-6), ("float64", 1e-14)])
@pytest.mark.parametrize("rotation", ["euler", "axis-angle", "full"])
def test_rotation_is_orthonormal_in_the_dtype_of_the_shape(dtype, tolerance, rotation, seed):
    config = dataclasses.replace(SMALL, rotation=rotation)
    pair = drawn_pair(jax.random.key(seed), random_cloud(seed, dtype=dtype), config)
    rotation = np.asarray(pair.transform.rotation)
    assert {leaf.dtype.name for leaf in jax.tree.leaves(pair)} == {dtype, "bool"}
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=tolerance)
    assert np.linalg.det(rotation) > 0


# Crops and sampling


def test_uncropped_copies_are_all_there_in_another_order(seed):
    shape = random_cloud(seed)
    pair = drawn_pair(jax.random.key(seed), shape, dataclasses.replace(SMALL, crop="none"))
    source, reference = rows_of(pair.source.points, shape), rows_of(unmoved(pair), shape)
    assert sorted(source) == sorted(reference) == list(range(100))
    assert (source != np.arange(100)).any()
    assert np.mean(source == reference) < 0.1


def test_the_first_points_of_a_larger_shape_are_taken(seed):
    shape = random_cloud(seed, 150)
    pair = drawn_pair(jax.random.key(seed), shape, SMALL)
    assert rows_of(pair.source.points, shape).max() < 100


def test_viewpoint_crop_keeps_the_nearest_to_one_viewpoint_for_both_clouds(seed):
    shape = np.asarray(random_cloud(seed))
    signs = []
    for i in range(16):
        pair = drawn_pair(jax.random.key(seed + i), jnp.asarray(shape), SMALL)
        transform = pair.transform
        moved = shape @ np.asarray(transform.rotation).T + np.asarray(transform.translation)
        kept = rows_of(pair.source.points, shape), rows_of(unmoved(pair), shape)
        # The viewpoint lies within 0.87 of +-(500.5, 500.5, 500.5): that turns the view by 1e-3.
        fits = [
            all(
                separation(np.linalg.norm(cloud - sign * 500 - 0.5, axis=1), rows) < 5e-3
                for cloud, rows in zip((shape, moved), kept, strict=True)
            )
            for sign in (1, -1)
        ]
        assert fits in ([True, False], [False, True])
        signs.append(fits[0])
    assert any(signs)
    assert not all(signs)


def separation(distance, rows):
    """How far the farthest of the kept rows lies behind the nearest of the others."""
    kept = np.zeros(len(distance), bool)
    kept[rows] = True
    return distance[kept].max() - distance[~kept].min()


def one_direction_separates(clouds):
    """Whether d with d.kept >= c > d.dropped exists, one d for all clouds, a c for each."""
    rows, bounds = [], []
    for i, (kept, dropped) in enumerate(clouds):
        level = np.eye(len(clouds))[i]
        rows += [np.r_[-point, level] for point in kept] + [np.r_[p, -level] for p in dropped]
        bounds += [0.0] * len(kept) + [-1.0] * len(dropped)
    size = 3 + len(clouds)
    return linprog(np.zeros(size), rows, bounds, bounds=[(None, None)] * size).status == 0


def test_half_space_crop_keeps_the_same_part_of_both_clouds(seed):
    shape = np.asarray(random_cloud(seed))
    config = dataclasses.replace(SMALL, crop="half-space")
    pair = drawn_pair(jax.random.key(seed), jnp.asarray(shape), config)
    kept = rows_of(pair.source.points, shape)
    assert sorted(kept) == sorted(rows_of(unmoved(pair), shape))
    assert one_direction_separates([(shape[kept], np.delete(shape, kept, axis=0))])


def test_half_space_crop_of_disjoint_clouds_has_one_direction(seed):
    shape = np.asarray(random_cloud(seed))
    whole = PairConfig(points=50, crop="none", sampling="disjoint")
    config = dataclasses.replace(whole, crop="half-space", kept=30)
    key = jax.random.key(seed)
    before, after = (drawn_pair(key, jnp.asarray(shape), c) for c in (whole, config))
    clouds = []
    for full, crop in (
        (before.source.points, after.source.points),
        (unmoved(before), unmoved(after)),
    ):
        rows = rows_of(crop, full)
        clouds.append((np.asarray(full)[rows], np.delete(np.asarray(full), rows, axis=0)))
    assert one_direction_separates(clouds)


@pytest.mark.parametrize("crop", ["viewpoint", "half-space"])
def test_independent_crops_overlap_less(crop, seed):
    shared = dataclasses.replace(SMALL, crop=crop)
    config = dataclasses.replace(shared, independent_crops=True)
    shape = random_cloud(seed)
    means = []
    for one in (shared, config):
        batch = many(one, shape, seed, 64)
        means.append(np.mean([overlap(jax.tree.map(lambda x: x[i], batch)) for i in range(64)]))  # noqa: B023
    assert means[0] > 0.85
    assert means[1] < means[0] - 0.05


@pytest.mark.parametrize(
    ("total", "points", "each"), [(100, 100, 50), (101, 80, 50), (400, 90, 90)]
)
def test_disjoint_clouds_share_no_point(total, points, each, seed):
    shape = random_cloud(seed, total)
    config = PairConfig(points=points, crop="none", sampling="disjoint")
    drawn = []
    for i in range(2):
        pair = drawn_pair(jax.random.key(seed + i), shape, config)
        source, reference = rows_of(pair.source.points, shape), rows_of(unmoved(pair), shape)
        assert len(set(source)) == len(set(reference)) == each
        assert not set(source) & set(reference)
        drawn.append(set(source))
    assert drawn[0] != drawn[1]
    assert pair_sizes(config, total) == (each, each)


# Noise


def test_jitter_has_its_deviation_and_its_bound_and_changes_nothing_else(seed):
    shape = random_cloud(seed, 4000)
    clean = PairConfig(points=4000, kept=3000)
    key = jax.random.key(seed)
    noisy = dataclasses.replace(clean, jitter=0.01, jitter_clip=0.02)
    before, after = (drawn_pair(key, shape, config) for config in (clean, noisy))
    noise = [np.asarray(after[i].points - before[i].points) for i in (0, 1)]
    for part in noise:
        assert np.abs(part).max() == pytest.approx(0.02)
        inside = stats.truncnorm(-1.999, 1.999, scale=0.01)
        assert stats.kstest(part[np.abs(part) < 0.01999], inside.cdf).pvalue > 1e-3
    assert np.abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.05
    np.testing.assert_array_equal(before.transform.rotation, after.transform.rotation)


def test_outliers_are_appended_points_with_clipped_noise(seed):
    shape = jnp.ones((100, 3)) * 0.25  # All in one place, so that the noise can be read off.
    config = dataclasses.replace(SMALL, outliers=3000)
    pair = drawn_pair(jax.random.key(seed), shape, config)
    assert pair_sizes(config, 100) == (3075, 3075)
    noise = np.asarray(pair.source.points[75:]) - 0.25
    assert np.abs(noise).max() == 1
    assert np.mean(np.abs(noise) == 1) == pytest.approx(2 * stats.norm.cdf(-2), abs=0.01)
    inside = stats.truncnorm(-2, 2, scale=0.5)
    assert stats.kstest(noise[np.abs(noise) < 1], inside.cdf).pvalue > 1e-3


def test_outliers_leave_the_rest_of_the_pair_alone(seed):
    shape, key = random_cloud(seed), jax.random.key(seed)
    clean = drawn_pair(key, shape, SMALL)
    noisy = drawn_pair(key, shape, dataclasses.replace(SMALL, outliers=20))
    for i in (0, 1):
        np.testing.assert_array_equal(noisy[i].points[:75], clean[i].points)
        assert noisy[i].mask.all()
        near = cKDTree(clean[i].points).query(noisy[i].points[75:])[0]
        assert 0.01 < near.max() <= np.sqrt(3)
    assert np.abs(noisy.source.points[75:] - noisy.reference.points[75:]).max() > 0.1


# Masks

MASKED = [
    SMALL,
    dataclasses.replace(SMALL, crop="half-space", jitter=0.01, outliers=10),
    dataclasses.replace(SMALL, crop="none"),
    PairConfig(points=60, kept=40, sampling="disjoint"),
]


@pytest.mark.parametrize("valid", [100, 60, 3])
@pytest.mark.parametrize("config", MASKED)
def test_padding_is_never_preferred_and_leaks_nowhere(config, valid, seed):
    rows = np.random.default_rng(seed).permutation(120)[:valid]
    mask = np.zeros(120, bool)
    mask[rows] = True
    shape = jnp.where(mask[:, None], random_cloud(seed, 120), jnp.nan)
    pair = drawn_pair(jax.random.key(seed), shape, config, jnp.asarray(mask))
    size = pair_sizes(config, 120)[0] - config.outliers
    share = [min(valid, 100)] * 2 if config.sampling == "copy" else [-(-valid // 2), valid // 2]
    for cloud, available in zip(pair[:2], share, strict=True):
        assert int(cloud.mask[:size].sum()) == min(size, available)
        assert np.isfinite(cloud.points).all()
        assert cloud.mask[size:].all()
        assert not (np.diff(np.asarray(cloud.mask[:size], int)) > 0).any()  # Valid rows come first.
    if config.jitter == 0:
        rows_of(pair.source.points[pair.source.mask], shape[mask])
        rows_of(unmoved(pair)[np.asarray(pair.reference.mask)], shape[mask])


def test_a_padded_shape_keeps_what_the_unpadded_one_keeps(seed):
    shape, key = random_cloud(seed), jax.random.key(seed)
    padded = jnp.concatenate([shape, jnp.full((30, 3), jnp.nan)])
    one = drawn_pair(key, shape, SMALL)
    other = drawn_pair(key, padded, SMALL, jnp.arange(130) < 100)
    for i in (0, 1):
        np.testing.assert_array_equal(
            np.sort(one[i].points, axis=0), np.sort(other[i].points, axis=0)
        )


def test_a_shape_without_a_valid_point_gives_an_empty_pair():
    config = dataclasses.replace(SMALL, outliers=5)
    pair = drawn_pair(jax.random.key(0), jnp.full((100, 3), jnp.nan), config, jnp.zeros(100, bool))
    assert not pair.source.mask.any()
    assert not pair.reference.mask.any()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(pair))


# Transforms of JAX


ALL_ON = PairConfig(
    points=60, kept=40, sampling="disjoint", jitter=0.01, outliers=10, crop="half-space"
)


@pytest.mark.parametrize("config", [SMALL, ALL_ON])
def test_same_key_same_bits_and_vmap_is_a_loop(config, seed):
    shape = jnp.stack([random_cloud(seed + i, 120, np.float32) for i in range(3)])
    keys = jax.random.split(jax.random.key(seed), 3)
    batch = jax.jit(jax.vmap(lambda key, one: make_pair(key, one, config)))(keys, shape)
    again = jax.jit(jax.vmap(lambda key, one: make_pair(key, one, config)))(keys, shape)
    for one, other in zip(jax.tree.leaves(batch), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
    for i in range(3):
        single = drawn_pair(keys[i], shape[i], config)
        for one, other in zip(jax.tree.leaves(batch), jax.tree.leaves(single), strict=True):
            np.testing.assert_allclose(one[i], other, atol=1e-6)
    assert np.abs(batch.transform.translation[0] - batch.transform.translation[1]).max() > 1e-3


def test_64_bit_mode_draws_the_same_pair(seed):
    shape = np.asarray(random_cloud(seed, 120), np.float32)
    drawn = []
    for mode in (False, True):
        with jax.enable_x64(mode):
            drawn.append(drawn_pair(jax.random.key(seed), jnp.asarray(shape), ALL_ON))
    for one, other in zip(*map(jax.tree.leaves, drawn), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


# Scans


def test_scans_of_different_sizes(seed):
    source, reference = random_cloud(seed, 80), random_cloud(seed + 1, 120)
    clouds = [PointCloud(cloud, jnp.ones(len(cloud), bool)) for cloud in (source, reference)]
    config = PairConfig(crop="none")
    pair = make_pair_from_scans(jax.random.key(seed), *clouds, config)
    assert sorted(rows_of(pair.source.points, source)) == list(range(80))
    assert sorted(rows_of(unmoved(pair), reference)) == list(range(120))
    with pytest.raises(ValueError, match="kept = 90, but each cloud has 80 points"):
        make_pair_from_scans(jax.random.key(seed), *clouds, PairConfig(kept=90))


# Errors


@pytest.mark.parametrize(
    ("changes", "points", "message"),
    [
        ({"kept": 101}, 100, "kept = 101, but each cloud has 100 points"),
        ({"kept": 0}, 100, "choose 1 <= kept <= 100"),
        ({"sampling": "disjoint"}, 100, "each cloud has 50 points before the crop"),
        ({}, 99, "points = 100 cannot be taken from a shape of 99"),
        ({"points": 0}, 99, "points = 0 cannot be taken"),
        ({"sampling": "disjoint"}, 1, "points = 100 cannot be taken from a shape of 1"),
        ({"outliers": -1}, 100, "outliers = -1 is negative"),
    ],
)
def test_sizes_that_do_not_fit(changes, points, message):
    config = dataclasses.replace(SMALL, **changes)
    with pytest.raises(ValueError, match=message):
        pair_sizes(config, points)
    with pytest.raises(ValueError, match=message):
        make_pair(jax.random.key(0), jnp.zeros((points, 3)), config)


@pytest.mark.untyped
def test_a_batch_of_shapes_is_refused():
    with pytest.raises(ValueError, match=r"must have shape .*got \(2, 100, 3\).*jax.vmap"):
        make_pair(jax.random.key(0), jnp.zeros((2, 100, 3)), SMALL)


# Real shapes


@pytest.mark.modelnet
def test_overlap_on_modelnet_is_that_of_the_predecessor(data_root, seed):
    clouds, _ = modelnet.load(data_root, "test")
    clouds = clouds[::5][:400, :1024]
    keys = jax.random.split(jax.random.key(seed), len(clouds))
    batch = jax.jit(jax.vmap(lambda key, one: make_pair(key, one, PairConfig())))(keys, clouds)
    ours = [overlap(jax.tree.map(lambda x: x[i], batch)) for i in range(len(clouds))]  # noqa: B023
    rng = np.random.default_rng(seed)
    theirs = [predecessor_overlap(cloud.astype(np.float64), rng) for cloud in clouds]
    assert np.mean(ours) == pytest.approx(0.955, abs=0.006)
    assert stats.ks_2samp(ours, theirs).pvalue > 1e-3


def test_overlap_on_procedural_shapes_is_that_of_the_predecessor(seed):
    clouds, _ = shapes.load("test", 104, points=1024)
    keys = jax.random.split(jax.random.key(seed), len(clouds))
    batch = jax.jit(jax.vmap(lambda key, one: make_pair(key, one, PairConfig())))(keys, clouds)
    ours = [overlap(jax.tree.map(lambda x: x[i], batch)) for i in range(len(clouds))]  # noqa: B023
    rng = np.random.default_rng(seed)
    theirs = [predecessor_overlap(cloud.astype(np.float64), rng) for cloud in clouds]
    assert stats.ks_2samp(ours, theirs).pvalue > 1e-3


@pytest.mark.parametrize("setting", ["rbg", "unsafe_rbg", "not partitionable"])
def test_test_pairs_do_not_follow_the_generator_of_the_process(setting):
    shapes = np.random.default_rng(0).normal(size=(2, 100, 3)).astype(np.float32)

    def drawn():
        batches = pair_batches(shapes, key_of_tests(3), config=SMALL, batch=2)
        return next(batches)[0].transform

    expected = drawn()
    other = (
        jax.threefry_partitionable(False)
        if setting.startswith("not")
        else jax.default_prng_impl(setting)
    )
    with other:
        found = drawn()
    jax.tree.map(np.testing.assert_array_equal, found, expected)
