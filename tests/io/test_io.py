"""Every format: what is written comes back, and what other programs write is read."""

import struct
import sys

import numpy as np
import pytest
import trimesh
from plyfile import PlyData, PlyElement

from jaxreg import io

ASCII_PLY = """ply
format ascii 1.0
comment by hand
element vertex {n}
property float x
property float y
property float z
property uchar red
element face 0
property list uchar int vertex_indices
end_header
"""


@pytest.fixture
def points(seed):
    return np.random.default_rng(seed).normal(size=(40, 3)) * 3 + [5e6, -2e5, 100]


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npy", ".npz", ".NPY", ".NPZ"])
def test_lossless_formats_keep_every_bit(tmp_path, points, suffix):
    io.write_cloud(tmp_path / f"cloud{suffix}", points)
    np.testing.assert_array_equal(io.read_cloud(tmp_path / f"cloud{suffix}"), points)


@pytest.mark.parametrize("suffix", [".xyz", ".txt", ".csv"])
def test_text_keeps_twelve_digits(tmp_path, points, suffix):
    io.write_cloud(tmp_path / f"cloud{suffix}", points)
    np.testing.assert_allclose(io.read_cloud(tmp_path / f"cloud{suffix}"), points, rtol=1e-11)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_keeps_a_billionth_of_the_extent(tmp_path, points, suffix):
    pytest.importorskip("laspy", reason="the extra `las` is not installed")
    io.write_cloud(tmp_path / f"cloud{suffix}", points)
    read = io.read_cloud(tmp_path / f"cloud{suffix}")
    np.testing.assert_allclose(read, points, atol=1e-8 * np.ptp(points, axis=0).max() + 1e-9)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_moved_las_keeps_what_else_it_stores(tmp_path, points, suffix):
    laspy = pytest.importorskip("laspy", reason="the extra `las` is not installed")
    cloud = laspy.LasData(laspy.LasHeader(point_format=3, version="1.4"))
    cloud.header.offsets, cloud.header.scales = points.min(axis=0), [1e-3] * 3
    cloud.points.offsets, cloud.points.scales = cloud.header.offsets, cloud.header.scales
    cloud.xyz = points
    cloud.intensity, cloud.red = np.arange(40), np.arange(40) * 7
    cloud.gps_time = np.arange(40) / 3
    cloud.write(str(tmp_path / f"a{suffix}"))
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    shift = np.array([-4e6, 2e6, 5.0])  # Out of the range of the integers of the original.
    io.las.write_moved(tmp_path / f"b{suffix}", tmp_path / f"a{suffix}", turn, shift)
    moved = io.read_cloud(tmp_path / f"a{suffix}") @ turn.T + shift
    np.testing.assert_allclose(io.read_cloud(tmp_path / f"b{suffix}"), moved, atol=0.6e-3)
    found = laspy.read(tmp_path / f"b{suffix}")
    for name in ("intensity", "red", "gps_time"):
        np.testing.assert_array_equal(found[name], cloud[name])


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_leaves_out_rows_that_are_not_finite(tmp_path, points, suffix):
    pytest.importorskip("laspy", reason="the extra `las` is not installed")
    path = tmp_path / f"cloud{suffix}"
    holed = points.copy()
    holed[[0, 7], [0, 2]], holed[9] = np.nan, np.inf
    io.write_cloud(path, holed)
    whole = np.delete(points, [0, 7, 9], axis=0)
    np.testing.assert_allclose(io.read_cloud(path), whole, atol=1e-7)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("text", [False, True])
