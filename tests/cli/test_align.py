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
