"""`jaxreg align`: exit statuses, one clear line for every mistake, and what it writes."""

import json

import numpy as np
import pytest
from matplotlib.image import imread
from plyfile import PlyData

from jaxreg import io
from jaxreg.cli import main, process
from jaxreg.cli.options import BAD_INPUT, NOT_TRUSTED, SUCCESS
from jaxreg.data.procedural import shapes
from jaxreg.scans import many
from jaxreg.scans.relation import Relation

pytestmark = pytest.mark.float32


@pytest.fixture(scope="module")
def scans(folder):
    """The two scans of the table, and a plant."""
    io.write_cloud(folder / "plant.ply", shapes.sample_shape(2, 22, points=500).astype(float))
    return [str(folder / name) for name in ("a.ply", "b.pcd", "plant.ply")]


@pytest.fixture(scope="module")
def aligned(folder, scans):
    """The folder after one run with everything, and its exit status."""
    outputs = {
        "-o": "m.ply",
        "--poses": "p.json",
        "--json": "r.json",
        "--html": "r.html",
        "--plot": "r.png",
    }
    options = [part for name, file in outputs.items() for part in (name, str(folder / file))]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(process, "enable_compilation_cache", lambda **_: None)
        return folder, main(["align", *scans[:2], *options])


def test_align_succeeds_and_writes_what_is_asked_for(aligned, truth):
    folder, status = aligned
    assert status == SUCCESS
    poses = json.loads((folder / "p.json").read_text())["poses"]
    a, b = (np.array(pose) for pose in poses.values())
    np.testing.assert_array_equal(a, np.eye(4))
    # The truth lays a on b, and the frame is that of a.
    np.testing.assert_allclose(b[:3, :3], np.linalg.inv(truth)[:3, :3], atol=0.03)
    vertex = PlyData.read(str(folder / "m.ply"))["vertex"]
    np.testing.assert_array_equal(np.bincount(vertex["scan"]), [500, 500])
    page = (folder / "r.html").read_text()
    assert '"edges": [[' in page
    assert imread(folder / "r.png").ndim == 3
    found = json.loads((folder / "r.json").read_text())
    assert found["success"] is True
    assert [scan["group"] for scan in found["scans"]] == [0, 0]
    assert found["pairs"][0]["used"] is True


@pytest.mark.slow
def test_a_scan_of_something_else_is_said_and_left_out(scans, folder, run):
    status, out, _ = run("align", *scans, "-o", folder / "three.ply", "--poses", folder / "p.txt")
    assert status == NOT_TRUSTED
    assert "not placed" in out
    assert "2 of 3 scans placed" in out
    vertex = PlyData.read(str(folder / "three.ply"))["vertex"]
    assert set(vertex["scan"].tolist()) == {0, 1}
    assert list(io.read_poses(folder / "p.txt")) == scans[:2]


def test_scans_may_have_times(scans, folder, run):
    (folder / "times.txt").write_text("1305031102.5\n1305031101.5\n")
    status, out, _ = run("align", *scans[:2], "--times", folder / "times.txt", "--no-joint")
    assert status == SUCCESS
    assert "1 registered, 1 used" in out


def test_poses_of_an_earlier_run_are_a_start(aligned, scans, run):
    folder, _ = aligned
    status, out, _ = run("align", *scans[:2], "--initial", folder / "p.json", "--no-joint")
    assert status == SUCCESS
    assert "all 2 scans placed" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["a.ply"], "1 scan given"),
        (["a.ply", "a.ply"], "named twice"),
        (["a.ply", "none.ply"], "no such file"),
        (["a.ply", "b.pcd", "--poses", "p.csv"], "poses cannot be written as '.csv'"),
        (["a.ply", "b.pcd", "-o", "m.abc"], "clouds cannot be written"),
        (["a.ply", "b.pcd", "--plot", "m.gif"], ".png, .pdf or .svg"),
        (["a.ply", "b.pcd", "-o", "a.ply"], "already read or written"),
        (["a.ply", "b.pcd", "--initial", "none.json"], "no such file"),
        (["a.ply", "b.pcd", "--voxel", "-1"], "--voxel must be positive"),
        (["a.ply", "b.pcd", "--times", "none.txt"], "no such file"),
        (["a.ply", "b.pcd", "--times", "three.txt"], "write 2 numbers, one for each scan"),
        (["a.ply", "b.pcd", "--times", "three.txt", "--ordered"], "not both"),
    ],
)
def test_mistakes_are_one_line(arguments, message, folder, run, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "three.txt").write_text("0.5\n1.5\n2.5\n")
    status, _, error = run("align", *arguments)
    assert status == BAD_INPUT
    assert message in error
    assert "Traceback" not in error


