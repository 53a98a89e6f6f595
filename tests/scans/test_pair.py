"""Two scans in, a pose and a verdict out: known poses, laws, awkward inputs, and clear errors.

T01 to T25 are the degenerate cases that every room is tested with.
"""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural import shapes
from jaxreg.geometry import trees
from jaxreg.refine import kdtree
from jaxreg.refine.config import RefineConfig
from jaxreg.scans import prepare
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.pair import register
from jaxreg.search.config import SearchConfig
from jaxreg.types import RigidTransform
from tests.scenes import angle_deg, assert_proper, moved, pose, revolved, shape

STAIRS, TABLE, CHAIR = 8, 9, 10
UNREFINED = RegisterConfig(refine=None)
NARROW = RegisterConfig(wide=None)
"""For tests to which the wider search, which takes far longer here, is nothing but a second one."""


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


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
    return source, moved(reference, *truth), truth


@pytest.fixture(scope="module")
def result(pair):
    return register(*pair[:2])


@pytest.mark.parametrize(
    ("index", "learned"), [(STAIRS, False), (CHAIR, False), (1, False), (CHAIR, True)]
)
def test_any_rotation_of_shapes_that_share_no_point(index, learned, seed):
    source, reference = halves(index)
    truth = motion(seed)
    found = register(source, moved(reference, *truth), config=RegisterConfig(learned=learned))
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
    near = distance.min(axis=1) <= result.max_correspondence_distance
    assert result.fitness == pytest.approx(near.mean())
    assert result.inlier_rmse == pytest.approx(np.sqrt(np.mean(distance.min(axis=1)[near] ** 2)))
    assert result.covariance.shape == (6, 6)
    assert np.all(np.linalg.eigvalsh(result.covariance) >= 0)
    assert result.weak_directions == ()
    assert result.dropped == 0
    assert result.success == (result.probability >= 0.5) == (result.reason == "")
    assert 0 <= result.probability + sum(o.probability for o in result.alternatives) <= 1 + 1e-9
    assert 0 < result.evidence.smaller <= result.evidence.larger <= 1


def test_identical_clouds_stay(pair):
    """T01."""
    found = register(pair[0], pair[0])
    np.testing.assert_allclose(found.transformation, np.eye(4), atol=1e-6)


def test_noiseless_copy_is_exact_and_its_swap_the_inverse(pair):
    """T02, T03."""
    source, _, truth = pair
    reference = moved(source, *truth)[::-1]
    found = register(source.astype(np.float32), reference.astype(np.float32))
    assert angle_deg(found.rotation, truth.rotation) < 1e-3
    assert np.abs(found.translation - truth.translation).max() < 1e-4
    back = register(reference, source)
    np.testing.assert_allclose(back.transformation @ found.transformation, np.eye(4), atol=1e-4)


def test_swapped_clouds_give_the_inverse(pair, result):
    """T03, where the clouds share no point."""
    back = register(pair[1], pair[0])
    np.testing.assert_allclose(back.transformation @ result.transformation, np.eye(4), atol=0.02)


def test_coplanar_points_have_one_rotation(rng):
    """T04."""
    points = moved(rng.normal(size=(200, 3)) * [1.0, 1.0, 0.0], *pose(rng))
    reference = moved(points, *pose(rng))
    centred = (x - x.mean(axis=0) for x in (reference, points))
    expected = Rotation.align_vectors(*centred)[0].as_matrix()
    assert angle_deg(register(points, rng.permutation(reference)).rotation, expected) < 1e-3


@pytest.mark.parametrize("name", ["circle", "cylinder", "sphere"])
def test_shapes_of_revolution_get_one_of_the_best_poses(rng, name):
    """T05: any turn about the axis is as good, but the points lie on the surface of the reference."""
    points = revolved(rng, name)
    rotation, translation = pose(rng)
    found = register(points, moved(points, rotation, translation))
    assert_proper(found.rotation)
    back = (moved(points, found.rotation, found.translation) - translation) @ rotation
    radial = back if name == "sphere" else back[:, :2]
    np.testing.assert_allclose(np.linalg.norm(radial, axis=1), 1, atol=1e-3)
    if name == "circle":
        np.testing.assert_allclose(back[:, 2], 0, atol=1e-3)


