"""`jaxreg register` of few points, two-column files, level scans, and parts that moved."""

import dataclasses
import importlib
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg import io
from jaxreg.cli.options import BAD_INPUT, NOT_TRUSTED, SUCCESS
from tests.view.test_page import registration

pytestmark = pytest.mark.float32

TARGETS = np.array([[0.0, 0, 0], [12, 1, 0.5], [7, 9, 2], [1, 8, 0.2], [4, 3, 1.5], [9, 5, 1]])
TURN = Rotation.from_euler("z", 110, degrees=True).as_matrix()
SHIFT = np.array([100.0, 200, 0])


@pytest.fixture
def targets(tmp_path):
    """Six targets, and five of them in another frame and order."""
    io.write_cloud(tmp_path / "a.xyz", TARGETS)
    io.write_cloud(tmp_path / "b.xyz", TARGETS[[4, 0, 5, 2, 1]] @ TURN.T + SHIFT)
    return tmp_path / "a.xyz", tmp_path / "b.xyz"


def test_targets(targets, tmp_path, run):
    outputs = (
        "--json",
        tmp_path / "r.json",
        "--plot",
        tmp_path / "r.png",
        "--html",
        tmp_path / "r.html",
    )
    status, out, _ = run("register", *targets, *outputs, "-o", tmp_path / "out.xyz")
    assert status == SUCCESS
    assert "success" in out
    found = json.loads((tmp_path / "r.json").read_text())
    assert found["evidence"]["matched"] == 5
    np.testing.assert_allclose(found["rotation"], TURN, atol=1e-6)
    moved = io.read_cloud(tmp_path / "out.xyz")
    np.testing.assert_allclose(moved, TARGETS @ TURN.T + SHIFT, atol=1e-6)


def test_upright_keeps_the_axis(tmp_path, run):
    """A rectangle has four poses; two of them are not upside down, and a rotation limit leaves one."""
    box = np.array([[0.0, 0, 0], [10, 0, 0], [10, 20, 0], [0, 20, 0], [5, 10, 0]])
    io.write_cloud(tmp_path / "a.xyz", box)
    files = tmp_path / "a.xyz", tmp_path / "b.xyz"
    io.write_cloud(files[1], box @ Rotation.from_euler("z", 30, degrees=True).as_matrix().T)
    options = "--known", "upright", "--up", "z", "--json", tmp_path / "r.json"
    status, _, _ = run("register", *options, *files)
    assert status == NOT_TRUSTED
    found = json.loads((tmp_path / "r.json").read_text())
    assert len(found["alternatives"]) == 1
    np.testing.assert_allclose(np.array(found["rotation"])[2], [0, 0, 1], atol=1e-9)
    status, _, _ = run("register", *options, "--max-rotation-deg", "90", *files)
    assert status == SUCCESS


def test_stable_box_and_file(targets, tmp_path, run):
    """Of the reference only three targets are left, or those that a file of numbers names."""
    source, reference = targets
    there = io.read_cloud(reference)
    low, high = there[:3].min(axis=0) - 1, there[:3].max(axis=0) + 1
    inside = np.all((there >= low) & (there <= high), axis=1)
    box = ",".join(map(str, [*low, *high]))
    status, _, _ = run(
        "register", source, reference, f"--stable={box}", "--json", tmp_path / "r.json"
    )
    assert status in (SUCCESS, NOT_TRUSTED)
    found = json.loads((tmp_path / "r.json").read_text())
    assert found["evidence"]["of"] == inside.sum()
    (tmp_path / "stays.txt").write_text("1\n1\n0\n1\n1\n")
    options = "--stable", tmp_path / "stays.txt", "--json", tmp_path / "s.json"
    assert run("register", source, reference, *options)[0] == SUCCESS
    assert json.loads((tmp_path / "s.json").read_text())["evidence"]["of"] == 4


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ("nowhere.txt", "no such file"),
        ("1,2,3", "a box is x0,y0,x1,y1"),
        ("short.txt", "write 5 numbers"),
        ("words.txt", "holds no numbers"),
    ],
)
def test_what_is_not_stable_is_told(targets, tmp_path, run, told, said):
    (tmp_path / "short.txt").write_text("1\n0\n")
    (tmp_path / "words.txt").write_text("yes\nno\n")
    place = tmp_path / told if told.endswith("txt") else told
    status, _, err = run("register", *targets, "--stable", place)
    assert status == BAD_INPUT
    assert said in err
    assert "Traceback" not in err


