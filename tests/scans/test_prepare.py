"""Checking, canonical order, scaling and reduction, against loops."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxreg.scans import diagnosis, prepare
from jaxreg.scans.config import RegisterConfig


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def test_canonical_form_forgets_order_and_repetition_and_remembers_rows(rng):
    points = rng.integers(-2, 3, (60, 3)).astype(float)
    points[5] = np.nan
    scan = prepare.prepare(points, nonfinite="drop")
    distinct = sorted({tuple(p) for p in np.delete(points, 5, 0)})
    back = scan.points * scan.radius + scan.centre
    np.testing.assert_allclose(back, distinct, atol=1e-12)
    rows = scan.per_input_row(back[:, 0], missing=np.nan)
    np.testing.assert_allclose(rows, points[:, 0], atol=1e-12)


def test_signed_zeros_are_one_number():
    assert len(prepare.prepare([[0.0, 0, 0], [-0.0, 0, 0], [1, 1, 1]]).points) == 2


@pytest.mark.parametrize("kind", ["float32", "float16", "int64", list, np.asfortranarray])
def test_anything_numeric_will_do(rng, kind):
    points = np.round(100 * rng.normal(size=(50, 3)))
    given = points.astype(kind) if isinstance(kind, str) else kind(points)
    scan = prepare.prepare(given)
    assert scan.points.dtype == np.float64
    back = scan.points[scan.row] * scan.radius + scan.centre
    np.testing.assert_allclose(back, points, atol=1e-10)


def test_voxels_against_a_loop(rng):
    points, size = rng.normal(size=(200, 3)), 0.7
    cells = {}
    for point in points:
        cell = tuple(np.floor((point - points.min(axis=0)) / size).astype(int))
        cells.setdefault(cell, []).append(point)
    expected = np.array([np.mean(cells[cell], axis=0) for cell in sorted(cells)])
    np.testing.assert_allclose(prepare.voxel_reduced(points, size), expected, atol=1e-12)


@pytest.mark.parametrize("most", [50, 500, 2048])
def test_reduction_uses_what_it_may(rng, most):
    points = rng.normal(size=(6000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    reduced = prepare.reduce_to(points, most)
    assert 0.7 * most <= len(reduced) <= most


def of_a_cube(count, rng):
    return rng.uniform(size=(count, 3))


def of_a_sphere(count, rng):
    """A Fibonacci lattice: neighbours are about equally far apart everywhere."""
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)


def of_a_raster(count, rng):
    rows = np.arange(count)
    return np.stack([rows % 61, rows // 61, np.zeros(count)], axis=1) * [1, 1, 0.5]


@pytest.mark.parametrize("shape", [of_a_cube, of_a_sphere, of_a_raster])
def test_a_cloud_hardly_larger_than_the_limit_keeps_its_points(rng, shape):
    for count in range(1025, 1450, 17):
        points = shape(count, rng)
        reduced = prepare.reduce_to(points, 1024)
        assert 700 < len(reduced) <= 1024, count
        # Every point is represented: none lies farther from a mean than two cubes of that many.
        nearest = cKDTree(reduced).query(points)[0].max()
        assert nearest < 4 * np.median(cKDTree(points).query(points, k=2)[0][:, 1]) + 1e-9


def test_reduction_with_a_stray_point(rng):
    points = np.concatenate([rng.normal(size=(3000, 3)), [[1e9, 0, 0]]])
    assert len(prepare.reduce_to(points, 500)) > 100


def test_spacing_of_a_grid_is_its_edge():
    grid = np.stack(np.meshgrid(np.arange(30), np.arange(30), [0.0]), axis=-1).reshape(-1, 3)
    assert prepare.spacing(0.25 * grid) == pytest.approx(0.25)
    assert prepare.spacing(1e-12 * grid) == pytest.approx(1e-12)  # in whatever unit


def test_many_rows_of_one_place_far_away_are_one_stray(rng):
    """What did not come back, written as zeros; with normals, and repeated rows."""
    cloud = np.repeat(rng.normal(size=(250, 3)) + [5e5, 4e6, 100], 2, axis=0)
    rows = np.sort(rng.choice(len(cloud), 100, replace=False))
    given = np.insert(cloud, rows, 0, axis=0)
    zero = (given == 0).all(axis=1)
    normals = np.where(zero[:, None], 0, [[0.0, 0, 1]])
    found = prepare.prepare(given, normals=normals)
    np.testing.assert_array_equal(found.kept, ~zero)
    assert found.notes[0].startswith("cloud: 100 points lie 4.03e+06 from the rest")
    again = found.points[found.row] * found.radius + found.centre
    np.testing.assert_allclose(again, cloud, atol=1e-8)
    np.testing.assert_array_equal(found.normals, np.tile([0.0, 0, 1], (250, 1)))
    assert "100 points lie" in diagnosis.findings(given)[0]
    kept = prepare.prepare(given, strays="keep")
    assert kept.kept.all()
    assert kept.radius == pytest.approx(found.radius, rel=0.1)


def test_a_stray_row_does_not_overflow_the_numbers_of_the_cubes(rng):
    """Cells farther apart than int64 has numbers for their products."""
    points = np.concatenate([rng.normal(size=(3000, 3)), 1e14 * np.eye(3)])
    size = 1e-4
    cells = {tuple(np.floor((p - points.min(axis=0)) / size).astype(int)) for p in points}
    assert len(prepare.voxel_reduced(points, size)) == len(cells)


def test_clouds_of_unlike_density_are_thinned_to_one(rng):
    dense = rng.uniform(size=(4000, 3)) * [1, 1, 0]
    sparse = rng.uniform(size=(250, 3)) * [1, 1, 0]
    for scale in (1.0, 250.0):
        clouds = [prepare.prepare(scale * p) for p in (dense, sparse)]
        levels = prepare.at_one_density(*clouds)
        spacings = [
            level.spacing * cloud.radius for level, cloud in zip(levels, clouds, strict=True)
        ]
        assert max(spacings) < 1.4 * min(spacings)
        assert levels[1] is clouds[1].coarse
        assert prepare.at_one_density(*clouds)[0] is levels[0]  # made once


def test_a_level_is_examined_once_and_its_padding_does_not_count(rng):
    plane = rng.uniform(-1, 1, size=(300, 3)) * [5, 3, 0]
    level = prepare.prepare(plane).fine
    found = level.examined
    assert level.examined is found
    np.testing.assert_array_equal(found.mask, np.arange(len(found.mask)) < 300)
    # The unit of the level, in which the spacing of the same points is that of the trees.
    assert float(found.spacing) == pytest.approx(level.spacing, rel=0.01)
    np.testing.assert_allclose(found.rarity[:300], 1, rtol=1e-6)
    assert np.max(found.variation[:300]) < 1e-6


def test_normals_that_are_given_are_used_and_found_ones_are_not(rng):
    plane = rng.uniform(-1, 1, size=(300, 3)) * [1, 1, 0]
    given = np.tile([0.0, 3.0, 4.0], (300, 1))
    index = prepare.prepare(plane, normals=given).fine.index
    np.testing.assert_allclose(index.host_normals, given / 5, atol=1e-6)
    found = prepare.prepare(plane).fine.index.host_normals
    np.testing.assert_allclose(np.abs(found[:, 2]), 1, atol=1e-4)


@pytest.mark.parametrize(
    ("normals", "message"),
    [
        (np.zeros((4, 3)), r"the normals of cloud have shape \(4, 3\): give one for each of its 5"),
        (np.full((5, 3), np.nan), "normal 0 of cloud is not finite"),
        ([["a"] * 3] * 5, "the normals of cloud has dtype"),
    ],
)
def test_wrong_normals_are_named(rng, normals, message):
    with pytest.raises(ValueError, match=message):
        prepare.prepare(rng.normal(size=(5, 3)), normals=normals)


def test_quantised_values_are_near_and_few():
    values = np.geomspace(1e-90, 1e90, 4001)
    steps = np.array([prepare.in_steps(value) for value in values])
    assert np.abs(np.log2(steps / values)).max() <= 1 / 8 + 1e-12
    assert len(np.unique(steps)) < 4.1 * np.log2(1e180)
    assert prepare.in_steps(0.0) == 0.0


@pytest.mark.parametrize("field", ["search_points", "refine_points", "inlier_spacings"])
def test_settings_out_of_range_are_refused(rng, field):
    config = RegisterConfig(**{field: 0})
    with pytest.raises(ValueError, match=f"config.{field} must be"):
        prepare.prepare(rng.normal(size=(50, 3)), config=config)
