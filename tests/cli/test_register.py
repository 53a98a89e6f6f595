"""`jaxreg register`: exit statuses, one clear line for every mistake, and what it writes."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from matplotlib.image import imread
from plyfile import PlyData
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg import io
from jaxreg.cli import main, process
from jaxreg.cli.options import BAD_INPUT, NOT_TRUSTED, SUCCESS
from jaxreg.judge.evidence import Evidence

pytestmark = pytest.mark.float32

SOURCE_ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def registered(folder):
    """The folder after one run with everything, its exit status and what it printed."""
    outputs = ["-o", "out.ply", "--json", "r.json", "--plot", "r.png", "--html", "r.html"]
    files = [str(folder / part) if "." in part else part for part in ("a.ply", "b.pcd", *outputs)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(process, "enable_compilation_cache", lambda **_: None)
        return folder, main(["register", *files])


def test_register_succeeds_and_writes_what_is_asked_for(registered, truth):
    folder, status = registered
    assert status == SUCCESS
    found = json.loads((folder / "r.json").read_text())
    matrix = np.array(found["transformation"])
    turned = Rotation.from_matrix(matrix[:3, :3] @ truth[:3, :3].T).magnitude()
    assert np.degrees(turned) < 2
    source, reference = io.read_cloud(folder / "a.ply"), io.read_cloud(folder / "b.pcd")
    aligned = PlyData.read(str(folder / "out.ply"))["vertex"]
    moved = np.stack([aligned[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(moved, source @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-12)
    np.testing.assert_array_equal(aligned["red"], np.arange(500) % 256)
    assert np.median(cKDTree(reference).query(moved)[0]) < 1.0
    assert imread(folder / "r.png").ndim == 3
    assert "<canvas" in (folder / "r.html").read_text()


def test_json_is_strict_and_complete(registered):
    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    found = json.loads((registered[0] / "r.json").read_text(), parse_constant=refuse)
    assert found["success"] is True
    assert found["source"].endswith("a.ply")
    assert np.shape(found["covariance"]) == (6, 6)
    assert set(found["evidence"]) == set(Evidence._fields)
    assert 0 < found["evidence"]["smaller"] <= found["evidence"]["larger"] <= 1
    assert 0 <= found["mean_confidence"] <= 1
    assert "correspondences" not in found


def test_las_keeps_its_intensity(folder, tmp_path, run, truth):
    laspy = pytest.importorskip("laspy", reason="the extra `las` is not installed")
    points = io.read_cloud(folder / "a.ply")
    io.write_cloud(tmp_path / "a.las", points)
    cloud = laspy.read(tmp_path / "a.las")
    cloud.intensity = np.arange(500)
    cloud.write(str(tmp_path / "a.las"))
    np.savetxt(tmp_path / "T.txt", truth)
    files = (tmp_path / "a.las", folder / "b.pcd", "--initial", tmp_path / "T.txt")
    status, _, _ = run("register", *files, "-o", tmp_path / "out.las")
    assert status == SUCCESS
    aligned = laspy.read(tmp_path / "out.las")
    np.testing.assert_array_equal(aligned.intensity, np.arange(500))
    expected = points @ truth[:3, :3].T + truth[:3, 3]
    assert np.linalg.norm(aligned.xyz - expected, axis=1).mean() < 1.0


def test_an_earlier_result_is_a_start(registered, run):
    folder, _ = registered
    files = (folder / "a.ply", folder / "b.pcd")
    status, out, _ = run("register", *files, "--initial", folder / "r.json")
    assert status == SUCCESS
    assert "success (probability" in out
    rows = out.partition("(source to reference)\n")[2].splitlines()[:4]
    again = np.array([row.split() for row in rows], float)
    first = json.loads((folder / "r.json").read_text())["transformation"]
    np.testing.assert_allclose(again, first, atol=0.2)


def test_wrong_pose_is_not_trusted(folder, tmp_path, run):
    np.savetxt(tmp_path / "far.txt", np.eye(4) + np.eye(4, k=3) * 100)
    options = ("--initial", tmp_path / "far.txt", "--refine", "none")
    status, out, _ = run("register", folder / "a.ply", folder / "b.pcd", *options)
    assert status == NOT_TRUSTED
    assert "verdict          not trustworthy (probability 0.0" in out
    # A start pose was given: another is not what to try next.
    assert out.splitlines()[-1].endswith("--html PAGE.html")


def test_non_finite_points_are_refused_or_dropped(folder, tmp_path, run):
    points = np.insert(io.read_cloud(folder / "a.ply"), 3, np.nan, axis=0)
    io.write_cloud(tmp_path / "holes.npy", points)
    arguments = ["register", tmp_path / "holes.npy", folder / "b.pcd", "--refine", "none"]
    arguments += ["--initial", folder / "T.txt", "-o", tmp_path / "out.csv"]
    status, _, err = run(*arguments)
    assert status == BAD_INPUT
    assert "point 3: remove them, or give --nonfinite drop" in err
    status, out, _ = run(*arguments, "--nonfinite", "drop")
    assert status == SUCCESS
    assert "dropped points   1\n" in out
    assert len(io.read_cloud(tmp_path / "out.csv")) == 501


@pytest.mark.parametrize("option", ["--output", "--json", "--html"])
def test_no_output_replaces_an_input(folder, tmp_path, run, option):
    paths = [tmp_path / "a.ply", tmp_path / "b.ply"]
    io.write_cloud(paths[0], io.read_cloud(folder / "a.ply"))
    paths[1].symlink_to(paths[0])
    before = paths[0].read_bytes()
    for path in paths:
        status, out, err = run("register", paths[0], folder / "b.pcd", option, path)
        assert (status, out) == (BAD_INPUT, "")
        assert f"{path} is already read or written by this command" in err
    assert paths[0].read_bytes() == before
    twice = ("--json", tmp_path / "r.html", "--html", tmp_path / "r.html")
    status, _, err = run("register", paths[0], folder / "b.pcd", *twice)
    assert (status, "already" in err) == (BAD_INPUT, True)
    status, _, err = run("view", paths[0], "-o", paths[0])
    assert (status, "already" in err) == (BAD_INPUT, True)


def test_an_output_is_whole_or_as_it_was(folder, tmp_path, run, monkeypatch):
    def fails(path, *_, **__):
        path.write_text("half a p")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("jaxreg.view.page.write_registration_page", fails)
    page = tmp_path / "r.html"
    page.write_text("an older page")
    start = ("--initial", folder / "T.txt", "--refine", "none", "--html", page)
    status, out, err = run("register", folder / "a.ply", folder / "b.pcd", *start)
    assert status == BAD_INPUT
    assert "verdict" in out
    assert err.startswith(f"error: {page} could not be written (No space left on device)")
    assert [path.name for path in tmp_path.iterdir()] == ["r.html"]
    assert page.read_text() == "an older page"


GOOD = "x,y,z\n" + "".join(f"{i},{i * i},{i % 3}\n" for i in range(20))


MISTAKES = {
    "no such file": ["absent.ply", "good.csv"],
    "0 bytes": ["empty.ply", "good.csv"],
    "needs at least 3": ["good.csv", "two.xyz"],
    "unknown format '.docx'": ["good.csv", "scan.docx"],
    "cannot be written as '.obj'": ["good.csv", "good.csv", "-o", "out.obj"],
    "nowhere does not exist": ["good.csv", "good.csv", "--html", "nowhere/r.html"],
    "written as .png, .pdf or .svg": ["good.csv", "good.csv", "--plot", "r.bmp"],
    "does not contain a 4x4 matrix": ["good.csv", "good.csv", "--initial", "two.xyz"],
    "absent.txt: no such file": ["good.csv", "good.csv", "--initial", "absent.txt"],
    "not a rigid transform": ["good.csv", "good.csv", "--initial", "scale.npy"],
    "may be transposed": ["good.csv", "good.csv", "--initial", "transposed.npy"],
    "config.search_points must be at least 16": [
        "good.csv",
        "good.csv",
        "--config.search-points",
        "0",
    ],
    "config.inlier_spacings must be positive": [
        "good.csv",
        "good.csv",
        "--config.inlier-spacings",
        "nan",
    ],
}


@pytest.mark.parametrize("told", MISTAKES)
def test_every_mistake_is_one_line_and_status_2(tmp_path, monkeypatch, run, told):
    monkeypatch.chdir(tmp_path)
    Path("good.csv").write_text(GOOD)
    Path("empty.ply").write_bytes(b"")
    Path("two.xyz").write_text("1 2 3\n4 5 6\n")
    Path("scan.docx").write_text("no cloud")
    np.save("scale.npy", np.diag([2.0, 2, 2, 1]))
    np.save("transposed.npy", np.eye(4) + np.eye(4, k=-3))
    status, out, err = run("register", *MISTAKES[told])
    assert (status, out) == (BAD_INPUT, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert told in err
    assert "Traceback" not in err


def test_files_that_cannot_be_written_are_named(folder, tmp_path, run):
    (tmp_path / "r.json").mkdir()
    options = ("--json", tmp_path / "r.json")
    status, out, err = run("register", folder / "a.ply", folder / "b.pcd", *options)
    assert (status, out) == (BAD_INPUT, "")
    assert err == f"error: {tmp_path / 'r.json'} is a directory: name a file in it.\n"


def test_las_without_laspy_is_told_before_the_work(folder, tmp_path, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    module = importlib.import_module("jaxreg.scans.pair")
    monkeypatch.setattr(module, "register", lambda *_, **__: pytest.fail("it registered"))
    files = (folder / "a.ply", folder / "b.pcd")
    status, out, err = run("register", *files, "-o", tmp_path / "out.las")
    assert (status, out) == (BAD_INPUT, "")
    assert "LAS needs laspy, which is not installed: run pip install 'jaxreg[las]'" in err


def test_first_process_says_that_it_compiles_and_the_second_need_not(folder, tmp_path):
    code = "import sys; from jaxreg.cli import main; status = main();"
    code += "print(*sys.modules, file=open('modules', 'w')); sys.exit(status)"
    start = ["--initial", "T.txt", "--refine", "none", "--html", "page.html"]
    command = [sys.executable, "-c", code, "register", "a.ply", "b.pcd", *start]
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(SOURCE_ROOT)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    runs = [
        subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        for _ in range(2)
    ]
    assert [one.returncode for one in runs] == [SUCCESS] * 2, runs[0].stderr
    assert "compiling" in runs[0].stderr
    assert str(tmp_path) in runs[0].stderr
    assert runs[1].stderr == ""
    # Nothing was drawn, trained or sampled, so what does that was not imported.
    unneeded = {"matplotlib", "orbax", "optax", "trimesh", "laspy", "h5py", "scipy.optimize"}
    assert unneeded & set((folder / "modules").read_text().split()) == set()
    timeless = [
        [line for line in one.stdout.splitlines() if "time" not in line[:6]] for one in runs
    ]
    assert timeless[0] == timeless[1]
    assert (tmp_path / "jaxreg" / "xla").stat().st_mode & 0o777 == 0o700


def test_a_mesh_goes_out_as_a_mesh_and_both_are_told(folder, tmp_path, run, truth):
    box = trimesh.util.concatenate(
        [
            trimesh.creation.box((4, 2, 1)),
            trimesh.creation.box((1, 1, 3)).apply_translation([1, 0, 2]),
        ]
    )
    box.export(tmp_path / "a.ply")
    moved = box.sample(2000, seed=0) @ truth[:3, :3].T + truth[:3, 3]
    io.write_cloud(tmp_path / "b.npy", moved)
    files = (tmp_path / "a.ply", tmp_path / "b.npy", "--initial", folder / "T.txt")
    status, out, _ = run("register", *files, "--refine", "none", "-o", tmp_path / "o.stl")
    assert status == SUCCESS
    assert "(20,000 points; a mesh of 24 triangles, sampled over its surface)" in out
    found = trimesh.load(tmp_path / "o.stl")
    assert len(found.faces) == 24
    expected = box.apply_transform(truth)
    np.testing.assert_allclose(found.bounds, expected.bounds, atol=1e-5)


def test_columns_are_kept_or_their_loss_is_told(folder, tmp_path, run):
    points = io.read_cloud(folder / "a.ply")
    rows = "".join("{:.4f},{:.4f},{:.4f},51\n".format(*row) for row in points)
    (tmp_path / "a.csv").write_text("x,y,z,red\n" + rows)
    start = ("--initial", folder / "T.txt", "--refine", "none", "-o")
    for source, out, told in (
        (tmp_path / "a.csv", tmp_path / "o.csv", ""),
        (
            folder / "a.ply",
            tmp_path / "o.pcd",
            "note             .pcd gets coordinates alone; .ply",
        ),
    ):
        status, text, _ = run("register", source, folder / "b.pcd", *start, out)
        assert status == SUCCESS
        assert told in text
    assert (tmp_path / "o.csv").read_text().startswith("x,y,z,red\n")
    assert {line.split(",")[3] for line in (tmp_path / "o.csv").read_text().split()[1:]} == {"51"}


def test_clouds_in_different_units_are_told(folder, tmp_path, run):
    io.write_cloud(tmp_path / "mm.npy", 1000 * io.read_cloud(folder / "b.pcd"))
    start = ("--initial", folder / "T.txt", "--refine", "none")
    status, out, _ = run("register", folder / "a.ply", tmp_path / "mm.npy", *start)
    assert status == NOT_TRUSTED
    assert "times the size of the source: are their units metres and millimetres?" in out


def test_a_cloud_cannot_become_a_mesh(folder, tmp_path, run):
    files = (folder / "a.ply", folder / "b.pcd")
    status, out, err = run("register", *files, "-o", tmp_path / "o.stl")
    assert (status, out) == (BAD_INPUT, "")
    assert "which holds surfaces, and" in err