def test_ply_of_any_byte_order_with_extra_properties(tmp_path, order, text):
    kinds = [("intensity", "u2"), ("z", "f4"), ("y", "f8"), ("x", "f4"), ("nx", "f4")]
    rows = np.zeros(5, kinds)
    rows["x"], rows["y"], rows["z"] = np.arange(5), np.arange(5) / 4, -np.arange(5)
    faces = np.array([([0, 1, 2],)], [("vertex_indices", "i4", (3,))])
    elements = [PlyElement.describe(rows, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements, text=text, byte_order="=" if text else order).write(str(tmp_path / "a.ply"))
    expected = np.stack([np.arange(5), np.arange(5) / 4, -np.arange(5.0)], axis=1)
    np.testing.assert_array_equal(io.read_cloud(tmp_path / "a.ply"), expected)


def test_ascii_ply_with_windows_line_ends(tmp_path):
    content = ASCII_PLY.format(n=2) + "1 2 3 255\n4 5 6 0\n"
    (tmp_path / "a.ply").write_bytes(content.replace("\n", "\r\n").encode())
    np.testing.assert_array_equal(io.read_cloud(tmp_path / "a.ply"), [[1, 2, 3], [4, 5, 6]])


def test_binary_ply_with_windows_line_ends_in_its_header(tmp_path):
    head = "ply\nformat binary_big_endian 1.0\nelement vertex 2\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    rows = struct.pack(">6f", 1, 2, 3, 4, 5, 6)
    (tmp_path / "a.ply").write_bytes(head.replace("\n", "\r\n").encode() + rows)
    np.testing.assert_array_equal(io.read_cloud(tmp_path / "a.ply"), [[1, 2, 3], [4, 5, 6]])


def test_moved_ply_keeps_colours_turns_normals_and_widens_coordinates(tmp_path):
    kinds = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("nx", "f4"), ("ny", "f4"), ("nz", "f4")]
    rows = np.zeros(3, [*kinds, ("red", "u1")])
    rows["x"], rows["nx"], rows["red"] = [1, 2, 3], 1, [7, 8, 9]
    vertex = PlyElement.describe(rows, "vertex", comments=["in metres"])
    PlyData([vertex], obj_info=["num_cols 512"]).write(str(tmp_path / "a.ply"))
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    io.ply.write_moved(
        tmp_path / "b.ply", tmp_path / "a.ply", quarter, np.array([5e6 + 0.125, 0, 0])
    )
    vertex = PlyData.read(str(tmp_path / "b.ply"))["vertex"]
    np.testing.assert_array_equal(vertex["x"], [5e6 + 0.125] * 3)
    np.testing.assert_array_equal(vertex["y"], [1, 2, 3])
    np.testing.assert_array_equal(vertex["ny"], [1, 1, 1])
    np.testing.assert_array_equal(vertex["red"], [7, 8, 9])
    assert vertex.comments == ["in metres"]
    assert PlyData.read(str(tmp_path / "b.ply")).obj_info == ["num_cols 512"]


COLORS = ("red", "green", "blue")


def test_colours_of_scans_of_any_size_follow_each_other(tmp_path):
    paths = [tmp_path / "a.ply", tmp_path / "b.ply", tmp_path / "c.xyz"]
    for path, count, red in zip(paths, (2, 3, 1), (7, 8, None), strict=True):
        io.write_cloud(path, np.ones((count, 3)))
        if red:
            rows = np.full(count, red, [*((a, "f4") for a in "xyz"), *((c, "u1") for c in COLORS)])
            PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))
    clouds = [io.read_cloud(path) for path in paths]
    for _ in range(20):  # the check of types looks at one cloud, by chance
        found = io.read_colors(paths, clouds)
    np.testing.assert_array_equal(found, np.repeat([[7], [8], [128]], [2, 3, 1], 0) * [[1, 1, 1]])