@pytest.fixture
def placed(monkeypatch):
    """Has `register_many` find these groups of the scans that it is given, and a planar pair."""

    def found(groups):
        def register_many(clouds, **_):
            count = len(clouds)
            covariance = np.diag([0, 0, 1e-6, 1e-4, 1e-4, 0.0])
            relation = Relation(
                1, 0, "search", np.eye(4), 0.99, True, "", 0.5, 0.1, covariance
            )  # fmt: skip
            alone = np.array([not any(k in group for group in groups) for k in range(count)])
            return many.Alignment(
                np.where(alone[:, None, None], np.nan, np.eye(3)),
                np.where(alone[:, None], np.nan, np.zeros((count, 3))),
                groups, np.where(alone, 0, 0.99), np.zeros((count, 6, 6)), np.zeros((count, 3)),
                (many.AlignedPair(relation, 0.99, True, ""),) if groups else (),
                tuple("Nothing fits." if left else "" for left in alone), (), (),
            )  # fmt: skip

        monkeypatch.setattr(many, "register_many", register_many)

    return found


@pytest.fixture
def rooms(tmp_path):
    """Four scans, named as the files of groups are."""
    rng = np.random.default_rng(1)
    paths = [tmp_path / f"room.{k}.ply" for k in range(1, 5)]
    for k, path in enumerate(paths):
        io.write_cloud(path, rng.uniform(size=(10, 3)) + [k, 0, 0])
    return paths


def set_of(path):
    """Which rooms a merged cloud shows: each has its own metre of x."""
    return set(np.floor(io.read_cloud(path)[:, 0]).astype(int).tolist())


def test_the_files_of_further_groups_replace_no_input_and_no_output(rooms, tmp_path, run, placed):
    placed(((0, 1), (2, 3)))
    before = [path.read_bytes() for path in rooms]
    outputs = "-o", tmp_path / "room.ply", "--html", tmp_path / "room.5.ply"
    status, out, _ = run("align", *rooms, *outputs)
    assert status == NOT_TRUSTED
    assert [path.read_bytes() for path in rooms] == before
    assert (tmp_path / "room.5.ply").read_text().startswith("<!")
    assert f"wrote            {tmp_path / 'room.ply'} (group 1)\n" in out
    assert f"wrote            {tmp_path / 'room.6.ply'} (group 2)\n" in out
    assert set_of(tmp_path / "room.ply") == {0, 1}
    assert set_of(tmp_path / "room.6.ply") == {2, 3}
    assert len(list(tmp_path.iterdir())) == 4 + 3


def test_further_groups_have_numbers_where_nothing_is_in_the_way(rooms, tmp_path, run, placed):
    placed(((0, 1), (2, 3)))
    _, out, _ = run("align", *rooms, "-o", tmp_path / "all.ply")
    assert f"{tmp_path / 'all.2.ply'} (group 2)" in out
    assert set_of(tmp_path / "all.2.ply") == {2, 3}


def test_poses_of_groups_name_these_and_start_the_first_alone(
    rooms, tmp_path, run, placed, monkeypatch
):
    placed(((0, 2), (1, 3)))
    run("align", *rooms, "--poses", tmp_path / "p.json")
    found, given = many.register_many, []

    def listening(clouds, **options):
        given.extend(options["initial"])
        return found(clouds, **options)

    monkeypatch.setattr(many, "register_many", listening)
    run("align", *rooms, "--initial", tmp_path / "p.json")
    assert [pose is not None for pose in given] == [True, False, True, False]


def test_a_merged_cloud_that_is_not_written_is_told(rooms, tmp_path, run, placed):
    placed(())
    status, out, _ = run("align", *rooms, "-o", tmp_path / "all.ply")
    assert status == NOT_TRUSTED
    assert f"not written      {tmp_path / 'all.ply'}: no two scans hang together\n" in out
    assert not (tmp_path / "all.ply").exists()


@pytest.mark.parametrize("suffix", [".json", ".txt", ".tum", ".kitti", ".g2o"])
def test_planar_scans_have_poses_and_all_else_that_is_asked_for(
    rooms, tmp_path, run, placed, suffix
):
    """Three of the motions of a planar pair have no variance at all."""
    placed(((0, 1, 2, 3),))
    others = {"--json": "r.json", "--html": "r.html", "--plot": "r.png", "--poses": f"p{suffix}"}
    files = [part for option, name in others.items() for part in (option, tmp_path / name)]
    status, _, err = run("align", *rooms, *files)
    assert (status, err.count("error")) == (SUCCESS, 0)
    assert all((tmp_path / name).stat().st_size > 0 for name in others.values())
