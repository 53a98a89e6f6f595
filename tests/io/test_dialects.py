"""Files as the world writes them: encodings, decimal marks, names, fields without numbers."""

import gzip
import struct

import numpy as np
import pytest

from jaxreg import io

ROWS = [[1.5, 2.25, -3], [4, 5.5, 6], [7, 8, 9.75]]

READ_RIGHT = {
    "comma-blanks.xyz": b"1,5 2,25 -3\n4 5,5 6\n7 8 9,75\n",
    "comma-tabs.txt": b"1,5\t2,25\t-3\t255\n4\t5,5\t6\t0\n7\t8\t9,75\t0\n",
    "comma-semicolons.csv": b"X;Y;Z;I\n1,5;2,25;-3;1,0\n4;5,5;6;1,0\n7;8;9,75;1\n",
    "comma-exponent.txt": b"1,5e0 2,25 -3\n4,0 5,5 6\n7 8 0,975E+1\n",
    "comma-after-whole-rows.txt": b"1,5 2,25 -3\n4 5,5 6\n7 8 9,75\n",
    "bars.txt": b"x|y|z\n1.5|2.25|-3\n4|5.5|6\n7|8|9.75\n",
    "fortran.txt": b"0.15D1 2.25d0 -3\n4 5.5 6\n7 8 9.75\n",
    "utf16.txt": "1.5 2.25 -3\r\n4 5.5 6\r\n7 8 9.75\r\n".encode("utf-16"),
    "utf16-be.csv": "x,y,z\n1.5,2.25,-3\n4,5.5,6\n7,8,9.75\n".encode("utf-16-be"),
    "latin.csv": "Größe,x,y,z\n1,1.5,2.25,-3\n2,4,5.5,6\n3,7,8,9.75\n".encode("latin-1"),
    "greek.asc": "# Σάρωση\n1.5 2.25 -3\n4 5.5 6\n7 8 9.75\n".encode(),
    "mark-inside.xyz": "# scan\n\ufeff1.5 2.25 -3\n4 5.5 6\n7 8 9.75\n".encode(),
    "old-mac.txt": b"1.5 2.25 -3\r4 5.5 6\r7 8 9.75\r",
    "easting.csv": b"PointID,Easting,Northing,Elevation,Code\n"
    b"1,1.5,2.25,-3,TREE\n2,4,5.5,6,\n3,7,8,9.75,KERB\n",
    "northing-first.csv": b"No,N,E,H\n1,2.25,1.5,-3\n2,5.5,4,6\n3,8,7,9.75\n",
    "german.csv": "Nr;Rechtswert;Hochwert;Höhe\n1;1,5;2,25;-3\n2;4;5,5;6\n3;7;8;9,75\n".encode(),
    "xy-height.csv": b"x,y,height [m]\n1.5,2.25,-3\n4,5.5,6\n7,8,9.75\n",
    "paraview.csv": b'"id","Points:0","Points:1","Points:2"\n8,1.5,2.25,-3\n9,4,5.5,6\n9,7,8,9.75\n',
    "coords.txt": b"time coord_x coord_y coord_z\n0 1.5 2.25 -3\n1 4 5.5 6\n2 7 8 9.75\n",
    "labels.csv": b"P1,1.5,2.25,-3,TREE\nP2,4,5.5,6,TREE\nP3,7,8,9.75,TREE\n",
    "number-and-label.csv": b"1,TREE,1.5,2.25,-3\n2,TREE,4,5.5,6\n3,KERB,7,8,9.75\n",
    "obj-like.txt": b"v 1.5 2.25 -3\nv 4 5.5 6\nv 7 8 9.75\n",
    "blocks.pts": b"2\n1.5 2.25 -3 -1200 1 2 3\n4 5.5 6 -1200 1 2 3\n1\n7 8 9.75 -1200 1 2 3\n",
    "colours.xyzrgb": b"1.5 2.25 -3 255 0 0\n4 5.5 6 255 0 0\n7 8 9.75 255 0 0\n",
    "titles.asc": b"a scan of last Monday\nX Y Z\n1.5 2.25 -3\n4 5.5 6\n7 8 9.75\n",
}  # fmt: skip


@pytest.mark.parametrize("name", READ_RIGHT)
def test_text_of_many_programs(tmp_path, name):
    (tmp_path / name).write_bytes(READ_RIGHT[name])
    np.testing.assert_array_equal(io.read_cloud(tmp_path / name), ROWS)


HOLED = {
    "windows.xyz": b"1 2 3\n-nan(ind) 5 6\n7 1.#QNAN 9\n",
    "windows-last.txt": b"1 2 3 4\n-1.#IND 5 6 4\n7 -nan 9 1.#QNAN\n",
    "empty.csv": b"x,y,z,i\n1,2,3,5\n,5,6,5\n7,,9,5\n",
    "empty-tabs.txt": b"1\t2\t3\t0\n\t5\t6\t0\n7\t\t9\t0\n",
    "null.csv": b"x;y;z\n1;2;3\nNULL;5;6\n7;n/a;9\n",
}


