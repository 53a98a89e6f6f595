"""Many scans in, poses and groups out; resumed runs, workers that die, and clear errors."""

import concurrent.futures
import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural import shapes
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.scans import many, relation, stored
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.many import register_many
from jaxreg.scans.prepare import prepare

TABLE, PLANT = 9, 22
NARROW = RegisterConfig(wide=None)
FLAGS = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
"""Those of tests/conftest.py, for processes that a test starts."""


@pytest.fixture(scope="module")
def scans():
    """Four samplings of a table that share no point, each in a frame of its own, and a plant."""
    rng = np.random.default_rng(7)
    cloud = shapes.sample_shape(5, TABLE, points=2000).astype(np.float64)
    turns = Rotation.random(4, random_state=rng).as_matrix()
    shifts = rng.uniform(-5, 5, (4, 3))
    clouds = [
        part @ turn.T + shift
        for part, turn, shift in zip(np.split(cloud, 4), turns, shifts, strict=True)
    ]
    plant = shapes.sample_shape(2, PLANT, points=500).astype(np.float64)
    return [*clouds, plant], turns, shifts


@pytest.fixture(scope="module")
def alignment(scans):
    return register_many(scans[0], config=NARROW)


def test_scans_of_one_thing_are_placed_and_the_other_is_not(scans, alignment):
    clouds, turns, shifts = scans
    assert alignment.groups == ((0, 1, 2, 3),)
    assert alignment.unplaced == (4,)
    assert alignment.reasons[4]
    assert not alignment.success
    assert np.isnan(alignment.transformation[4, :3]).all()
    for k in range(4):
        turn = turns[0] @ turns[k].T
        assert rotation_angle_deg(alignment.rotation[k], turn) < 2
        centre = clouds[k].mean(axis=0)
        expected = turn @ (centre - shifts[k]) + shifts[0]
        found = alignment.rotation[k] @ centre + alignment.translation[k]
        np.testing.assert_allclose(found, expected, atol=0.05)
    np.testing.assert_array_equal(alignment.transformation[0], np.eye(4))
    assert alignment.probability[:4].min() > 0.9
    assert alignment.probability[4] == 0


def test_merged_cloud_has_the_points_of_the_group(scans, alignment):
    points, scan = alignment.merged(scans[0])
    assert points.shape == (2000, 3)
    np.testing.assert_array_equal(np.bincount(scan), [500] * 4)
    np.testing.assert_allclose(points[:500], scans[0][0])
    fewer, _ = alignment.merged(scans[0], voxel=0.2)
    assert len(fewer) < len(points)
    with pytest.raises(ValueError, match="no group 1"):
        alignment.merged(scans[0], group=1)


def test_merged_takes_what_was_registered(scans, alignment):
    """Arrays with rows that are NaN, prepared clouds, and clouds in the plane."""
    points, _ = alignment.merged(scans[0])
    prepared = [prepare(cloud) for cloud in scans[0]]
    np.testing.assert_allclose(alignment.merged(prepared)[0], points, atol=1e-9)
    holed = [np.vstack([[np.nan] * 3, cloud]) for cloud in scans[0]]
    np.testing.assert_allclose(alignment.merged(holed)[0], points)
    flat = [cloud[:, :2] for cloud in scans[0]]
    expected = flat[0] @ alignment.rotation[0][:, :2].T + alignment.translation[0]
    np.testing.assert_allclose(alignment.merged(flat)[0][:500], expected)
    with pytest.raises(ValueError, match="4 clouds for 5 scans"):
        alignment.merged(scans[0][:4])


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"config": RegisterConfig(search_points=0)}, "config.search_points must be at least 16"),
        ({"initial": [np.eye(4)] * 4 + [np.ones((4, 4))]}, r"the last row of initial\[4\] is"),
    ],
)
def test_settings_and_starts_are_checked_before_anything_is_done(scans, options, told):
    with pytest.raises(ValueError, match=told):
        register_many(scans[0], **options)


def test_poses_of_an_alignment_are_starts_and_nan_is_none(scans, alignment):
    starts = many._checked_starts(alignment.transformation, 5)
    assert [start is None for start in starts] == [False] * 4 + [True]
    np.testing.assert_allclose(starts[1], alignment.transformation[1], atol=1e-12)
    again = many._checked_starts(alignment, 5)
    np.testing.assert_array_equal(again[1], starts[1])


def test_a_second_run_goes_on_where_the_first_ended(scans, alignment, tmp_path, monkeypatch):
    made = []

    def counted(task, *rest):
        if len(made) == 3 and not (tmp_path / "again").exists():
            raise KeyboardInterrupt
        made.append(task[:3])
        return relation.register_task(task, *rest)

    monkeypatch.setattr(many, "register_task", counted)
    with pytest.raises(KeyboardInterrupt):
        register_many(scans[0], config=NARROW, work=tmp_path)
    (tmp_path / "again").touch()
    kept = sorted((tmp_path / "pairs").iterdir())
    assert len(kept) == 3
    kept[0].write_text(kept[0].read_text()[:40])  # cut off, as by a full disk
    first = set(made)
    made.clear()
    assert_same(register_many(scans[0], config=NARROW, work=tmp_path), alignment)
    assert len(first & set(made)) == 1
    made.clear()
    assert_same(register_many(scans[0], config=NARROW, work=tmp_path), alignment)
    assert made == []


