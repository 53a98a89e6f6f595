"""T26: every malformed file is a ValueError that names the file, the place and what to do."""

import contextlib
import os
import pickle
import struct

import numpy as np
import pytest
import trimesh

from jaxreg import io

PLY = "ply\nformat {kind} 1.0\nelement vertex {n}\n{properties}end_header\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"
PCD = (
    "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 3\nHEIGHT 1\nPOINTS 3\n"
    "DATA {kind}\n"
)


def ply(kind="ascii", n=3, properties=XYZ) -> bytes:
    return PLY.format(kind=kind, n=n, properties=properties).encode()


ROW = struct.pack("<fff", 1, 2, 3)
CASES = {
    "empty.ply": (b"", "empty"),
    "nothing.ply": (ply(n=0), "no point"),
    "short.ply": (ply() + b"1 2 3\n4 5 6\n", "row 2"),
    "word.ply": (ply() + b"1 2 3\n4 five 6\n7 8 9\n", "row 1"),
    "short-binary.ply": (ply("binary_little_endian") + 2 * ROW, "row 2"),
    "no-z.ply": (
        ply(properties="property float x\nproperty float y\n") + b"1 2\n" * 3,
        "x, y or z",
    ),
    "no-vertex.ply": (
        b"ply\nformat ascii 1.0\nelement edge 0\nproperty int a\nend_header\n",
        "vertex",
    ),
    "cut-header.ply": (b"ply\nformat ascii 1.0\nelement ver", "export it again"),
    "not.ply": (b"\x89PNG\r\n\x1a\n" + bytes(range(256)), "export it again"),
    "empty.xyz": (b"", "empty"),
    "comments.xyz": (b"# nothing\n\n", "no point"),
    "header.csv": (b"x,y,z\n", "no point"),
    "two-columns.xyz": (b"1 2 3\n4 5\n6 7 8\n", "line 2"),
    "word.txt": (b"# head\n1 2 3\n4 5 six\n", "line 3"),
    "one-word.txt": (b"hello\n1 2 3\n", "line 1"),
    "names.csv": (b"id,a,b,c\n7,1,2,3\n", "line 1: .* id, a, b, c, .*call those that hold"),
    "no-z.csv": (b"x,y,time\n1,2,3\n", "x, y, time, not x, y, z"),
    "names.txt": (b"# id,a,b,c\n7,1,2,3\n8,4,5,6\n", "id, a, b, c.*call those that hold"),
    "slashes.txt": (b"\n//R G B\n1 2 3\n4 5 6\n", "line 2: .* R, G, B"),
    "units.txt": (b"a [m] b [m] c [m]\n1 2 3\n4 5 6\n", r"a\[m\], b\[m\], c\[m\], not x, y, z"),
    "blank-in-name.txt": (
        b"Point ID X Y Z Intensity\n1 2 3 4 5\n6 7 8 9 10\n",
        "line 1: the header has 6 names for 5 columns",
    ),
    "index.csv": (b",0,1,2\n0,1,2,3\n1,4,5,6\n", ", 0, 1, 2, not x, y, z"),
    "raised.xyz": ("²\n1 2 3\n4 5 6\n".encode(), "line 1: '²' is not a point"),
    "raised.pts": ("2\n1 2 3 0\n4 5 6 0\n²\n7 8 9 0\n".encode(), "line 4: '²' has 1 column"),
    "raised.ply": (ply().replace(b"vertex 3", b"vertex \xb2") + b"1 2 3\n", "line 3"),
    "digits.xyz": (b"9" * 5000 + b"\n1 2 3\n4 5 6\n", "line 1: '9{60}' is not a point"),
    "binary.txt": (b"\xff\xfe\x00\x81" * 10, "not a text file"),
    "short.pcd": (PCD.format(kind="ascii").encode() + b"1 2 3\n", "truncated"),
    "word.pcd": (PCD.format(kind="ascii").encode() + b"1 2 3\n4 x 6\n7 8 9\n", "point 1"),
    "short-binary.pcd": (PCD.format(kind="binary").encode() + ROW, "row 1"),
    "short-packed.pcd": (PCD.format(kind="binary_compressed").encode() + b"\0" * 6, "truncated"),
    "cut-packed.pcd": (
        PCD.format(kind="binary_compressed").encode() + struct.pack("<II", 50, 36) + b"\x05abc",
        "truncated",
    ),
    "odd.pcd": (PCD.format(kind="holographic").encode(), "encoding"),
    "no-x.pcd": (PCD.format(kind="ascii").replace("x y z", "a b c").encode(), "without x y z"),
    "mismatch.pcd": (PCD.format(kind="ascii").replace("SIZE 4 4 4", "SIZE 4 4").encode(), "SIZE"),
    "no-header.pcd": (b"1 2 3\n4 5 6\n", "header"),
    "cut.npy": (b"\x93NUMPY\x01\x00", "save"),
    "cut.npz": (b"PK\x03\x04rest", "save"),
    "text.npy": (b"1 2 3\n", "save"),
    "cut.off": (b"OFF\n8 12 0\n0 0 0\n", "malformed or truncated"),
    "bad-face.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n", "export it again"),
    "cut.stl": (b"\0" * 80 + struct.pack("<I", 9) + b"\0" * 20, "truncated"),
    "unknown.xyzzy": (b"1 2 3\n", "unknown format"),
}