def test_order_and_repetition_of_the_points_change_no_bit(pair, result, rng):
    """T08, T20."""
    order = rng.permutation(len(pair[0]))
    again = register(pair[0][order], pair[1][::-1])
    np.testing.assert_array_equal(again.transformation, result.transformation)
    np.testing.assert_array_equal(again.confidence, result.confidence[order])
    np.testing.assert_array_equal(again.correspondences, result.correspondences[order])
    often = rng.permutation(np.repeat(pair[0], 10, axis=0)), np.repeat(pair[1], 10, axis=0)
    np.testing.assert_array_equal(register(*often).transformation, result.transformation)


def test_order_changes_no_bit_where_distances_tie(rng):
    """T20."""
    axis = np.arange(7.0)
    points = np.stack(np.meshgrid(axis, axis[:4], axis[:2]), axis=-1).reshape(-1, 3)
    reference = moved(points, *pose(rng))
    p, q = rng.permutation(len(points)), rng.permutation(len(points))
    found, permuted = register(points, reference), register(points[p], reference[q])
    np.testing.assert_array_equal(permuted.transformation, found.transformation)
    np.testing.assert_array_equal(permuted.confidence, found.confidence[p])
    np.testing.assert_array_equal(permuted.correspondences, found.correspondences[p])


def test_same_input_gives_the_same_bits(pair, result):
    """T21."""
    again = register(*pair[:2])
    for field in dataclasses.fields(result):
        one, other = (getattr(found, field.name) for found in (again, result))
        if isinstance(one, np.ndarray):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 2.0**-8, 2.0**40, 1e3, 1e6])
def test_unit_plays_no_role(pair, result, scale):
    """T11. The search works in units a fifth apart, so that clouds are described once for many pairs.

    A power of two changes no bit; any other scale starts the refinement elsewhere, by less than the
    points determine the pose.
    """
    found = register(pair[0] * scale, pair[1] * scale)
    if np.log2(scale).is_integer():
        np.testing.assert_array_equal(found.rotation, result.rotation)
        np.testing.assert_array_equal(found.confidence, result.confidence)
    assert angle_deg(found.rotation, result.rotation) < 0.01
    np.testing.assert_allclose(found.translation / scale, result.translation, atol=3e-4)
    assert found.inlier_rmse / scale == pytest.approx(result.inlier_rmse, rel=1e-3)
    assert found.success == result.success


@pytest.mark.parametrize("offset", [1e6, 5e6])
def test_offset_plays_no_role(pair, result, offset):
    """T12: compared where the points land, in the frame of the reference without its offset."""
    shift = offset * np.array([1.0, -0.6, 0.01])
    found = register(pair[0] + shift, pair[1] + shift)
    assert angle_deg(found.rotation, result.rotation) < 0.01
    landed = moved(pair[0] + shift, found.rotation, found.translation) - shift
    expected = moved(pair[0], result.rotation, result.translation)
    np.testing.assert_allclose(landed, expected, atol=1e-3)


@pytest.mark.parametrize("sizes", [(500, 3000), (3000, 500)])
def test_clouds_of_very_different_sizes(rng, sizes):
    """T10. Few points in the search, so that it is compiled for no other size."""
    source, reference = (shape(rng, n) for n in sizes)
    rotation, translation = pose(rng)
    few = RegisterConfig(search_points=512)
    found = register(source, moved(reference, rotation, translation), config=few)
    assert angle_deg(found.rotation, rotation) < 0.5
    assert found.confidence.shape == (len(source),)