def assert_same(one, other):
    np.testing.assert_array_equal(one.transformation, other.transformation)
    np.testing.assert_array_equal(one.covariance, other.covariance)
    assert [p.used for p in one.pairs] == [p.used for p in other.pairs]


class Dying(concurrent.futures.ThreadPoolExecutor):
    """An executor whose first worker dies with its pair."""

    died = False

    def submit(self, function, *arguments):
        if not self.died:
            self.died = True
            future = concurrent.futures.Future()
            future.set_exception(RuntimeError("the worker was killed"))
            return future
        return super().submit(function, *arguments)


def test_workers_give_the_same_bits_and_one_that_dies_costs_a_retry(scans, alignment):
    with Dying(2) as executor:
        assert_same(register_many(scans[0], config=NARROW, executor=executor), alignment)
    assert executor.died


@pytest.mark.slow
@pytest.mark.float32
def test_processes_and_a_dask_cluster_give_the_same_bits(scans, tmp_path, monkeypatch):
    """In float32: new processes have JAX as it is by default, but for the flags of the tests."""
    distributed = pytest.importorskip("distributed")
    monkeypatch.setenv("XLA_FLAGS", FLAGS)
    in_turn = register_many(scans[0], config=NARROW)
    assert in_turn.groups == ((0, 1, 2, 3),)
    assert_same(register_many(scans[0], config=NARROW, workers=2), in_turn)
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        executor = client.get_executor()
        assert_same(
            register_many(scans[0], config=NARROW, executor=executor, work=tmp_path), in_turn
        )


def test_a_prepared_scan_is_the_same_after_it_was_stored(scans, tmp_path, seed):
    normals = np.random.default_rng(seed).normal(size=(500, 3))
    cloud = prepare(scans[0][0], normals=normals, config=NARROW)
    stored.save(cloud, tmp_path / "a.npz")
    back = stored.load(tmp_path / "a.npz", NARROW)
    assert stored.fingerprint(back) == stored.fingerprint(cloud)
    for level in ("fine", "coarse"):
        np.testing.assert_array_equal(getattr(back, level).points, getattr(cloud, level).points)
        np.testing.assert_array_equal(getattr(back, level).normals, getattr(cloud, level).normals)
    np.testing.assert_array_equal(back.row, cloud.row)
    other = prepare(scans[0][0], config=NARROW)
    assert stored.fingerprint(other) != stored.fingerprint(cloud)
    (tmp_path / "b.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:100])
    with pytest.raises(ValueError, match=r"b\.npz holds no prepared scan"):
        stored.load(tmp_path / "b.npz", NARROW)


def test_an_earlier_alignment_starts_the_scans_of_its_first_group(scans, alignment, monkeypatch):
    """Each group has a frame of its own."""
    given = []

    def from_starts(run, starts):
        given.extend(starts)
        return []

    monkeypatch.setattr(many, "_from_starts", from_starts)
    monkeypatch.setattr(many, "_first_pairs", lambda *_: [])
    monkeypatch.setattr(many, "_wider", lambda *_: [])
    earlier = dataclasses.replace(alignment, groups=((0, 2, 3), (1, 4)))
    register_many(scans[0], initial=earlier, config=NARROW)
    assert [start is not None for start in given] == [True, False, True, True, False]
    np.testing.assert_allclose(given[2], alignment.transformation[2])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clouds": [np.zeros((9, 3))]}, "1 scan given"),
        ({"names": ["a"]}, "1 names for 5 scans"),
        ({"initial": [None]}, "1 initial poses for 5 scans"),
        ({"initial": [np.ones((4, 4)), *[None] * 4]}, r"initial\[0\]"),
        ({"order": "random"}, "order must be"),
        ({"order": [0.0]}, "one finite time for each of the"),
        ({"order": [*[0.0] * 4, np.nan]}, "one finite time for each of the"),
        ({"workers": -1}, "workers must be"),
    ],
)
@pytest.mark.untyped
def test_bad_input_is_one_clear_line(scans, options, message):
    options = {"clouds": scans[0], "config": NARROW} | options
    with pytest.raises(ValueError, match=message):
        register_many(options.pop("clouds"), **options)


def test_a_scan_of_nan_is_named(scans):
    clouds = [scans[0][0], np.full((50, 3), np.nan)]
    with pytest.raises(ValueError, match="broken"):
        register_many(clouds, names=["whole", "broken"], nonfinite="drop", config=NARROW)


def test_the_file_name_of_a_pair_depends_on_all_that_changes_it(tmp_path):
    folder = relation.WorkFolder(tmp_path, NARROW)
    task = relation.Task(1, 0, "search")
    path = folder.pair_path(task, "a", "b")
    assert folder.pair_path(relation.Task(5, 3, "search"), "a", "b") == path
    others = [
        folder.pair_path(task, "b", "a"),
        folder.pair_path(relation.Task(1, 0, "wide search"), "a", "b"),
        folder.pair_path(relation.Task(1, 0, "start", np.eye(4)), "a", "b"),
        relation.WorkFolder(tmp_path, dataclasses.replace(NARROW, refine_points=999)).pair_path(
            task, "a", "b"
        ),
    ]
    assert len({path, *others}) == 5