@pytest.mark.parametrize("name", HOLED)
def test_what_is_no_number_is_nan_in_its_row(tmp_path, name):
    (tmp_path / name).write_bytes(HOLED[name])
    nan = np.nan
    np.testing.assert_array_equal(
        io.read_cloud(tmp_path / name), [[1, 2, 3], [nan, 5, 6], [7, nan, 9]]
    )


REFUSED = {
    "survey.csv": (b"1,45.5,11.2,2.5\n2,46.5,12.2,2.5\n3,47.5,13.2,2.5\n", "seems to number"),
    "gaps.txt": (b"101 45.5 11.2 2.5\n105 46.5 12.2 2.5\n220 47.5 13.2 2.5\n", "'number x y z'"),
    "doubled.csv": (b"x,y,z\n1,5,2,5,3,5\n4,5,5,5,6,5\n", "decimal mark as well"),
    "degrees.csv": (b"name,latitude,longitude,height\na,48.1,11.5,500\n", "project them"),
    "cut.pts": (b"5\n1 2 3 0\n4 5 6 0\n", "line 1 announces 5 points and 2 follow"),
    "grid.asc": (b"ncols 2\nnrows 1\nxllcorner 0\n1 2\n", "gdal_translate"),
    "thousands.txt": (b"1,234 5.5 6.5\n2,345 6.5 7.5\n", "decimal mark"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_could_be_misread_is_refused(tmp_path, name):
    content, told = REFUSED[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=told):
        io.read_cloud(tmp_path / name)


@pytest.mark.parametrize("header", [b"number x y z\n", b"x y z i\n"])
def test_the_advice_for_numbered_points_works(tmp_path, header):
    content = REFUSED["gaps.txt"][0]
    (tmp_path / "a.txt").write_bytes(header + content)
    rows = np.loadtxt(content.decode().splitlines())
    expected = rows[:, 1:] if header.startswith(b"number") else rows[:, :3]
    np.testing.assert_array_equal(io.read_cloud(tmp_path / "a.txt"), expected)


HEAD = "ply\nformat {} 1.0\ncomment {}\nelement vertex 3\n"
HEAD += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
BODY = "1.5 2.25 -3\n4 5.5 6\n7 8 9.75\n"
PACKED = struct.pack("<9f", *np.ravel(ROWS))
PLY = {
    "greek": HEAD.format("binary_little_endian", "Σάρωση").encode() + PACKED,
    "latin": HEAD.format("binary_little_endian", "Gerät").encode("latin-1") + PACKED,
    "mark": b"\xef\xbb\xbf" + (HEAD.format("ascii", "x") + BODY).encode(),
    "mark-binary": b"\xef\xbb\xbf" + HEAD.format("binary_little_endian", "x").encode() + PACKED,
    "mark-inside": (HEAD.format("ascii", "x") + "\ufeff" + BODY).encode(),
    "utf16": (HEAD.format("ascii", "ä") + BODY).encode("utf-16"),
    "comma": (HEAD.format("ascii", "1,2") + BODY.replace(".", ",")).encode(),
}


@pytest.mark.parametrize("name", PLY)
def test_ply_of_any_encoding(tmp_path, name):
    (tmp_path / "a.ply").write_bytes(PLY[name])
    np.testing.assert_array_equal(io.read_cloud(tmp_path / "a.ply"), ROWS)


def test_ply_with_numbers_of_windows(tmp_path):
    body = BODY.replace("4 5.5 6", "-nan(ind) 5.5 1.#QNAN")
    (tmp_path / "a.ply").write_bytes((HEAD.format("ascii", "x") + body).encode())
    expected = [ROWS[0], [np.nan, 5.5, np.nan], ROWS[2]]
    np.testing.assert_array_equal(io.read_cloud(tmp_path / "a.ply"), expected)


PCD = {
    "0.5": "VERSION .5\nCOLUMNS x y z\nPOINTS 3\nDATA ascii\n",
    "0.6": "VERSION .6\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\nHEIGHT 1\nPOINTS 3\n"
    "DATA ascii\n",
    "0.7": "# Gerät\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 3\n"
    "HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA ASCII\n",
}


@pytest.mark.parametrize("version", PCD)
@pytest.mark.parametrize("comma", [False, True])
def test_pcd_of_every_version(tmp_path, version, comma):
    body = BODY.replace(".", ",") if comma else BODY
    (tmp_path / "a.pcd").write_bytes((PCD[version] + body).encode("latin-1"))
    np.testing.assert_array_equal(io.read_cloud(tmp_path / "a.pcd"), ROWS)


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".csv", ".npy", ".npz"])
def test_gzip_of_any(tmp_path, suffix):
    io.write_cloud(tmp_path / f"a{suffix}", np.array(ROWS))
    packed = gzip.compress((tmp_path / f"a{suffix}").read_bytes())
    (tmp_path / f"b{suffix}.gz").write_bytes(packed)
    np.testing.assert_array_equal(io.read_cloud(tmp_path / f"b{suffix}.gz"), ROWS)
    (tmp_path / f"c{suffix}.gz").write_bytes(packed[: len(packed) // 2])
    with pytest.raises(ValueError, match=rf"c\{suffix}\.gz is a damaged or truncated gzip"):
        io.read_cloud(tmp_path / f"c{suffix}.gz")


def test_errors_inside_gzip_name_the_file(tmp_path):
    (tmp_path / "a.xyz.gz").write_bytes(gzip.compress(b"1 2 3\n4 5\n"))
    with pytest.raises(ValueError, match=r"/a\.xyz\.gz, line 2: '4 5' has 2"):
        io.read_cloud(tmp_path / "a.xyz.gz")


PTX = "3\n1\n1 2 3\n1 0 0\n0 1 0\n0 0 1\n"
POSE = "0 1 0 0\n-1 0 0 0\n0 0 1 0\n10 20 30 1\n"  # for rows: a quarter about z, then a shift
RAYS = "1.5 2.25 -3 0.5\n0 0 0 0.5\n4 5.5 6 0.5\n"


def test_ptx_lays_every_station_by_its_matrix_and_says_so(tmp_path):
    identity = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    (tmp_path / "a.ptx").write_text(PTX + identity + RAYS + PTX + POSE + RAYS)
    points, notes, place = io.read_scan(tmp_path / "a.ptx")
    assert place is None  # there are two scanners
    seen = [[1.5, 2.25, -3], [4, 5.5, 6]]
    placed = [[10 - 2.25, 20 + 1.5, 27], [10 - 5.5, 24, 36]]
    np.testing.assert_allclose(points, [*seen, *placed])
    assert notes[0].startswith("2 stations")
    assert notes[1].startswith("2 rays without a return")


def test_the_scanner_of_one_ptx_station_stood_where_its_matrix_lays_the_origin(tmp_path):
    (tmp_path / "a.ptx").write_text(PTX + POSE + RAYS)
    np.testing.assert_allclose(io.read_scan(tmp_path / "a.ptx").viewpoint, [10, 20, 30])


@pytest.mark.parametrize("version", PCD)
def test_the_viewpoint_of_a_pcd_is_read_where_there_is_one(tmp_path, version):
    head = PCD[version].replace("VIEWPOINT 0 0 0", "VIEWPOINT 1.5 -2 3")
    (tmp_path / "a.pcd").write_bytes((head + BODY).encode("latin-1"))
    place = io.read_scan(tmp_path / "a.pcd").viewpoint
    if "VIEWPOINT" in head:
        np.testing.assert_array_equal(place, [1.5, -2, 3])
    else:
        assert place is None


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (PTX + POSE + "1 2 3 0\n", "announces 3 points and has 1"),
        (PTX + POSE + "1 2 x 0\n" * 3, "line 1: a point of this station"),
        ("1 2 3\n4 5 6\n", "line 1: not the header of a station.*name the file .xyz"),
    ],
)
def test_malformed_ptx(tmp_path, content, told):
    (tmp_path / "a.ptx").write_text(content)
    with pytest.raises(ValueError, match=told):
        io.read_cloud(tmp_path / "a.ptx")