@pytest.mark.parametrize(
    "content",
    [
        "1 2 3\n4 5 6\n",
        "1\t2\t3\t0.5\r\n4\t5\t6\t0.5\r\n",
        "# made by hand\n\n1,2,3\n4,5,6\n",
        "x;y;z;label\n1;2;3;9\n4;5;6;9\n",
        '"label","z","y","x"\n9,3,2,1\n9,6,5,4\n',
        "//X Y Z\n1 2 3\n4 5 6\n",
        "2\n1 2 3\n4 5 6\n",
        "\ufeff1 2 3\n4 5 6\n",
        "# id,x,y,z\n7,1,2,3\n8,4,5,6\n",
        "# id x y z\n7 1 2 3\n8 4 5 6\n",
        "# id, x, y, z\n7 1 2 3\n8 4 5 6\n",
        "# id x y z\n7,1,2,3\n8,4,5,6\n",
        "# made by hand\n# z y x\n3 2 1\n6 5 4\n",
        "# made by hand\nz y x\n3 2 1\n6 5 4\n",
        "# columns: x y z\n1 2 3 9\n4 5 6 9\n",
        "//R G X Y Z\n2\n9 9 1 2 3\n9 9 4 5 6\n",
        "\n//Z;Y;X\n3;2;1\n6;5;4\n",
        "t,X [m],Y [m],Z [m]\n9,1,2,3\n9,4,5,6\n",
        "# Z (mm) Y (mm) X (mm)\n3 2 1\n6 5 4\n",
        "z_m y_m x_m\n3 2 1\n6 5 4\n",
        "# scanned by hand in May\n1 2 3\n4 5 6\n",
        "# the x y z of a scan\n1 2 3\n4 5 6\n",
        "# author: Jane Doe\n1 2 3\n4 5 6\n",
        "# 9 9 9\n1 2 3\n4 5 6\n",
        "# --- --- ---\n1 2 3\n4 5 6\n",
        "1 2 3 # first of all\n4 5 6 # x y z\n",
        "Point ID\tX\tY\tZ\tIntensity\n7\t1\t2\t3\t50\n8\t4\t5\t6\t50\n",
        "# Point ID\tX\tY\tZ\n7\t1\t2\t3\n8\t4\t5\t6\n",
        "a scan of last Monday\n1 2 3\n4 5 6\n",
    ],
)
def test_text_as_programs_write_it(tmp_path, content):
    (tmp_path / "a.txt").write_bytes(content.encode())
    np.testing.assert_array_equal(io.read_cloud(tmp_path / "a.txt"), [[1, 2, 3], [4, 5, 6]])


def pcd_header(data: str, fields="x y z rgb", size="4 4 4 4", kind="F F F U", count="1 1 1 1"):
    return (
        f"# .PCD v.7\nVERSION .7\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\nCOUNT {count}\n"
        f"WIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA {data}\n"
    ).encode()


def test_pcd_ascii_binary_and_compressed(tmp_path):
    expected = np.array([[1, 2, 3], [4, 5, 6.0]])
    (tmp_path / "a.pcd").write_bytes(pcd_header("ascii") + b"1 2 3 77\n4 5 6 77\n")
    rows = struct.pack("<fffIfffI", 1, 2, 3, 77, 4, 5, 6, 77)
    (tmp_path / "b.pcd").write_bytes(pcd_header("binary") + rows)
    columns = struct.pack("<ffffffII", 1, 4, 2, 5, 3, 6, 77, 77)
    packed = bytes([len(columns) - 1]) + columns  # one run of literals
    sizes = struct.pack("<II", len(packed), len(columns))
    (tmp_path / "c.pcd").write_bytes(pcd_header("binary_compressed") + sizes + packed)
    for name in "abc":
        np.testing.assert_array_equal(io.read_cloud(tmp_path / f"{name}.pcd"), expected)


