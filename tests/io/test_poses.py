"""Poses of many scans: every format there and back, and what others write."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.io import read_pairs_log, read_poses, write_poses
from jaxreg.io.poses import FORMATS, Edges, read_g2o

NAMES = ["scans/a.ply", "scans/b.ply", "scans/c.ply"]


@pytest.fixture
def poses(seed):
    rng = np.random.default_rng(seed)
    found = np.repeat(np.eye(4)[None], 3, 0)
    found[:, :3, :3] = Rotation.random(3, random_state=rng).as_matrix()
    found[:, :3, 3] = rng.normal(size=(3, 3)) + [4e5, 5e6, 30]
    found[1, :3] = np.nan  # not placed
    return found


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_gives_the_poses_back(poses, suffix, tmp_path):
    path = tmp_path / f"poses{suffix}"
    write_poses(path, poses, names=NAMES)
    found = read_poses(path, NAMES)
    assert list(found) == [NAMES[0], NAMES[2]]
    for k in (0, 2):
        np.testing.assert_allclose(found[NAMES[k]], poses[k], rtol=1e-14, atol=1e-14)


def test_kitti_s_own_file_is_read_by_lines(tmp_path):
    (tmp_path / "00.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 5 0 1 0 6 0 0 1 7\n")
    found = read_poses(tmp_path / "00.txt", ["x.bin", "y.bin"])
    np.testing.assert_array_equal(found["y.bin"][:3, 3], [5, 6, 7])


def test_tum_s_times_count_rows(tmp_path):
    """A half turn about z, as quaternion (x, y, z, w)."""
    lines = (
        "# time tx ty tz qx qy qz qw\n1305031102.17 1 2 3 0 0 1 0\n1305031102.21 4 5 6 0 0 0 1\n"
    )
    (tmp_path / "t.tum").write_text(lines)
    found = read_poses(tmp_path / "t.tum", ["x", "y"])
    np.testing.assert_allclose(
        found["x"][:3], [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3]], atol=1e-15
    )


def test_g2o_keeps_edges_and_their_order(poses, seed, tmp_path):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(1, 6, 6))
    edges = Edges(np.array([2]), np.array([0]), poses[2:], root @ root.swapaxes(1, 2))
    write_poses(tmp_path / "a.g2o", poses, edges=edges)
    text = (tmp_path / "a.g2o").read_text()
    # i j holds the pose of j in i, so the reference comes first; translation before rotation.
    words = text.splitlines()[-1].split()
    assert words[:3] == ["EDGE_SE3:QUAT", "0", "2"]
    assert float(words[10]) == edges.information[0, 3, 3]
    _, back = read_g2o(tmp_path / "a.g2o")
    assert (back.source[0], back.reference[0]) == (2, 0)
    np.testing.assert_allclose(back.transform[0], poses[2], rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(back.information, edges.information, rtol=1e-14)


def test_logs_of_3dmatch(tmp_path):
    block = "0\t 3\t 60\n1 0 0 4\n0 1 0 5\n0 0 1 6\n0 0 0 1\n"
    (tmp_path / "gt.log").write_text(2 * block)
    ends, matrices = read_pairs_log(tmp_path / "gt.log")
    np.testing.assert_array_equal(ends, [[0, 3]] * 2)
    np.testing.assert_array_equal(matrices[1, :3, 3], [4, 5, 6])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", '{"poses": {"a": [1, 2]}}', "does not contain poses"),
        ("a.json", "{", "does not contain poses"),
        ("a.txt", "1 0 0 0\n0 1 0 0\n", "blocks of four lines"),
        ("a.tum", "1 2 3\n", "does not contain poses"),
        ("a.g2o", "VERTEX_SE3:QUAT 0 1 2\n", "line 1 is malformed"),
        ("a.kitti", "", "does not contain poses"),
    ],
)
def test_broken_files_are_named(name, content, message, tmp_path):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=message):
        read_poses(tmp_path / name)


def test_what_is_not_there_is_said(poses, tmp_path):
    with pytest.raises(ValueError, match="no such file"):
        read_poses(tmp_path / "none.json")
    with pytest.raises(ValueError, match="no such file"):
        read_pairs_log(tmp_path / "none.log")
    with pytest.raises(ValueError, match=r"\.json, \.txt"):
        write_poses(tmp_path / "a.csv", poses)
    write_poses(tmp_path / "a.json", poses, names=NAMES)
    with pytest.raises(ValueError, match="none of these scans"):
        read_poses(tmp_path / "a.json", ["other.ply"])