def test_e57_of_two_scans(tmp_path):
    pye57 = pytest.importorskip("pye57", reason="the extra `e57` is not installed")
    file = pye57.E57(str(tmp_path / "a.e57"), mode="w")
    columns = {f"cartesian{axis}": np.array(ROWS)[:, i] for i, axis in enumerate("XYZ")}
    file.write_scan_raw(columns)
    file.write_scan_raw(columns, translation=np.array([10.0, 20, 30]))
    file.close()
    points, notes, _ = io.read_scan(tmp_path / "a.e57")
    np.testing.assert_allclose(points, [*ROWS, *(np.array(ROWS) + [10, 20, 30])])
    assert notes == ("2 scans as one cloud, each laid where its own pose says",)


def test_what_is_not_read_says_what_helps(tmp_path):
    for name, told in {
        "a.gltf": "export it as .glb",
        "a.fls": "export it as .e57, .ptx or .las",
        "a.bin": "numpy.fromfile",
        "a.vtp": "ParaView",
    }.items():
        with pytest.raises(ValueError, match=told):
            io.read_cloud(tmp_path / name)
    (tmp_path / "a.scan").write_bytes(b"1 2 3\n4 5 6\n")
    with pytest.raises(ValueError, match=r"begins as '\.txt' does: give it that suffix"):
        io.read_cloud(tmp_path / "a.scan")
    (tmp_path / "a.scan").rename(tmp_path / "a.txt")
    assert len(io.read_cloud(tmp_path / "a.txt")) == 2