def test_pcd_back_references_unpack_as_open3d_packs_them(tmp_path):
    o3d = pytest.importorskip("open3d", reason="Open3D is not here", exc_type=ImportError)
    points = np.repeat(np.arange(12.0).reshape(4, 3), 50, axis=0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    o3d.io.write_point_cloud(str(tmp_path / "a.pcd"), cloud, compressed=True)
    np.testing.assert_array_equal(io.read_cloud(tmp_path / "a.pcd"), points)


def test_pcd_with_repeated_and_padding_fields(tmp_path):
    header = pcd_header("ascii", "x y z normal _", "4 4 4 4 1", "F F F F U", "1 1 1 3 2")
    (tmp_path / "a.pcd").write_bytes(header + b"1 2 3 0 0 1 0 0\n4 5 6 0 0 1 0 0\n")
    np.testing.assert_array_equal(io.read_cloud(tmp_path / "a.pcd"), [[1, 2, 3], [4, 5, 6]])


def test_numpy_archives_and_structured_arrays(tmp_path, points):
    np.savez(tmp_path / "a.npz", points=points, colours=np.zeros((40, 3)))
    np.savez(tmp_path / "b.npz", cloud=points, label=np.zeros(40))
    rows = np.zeros(40, [("z", "f8"), ("y", "f8"), ("x", "f8")])
    rows["x"], rows["y"], rows["z"] = points.T
    np.save(tmp_path / "c.npy", rows)
    np.save(tmp_path / "d.npy", rows.reshape(20, 2))  # organised, two columns wide
    for name in ("a.npz", "b.npz", "c.npy", "d.npy"):
        np.testing.assert_array_equal(io.read_cloud(tmp_path / name), points)
        assert io.read_scan(tmp_path / name).notes == ()
    np.save(tmp_path / "e.npy", points[:, :2])
    assert io.read_scan(tmp_path / "e.npy").notes == ("two columns: z is 0",)


CUBE_OFF = (
    "8 12 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n0 0 1\n1 0 1\n1 1 1\n0 1 1\n"
    "3 0 1 2\n3 0 2 3\n3 4 5 6\n3 4 6 7\n3 0 1 5\n3 0 5 4\n3 1 2 6\n3 1 6 5\n3 2 3 7\n3 2 7 6\n"
    "3 3 0 4\n3 3 4 7\n"
)


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
@pytest.mark.parametrize("head", ["OFF\n", "OFF", "OFF "])
def test_off_of_modelnet_even_with_its_glued_first_line(tmp_path, head, line_end):
    (tmp_path / "cube.off").write_bytes((head + CUBE_OFF).replace("\n", line_end).encode())
    cloud = io.read_cloud(tmp_path / "cube.off")
    on_surface = np.min(np.minimum(np.abs(cloud), np.abs(cloud - 1)), axis=1)
    assert len(cloud) > 1000
    assert np.all((cloud >= -1e-9) & (cloud <= 1 + 1e-9))
    np.testing.assert_allclose(on_surface, 0, atol=1e-9)
    # Uniform by area: every face has a sixth of the points.
    share = np.mean(np.abs(cloud[:, 2]) < 1e-9)
    assert 0.13 < share < 0.2
    np.testing.assert_array_equal(cloud, io.read_cloud(tmp_path / "cube.off"))


def test_obj_and_stl_agree_with_the_shape_they_were_written_from(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=2.0)
    for suffix in (".obj", ".stl"):
        sphere.export(tmp_path / f"ball{suffix}")
        radius = np.linalg.norm(io.read_cloud(tmp_path / f"ball{suffix}"), axis=1)
        assert np.all((radius > 1.95) & (radius <= 2 + 1e-6))


def test_obj_without_faces_gives_its_vertices(tmp_path):
    (tmp_path / "a.obj").write_text("v 1 2 3\nv 4 5 6\nv 7 8 9\n")
    np.testing.assert_array_equal(
        io.read_cloud(tmp_path / "a.obj"), [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    )


def test_obj_with_a_latin_1_comment(tmp_path, monkeypatch):
    for name in ("charset_normalizer", "chardet"):  # Trimesh would guess by these.
        monkeypatch.setitem(sys.modules, name, None)
    content = "# Gerät für Größe, fläche\nv 1 2 3\nv 4 5 6\nv 7 8 9\n"
    (tmp_path / "a.obj").write_bytes(content.encode("latin-1"))
    np.testing.assert_array_equal(
        io.read_cloud(tmp_path / "a.obj"), [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    )


def test_nan_points_stay_in_their_rows(tmp_path):
    (tmp_path / "a.xyz").write_text("1 2 3\nnan 0 0\n4 5 6\n")
    np.testing.assert_array_equal(np.isnan(io.read_cloud(tmp_path / "a.xyz")[:, 0]), [0, 1, 0])