@pytest.mark.parametrize("name", CASES)
def test_malformed_file_is_named_with_place_and_remedy(tmp_path, name):
    content, told = CASES[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=told) as caught:
        io.read_cloud(tmp_path / name)
    assert name in str(caught.value)


@pytest.mark.parametrize("suffix", [*io.WRITABLE, ".obj", ".off", ".stl", ".glb"])
def test_damaged_files_are_read_or_refused_by_name(tmp_path, seed, suffix):
    """Cut anywhere, or with bytes changed: a cloud or a ValueError, and nothing else."""
    rng = np.random.default_rng(seed)
    if suffix in (".las", ".laz"):
        pytest.importorskip("laspy", reason="the extra `las` is not installed")
    path = tmp_path / f"scan{suffix}"
    if suffix in io.WRITABLE:
        io.write_cloud(path, rng.normal(size=(30, 3)))
    else:
        trimesh.creation.icosphere(subdivisions=1).export(path)
    whole = path.read_bytes()
    for i in range(40):
        damaged = bytearray(whole[: rng.integers(1, len(whole))] if i % 2 else whole)
        for _ in range(0 if i % 2 else rng.integers(1, 6)):
            damaged[rng.integers(0, min(len(damaged), 400))] = rng.integers(0, 256)
        path.write_bytes(damaged)
        try:
            cloud = io.read_cloud(path)
        except ValueError as error:
            assert str(path) in str(error)  # noqa: PT017 - either outcome is right
        else:
            assert (cloud.ndim, cloud.shape[1], cloud.dtype) == (2, 3, np.float64)


READERS = (
    io.read_cloud,
    io.read_matrix,
    io.read_poses,
    io.read_pairs_log,
    lambda path: io.read_numbers(path, 2),
)
UNKNOWN = {(io.read_cloud, ".json"), (io.read_cloud, ".g2o")}


@pytest.mark.parametrize("suffix", [".ply", ".json", ".npy", ".g2o", ".txt"])
def test_missing_file(tmp_path, suffix):
    (tmp_path / "file").touch()
    for path in (tmp_path / f"absent{suffix}", tmp_path / "file" / f"absent{suffix}"):
        for read in READERS:
            told = "unknown format" if (read, suffix) in UNKNOWN else "no such file; check the path"
            with pytest.raises(ValueError, match=told) as caught:
                read(path)
            assert str(caught.value).startswith(str(path))


@contextlib.contextmanager
def as_another_user():
    """Root may read every file: what it does inside, another user does, who may not."""
    if not hasattr(os, "geteuid"):
        pytest.skip("permissions are those of POSIX")
    own = os.geteuid()
    try:
        if own == 0:
            os.seteuid(65534)
        yield
    finally:
        os.seteuid(own)


