import time

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural import objects, shapes, solids

COUNT = len(shapes.families())


@pytest.fixture(scope="module")
def clouds():
    return shapes.load("train", 4 * COUNT, points=1024, seed=3)


def test_families_are_many_and_labelled_in_turn(clouds):
    assert COUNT >= 16
    assert len(set(shapes.families())) == COUNT
    np.testing.assert_array_equal(clouds[1], np.tile(np.arange(COUNT), 4))
    for split in ("validation", "test"):
        np.testing.assert_array_equal(shapes.load(split, 5, points=8)[1], np.arange(5))


def test_zero_mean_in_the_unit_sphere(clouds):
    assert (clouds[0].dtype, clouds[1].dtype) == (np.float32, np.int32)
    np.testing.assert_allclose(clouds[0].mean(axis=1), 0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(clouds[0], axis=2).max(axis=1), 1, atol=1e-6)


def test_no_shape_is_thin_or_clumped(clouds):
    for cloud, label in zip(*clouds, strict=True):
        name = shapes.families()[label]
        spread = np.linalg.svd(cloud, compute_uv=False) / np.sqrt(len(cloud))
        assert spread[2] > 0.02, name
        assert len(np.unique(cloud, axis=0)) == len(cloud), name
        near = cKDTree(cloud).query(cloud, k=2)[0][:, 1]
        assert np.median(near) > 2e-3, name


def test_the_pose_is_well_defined(clouds):
    """No cube rotation about the axes, or the principal axes, brings a shape onto itself."""
    turns = [r for r in Rotation.create_group("O").as_matrix() if np.trace(r) < 3 - 1e-6]
    ratios = []
    for cloud in clouds[0][: 2 * COUNT]:
        tree, other = cKDTree(cloud[::2]), cloud[1::2]
        principal = np.linalg.svd(cloud, full_matrices=False)[2]
        principal *= np.linalg.det(principal)
        turned = [other @ (f.T @ r @ f).T for f in (np.eye(3), principal) for r in turns]
        distance = [tree.query(points)[0].mean() for points in turned]
        ratios.append(min(distance) / tree.query(other)[0].mean())
    assert np.mean(np.array(ratios) > 1.2) > 0.95
    assert min(ratios) > 1.05


@pytest.mark.parametrize("family", solids.FAMILIES + objects.FAMILIES)
def test_surfaces_of_a_family_are_finite_and_differ(family, seed):
    rng = np.random.default_rng(seed)
    drawn = [family(rng) for _ in range(20)]
    for surface in drawn:
        assert surface.shape[1:] == (3, 3)
        assert np.isfinite(surface).all()
    assert len({round(float(np.abs(surface).mean()), 9) for surface in drawn}) == 20


def test_seeded_by_seed_and_index():
    one = shapes.sample_shape(1, 5, points=64)
    np.testing.assert_array_equal(one, shapes.sample_shape(1, 5, points=64))
    for seed, index in ((2, 5), (1, 5 + COUNT)):
        assert np.abs(shapes.sample_shape(seed, index, points=64) - one).max() > 0.1


def test_splits_share_no_shape_and_a_longer_load_continues_a_shorter():
    loads = {split: shapes.load(split, 2 * COUNT, points=32)[0] for split in shapes._STREAMS}
    keys = {tuple(cloud.ravel()) for clouds in loads.values() for cloud in clouds}
    assert len(keys) == 6 * COUNT
    np.testing.assert_array_equal(shapes.load("test", 3, points=32)[0], loads["test"][:3])


def test_halves_of_a_cloud_are_independent_samples_of_one_surface():
    cloud = shapes.sample_shape(0, 6, points=4000)
    first, second = cloud[:2000], cloud[2000:]
    across = cKDTree(first).query(second)[0]
    within = cKDTree(first).query(first, k=2)[0][:, 1]
    assert across.min() > 0
    assert across.mean() == pytest.approx(within.mean(), rel=0.1)


@pytest.mark.untyped
def test_errors():
    with pytest.raises(ValueError, match="train, validation, test, got 'dev'"):
        shapes.load("dev", 1, points=8)
    with pytest.raises(ValueError, match="count = 0 shapes: ask for at least 1"):
        shapes.load("train", 0, points=8)
    for arguments in ((-1, 0, 8), (0, -1, 8), (0, 0, 1)):
        with pytest.raises(ValueError, match=r"must be 0 or more, points = \d at least 2"):
            shapes.sample_shape(*arguments[:2], points=arguments[2])


def test_a_shape_takes_milliseconds():
    start = time.process_time()
    shapes.load("train", 4 * COUNT, points=2048)
    assert (time.process_time() - start) / (4 * COUNT) < 0.02  # 2 ms, and slow machines.
