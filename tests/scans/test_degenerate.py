"""What `register` does with degenerate scans (see test_degenerate.py)."""

import jax
import numpy as np
import pytest

from jaxreg.scans.pair import register
from tests.scenes import angle_deg, assert_proper, moved, pose, revolved, shape


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def test_t01_identical_clouds(rng):
    points = shape(rng)
    result = register(points, points)
    np.testing.assert_allclose(result.rotation, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(result.translation, 0, atol=2e-6)


def test_t02_known_pose_without_noise_in_another_order(rng):
    points, (rotation, translation) = shape(rng), pose(rng)
    reference = rng.permutation(moved(points, rotation, translation))
    result = register(points.astype(np.float32), reference.astype(np.float32))
    assert angle_deg(result.rotation, rotation) < 1e-3
    np.testing.assert_allclose(result.translation, translation, atol=1e-4)


def test_t03_swapped_clouds_give_the_inverse(rng):
    points, (rotation, translation) = shape(rng), pose(rng)
    reference = moved(points, rotation, translation)
    there, back = register(points, reference), register(reference, points)
    product = there.transformation @ back.transformation
    np.testing.assert_allclose(product, np.eye(4), atol=1e-4)


@pytest.mark.parametrize("generic", [False, True], ids=["z = 0", "any plane"])
def test_t04_coplanar_points(rng, generic):
    points = rng.normal(size=(20, 3)) * [1.0, 1.0, 0.0]
    if generic:
        points = moved(points, *pose(rng))
    assert_proper(register(points, moved(points, *pose(rng))).rotation)


@pytest.mark.parametrize("name", ["circle", "cylinder", "sphere"])
def test_t05_shapes_of_revolution_get_one_of_the_best_poses(rng, name):
    points = revolved(rng, name)
    result = register(points, moved(points, *pose(rng)))
    assert_proper(result.rotation)
    # Any turn about the axis is as good: the residual is the spacing of the points at most.
    assert result.inlier_rmse < 0.3


@pytest.mark.parametrize("count", [0, 1, 2, 6])
def test_t06_t07_points_of_a_line_and_fewer(rng, count):
    points = np.outer(np.arange(count) + 1.0, [1.0, -2.0, 0.5])
    reference = moved(points, *pose(rng))
    if count < 3:
        with pytest.raises(ValueError, match="at least 3"):
            register(points, reference)
    else:
        assert_proper(register(points, reference).rotation)


def test_t08_each_point_ten_times_is_the_same_as_once(rng):
    points, (rotation, translation) = shape(rng), pose(rng)
    reference = moved(points, rotation, translation) + rng.normal(0, 0.01, points.shape)
    once = register(points, reference)
    often = register(
        rng.permutation(np.repeat(points, 10, axis=0)), np.repeat(reference, 10, axis=0)
    )
    np.testing.assert_allclose(often.transformation, once.transformation, atol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_t09_a_point_that_is_not_finite(rng, bad):
    points, (rotation, translation) = shape(rng), pose(rng)
    reference = moved(points, rotation, translation)
    broken = points.copy()
    broken[17, 1] = bad
    with pytest.raises(ValueError, match=r"source: point 17 .*nonfinite='drop'"):
        register(broken, reference)
    with pytest.raises(ValueError, match=r"reference: point 17 "):
        register(points, broken)
    result = register(broken, reference, nonfinite="drop")
    assert result.dropped == 1
    assert result.confidence.shape == (len(points),)
    assert angle_deg(result.rotation, rotation) < 0.1


@pytest.mark.parametrize("sizes", [(500, 3000), (3000, 500)])
def test_t10_clouds_of_very_different_sizes(rng, sizes):
    source, reference = (shape(rng, n) for n in sizes)
    rotation, translation = pose(rng)
    result = register(source, moved(reference, rotation, translation))
    assert angle_deg(result.rotation, rotation) < 2
    assert result.confidence.shape == (len(source),)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_t11_the_unit_plays_no_role(rng, scale):
    points, (rotation, translation) = shape(rng), pose(rng)
    reference = moved(points, rotation, translation)
    plain, scaled = register(points, reference), register(scale * points, scale * reference)
    assert angle_deg(scaled.rotation, plain.rotation) < 1e-3
    np.testing.assert_allclose(scaled.translation / scale, plain.translation, atol=1e-4)


@pytest.mark.parametrize("offset", [1e6, 5e6])
def test_t12_far_from_the_origin(rng, offset):
    points, (rotation, translation) = shape(rng), pose(rng)
    reference = moved(points, rotation, translation)
    shift = np.array([offset, -offset, 0.3 * offset])
    near, far = register(points, reference), register(points + shift, reference + shift)
    assert angle_deg(far.rotation, near.rotation) < 0.01
    # Where the points land, in the frame of the reference without its offset.
    landed = moved(points + shift, far.rotation, far.translation) - shift
    extent = np.ptp(points, axis=0).max()
    expected = moved(points, near.rotation, near.translation)
    np.testing.assert_allclose(landed, expected, atol=1e-3 * extent)


def test_t14_clouds_without_overlap_get_no_confident_pose(rng):
    flat = rng.uniform(size=(300, 3)) * [2.0, 1.0, 0.0]
    ball = rng.normal(size=(300, 3))
    ball *= 0.5 / np.linalg.norm(ball, axis=1, keepdims=True)
    result = register(flat, ball)
    assert_proper(result.rotation)
    assert not result.success


@pytest.mark.parametrize(("overlap", "outliers"), [(0.9, 0.0), (0.9, 0.2), (0.7, 0.0)])
def test_t15_part_of_the_points_in_common_and_outliers(rng, overlap, outliers):
    points, (rotation, translation) = shape(rng, 800), pose(rng)
    order = np.argsort(points[:, 0])
    cut = int(round(len(points) * (1 - overlap) / 2))
    source, reference = points[order[cut:]], points[order[: len(points) - cut]]
    extra = rng.uniform(-1, 3, (int(outliers * len(source)), 3))
    source = np.concatenate([source, extra])
    result = register(source, moved(reference, rotation, translation))
    error = angle_deg(result.rotation, rotation)
    print(f"overlap {overlap}, outliers {outliers}: {error:.3f} degrees")
    assert error < 2


def test_t16_a_mirrored_reference_never_gives_a_mirror(rng):
    points = shape(rng)
    assert_proper(register(points, points * [1.0, 1.0, -1.0]).rotation)


@pytest.mark.parametrize("kind", ["generic", "grid", "duplicates"])
def test_t20_the_order_of_the_points_plays_no_role(rng, kind):
    points, (rotation, translation) = shape(rng), pose(rng)
    if kind == "grid":
        axis = np.arange(7.0)
        points = np.stack(np.meshgrid(axis, axis[:4], axis[:2]), axis=-1).reshape(-1, 3)
    if kind == "duplicates":
        points = np.repeat(points[::3], 3, axis=0)
    reference = moved(points, rotation, translation)
    p, q = rng.permutation(len(points)), rng.permutation(len(points))
    result, permuted = register(points, reference), register(points[p], reference[q])
    np.testing.assert_array_equal(permuted.transformation, result.transformation)
    np.testing.assert_array_equal(permuted.confidence, result.confidence[p])
    np.testing.assert_array_equal(permuted.correspondences, result.correspondences[p])


def test_t21_same_input_same_bits(rng):
    points, (rotation, translation) = shape(rng), pose(rng)
    reference = moved(points, rotation, translation)
    first, second = register(points, reference), register(points, reference)
    np.testing.assert_array_equal(first.transformation, second.transformation)


def test_t23_ten_sizes_in_one_bucket_compile_once(rng):
    compilations = []

    def listen(event, duration, **_):
        if event.endswith("backend_compile_duration"):
            compilations.append(event)

    clouds = {n: (shape(rng, n), *pose(rng)) for n in (260, *range(264, 300, 4))}
    for n, (points, rotation, translation) in clouds.items():
        result = register(points, moved(points, rotation, translation))
        assert_proper(result.rotation)
        if n == 260:
            jax.monitoring.register_event_duration_secs_listener(listen)
    jax.monitoring.unregister_event_duration_listener(listen)
    assert len(compilations) == 0


def test_t25_a_regular_grid():
    axis = np.arange(3.0)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    assert_proper(register(grid, grid + 0.1).rotation)