@pytest.mark.parametrize(("overlap", "outliers"), [(0.9, 0.0), (0.9, 0.2), (0.7, 0.0)])
def test_part_of_the_points_in_common_and_outliers(rng, overlap, outliers):
    """T15."""
    points, (rotation, translation) = shape(rng, 440), pose(rng)
    order = np.argsort(points[:, 0])
    cut = int(round(len(points) * (1 - overlap) / 2))
    source, reference = points[order[cut:]], points[order[: len(points) - cut]]
    extra = rng.uniform(-1, 3, (int(outliers * len(source)), 3))
    source = np.concatenate([source, extra])
    found = register(source, moved(reference, rotation, translation))
    assert angle_deg(found.rotation, rotation) < 0.1


def test_mirrored_reference_gives_a_rotation(pair):
    """T16."""
    assert_proper(register(pair[0], pair[0] * [1, 1, -1], config=NARROW).rotation)


@pytest.mark.slow
def test_clouds_without_common_surface_are_no_success():
    """T14."""
    for source, reference in (
        (halves(STAIRS)[0], halves(1)[1]),
        (halves(CHAIR)[0], halves(STAIRS)[1]),
    ):
        found = register(source, reference)
        assert_proper(found.rotation)
        assert not found.success


def test_the_two_sides_of_a_chair_are_no_success():
    """T14: one is the mirror image of the other, and fits better if it is mirrored."""
    cloud = np.concatenate(halves(CHAIR, points=1000))
    assert not register(cloud[cloud[:, 0] < -0.1], cloud[cloud[:, 0] > 0.1]).success


def test_given_pose_skips_the_search(pair):
    source, reference, truth = pair
    near = Rotation.from_rotvec([0.05, -0.04, 0.03]).as_matrix() @ truth.rotation
    shift = truth.translation + truth.rotation @ source.mean(axis=0) - near @ source.mean(axis=0)
    found = register(source, reference, initial=RigidTransform(near, shift))
    assert angle_deg(found.rotation, truth.rotation) < 1
    kept = register(source, reference, initial=RigidTransform(near, shift), config=UNREFINED)
    np.testing.assert_allclose(kept.rotation, near, atol=1e-14)
    np.testing.assert_allclose(kept.translation, shift, atol=1e-14)
    assert found.alternatives == ()
    assert np.isfinite(found.evidence).all()
    assert np.isfinite(found.covariance).all()
    assert np.isnan(kept.covariance).all()  # zero would say that the pose is known for sure


def test_a_pose_that_is_not_refined_stays_even_where_points_coincide():
    turn = Rotation.from_rotvec(np.radians(30) * np.array([1, 2, 3]) / 14**0.5).as_matrix()
    start = np.block([[turn, np.zeros((3, 1))], [0, 0, 0, 1]])  # about the middle of the grid
    grid = np.stack(np.meshgrid(*[np.arange(-1.0, 2)] * 3), axis=-1).reshape(-1, 3)
    kept = register(grid, grid, initial=start, config=UNREFINED)
    np.testing.assert_allclose(kept.transformation, start, atol=1e-14)


@pytest.mark.parametrize("method", ["icp", "point_to_plane", None])
def test_other_refinements(pair, method):
    refine = method and dataclasses.replace(RegisterConfig().refine, method=method)
    found = register(*pair[:2], config=RegisterConfig(refine=refine))
    assert angle_deg(found.rotation, pair[2].rotation) < 3


def test_limited_rotation_is_kept(pair):
    found = register(*pair[:2], max_rotation_deg=80)
    # The right pose turns by 160 degrees; a refinement may turn on, but hardly.
    assert angle_deg(found.rotation, np.eye(3)) < 80.5
    for other in found.alternatives:  # and no pose beyond counts as a rival
        assert angle_deg(other.transform.rotation, np.eye(3)) < 80.5


@pytest.mark.slow
def test_limited_rotation_is_kept_where_all_rotations_fit(seed):
    """A vase looks alike from everywhere: of some two dozen distinct poses one is within bounds."""
    rng = np.random.default_rng(seed)
    angle, height = rng.uniform(0, 2 * np.pi, (2, 450)), rng.uniform(-0.8, 0.8, (2, 450))
    radius = 0.4 + 0.15 * np.sin(4 * height)
    vases = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1)
    found = register(*vases, max_rotation_deg=10)
    assert angle_deg(found.rotation, np.eye(3)) < 15


