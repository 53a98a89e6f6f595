"""Two scans in, a pose and a verdict out: known poses, laws, awkward inputs, and clear errors."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural import shapes
from jaxreg.refine import kdtree
from jaxreg.scans import verdict
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.pair import _search, register
from jaxreg.types import RigidTransform

STAIRS, TABLE, CHAIR = 8, 9, 10


def angle_deg(one, other):
    return np.degrees(Rotation.from_matrix(one @ other.T).magnitude())


def halves(index, *, points=1000):
    """Two samplings of one procedural shape that share no point."""
    cloud = shapes.sample_shape(5, index, points=points).astype(np.float64)
    return cloud[: points // 2], cloud[points // 2 :]


def motion(seed):
    rng = np.random.default_rng(seed)
    return RigidTransform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-2, 2, 3))


@pytest.fixture(scope="module")
def pair():
    source, reference = halves(TABLE)
    truth = motion(3)
    return source, reference @ truth.rotation.T + truth.translation, truth


@pytest.fixture(scope="module")
def result(pair):
    return register(*pair[:2])


@pytest.mark.parametrize(
    ("index", "learned"), [(STAIRS, False), (CHAIR, False), (1, False), (CHAIR, True)]
)
def test_any_rotation_of_shapes_that_share_no_point(index, learned, seed):
    source, reference = halves(index)
    truth = motion(seed)
    moved = reference @ truth.rotation.T + truth.translation
    found = register(source, moved, config=RegisterConfig(learned=learned))
    assert angle_deg(found.rotation, truth.rotation) < 2
    centre = source.mean(axis=0)
    error = (found.rotation - truth.rotation) @ centre + found.translation - truth.translation
    assert np.linalg.norm(error) < 0.03
    assert found.success


def test_record(pair, result):
    source, reference, truth = pair
    assert result.rotation.dtype == result.confidence.dtype == np.float64
    np.testing.assert_allclose(result.rotation @ result.rotation.T, np.eye(3), atol=1e-14)
    np.testing.assert_array_equal(result.transformation[:3, :3], result.rotation)
    np.testing.assert_array_equal(result.transformation[:3, 3], result.translation)
    np.testing.assert_array_equal(result.transformation[3], [0, 0, 0, 1])
    assert result.confidence.shape == (len(source),)
    assert np.all((result.confidence >= 0) & (result.confidence <= 1))
    aligned = source @ result.rotation.T + result.translation
    distance = np.linalg.norm(aligned[:, None] - reference[None], axis=2)
    np.testing.assert_allclose(result.correspondences, reference[np.argmin(distance, axis=1)])
    near = distance.min(axis=1) <= result.reach
    assert result.fitness == pytest.approx(near.mean())
    assert result.inlier_rmse == pytest.approx(np.sqrt(np.mean(distance.min(axis=1)[near] ** 2)))
    assert result.covariance.shape == (6, 6)
    assert np.all(np.linalg.eigvalsh(result.covariance) >= 0)
    assert result.weak_directions == ()
    assert result.dropped == 0


def test_noiseless_copy_is_exact(pair):
    source, _, truth = pair
    moved = source @ truth.rotation.T + truth.translation
    found = register(source, moved[::-1])
    assert angle_deg(found.rotation, truth.rotation) < 1e-3
    assert np.abs(found.translation - truth.translation).max() < 1e-4


def test_identical_clouds_stay(pair):
    found = register(pair[0], pair[0])
    np.testing.assert_allclose(found.transformation, np.eye(4), atol=1e-6)


def test_order_and_repetition_of_the_points_change_no_bit(pair, result, seed):
    order = np.random.default_rng(seed).permutation(len(pair[0]))
    again = register(pair[0][order], pair[1][::-1])
    np.testing.assert_array_equal(again.transformation, result.transformation)
    np.testing.assert_array_equal(again.confidence, result.confidence[order])
    repeated = register(np.repeat(pair[0], 10, axis=0), pair[1])
    np.testing.assert_array_equal(repeated.transformation, result.transformation)


def test_same_input_gives_the_same_bits(pair, result):
    again = register(*pair[:2])
    for one, other in zip(again, result, strict=True):
        if isinstance(one, np.ndarray):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_unit_plays_no_role(pair, result, scale):
    found = register(pair[0] * scale, pair[1] * scale)
    assert angle_deg(found.rotation, result.rotation) < 1e-3
    np.testing.assert_allclose(found.translation / scale, result.translation, atol=1e-4)
    assert found.inlier_rmse / scale == pytest.approx(result.inlier_rmse, rel=1e-3)
    assert found.success == result.success


@pytest.mark.parametrize("offset", [1e6, 5e6])
def test_offset_plays_no_role(pair, result, offset):
    shift = offset * np.array([1.0, -0.6, 0.01])
    found = register(pair[0] + shift, pair[1] + shift)
    moved = pair[0] @ result.rotation.T + result.translation
    again = (pair[0] + shift) @ found.rotation.T + found.translation - shift
    np.testing.assert_allclose(again, moved, atol=1e-3)


def test_swapped_clouds_give_the_inverse(pair, result):
    back = register(pair[1], pair[0])
    np.testing.assert_allclose(back.transformation @ result.transformation, np.eye(4), atol=0.02)


@pytest.mark.parametrize("sizes", [(260, 490), (490, 260)])
def test_clouds_of_unlike_sizes(pair, sizes):
    found = register(pair[0][: sizes[0]], pair[1][: sizes[1]])
    assert angle_deg(found.rotation, pair[2].rotation) < 3


def test_mirrored_reference_gives_a_rotation(pair):
    found = register(pair[0], pair[0] * [1, 1, -1])
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_clouds_without_common_surface_are_no_success():
    cloud = np.concatenate(halves(CHAIR, points=1000))
    found = register(cloud[cloud[:, 0] < -0.1], cloud[cloud[:, 0] > 0.1])
    assert not found.success
    other = register(halves(STAIRS)[0], halves(1)[1])
    assert not other.success


def test_given_pose_skips_the_search(pair):
    source, reference, truth = pair
    near = Rotation.from_rotvec([0.05, -0.04, 0.03]).as_matrix() @ truth.rotation
    shift = truth.translation + truth.rotation @ source.mean(axis=0) - near @ source.mean(axis=0)
    found = register(source, reference, initial=RigidTransform(near, shift))
    assert angle_deg(found.rotation, truth.rotation) < 1
    kept = register(source, reference, initial=RigidTransform(near, shift), refine=None)
    np.testing.assert_allclose(kept.rotation, near, atol=1e-14)
    np.testing.assert_allclose(kept.translation, shift, atol=1e-14)
    assert np.isnan(found.evidence.rival)
    assert np.isfinite(found.covariance).all()
    assert np.isnan(kept.covariance).all()  # zero would say that the pose is known for sure


def test_a_pose_that_is_not_refined_stays_even_where_points_coincide():
    turn = Rotation.from_rotvec(np.radians(30) * np.array([1, 2, 3]) / 14**0.5).as_matrix()
    start = np.block([[turn, np.zeros((3, 1))], [0, 0, 0, 1]])  # about the middle of the grid
    grid = np.stack(np.meshgrid(*[np.arange(-1.0, 2)] * 3), axis=-1).reshape(-1, 3)
    kept = register(grid, grid, initial=start, refine=None)
    np.testing.assert_allclose(kept.transformation, start, atol=1e-14)


@pytest.mark.parametrize("method", ["icp", "point_to_plane", None])
def test_other_refinements(pair, method):
    found = register(*pair[:2], refine=method)
    assert angle_deg(found.rotation, pair[2].rotation) < 3


def test_limited_rotation_is_kept(pair):
    found = register(*pair[:2], rotation="limited")
    assert np.degrees(Rotation.from_matrix(found.rotation).magnitude()) < 95
    assert found.evidence.rival <= verdict.NO_RIVAL  # and no pose beyond counts as a rival


def test_limited_rotation_is_kept_where_all_rotations_fit(seed):
    """A vase looks alike from everywhere: of some two dozen distinct poses one is within bounds."""
    rng = np.random.default_rng(seed)
    angle, height = rng.uniform(0, 2 * np.pi, (2, 450)), rng.uniform(-0.8, 0.8, (2, 450))
    radius = 0.4 + 0.15 * np.sin(4 * height)
    vases = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)
    found = register(*vases, rotation="limited", config=RegisterConfig(limited_deg=10))
    assert np.degrees(Rotation.from_matrix(found.rotation).magnitude()) < 15


def test_nonfinite_points_are_named_or_dropped(pair, result):
    source = np.insert(pair[0], 7, [[np.nan, 0, 0], [0, np.inf, 0]], axis=0)
    with pytest.raises(ValueError, match=r"source: point 7 is .*nan.* and 2 of .*nonfinite='drop'"):
        register(source, pair[1])
    found = register(source, pair[1], nonfinite="drop")
    assert found.dropped == 2
    np.testing.assert_array_equal(found.transformation, result.transformation)
    assert np.isnan(found.correspondences[7:9]).all()
    assert not found.confidence[7:9].any()
    np.testing.assert_array_equal(np.delete(found.confidence, [7, 8]), result.confidence)


LINE = np.outer(np.linspace(0, 1, 20), [1, 2, 3])
rng = np.random.default_rng(0)
AWKWARD = {
    "line": LINE,
    "three points": np.eye(3),
    "one place": np.ones((5, 3)),
    "two places": np.repeat([[0.0, 0, 0], [1, 1, 1]], 4, axis=0),
    "plane": np.c_[rng.normal(size=(60, 2)), np.zeros(60)],
    "grid": np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3),
    "tiny": 1e-200 * rng.normal(size=(40, 3)),
    "huge": 1e90 * rng.normal(size=(40, 3)),
    "far": 5e6 + 1e-3 * rng.normal(size=(40, 3)),
    "stray": np.concatenate([rng.normal(size=(300, 3)), [[1e9, 0, 0]]]),
    "ball": rng.normal(size=(200, 3)),
}


@pytest.mark.parametrize("name", AWKWARD)
def test_awkward_clouds_give_a_finite_rotation(name):
    for other in (AWKWARD[name], AWKWARD["ball"][:50]):
        found = register(AWKWARD[name], other)
        assert np.isfinite(found.transformation).all()
        np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(found.rotation) > 0
        assert np.isfinite(found.confidence).all()
        assert np.isfinite(found.covariance).all() or np.isnan(found.covariance).all()


@pytest.mark.parametrize("name", ["line", "three points", "one place", "plane"])
def test_what_fixes_no_pose_is_no_success(name):
    assert not register(AWKWARD[name], AWKWARD[name]).success


@pytest.mark.parametrize("kind", [np.float32, np.float16, list, np.asfortranarray, np.int64])
def test_anything_numeric_will_do(pair, kind):
    source = np.round(100 * pair[0])
    given = source.tolist() if kind is list else source
    given = kind(source) if kind is np.asfortranarray else given
    given = source.astype(kind) if isinstance(kind, type) and kind is not list else given
    expected = register(source, 100 * pair[1])
    np.testing.assert_array_equal(
        register(given, 100 * pair[1]).transformation, expected.transformation
    )


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        (np.zeros((0, 3)), "0 finite points"),
        (np.zeros((2, 3)), "2 finite points"),
        (np.zeros(6), r"shape \(6,\)"),
        (np.zeros((4, 2)), r"shape \(4, 2\)"),
        (np.zeros((2, 4, 3)), r"shape \(2, 4, 3\)"),
        (np.zeros((4, 3), object), "dtype object"),
        (np.zeros((4, 3), complex), "dtype complex128"),
        (np.zeros((4, 3), bool), "dtype bool"),
        ([["a", "b", "c"]] * 4, "dtype <U1"),
        ([[1, 2, 3], [4, 5]], "no array"),
        (None, "dtype object"),
        (np.full((4, 3), 1e200), "larger unit"),
    ],
)
def test_what_is_no_cloud_is_a_clear_error(bad, told):
    with pytest.raises(ValueError, match=told):
        register(bad, np.eye(3))
    with pytest.raises(ValueError, match="reference"):
        register(np.eye(3), bad)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"initial": np.eye(3)}, "4x4"),
        ({"initial": np.diag([2.0, 2, 2, 1])}, "no rigid transform"),
        ({"initial": np.diag([1.0, 1, -1, 1])}, "no rigid transform"),
        ({"initial": np.full((4, 4), np.nan)}, "NaN"),
    ],
)
def test_bad_options(options, told):
    with pytest.raises(ValueError, match=told):
        register(np.eye(3), np.eye(3), **options)


@pytest.mark.untyped
@pytest.mark.parametrize(
    "options", [{"rotation": "some"}, {"refine": "magic"}, {"nonfinite": "ignore"}]
)
def test_unknown_options(options):
    with pytest.raises(ValueError, match="must be"):
        register(np.eye(3), np.eye(3), **options)


def test_sizes_in_one_bucket_compile_once(pair):
    register(pair[0][:490], pair[1][:480])
    compiled = [f._cache_size() for f in (_search(False).func, kdtree._step, kdtree._normals)]
    for size in range(460, 500, 5):
        register(pair[0][:size], pair[1][: size - 3])
    assert [
        f._cache_size() for f in (_search(False).func, kdtree._step, kdtree._normals)
    ] == compiled


def test_units_that_differ_beyond_single_precision(pair):
    for scale in (1e98, 1e-98):
        result = register(np.ones((3, 3)), scale * np.array([[1.0, 2, 3]] * 3))
        assert np.isfinite(result.transformation).all()
        assert not result.success
        assert np.isfinite(register(pair[0], scale * pair[1]).transformation).all()