@pytest.mark.parametrize("suffix", [".ply", ".json", ".npy", ".g2o", ".txt", ".pcd", ".xyz.gz"])
@pytest.mark.parametrize("place", ["file", "folder"])
def test_a_file_that_may_not_be_read(tmp_path, suffix, place):
    path = tmp_path / "closed" / f"a{suffix}"
    path.parent.mkdir()
    path.write_text("1 2 3\n4 5 6\n")
    closed = path if place == "file" else path.parent
    mode = closed.stat().st_mode
    closed.chmod(0)
    try:
        for read in READERS:
            if (read, suffix) in UNKNOWN:
                continue
            with contextlib.suppress(ValueError):
                read(path)  # for the imports that another user may not do
            with as_another_user(), pytest.raises(ValueError, match="Permission denied") as caught:
                read(path)
            told = f"{path} cannot be read (Permission denied): check who may read it, or copy it."
            assert str(caught.value) == told
    finally:
        closed.chmod(mode)


def test_directory(tmp_path):
    (tmp_path / "scans.ply").mkdir()
    for path in (tmp_path, tmp_path / "scans.ply"):
        for read in READERS:
            with pytest.raises(ValueError, match="is a directory, not a file: name a file in it"):
                read(path)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_without_a_finite_point(tmp_path, suffix):
    pytest.importorskip("laspy", reason="the extra `las` is not installed")
    with pytest.raises(ValueError, match="no point is finite"):
        io.write_cloud(tmp_path / f"a{suffix}", np.full((4, 3), np.nan))
    assert not (tmp_path / f"a{suffix}").exists()


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_truncated_las(tmp_path, suffix):
    pytest.importorskip("laspy", reason="the extra `las` is not installed")
    path = tmp_path / f"a{suffix}"
    io.write_cloud(path, np.random.default_rng(0).normal(size=(500, 3)))
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(ValueError, match="truncated"):
        io.read_cloud(path)


def test_pickles_are_never_loaded(tmp_path):
    class Harm:
        def __reduce__(self):
            return (pytest.fail, ("a pickle was executed",))

    np.save(tmp_path / "a.npy", np.array([Harm()], object), allow_pickle=True)
    (tmp_path / "b.npy").write_bytes(pickle.dumps(Harm()))
    for name in ("a.npy", "b.npy"):
        with pytest.raises(ValueError, match="cannot be read"):
            io.read_cloud(tmp_path / name)


@pytest.mark.parametrize(("shape", "dtype"), [((5,), float), ((5, 1), float), ((5, 3), "U3")])
def test_arrays_that_are_no_cloud(tmp_path, shape, dtype):
    np.save(tmp_path / "a.npy", np.zeros(shape, dtype))
    with pytest.raises(ValueError, match=r"not numbers of shape \(n, 3\)"):
        io.read_cloud(tmp_path / "a.npy")


def test_archive_with_two_clouds_asks_for_a_name(tmp_path):
    np.savez(tmp_path / "a.npz", one=np.zeros((4, 3)), two=np.zeros((4, 3)))
    with pytest.raises(ValueError, match=r"one \(4, 3\), two \(4, 3\).*'points'"):
        io.read_cloud(tmp_path / "a.npz")


def test_unwritable(tmp_path):
    with pytest.raises(ValueError, match="cannot be written as '.obj'"):
        io.write_cloud(tmp_path / "a.obj", np.zeros((3, 3)))
    with pytest.raises(ValueError, match="does not exist"):
        io.write_cloud(tmp_path / "nowhere" / "a.ply", np.zeros((3, 3)))


@pytest.mark.untyped
@pytest.mark.parametrize("suffix", [".ply", ".xyz", ".npz", ".pcd"])
def test_points_of_two_coordinates_are_not_written(suffix, tmp_path):
    with pytest.raises(ValueError, match=r"points must have shape \(n, 3\), got \(4, 2\)"):
        io.write_cloud(tmp_path / f"x{suffix}", np.zeros((4, 2)))
    assert list(tmp_path.iterdir()) == []