def test_nonfinite_points_are_named_or_dropped(pair, result):
    """T09."""
    bad = [[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf]]
    source = np.insert(pair[0], 7, bad, axis=0)
    message = r"source: 3 of .*, the first is point 7, .*nan.*nonfinite='drop'"
    with pytest.raises(ValueError, match=message):
        register(source, pair[1])
    for row in bad[1:]:
        with pytest.raises(ValueError, match=r"reference: .*point 17"):
            register(pair[0], np.insert(pair[1], 17, row, axis=0))
    found = register(source, pair[1], nonfinite="drop")
    assert found.dropped == 3
    np.testing.assert_array_equal(found.transformation, result.transformation)
    assert np.isnan(found.correspondences[7:10]).all()
    assert not found.confidence[7:10].any()
    np.testing.assert_array_equal(np.delete(found.confidence, [7, 8, 9]), result.confidence)


LINE = np.outer(np.linspace(0, 1, 20), [1, 2, 3])
draws = np.random.default_rng(0)
AWKWARD = {
    "line": LINE,
    "three points": np.eye(3),
    "one place": np.ones((5, 3)),
    "two places": np.repeat([[0.0, 0, 0], [1, 1, 1]], 4, axis=0),
    "plane": np.c_[draws.normal(size=(60, 2)), np.zeros(60)],
    "grid": np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3),
    "tiny": 1e-200 * draws.normal(size=(40, 3)),
    "huge": 1e90 * draws.normal(size=(40, 3)),
    "far": 5e6 + 1e-3 * draws.normal(size=(40, 3)),
    "stray": np.concatenate([draws.normal(size=(300, 3)), [[1e9, 0, 0]]]),
    "ball": draws.normal(size=(200, 3)),
}


FIXES_NO_POSE = ("line", "three points", "one place")
"""Points of one z fix a pose in their plane."""


@pytest.mark.parametrize("name", AWKWARD)
def test_awkward_clouds_give_a_finite_rotation(name):
    """T06: and what fixes no pose is no success."""
    for other in (AWKWARD[name], AWKWARD["ball"][:50]):
        found = register(AWKWARD[name], other, config=NARROW)
        assert np.isfinite(found.transformation).all()
        assert_proper(found.rotation, 1e-12)
        assert np.isfinite(found.confidence).all()
        assert np.isfinite(found.covariance).all() or np.isnan(found.covariance).all()
        assert name not in FIXES_NO_POSE or not found.success


@pytest.mark.parametrize("ratio", [1e7, 1e29, 1e300])
def test_a_cloud_that_is_a_point_of_the_other_is_told_and_moved_to_its_middle(rng, ratio):
    ball = rng.normal(size=(90, 3))
    for pair, larger in (((ball, ball / ratio), "source"), ((ball / ratio, ball), "reference")):
        found = register(*pair, config=NARROW)
        assert not found.success
        assert found.reason.startswith(f"The {larger} is more than 1,000,000 times")
        moved = pair[0] @ found.rotation.T + found.translation
        np.testing.assert_allclose(moved.mean(axis=0), pair[1].mean(axis=0), atol=1e-12)
        near = np.linalg.norm(found.correspondences[:, None] - pair[1], axis=2).min(axis=1)
        assert near.max() < 1e-15


def test_a_cloud_of_one_place_is_told(rng):
    for pair in (
        (np.ones((9, 3)), rng.normal(size=(90, 3))),
        (np.ones((9, 3)), np.eye(3) * 1e-300),
    ):
        assert "source lie in one place" in register(*pair, config=NARROW).reason
        start = np.eye(4) + 2 * np.eye(4, k=3)
        assert register(*pair, initial=start, config=NARROW).translation[0] == pytest.approx(2)


@pytest.mark.slow
def test_a_regular_grid_is_laid_on_the_grid(rng):
    """T25: every point looks like every other; any symmetry of the cube is as good."""
    axis = np.arange(3.0)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    rotation, translation = pose(rng)
    found = register(grid, moved(grid, rotation, translation))
    back = (moved(grid, found.rotation, found.translation) - translation) @ rotation
    np.testing.assert_allclose(back, np.round(back), atol=1e-4)
    assert {tuple(x) for x in np.round(back)} == {tuple(x) for x in grid}


