"""Poses of many scans: every format there and back, and what others write."""

import json

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


def shifts(*lengths):
    """Poses along x, one a length; NaN is no pose."""
    poses = np.repeat(np.eye(4)[None], len(lengths), 0)
    poses[:, 0, 3] = lengths
    poses[np.isnan(lengths)] = np.nan
    return poses


def lengths_of(found):
    return {name: pose[0, 3] for name, pose in found.items()}


def test_poses_without_names_are_those_of_the_scans_in_their_order(tmp_path):
    """Also where a scan is called as another one is numbered."""
    names = ["1.ply", "2.ply", "3.ply"]
    poses = shifts(10, 20, 30)
    blocks = "\n".join(" ".join(map(str, row)) for row in poses.reshape(-1, 4))
    (tmp_path / "bare.txt").write_text(blocks)
    (tmp_path / "titled.txt").write_text("# from the odometry\n" + blocks)
    (tmp_path / "list.json").write_text(json.dumps(poses.tolist()))
    for suffix in (".tum", ".kitti", ".g2o"):
        write_poses(tmp_path / f"p{suffix}", poses, names=names)
    for path in tmp_path.iterdir():
        found = lengths_of(read_poses(path, names))
        assert found == {"1.ply": 10, "2.ply": 20, "3.ply": 30}, path.name


def test_of_several_groups_the_first_one_s_poses_are_in_one_frame(tmp_path):
    path = tmp_path / "p.json"
    write_poses(path, shifts(0, 1, 2, 3), names=list("abcd"), groups=[(0, 3), (1, 2)])
    assert json.loads(path.read_text())["groups"] == [["a", "d"], ["b", "c"]]
    assert lengths_of(read_poses(path)) == {"a": 0, "d": 3}
    assert lengths_of(read_poses(path, ["c.ply", "d.ply"])) == {"d.ply": 3}
    write_poses(path, shifts(0, 1), names=list("ab"), groups=[(0, 1)])
    assert lengths_of(read_poses(path)) == {"a": 0, "b": 1}


def test_a_block_without_a_pose_shifts_no_other(tmp_path):
    rows = shifts(np.nan, 20, 30).reshape(-1, 4)
    np.savetxt(tmp_path / "p.txt", rows)
    assert lengths_of(read_poses(tmp_path / "p.txt", ["s0", "s1", "s2"])) == {"s1": 20, "s2": 30}
    assert lengths_of(read_poses(tmp_path / "p.txt")) == {"1": 20, "2": 30}


def test_a_row_of_tum_without_a_pose_shifts_no_other(tmp_path):
    row = "{} {} 0 0 0 0 0 1\n"
    times = (1305031102.17, 1305031102.21, 1305031102.25), (7, 7, 8), (0, 1, 2)
    for seconds in times:
        rows = zip(seconds, ("nan", 20, 30), strict=True)
        (tmp_path / "p.tum").write_text("".join(row.format(*one) for one in rows))
        assert lengths_of(read_poses(tmp_path / "p.tum", ["a", "b", "c"])) == {"b": 20, "c": 30}


@pytest.mark.parametrize(
    "printed",
    [
        lambda poses: "\n".join(str(row) for row in poses.reshape(-1, 4).tolist()),
        lambda poses: "\n\n".join(np.array2string(pose) for pose in poses),
        lambda poses: "\n".join(f"{pose.tolist()};".replace("], [", "],\n[") for pose in poses),
    ],
)
def test_matrices_are_read_as_python_prints_them(tmp_path, printed):
    (tmp_path / "p.txt").write_text(f"# two of them\n{printed(shifts(5, 6))}  # the last\n")
    assert lengths_of(read_poses(tmp_path / "p.txt", ["a", "b"])) == {"a": 5, "b": 6}


