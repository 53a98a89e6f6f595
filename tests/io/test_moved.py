"""The file of a source again, moved: meshes stay meshes, and every column stays where it was."""

import struct

import numpy as np
import pytest
import trimesh
from plyfile import PlyData

from jaxreg import io

TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
SHIFT = np.array([10.0, 20, 30])


def moved(path, source):
    return io.write_moved(path, source, TURN, SHIFT, points=io.read_cloud(source))


@pytest.mark.parametrize("before", ["stl", "obj", "off", "glb", "ply"])
@pytest.mark.parametrize("after", ["stl", "obj", "off", "glb", "ply"])
def test_a_mesh_stays_a_mesh(tmp_path, before, after):
    box = trimesh.creation.box((1, 2, 3))
    box.export(tmp_path / f"a.{before}")
    io.check_output(tmp_path / f"b.{after}", tmp_path / f"a.{before}")
    assert moved(tmp_path / f"b.{after}", tmp_path / f"a.{before}") == ()
    found = trimesh.load(tmp_path / f"b.{after}", force="mesh")
    assert len(found.faces) == 12
    np.testing.assert_allclose(found.bounds, [[9, 19.5, 28.5], [11, 20.5, 31.5]], atol=1e-5)
    assert found.volume == pytest.approx(6)


@pytest.mark.parametrize("after", ["stl", "glb", "obj"])
def test_single_precision_is_told_where_it_rounds(tmp_path, after):
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "a.off")
    points = io.read_cloud(tmp_path / "a.off")
    far = np.array([5e6, 0, 0])
    told = io.write_moved(tmp_path / f"b.{after}", tmp_path / "a.off", TURN, far, points=points)
    assert [("rounds here by up to 0.25" in note) for note in told] == [True] * (after != "obj")


def test_obj_keeps_its_lines(tmp_path):
    lines = ["# Gerät", "mtllib a.mtl", "v 1 2 3 0.5 0.5 0.5", "v 4 5 6", "v 7 8 1", "vt 0 1"]
    lines += ["vn 1 0 0", "g part", "f 1/1/1 2/1/1 3/1/1"]
    (tmp_path / "a.obj").write_text("\n".join(lines) + "\n", "latin-1")
    moved(tmp_path / "b.obj", tmp_path / "a.obj")
    expected = lines.copy()
    expected[2:5] = ["v 8 21 33 0.5 0.5 0.5", "v 5 24 36", "v 2 27 31"]
    expected[6] = "vn 0 1 0"
    assert (tmp_path / "b.obj").read_text("utf-8").splitlines() == expected


def test_ply_meshes_are_sampled_and_clouds_are_not(tmp_path):
    box = trimesh.creation.box((1, 2, 3))
    for name, encoding in (("a.ply", "binary"), ("b.ply", "ascii")):
        box.export(tmp_path / name, encoding=encoding)
        points, notes, _ = io.read_scan(tmp_path / name)
        assert len(points) == 20_000
        np.testing.assert_allclose(np.abs(points / [0.5, 1, 1.5]).max(axis=1), 1, atol=1e-6)
        assert notes == ("a mesh of 12 triangles, sampled over its surface",)
    io.write_cloud(tmp_path / "c.ply", box.vertices)
    assert len(io.read_cloud(tmp_path / "c.ply")) == 8