def test_a_copy_of_a_solid_grid_is_no_success():
    """Four poses agree to the last digit; more points than are judged, so that by chance one wins."""
    sizes = map(np.arange, (14.0, 17.0, 20.0))
    grid = np.stack(np.meshgrid(*sizes, indexing="ij"), axis=-1).reshape(-1, 3)
    for seed in (0, 7):
        turned = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
        found = register(grid, moved(grid, turned, np.array([1.0, -2.0, 3.0])))
        assert not found.success, seed
        assert len(found.alternatives) >= 3, seed
        rest = grid[~((grid[:, 0] > 7) & (grid[:, 1] > 8))]
        found = register(rest, moved(rest, turned, np.array([1.0, -2.0, 3.0])))
        assert found.success, seed
        assert angle_deg(found.rotation, turned) < 0.1, seed


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        (np.zeros((0, 3)), "0 finite points"),
        (np.zeros((2, 3)), "2 finite points"),
        (np.zeros(6), r"shape \(6,\)"),
        (np.zeros((4, 2)), r"shape \(4, 2\)"),
        (np.zeros((2, 4, 3)), r"shape \(2, 4, 3\)"),
        (np.zeros((4, 3), complex), "dtype complex128"),
        (np.zeros((4, 3), bool), "dtype bool"),
        ([["a", "b", "c"]] * 4, "dtype <U1"),
        ([[1, 2, 3], [4, 5]], "not an array"),
        (None, "NoneType"),
        (np.full((4, 3), 1e200), "larger unit"),
    ],
)
def test_what_is_no_cloud_is_a_clear_error(bad, told):
    """T07."""
    with pytest.raises(ValueError, match=told):
        register(bad, np.eye(3))
    with pytest.raises(ValueError, match="reference"):
        register(np.eye(3), bad)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"initial": np.eye(3)}, "4x4"),
        ({"initial": np.diag([2.0, 2, 2, 1])}, "not a rigid transform"),
        ({"initial": np.diag([1.0, 1, -1, 1])}, "not a rigid transform"),
        ({"initial": np.full((4, 4), np.nan)}, "NaN"),
        ({"max_rotation_deg": 0.0}, "above 0 and at most 180"),
        ({"max_rotation_deg": np.nan}, "above 0 and at most 180"),
        ({"max_rotation_deg": 181.0}, "leave it out"),
        ({"config": RegisterConfig(search_points=3)}, "config.search_points must be at least 16"),
        ({"config": RegisterConfig(inlier_spacings=np.nan)}, "config.inlier_spacings must be pos"),
    ],
)
def test_bad_options(options, told):
    with pytest.raises(ValueError, match=told):
        register(np.eye(3), np.eye(3), **options)


@pytest.mark.untyped
def test_unknown_options():
    with pytest.raises(ValueError, match="nonfinite must be"):
        register(np.eye(3), np.eye(3), nonfinite="ignore")
    magic = RegisterConfig(refine=RefineConfig(method="magic"))
    with pytest.raises(ValueError, match="method 'magic' does not exist"):
        register(np.eye(3), np.eye(3), config=magic)


def test_sizes_in_one_bucket_compile_once(pair):
    """T23."""
    compiled = []

    def listen(event, duration, **_):
        if event.endswith("backend_compile_duration"):
            compiled.append(event)

    register(pair[0][:490], pair[1][:480])
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for size in (459, 470, 481, 490, 499):
            register(pair[0][:size], pair[1][: size - 3])
        assert not compiled
        jax.jit(lambda x: x + 1)(0.0)
        assert compiled, "a compilation is heard"
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def test_units_that_differ_beyond_single_precision(pair):
    for scale in (1e98, 1e-98):
        result = register(np.ones((3, 3)), scale * np.array([[1.0, 2, 3]] * 3), config=NARROW)
        assert np.isfinite(result.transformation).all()
        assert not result.success
        assert np.isfinite(register(pair[0], scale * pair[1], config=NARROW).transformation).all()


