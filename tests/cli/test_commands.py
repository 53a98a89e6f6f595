"""The command line: exit statuses, one clear line for every mistake, and what it writes."""

import importlib
import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from plyfile import PlyData, PlyElement
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import jaxreg
from jaxreg import io
from jaxreg.cli import commands, process
from jaxreg.data.procedural import shapes

pytestmark = pytest.mark.float32

SOURCE_ROOT = Path(__file__).parents[2]
TRUTH = np.eye(4)
TRUTH[:3, :3] = Rotation.from_euler("xyz", [100, -40, 25], degrees=True).as_matrix()
TRUTH[:3, 3] = [12.0, -7.0, 3.0]
TABLE = 9


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    """Tests leave nothing in the user's cache, and no cache on for the tests that follow."""
    monkeypatch.setattr(process, "enable_compilation_cache", lambda **_: None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two samplings of a table in decimetres that share no point, the source with colours."""
    folder = tmp_path_factory.mktemp("scans")
    cloud = 10 * shapes.sample_shape(5, TABLE, points=1000).astype(np.float64)
    source, reference = cloud[:500], cloud[500:] @ TRUTH[:3, :3].T + TRUTH[:3, 3]
    rows = np.zeros(500, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1")])
    rows["x"], rows["y"], rows["z"] = source.T
    rows["red"] = np.arange(500) % 256
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(folder / "a.ply"))
    io.write_cloud(folder / "b.pcd", reference)
    np.savetxt(folder / "T.txt", TRUTH)
    return folder


@pytest.fixture(scope="module")
def registered(folder):
    """The folder after one run with everything, its exit status and what it printed."""
    outputs = ["-o", "out.ply", "--json", "r.json", "--plot", "r.png", "--html", "r.html"]
    files = [str(folder / part) if "." in part else part for part in ("a.ply", "b.pcd", *outputs)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(process, "enable_compilation_cache", lambda **_: None)
        return folder, commands.main(["register", *files])


def run(capsys, *arguments) -> tuple[int, str, str]:
    status = commands.main([str(part) for part in arguments])
    return status, *capsys.readouterr()


def test_register_succeeds_and_writes_what_is_asked_for(registered):
    folder, status = registered
    assert status == commands.SUCCESS
    found = json.loads((folder / "r.json").read_text())
    matrix = np.array(found["transformation"])
    turned = Rotation.from_matrix(matrix[:3, :3] @ TRUTH[:3, :3].T).magnitude()
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
    assert found["evidence"]["overlap"] == found["overlap"]
    assert 0 <= found["mean_confidence"] <= 1
    assert "correspondences" not in found


def test_las_keeps_its_intensity(folder, tmp_path, capsys):
    laspy = pytest.importorskip("laspy", reason="the extra `las` is not installed")
    points = io.read_cloud(folder / "a.ply")
    io.write_cloud(tmp_path / "a.las", points)
    cloud = laspy.read(tmp_path / "a.las")
    cloud.intensity = np.arange(500)
    cloud.write(str(tmp_path / "a.las"))
    np.savetxt(tmp_path / "T.txt", TRUTH)
    files = (tmp_path / "a.las", folder / "b.pcd", "--initial", tmp_path / "T.txt")
    status, _, _ = run(capsys, "register", *files, "-o", tmp_path / "out.las")
    assert status == commands.SUCCESS
    aligned = laspy.read(tmp_path / "out.las")
    np.testing.assert_array_equal(aligned.intensity, np.arange(500))
    expected = points @ TRUTH[:3, :3].T + TRUTH[:3, 3]
    assert np.linalg.norm(aligned.xyz - expected, axis=1).mean() < 1.0


def test_version(capsys):
    assert run(capsys, "--version")[:2] == (commands.SUCCESS, f"jaxreg {jaxreg.__version__}\n")


def test_an_earlier_result_is_a_start(registered, capsys):
    folder, _ = registered
    files = (folder / "a.ply", folder / "b.pcd")
    status, out, _ = run(capsys, "register", *files, "--initial", folder / "r.json")
    assert status == commands.SUCCESS
    assert "success (probability" in out
    rows = out.partition("(source to reference)\n")[2].splitlines()[:4]
    again = np.array([row.split() for row in rows], float)
    first = json.loads((folder / "r.json").read_text())["transformation"]
    np.testing.assert_allclose(again, first, atol=0.2)


def test_wrong_pose_is_not_trusted(folder, tmp_path, capsys):
    np.savetxt(tmp_path / "far.txt", np.eye(4) + np.eye(4, k=3) * 100)
    options = ("--initial", tmp_path / "far.txt", "--refine", "none")
    status, out, _ = run(capsys, "register", folder / "a.ply", folder / "b.pcd", *options)
    assert status == commands.NOT_TRUSTED
    assert "verdict          not trustworthy (probability 0.0" in out
    # A start pose was given: another is not what to try next.
    assert out.splitlines()[-1].endswith("--html PAGE.html")


def test_non_finite_points_are_refused_or_dropped(folder, tmp_path, capsys):
    points = np.insert(io.read_cloud(folder / "a.ply"), 3, np.nan, axis=0)
    io.write_cloud(tmp_path / "holes.npy", points)
    arguments = ["register", tmp_path / "holes.npy", folder / "b.pcd", "--refine", "none"]
    arguments += ["--initial", folder / "T.txt", "-o", tmp_path / "out.csv"]
    status, _, err = run(capsys, *arguments)
    assert status == commands.BAD_INPUT
    assert "point 3: remove them, or give --nonfinite drop" in err
    status, out, _ = run(capsys, *arguments, "--nonfinite", "drop")
    assert status == commands.SUCCESS
    assert "dropped points   1\n" in out
    assert len(io.read_cloud(tmp_path / "out.csv")) == 501


@pytest.mark.parametrize("option", ["--output", "--json", "--html"])
def test_no_output_replaces_an_input(folder, tmp_path, capsys, option):
    paths = [tmp_path / "a.ply", tmp_path / "b.ply"]
    io.write_cloud(paths[0], io.read_cloud(folder / "a.ply"))
    paths[1].symlink_to(paths[0])
    before = paths[0].read_bytes()
    for path in paths:
        status, out, err = run(capsys, "register", paths[0], folder / "b.pcd", option, path)
        assert (status, out) == (commands.BAD_INPUT, "")
        assert f"{path} is read or written by this command already" in err
    assert paths[0].read_bytes() == before
    twice = ("--json", tmp_path / "r.html", "--html", tmp_path / "r.html")
    status, _, err = run(capsys, "register", paths[0], folder / "b.pcd", *twice)
    assert (status, "already" in err) == (commands.BAD_INPUT, True)
    status, _, err = run(capsys, "view", paths[0], "-o", paths[0])
    assert (status, "already" in err) == (commands.BAD_INPUT, True)


def test_an_output_is_whole_or_as_it_was(folder, tmp_path, capsys, monkeypatch):
    def fails(path, *_, **__):
        path.write_text("half a p")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("jaxreg.view.page.write_registration_page", fails)
    page = tmp_path / "r.html"
    page.write_text("an older page")
    start = ("--initial", folder / "T.txt", "--refine", "none", "--html", page)
    status, out, err = run(capsys, "register", folder / "a.ply", folder / "b.pcd", *start)
    assert status == commands.BAD_INPUT
    assert "verdict" in out
    assert err.startswith(f"error: {page} could not be written (No space left on device)")
    assert [path.name for path in tmp_path.iterdir()] == ["r.html"]
    assert page.read_text() == "an older page"


GOOD = "x,y,z\n" + "".join(f"{i},{i * i},{i % 3}\n" for i in range(20))
MISTAKES = {
    "no such file": ["absent.ply", "good.csv"],
    "0 bytes": ["empty.ply", "good.csv"],
    "needs at least 3": ["good.csv", "two.xyz"],
    "suffix '.docx'": ["good.csv", "scan.docx"],
    "cannot be written as '.obj'": ["good.csv", "good.csv", "-o", "out.obj"],
    "nowhere does not exist": ["good.csv", "good.csv", "--html", "nowhere/r.html"],
    "written as .png, .pdf or .svg": ["good.csv", "good.csv", "--plot", "r.bmp"],
    "holds no 4x4 matrix": ["good.csv", "good.csv", "--initial", "two.xyz"],
    "absent.txt: there is no such file": ["good.csv", "good.csv", "--initial", "absent.txt"],
    "no rigid transform": ["good.csv", "good.csv", "--initial", "scale.npy"],
    "may be transposed": ["good.csv", "good.csv", "--initial", "transposed.npy"],
    "config.search_points must be at least 16": [
        "good.csv",
        "good.csv",
        "--config.search-points",
        "0",
    ],
    "config.reach must be positive": ["good.csv", "good.csv", "--config.reach", "nan"],
}


@pytest.mark.parametrize("told", MISTAKES)
def test_every_mistake_is_one_line_and_status_2(tmp_path, monkeypatch, capsys, told):
    monkeypatch.chdir(tmp_path)
    Path("good.csv").write_text(GOOD)
    Path("empty.ply").write_bytes(b"")
    Path("two.xyz").write_text("1 2 3\n4 5 6\n")
    Path("scan.docx").write_text("no cloud")
    np.save("scale.npy", np.diag([2.0, 2, 2, 1]))
    np.save("transposed.npy", np.eye(4) + np.eye(4, k=-3))
    status, out, err = run(capsys, "register", *MISTAKES[told])
    assert (status, out) == (commands.BAD_INPUT, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert told in err
    assert "Traceback" not in err


def test_files_that_cannot_be_written_are_named(folder, tmp_path, capsys):
    (tmp_path / "r.json").mkdir()
    options = ("--json", tmp_path / "r.json")
    status, out, err = run(capsys, "register", folder / "a.ply", folder / "b.pcd", *options)
    assert (status, out) == (commands.BAD_INPUT, "")
    assert err == f"error: {tmp_path / 'r.json'} is a directory: name a file in it.\n"


def test_las_without_laspy_is_told_before_the_work(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    module = importlib.import_module("jaxreg.scans.pair")
    monkeypatch.setattr(module, "register", lambda *_, **__: pytest.fail("it registered"))
    files = (folder / "a.ply", folder / "b.pcd")
    status, out, err = run(capsys, "register", *files, "-o", tmp_path / "out.las")
    assert (status, out) == (commands.BAD_INPUT, "")
    assert "LAS and LAZ need laspy" in err


def test_view_names_the_page_that_cannot_be_written(folder, tmp_path, capsys, monkeypatch):
    def full(path, *_, **__):
        path.write_text("half")
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("jaxreg.view.page.write_page", full)
    status, out, err = run(capsys, "view", folder / "a.ply", "-o", tmp_path / "v.html")
    told = "could not be written (No space left on device): choose another place."
    assert (status, out, err) == (commands.BAD_INPUT, "", f"error: {tmp_path / 'v.html'} {told}\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "arguments", [[], ["register", "a.ply"], ["fly"], ["info", "a.ply", "--x"]]
)
def test_usage_mistakes_end_with_status_2(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        commands.main(arguments)
    assert caught.value.code == 2
    assert capsys.readouterr().err


def test_info_describes_a_cloud(tmp_path, capsys):
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(7.0), [5e6]), axis=-1).reshape(-1, 3)
    io.write_cloud(tmp_path / "grid.npy", np.concatenate([grid, grid[:2], [[np.nan, 0, 0]]]))
    status, out, _ = run(capsys, "info", tmp_path / "grid.npy")
    told = dict(line.split(maxsplit=1) for line in out.replace("not f", "not_f").splitlines())
    assert status == commands.SUCCESS
    assert told["points"] == "66"
    assert told["not_finite"] == "1 points, the first is point 65"
    assert told["x"] == "0 to 8 (extent 8)"
    assert told["z"] == "5000000 to 5000000 (extent 0)"
    assert told["repeated"] == "2 points"
    assert told["spacing"] == "1"


def test_clouds_without_a_finite_point(tmp_path, capsys):
    io.write_cloud(tmp_path / "nan.npy", np.full((4, 3), np.nan))
    for command in ("info", "view"):
        status, _, err = run(capsys, command, tmp_path / "nan.npy")
        assert (status, "no point is finite" in err) == (commands.BAD_INPUT, True)


def test_view_writes_a_page_and_opens_it_when_asked(folder, tmp_path, capsys, monkeypatch):
    opened = []
    monkeypatch.setattr(commands.webbrowser, "open", opened.append)
    page = tmp_path / "page.html"
    status, out, _ = run(capsys, "view", folder / "a.ply", folder / "b.pcd", "-o", page)
    assert (status, out, opened) == (commands.SUCCESS, f"wrote            {page}\n", [])
    assert run(capsys, "view", folder / "a.ply", "-o", page, "--open")[0] == commands.SUCCESS
    assert opened == [page.as_uri()]
    status, _, err = run(capsys, "view", folder / "a.ply", "-o", tmp_path / "no" / "page.html")
    assert (status, "does not exist" in err) == (commands.BAD_INPUT, True)


@pytest.mark.parametrize("name", ["T.txt", "T.csv", "T.npy", "T.json", "list.json", "print.txt"])
def test_matrices_are_read_from_any_form(tmp_path, name):
    path = tmp_path / name
    if name.endswith("npy"):
        np.save(path, TRUTH)
    elif name == "list.json":
        path.write_text(json.dumps(TRUTH.tolist()))
    elif name == "print.txt":
        path.write_text(f"# from an earlier run\n{np.array2string(TRUTH, precision=17)}\n")
    elif name.endswith("json"):
        path.write_text(json.dumps({"transformation": TRUTH.tolist()}))
    else:
        np.savetxt(path, TRUTH, delimiter="," if name.endswith("csv") else " ")
    np.testing.assert_array_equal(commands.read_matrix(path), TRUTH)


def test_a_pickled_matrix_is_refused(tmp_path):
    np.save(tmp_path / "T.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(ValueError, match="no 4x4 matrix"):
        commands.read_matrix(tmp_path / "T.npy")


def test_console_script_is_declared():
    project = tomllib.loads((SOURCE_ROOT / "pyproject.toml").read_text())["project"]
    module, _, function = project["scripts"]["jaxreg"].partition(":")
    assert getattr(importlib.import_module(module), function) is commands.main


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
    assert [one.returncode for one in runs] == [commands.SUCCESS] * 2, runs[0].stderr
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