def test_polygons_of_ply_are_cut_into_triangles(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\n"
    head += "property float z\nelement face 2\nproperty list uchar int vertex_index\nend_header\n"
    corners = "0 0 0\n2 0 0\n2 2 0\n0 2 0\n1 3 0\n"
    (tmp_path / "a.ply").write_text(head + corners + "4 0 1 2 3\n3 3 2 4\n")
    points, notes, _ = io.read_scan(tmp_path / "a.ply")
    assert "3 triangles" in notes[0]
    assert np.mean(points[:, 1] <= 2) == pytest.approx(4 / 5, abs=0.01)  # areas 4 and 1


def pcd(data: str, extra=b"") -> bytes:
    return (
        "VERSION 0.7\nFIELDS rgb x y z normal_x normal_y normal_z intensity\nSIZE 4 4 4 4 4 4 4 4\n"
        "TYPE U F F F F F F F\nCOUNT 1 1 1 1 1 1 1 1\nWIDTH 1\nHEIGHT 2\n"
        f"VIEWPOINT 1 2 3 1 0 0 0\nPOINTS 2\nDATA {data}\n"
    ).encode() + extra


ROWS = (3368652, 1.0, 2, 3, 1, 0, 0, 7), (16777215, 4.0, 5, 6, 0, 1, 0, 9)
MOVED = (3368652, 8.0, 21, 33, 0, 1, 0, 7), (16777215, 5.0, 24, 36, -1, 0, 0, 9)


def test_binary_pcd_keeps_its_fields_and_their_order(tmp_path):
    rows = b"".join(struct.pack("<I7f", *row) for row in ROWS)
    (tmp_path / "a.pcd").write_bytes(pcd("binary", rows))
    columns = b"".join(
        struct.pack("<2I" if i == 0 else "<2f", *c) for i, c in enumerate(zip(*ROWS, strict=True))
    )
    packed = bytes([31]) + columns[:32] + bytes([31]) + columns[32:]  # two runs of literals
    sizes = struct.pack("<II", len(packed), len(columns))
    (tmp_path / "c.pcd").write_bytes(pcd("binary_compressed", sizes + packed))
    for name in ("a.pcd", "c.pcd"):
        moved(tmp_path / "b.pcd", tmp_path / name)
        head, _, body = (tmp_path / "b.pcd").read_bytes().partition(b"DATA binary\n")
        assert (
            b"FIELDS rgb x y z normal_x normal_y normal_z intensity\nSIZE 4 4 4 4 4 4 4 4" in head
        )
        # The scanner moves with its points: a quarter about z.
        assert b"WIDTH 1\nHEIGHT 2\nVIEWPOINT 8 21 33 0.707106781 0 0 0.707106781" in head
        assert body == b"".join(struct.pack("<I7f", *row) for row in MOVED)


def test_pcd_coordinates_become_double_where_single_precision_would_round(tmp_path):
    (tmp_path / "a.pcd").write_bytes(pcd("binary", b"".join(struct.pack("<I7f", *r) for r in ROWS)))
    shift = np.array([5e6 + 0.125, 0, 0])
    points = io.read_cloud(tmp_path / "a.pcd")
    io.write_moved(tmp_path / "b.pcd", tmp_path / "a.pcd", np.eye(3), shift, points=points)
    assert b"SIZE 4 8 8 8 4 4 4 4" in (tmp_path / "b.pcd").read_bytes()
    np.testing.assert_array_equal(io.read_cloud(tmp_path / "b.pcd"), points + shift)


def test_ascii_pcd_keeps_its_words(tmp_path):
    rows = "\n".join(" ".join(map(str, row)) for row in ROWS).replace("16777215", "4.2e+06")
    (tmp_path / "a.pcd").write_bytes(pcd("ascii", rows.encode() + b"\n"))
    moved(tmp_path / "b.pcd", tmp_path / "a.pcd")
    body = (tmp_path / "b.pcd").read_bytes().partition(b"DATA ascii\n")[2].decode()
    assert body == "3368652 8 21 33 0 1 0 7\n4.2e+06 5 24 36 -1 0 0 9\n"
    np.testing.assert_array_equal(io.read_scan(tmp_path / "b.pcd").viewpoint, [8, 21, 33])


TEXTS = {
    "a.csv": ("id,x,y,z,code\n7,1,2,3,TREE\n8,4,5,6,\n", "id,x,y,z,code\n7,8,21,33,TREE\n8,5,24,36,\n"),
    "a.xyz": ("# by hand\n1  2 3 255\n\n4 5 6 0\n", "# by hand\n8  21 33 255\n\n5 24 36 0\n"),
    "a.txt": ("x;y;z;i\n1,5;2;3;0,5\n", "x;y;z;i\n8;21,5;33;0,5\n"),
    "a.pts": ("2\n1 2 3 -5 1 2 3\n4 5 6 -5 1 2 3\n", "2\n8 21 33 -5 1 2 3\n5 24 36 -5 1 2 3\n"),
    "a.xyzn": ("1 2 3 1 0 0\n4 5 6 0 1 0\n", "8 21 33 0 1 0\n5 24 36 -1 0 0\n"),
    "a.asc": ("//X Y Z Nx Ny Nz\n1 2 3 2 0 0\n", "//X Y Z Nx Ny Nz\n8 21 33 0 2 0\n"),
    "a.tsv": ("x\ty\tz\tname\n1\t2\t3\tan oak\n", "x\ty\tz\tname\n8\t21\t33\tan oak\n"),
    "b.xyz": ("1 2 3\nnan 5 6\n", "8 21 33\nnan 5 6\n"),
    "b.csv": ("1,2,3 # a corner\n4,5,6\n", "8,21,33 # a corner\n5,24,36\n"),
}  # fmt: skip


@pytest.mark.parametrize("name", TEXTS)
def test_text_keeps_columns_comments_and_their_order(tmp_path, name):
    before, after = TEXTS[name]
    (tmp_path / name).write_text(before, "utf-8")
    out = tmp_path / f"out{(tmp_path / name).suffix}"
    io.check_output(out, tmp_path / name)
    moved(out, tmp_path / name)
    assert out.read_text("utf-8") == after


def test_text_to_csv_is_parted_by_commas(tmp_path):
    (tmp_path / "a.xyz").write_text("X Y Z R\n1 2 3 255\n4 5 6 0\n")
    moved(tmp_path / "b.csv", tmp_path / "a.xyz")
    assert (tmp_path / "b.csv").read_text() == "X,Y,Z,R\n8,21,33,255\n5,24,36,0\n"


PLANAR = {
    "a.txt": ("1 2\n4 5\n7 8\n", "8 21\n5 24\n2 27\n"),
    "a.xyz": ("# a plan\nx  y\n 1  2 # a corner\n\n4\t5\nnan 8\n7 8\n",
              "# a plan\nx  y\n 8  21 # a corner\n\n5\t24\nnan 8\n2 27\n"),
    "a.csv": ("x,y\n1,2\n4,5\n7,8.5\n", "x,y\n8,21\n5,24\n1.5,27\n"),
    "a.asc": ("1, 2 // a corner\n4, 5\n7, 8\n", "8,21 // a corner\n5,24\n2,27\n"),
    "a.dat": ("1,5;2\n4;5\n7;8\n", "8;21,5\n5;24\n2;27\n"),
    "a.tsv": ("1.5;2\n4;5\n7;8\n", "8;21.5\n5;24\n2;27\n"),
    "b.txt": ("1|2\n4|5\n7|8\n", "8|21\n5|24\n2|27\n"),
}  # fmt: skip


@pytest.mark.parametrize("name", PLANAR)
def test_text_of_two_columns_keeps_them(tmp_path, name):
    before, after = PLANAR[name]
    (tmp_path / name).write_text(before, "utf-8")
    out = tmp_path / f"out{(tmp_path / name).suffix}"
    io.check_output(out, tmp_path / name)
    points = io.read_cloud(tmp_path / name)
    shift = np.array([10.0, 20, 0])
    assert io.write_moved(out, tmp_path / name, TURN, shift, points=points) == ()
    assert out.read_text("utf-8") == after
    whole = np.isfinite(points).all(axis=1)
    np.testing.assert_allclose(io.read_cloud(out)[whole], points[whole] @ TURN.T + shift)


def test_two_columns_to_csv_are_parted_by_a_comma(tmp_path):
    (tmp_path / "a.xyz").write_text("x y\n1 2\n4 5\n7 8\n")
    moved(tmp_path / "b.csv", tmp_path / "a.xyz")
    assert (tmp_path / "b.csv").read_text() == "x,y\n8,21\n5,24\n2,27\n"


def test_a_height_that_two_columns_cannot_hold_is_told(tmp_path):
    (tmp_path / "a.xyz").write_text("1 2\n4 5\n7 8\n")
    assert moved(tmp_path / "b.xyz", tmp_path / "a.xyz") == (
        "two columns hold x and y alone: z, up to 30, is left out",
    )
    assert moved(tmp_path / "c.ply", tmp_path / "a.xyz") == ()
    np.testing.assert_array_equal(io.read_cloud(tmp_path / "c.ply")[:, 2], [30, 30, 30])


@pytest.mark.parametrize("shift", [[0.5, 0, 0], [3e6, 0, 0], [0, 1e12, 0]])
def test_las_keeps_scale_and_offset_as_long_as_they_hold(tmp_path, shift):
    laspy = pytest.importorskip("laspy", reason="the extra `las` is not installed")
    points = np.random.default_rng(0).uniform(0, 100, (40, 3)).round(3) + [452000, 5411000, 250]
    cloud = laspy.LasData(laspy.LasHeader(point_format=3, version="1.4"))
    for holder in (cloud.header, cloud.points):
        holder.offsets, holder.scales = [450000.0, 5410000, 0], [1e-3] * 3
    cloud.xyz = points
    cloud.write(str(tmp_path / "a.las"))
    read = io.read_cloud(tmp_path / "a.las")
    io.write_moved(tmp_path / "b.las", tmp_path / "a.las", np.eye(3), np.array(shift), points=read)
    found = laspy.read(tmp_path / "b.las")
    np.testing.assert_array_equal(found.header.scales, [1e-3] * 3)
    far = np.abs(shift) > 2e6
    np.testing.assert_array_equal(found.header.offsets[~far], np.array([450000, 5410000, 0])[~far])
    np.testing.assert_allclose(found.xyz, points + shift, atol=0.51e-3 + 1e-16 * max(shift))


def test_what_another_format_cannot_hold_is_told(tmp_path):
    (tmp_path / "a.pcd").write_bytes(pcd("binary", b"".join(struct.pack("<I7f", *r) for r in ROWS)))
    (told,) = moved(tmp_path / "b.xyz", tmp_path / "a.pcd")
    assert told.startswith(".xyz gets coordinates alone; .pcd would keep rgb, normal_x")
    np.testing.assert_array_equal(io.read_cloud(tmp_path / "b.xyz"), [[8, 21, 33], [5, 24, 36]])
    assert moved(tmp_path / "c.ply", tmp_path / "b.xyz") == ()
    assert len(PlyData.read(str(tmp_path / "c.ply"))["vertex"]) == 2


def test_a_cloud_is_no_surface(tmp_path):
    io.write_cloud(tmp_path / "a.ply", np.eye(3))
    for name in ("b.stl", "b.obj", "b.glb"):
        with pytest.raises(
            ValueError, match=r"holds surfaces, and .*a\.ply has none: choose one of"
        ):
            io.check_output(tmp_path / name, tmp_path / "a.ply")
    for name, told in (("b.ply.gz", "leave .gz out"), ("b.e57", "cannot be written as '.e57'")):
        with pytest.raises(ValueError, match=told):
            io.check_output(tmp_path / name, tmp_path / "a.ply")


def test_stl_of_other_programs(tmp_path):
    box = trimesh.creation.box((1, 2, 3))
    triangles = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join("vertex {:.3f} {:.3f} {:.3f}\n".format(*corner) for corner in triangle)
        + "endloop\nendfacet\n"
        for triangle in box.triangles
    )
    text = f"solid box\n{triangles}endsolid box\n"
    binary = box.export(file_type="stl")
    files = {
        "upper.stl": text.upper().encode(),
        "comma.stl": text.replace(".", ",").encode(),
        "utf16.stl": text.encode("utf-16"),
        "solid.stl": b"solid of CAD".ljust(80) + binary[80:],
        "trailing.stl": binary + b"an attribute block",
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        points = io.read_cloud(tmp_path / name)
        assert len(points) == 20_000, name
        np.testing.assert_allclose(np.abs(points / [0.5, 1, 1.5]).max(axis=1), 1, atol=1e-6)
    (tmp_path / "cut.stl").write_bytes(text.encode()[:-60])
    with pytest.raises(ValueError, match="truncated"):
        io.read_cloud(tmp_path / "cut.stl")