def counted(monkeypatch, module, name, calls):
    original = getattr(module, name)

    def counting(*arguments, **keywords):
        calls.append(name)
        return original(*arguments, **keywords)

    monkeypatch.setattr(module, name, counting)


def test_a_prepared_cloud_is_not_worked_on_again(pair, result, monkeypatch):
    """Neither checked, ordered, thinned, indexed nor described, whoever it meets."""
    source, reference = (prepare.prepare(points) for points in pair[:2])
    third = prepare.prepare(pair[1] @ np.diag([1.0, -1, -1]) + 5)
    found = register(source, reference)
    np.testing.assert_array_equal(found.transformation, result.transformation)
    register(source, third)
    register(third, source)  # the tree of all points is that of a reference
    calls = []
    for module, names in (
        (prepare, ("check_points", "_distinct", "reduce_to", "_describe")),
        (kdtree, ("_described",)),
        (trees, ("Tree",)),
    ):
        for name in names:
            counted(monkeypatch, module, name, calls)
    again = register(source, reference)
    register(reference, third)
    register(third, source, initial=np.eye(4), max_rotation_deg=30)
    assert calls == []
    np.testing.assert_array_equal(again.transformation, result.transformation)
    prepare.prepare(pair[0]).fine.index  # noqa: B018 (the counters count)
    assert {"check_points", "_distinct", "reduce_to", "Tree", "_described"} <= set(calls)


def test_other_settings_than_a_cloud_was_prepared_with_are_refused(pair):
    cloud = prepare.prepare(pair[0], config=RegisterConfig(search_points=256))
    with pytest.raises(ValueError, match="source was prepared with another configuration"):
        register(cloud, pair[1])


@pytest.mark.slow
def test_a_wrong_pose_says_why_and_names_the_others(pair):
    """`reason` and `alternatives`: of unlike shapes, of a plane, and of a shape with symmetries."""
    unlike = register(halves(STAIRS)[0], halves(1)[1])
    assert not unlike.success
    assert unlike.reason.endswith(".")
    flat = np.c_[np.random.default_rng(0).uniform(size=(400, 2)), np.zeros(400)]
    tilted = flat @ pose(np.random.default_rng(3))[0].T
    assert "leave the pose free: " in register(tilted, tilted + 0.001).reason
    assert register(*pair[:2]).reason == ""
    box = np.random.default_rng(1).uniform(-1, 1, size=(2, 600, 3)) * [1.0, 0.6, 0.4]
    side = np.random.default_rng(2).integers(0, 3, size=(2, 600))
    size = np.array([1.0, 0.6, 0.4])
    for cloud, axes in zip(box, side, strict=True):
        rows = np.arange(600)
        cloud[rows, axes] = np.sign(cloud[rows, axes]) * size[axes]
    found = register(*box)
    turns = [angle_deg(other.transform.rotation, found.rotation) for other in found.alternatives]
    assert sum(turn > 175 for turn in turns) >= 2  # half turns about its axes
    chances = [other.probability for other in found.alternatives]
    assert chances == sorted(chances, reverse=True)
    assert sum(chances) > 0.5  # three of the four poses that agree equally well
    assert found.probability + sum(chances) <= 1 + 1e-9
    assert not found.success


@pytest.mark.untyped
@pytest.mark.parametrize("config", [SearchConfig(), {}])
def test_settings_of_another_kind_are_named(config, rng):
    cloud = rng.normal(size=(100, 3))
    for call in (prepare.prepare, lambda x, config: register(x, x, config=config)):
        with pytest.raises(ValueError, match="config must be a jaxreg.RegisterConfig"):
            call(cloud, config=config)


@pytest.mark.parametrize("count", [50, 500])
def test_points_in_one_place_are_no_success(count, rng):
    cloud = rng.normal(size=(400, 3))
    assert not register(np.zeros((count, 3)), cloud).success
    assert not register(cloud, np.ones((count, 3))).success