@pytest.mark.parametrize("suffix", [".json", ".txt"])
@pytest.mark.parametrize(
    ("keys", "names", "expected"),
    [
        # Of equal file names the folders decide, as many of them as are needed.
        (["a/c.ply", "b/c.ply"], ["/x/a/c.ply", "/x/b/c.ply"], [10, 20]),
        (["/old/1/l/c.ply", "/old/2/l/c.ply"], ["/n/2/l/c.ply", "/n/1/l/c.ply"], [20, 10]),
        (["a/c.ply", "b/c.ply"], ["b/c.pcd", "a/c.xyz.gz"], [20, 10]),
        (["a/c", "b/c"], ["b/c.ply", "a/c.ply"], [20, 10]),
        # The whole path, also where it is the end of another.
        (["x/c.ply", "c.ply"], ["c.ply", "x/c.ply"], [20, 10]),
        # Of equal stems the file names decide, but not against the folders.
        (["o/c.ply", "o/c.pcd"], ["n/c.pcd", "n/c.ply"], [20, 10]),
        (["a/c.pcd", "b/c.ply"], ["a/c.ply", "b/c.pcd"], [10, 20]),
        # A name that is found once is enough, whatever the folder.
        (["old/c.ply", "old/d.ply"], ["new/d.ply", "new/c.ply"], [20, 10]),
        # What is another scan's is no scan's besides.
        (["b/c.ply", "d.ply"], ["/x/a/c.ply", "/x/b/c.ply"], [None, 10]),
        (["c.ply", "d.ply"], ["c.pcd", "c.ply"], [None, 10]),
        # The last digits of a time are no suffix.
        (["1305.17", "1305.21"], ["1305.21", "1305.99"], [20, None]),
        (["1305.17", "1305.21"], ["1305.21.ply", "1305.17.ply"], [20, 10]),
        # Numbers are names where all are found, and count the scans where none is.
        (["1", "2"], ["1.ply", "2.ply"], [10, 20]),
        (["0", "1"], ["a.ply", "b.ply"], [10, 20]),
    ],
)
def test_scans_are_found_by_what_tells_their_paths_apart(tmp_path, suffix, keys, names, expected):
    write_poses(tmp_path / f"p{suffix}", shifts(10, 20), names=keys)
    found = lengths_of(read_poses(tmp_path / f"p{suffix}", names))
    assert [found.get(name) for name in names] == expected


@pytest.mark.parametrize("suffix", [".json", ".txt"])
def test_a_scan_without_a_pose_gets_none_of_the_same_name(tmp_path, suffix):
    write_poses(
        tmp_path / f"p{suffix}", shifts(np.nan, 20, 30), names=["a/c.ply", "b/c.ply", "d.ply"]
    )
    found = read_poses(tmp_path / f"p{suffix}", ["/x/a/c.ply", "/x/d.ply"])
    assert lengths_of(found) == {"/x/d.ply": 30}


@pytest.mark.parametrize("suffix", [".json", ".txt"])
@pytest.mark.parametrize(
    ("keys", "names", "told"),
    [
        (
            ["c.ply", "d.ply"],
            ["a/c.ply", "b/c.ply"],
            "whether a/c.ply has the pose of c.ply is open",
        ),
        (["a/c.ply", "b/c.ply"], ["d/c.ply"], "of a/c.ply or b/c.ply is open, since several files"),
        (["a/c.ply", "b/c.ply"], ["a/c.ply", "d/c.ply"], "whether d/c.ply has the pose of b/c.ply"),
        (["c.ply", "c.pcd"], ["c.stl"], "of c.ply or c.pcd is open"),
        (["0", "1", "2"], ["1.ply", "2.ply", "3.ply"], "may be names of the scans or count them"),
    ],
)
def test_a_pose_that_could_be_of_several_scans_is_refused(tmp_path, suffix, keys, names, told):
    poses = shifts(10, 20, 30)[: len(keys)]
    write_poses(tmp_path / f"p{suffix}", poses, names=keys)
    with pytest.raises(ValueError, match=told) as caught:
        read_poses(tmp_path / f"p{suffix}", names)
    assert str(tmp_path / f"p{suffix}") in str(caught.value)


def test_blocks_are_all_named_or_none_is_and_by_names_of_their_own(tmp_path):
    block = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    for text, told in (
        (f"# a\n{block}# b\n{block}{block}", "block 3 has no name above it, and others have"),
        (f"# a\n{block}# b\n{block}# a\n{block}", "two blocks have the name a"),
    ):
        (tmp_path / "p.txt").write_text(text)
        with pytest.raises(ValueError, match=told):
            read_poses(tmp_path / "p.txt")


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