def test_a_viewpoint_of_the_file_needs_a_file_that_says_it(targets, tmp_path, run):
    source, reference = targets
    status, _, err = run("register", source, reference, "--viewpoint", "file")
    assert status == BAD_INPUT
    assert "does not say where the scanner stood" in err
    files = [tmp_path / "a.pcd", tmp_path / "b.pcd"]
    for path, cloud in zip(files, targets, strict=True):
        io.write_cloud(path, io.read_cloud(cloud))
    # A few targets hide nothing: told or not, the pose is the same.
    for told in ("unknown", "origin", "file"):
        options = "--viewpoint", told, "--json", tmp_path / f"{told}.json"
        assert run("register", *files, *options)[0] == SUCCESS, told
    poses = [
        json.loads((tmp_path / f"{told}.json").read_text())["transformation"]
        for told in ("unknown", "origin")
    ]
    assert poses[0] == poses[1]


@pytest.mark.parametrize("separator", [",", " ", ";"])
def test_files_of_two_columns_are_in_the_plane(tmp_path, run, separator):
    stems = np.random.default_rng(3).uniform(0, 50, (20, 2))
    turn = TURN[:2, :2]
    for name, points in (("a.txt", stems), ("b.txt", stems[::-1] @ turn.T + [3, 4])):
        np.savetxt(tmp_path / name, points, fmt="%.5f", delimiter=separator)
    files = tmp_path / "a.txt", tmp_path / "b.txt"
    status, out, _ = run("register", *files, "--json", tmp_path / "r.json")
    assert status == SUCCESS
    assert "two columns" in out
    found = json.loads((tmp_path / "r.json").read_text())
    np.testing.assert_allclose(found["rotation"], TURN, atol=1e-4)


@pytest.mark.parametrize("suffix", ["txt", "npy", "npz"])
def test_a_file_of_two_columns_beside_one_of_three_is_refused(tmp_path, run, suffix):
    points = np.random.default_rng(3).uniform(0, 50, (80, 3))
    plan = tmp_path / f"plan.{suffix}"
    write = {"txt": np.savetxt, "npy": np.save, "npz": lambda file, x: np.savez(file, points=x)}
    write[suffix](plan, points[:, :2])
    for name in ("b.txt", "c.txt"):
        np.savetxt(tmp_path / name, points)
    for command, files in (
        ("register", (plan, tmp_path / "b.txt")),
        ("register", (tmp_path / "b.txt", plan)),
        ("align", (tmp_path / "b.txt", plan, tmp_path / "c.txt")),
    ):
        status, _, err = run(command, *files)
        assert status == BAD_INPUT
        assert "has two columns, x and y, and" in err
        assert err.strip().splitlines()[-1].startswith("error: ")
    # A floor plan may stand beside a scan whose height is the same everywhere.
    points[:, 2] = 7
    np.savetxt(tmp_path / "b.txt", points)
    assert run("register", plan, tmp_path / "b.txt")[0] == SUCCESS


def test_a_row_that_is_no_point_does_not_hide_the_height(tmp_path, run):
    points = np.random.default_rng(3).uniform(0, 50, (80, 3))
    np.savetxt(tmp_path / "plan.txt", points[:, :2])
    np.save(tmp_path / "b.npy", np.insert(points, 5, np.nan, axis=0))
    files = tmp_path / "plan.txt", tmp_path / "b.npy"
    status, _, err = run("register", *files, "--nonfinite", "drop")
    assert status == BAD_INPUT
    assert "has two columns, x and y, and" in err


def test_no_output_replaces_the_file_of_what_is_stable(targets, tmp_path, run):
    stable = tmp_path / "s.json"
    stable.write_text("1\n1\n0\n1\n1\n")
    for option in ("--json", "--html"):
        status, out, err = run("register", *targets, "--stable", stable, option, stable)
        assert (status, out) == (BAD_INPUT, "")
        assert f"{stable} is already read or written by this command" in err
    assert stable.read_text() == "1\n1\n0\n1\n1\n"


@pytest.mark.parametrize("scale", [1.0, 3.28])
def test_sizes_are_compared_at_the_scale_that_was_found(tmp_path, run, monkeypatch, scale):
    """With --scale the size is no mistake; without it, a source in feet is one in other units."""
    points = np.random.default_rng(3).normal(size=(200, 3))
    files = tmp_path / "a.npy", tmp_path / "b.npy"
    np.save(files[0], points / 3.28)
    np.save(files[1], points)
    found = dataclasses.replace(registration(points, points, rotation=np.eye(3)), scale=scale)
    monkeypatch.setattr(
        importlib.import_module("jaxreg.scans.pair"), "register", lambda *_, **__: found
    )
    status, out, _ = run("register", *files)
    assert status == SUCCESS
    assert ("are their units metres and feet?" in out) == (scale == 1)


def test_few_points_have_no_scale(targets, run):
    status, _, err = run("register", *targets, "--scale")
    assert status == BAD_INPUT
    assert "more than 60 points" in err
