"""Checking, canonical order, scaling and reduction, against loops."""

import numpy as np
import pytest

from jaxreg.geometry import clouds, frame
from jaxreg.scans import prepare
from jaxreg.types import RigidTransform


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def test_canonical_form_forgets_order_and_repetition_and_remembers_rows(rng):
    points = rng.integers(-2, 3, (60, 3)).astype(float)
    points[5] = np.nan
    scan = prepare.make_scan(points, "cloud", nonfinite="drop")
    assert [tuple(p) for p in scan.points] == sorted({tuple(p) for p in np.delete(points, 5, 0)})
    np.testing.assert_array_equal(scan.points[scan.row], np.delete(points, 5, 0))
    rows = prepare.per_input_row(scan, scan.points[:, 0], missing=np.nan)
    np.testing.assert_array_equal(rows, points[:, 0])


def test_signed_zeros_are_one_number():
    assert len(prepare.make_scan([[0.0, 0, 0], [-0.0, 0, 0], [1, 1, 1]], "cloud").points) == 2


@pytest.mark.parametrize("kind", ["float32", "float16", "int64", list, np.asfortranarray])
def test_anything_numeric_will_do(rng, kind):
    points = np.round(100 * rng.normal(size=(50, 3)))
    given = points.astype(kind) if isinstance(kind, str) else kind(points)
    scan = prepare.make_scan(given, "cloud")
    assert scan.points.dtype == np.float64
    np.testing.assert_array_equal(scan.points[scan.row], points)


def test_frame_and_back(rng):
    source, reference = rng.normal(size=(50, 3)) + 5e6, 3 * rng.normal(size=(70, 3))
    where = frame.common_frame(source, reference)
    radii = [np.sqrt(np.mean(np.sum((x - x.mean(0)) ** 2, axis=1))) for x in (source, reference)]
    assert where.length == pytest.approx(max(radii))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose = RigidTransform(turn * np.linalg.det(turn), rng.normal(size=3))
    inner = frame.pose_in(where, pose)
    x = (source - where.source_centre) / where.length
    expected = (source @ pose.rotation.T + pose.translation - where.reference_centre) / where.length
    np.testing.assert_allclose(x @ inner.rotation.T + inner.translation, expected, atol=1e-8)
    np.testing.assert_allclose(
        frame.pose_out(where, inner).translation, pose.translation, atol=1e-8
    )


def test_rounding_of_an_offset_is_no_shape():
    points = np.full((10, 3), 5e6)
    points[::2] += 1e-9
    assert frame.common_frame(points, points).length == 1


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


def test_reduction_with_a_stray_point(rng):
    points = np.concatenate([rng.normal(size=(3000, 3)), [[1e9, 0, 0]]])
    assert len(prepare.reduce_to(points, 500)) > 100


def test_spacing_of_a_grid_is_its_edge():
    grid = np.stack(np.meshgrid(np.arange(30), np.arange(30), [0.0]), axis=-1).reshape(-1, 3)
    assert prepare.spacing(0.25 * grid) == pytest.approx(0.25)
    assert prepare.spacing(1e-12 * grid) == pytest.approx(1e-12)  # in whatever unit
    assert prepare.at_one_density(*2 * [np.zeros((5, 3))], 9)[2] == pytest.approx(1e-6)


@pytest.mark.parametrize(
    ("count", "size"), [(1, 128), (128, 128), (129, 256), (1000, 1024), (9999, 2048)]
)
def test_buckets(count, size):
    assert clouds.bucket(count, smallest=128, largest=2048) == size


def test_padding():
    rows, mask = clouds.padded(np.ones((3, 3)), 8)
    assert rows.dtype == np.float32
    np.testing.assert_array_equal(mask, [1, 1, 1, 0, 0, 0, 0, 0])
    assert not rows[3:].any()


def test_nearest_rotation_of_a_mirror_is_a_rotation():
    turned = frame.nearest_rotation(np.diag([1.0, 1, -1]))
    assert np.linalg.det(turned) == pytest.approx(1)
