"""Files that people have: members of the kinds C11 to C13 that no other test has.

The right value is what the file was written from, by hand. A member that is marked `xfail` is a fault
that stands; its reason says what comes out today.
"""

import gzip
import io as streams
import json
import re
import struct
import types

import numpy as np
import pytest
import trimesh
from plyfile import PlyData
from scipy.spatial.transform import Rotation

import jaxreg
from jaxreg import io
from jaxreg.cli import main, process

pytestmark = [pytest.mark.float32, pytest.mark.untyped]

ROWS = np.array([[1.5, 2.25, -3], [4, 5.5, 6], [7, 8, 9.75]])
UTM = np.array([452000.0, 5411000.0, 250.0])
QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
SHIFT = np.array([10.0, 20, 30])
NAN = np.nan


def members(table, faults=()):
    """A parameter for every name; those that stand for a fault are expected to fail."""
    faults = dict(faults)
    assert set(faults) <= set(table)
    return [
        pytest.param(
            name,
            id=name,
            marks=pytest.mark.xfail(strict=True, reason=faults[name]) if name in faults else (),
        )
        for name in table
    ]


def written(folder, name, content):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def right_or_refused(path, expected):
    """The points of a file are those it was written from, or it is refused in one line."""
    try:
        found = io.read_cloud(path)
    except ValueError as error:
        told = str(error)
        assert str(path) in told and "\n" not in told  # noqa: PT017, PT018 - either is right
    else:
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


# --- C12: text -----------------------------------------------------------------------------------

PLAIN = "1.5 2.25 -3\n4 5.5 6\n7 8 9.75\n"
TEXTS = {
    "quoted-remark.csv": 'id,desc,x,y,z\n1,"tree, oak",1.5,2.25,-3\n2,kerb,4,5.5,6\n3,kerb,7,8,9.75\n',
    "names-with-points.csv": "name;x;y;z\nP1.1;1,5;2,25;-3\nP1.2;4;5,5;6\nP1.3;7;8;9,75\n",
    "northing-before-easting.txt": "Punkt\tHoch\tRechts\tHöhe\n1\t2,25\t1,5\t-3\n2\t5,5\t4\t6\n"
    "3\t8\t7\t9,75\n",
    "words-of-a-survey.csv": "Point,Northing (m),Easting (m),Elev,Desc\nA1,2.25,1.5,-3,a\n"
    "A2,5.5,4,6,b\nA3,8,7,9.75,c\n",
    "east-north-up.csv": "up,east,north\n-3,1.5,2.25\n6,4,5.5\n9.75,7,8\n",
    "y-before-x.csv": "Y,X,Z\n2.25,1.5,-3\n5.5,4,6\n8,7,9.75\n",
    "windows-letters.txt": "Größe Höhe Rechts Hoch\n9 -3 1.5 2.25\n9 6 4 5.5\n9 9.75 7 8\n".encode(
        "cp1252"
    ),
    "utf16-decimal-commas.csv": "X;Y;Z\r\n1,5;2,25;-3\r\n4;5,5;6\r\n7;8;9,75\r\n".encode("utf-16"),
    "utf16-without-a-mark.csv": "X,Y,Z\n1.5,2.25,-3\n4,5.5,6\n7,8,9.75\n".encode("utf-16-le"),
    "utf32.txt": PLAIN.encode("utf-32"),
    "utf32-big-endian.txt": b"\0\0\xfe\xff" + PLAIN.encode("utf-32-be"),
    "mark-and-quotes.csv": b'\xef\xbb\xbf"X","Y","Z"\r\n"1.5","2.25","-3"\r\n"4","5.5","6"\r\n'
    b'"7","8","9.75"\r\n',
    "quotes-and-semicolons.csv": '"X";"Y";"Z"\n"1,5";"2,25";"-3"\n"4";"5,5";"6"\n"7";"8";"9,75"\n',
    "excel-sep.csv": "sep=;\nX;Y;Z\n1,5;2,25;-3\n4;5,5;6\n7;8;9,75\n",
    "excel-empty-columns.csv": ";;X;Y;Z\n;;1,5;2,25;-3\n;;4;5,5;6\n;;7;8;9,75\n",
    "line-of-units.csv": "x,y,z\nm,m,m\n1.5,2.25,-3\n4,5.5,6\n7,8,9.75\n",
    "pandas-index.csv": ",x,y,z\n0,1.5,2.25,-3\n1,4,5.5,6\n2,7,8,9.75\n",
    "comma-at-the-end.csv": "x,y,z,\n1.5,2.25,-3,\n4,5.5,6,\n7,8,9.75,\n",
    "colours-first.txt": "r g b x y z\n1 2 3 1.5 2.25 -3\n1 2 3 4 5.5 6\n1 2 3 7 8 9.75\n",
    "normals-first.txt": "nx ny nz x y z\n0 0 1 1.5 2.25 -3\n0 0 1 4 5.5 6\n0 0 1 7 8 9.75\n",
    "clock-first.csv": "2024-01-01 12:00:01,1.5,2.25,-3\n2024-01-01 12:00:02,4,5.5,6\n"
    "2024-01-01 12:00:03,7,8,9.75\n",
    "hard-blanks.txt": "1.5\u00a02.25\u00a0-3\n4\u00a05.5\u00a06\n7\u00a08\u00a09.75\n",
    "tabs-and-blanks.txt": "1.5 \t2.25 \t-3\n4 \t5.5 \t6\n7 \t8 \t9.75\n",
    "semicolons-and-blanks.txt": "1,5; 2,25; -3\n4; 5,5; 6\n7; 8; 9,75\n",
    "exponents-and-signs.txt": "+1.5E+000 +.225e1 -3.\n4.0E0 5.5E+00 +6\n7 8 9.75\n",
    "two-line-ends.txt": PLAIN.replace("\n", "\r\r\n"),
    "empty-lines-and-footer.txt": f"\n\n{PLAIN}   \n\n# 3 points exported\n",
    "count-below-a-comment.pts": f"# scanned\r\n3\r\n{PLAIN}",
    "remark-of-three-words.xyz": f"# exported from CloudCompare\n{PLAIN}",
    "UPPER.XYZ.GZ": gzip.compress(PLAIN.encode()),
    "two-members.xyz.gz": gzip.compress(b"1.5 2.25 -3\n4 5.5") + gzip.compress(b" 6\n7 8 9.75\n"),
    "end-of-file-of-dos.txt": PLAIN.replace("\n", "\r\n") + "\x1a",
}


@pytest.mark.parametrize("name", members(TEXTS))
def test_text_is_read_right(tmp_path, name):
    found = io.read_cloud(written(tmp_path, name, TEXTS[name]))
    np.testing.assert_array_equal(found, ROWS)


NUMBERS = np.array([[13.125, 0.5, 0.25], [14.5, 3.75, 1], [20, 1.25, -0.5]]) + UTM
AMBIGUOUS = {
    "thousands-with-points.txt": (
        "452.013,125\t5.411.000,500\t250,250\n452.014,500\t5.411.003,750\t251,000\n"
        "452.020,000\t5.411.001,250\t249,500\n", NUMBERS,
    ),
    "thousands-with-blanks.csv": (
        "x;y;z\n452 013.125;5 411 000.5;250.25\n452 014.5;5 411 003.75;251\n"
        "452 020.0;5 411 001.25;249.5\n", NUMBERS,
    ),
    "thousands-with-apostrophes.csv": (
        "x;y;z\n452'013.125;5'411'000.5;250.25\n452'014.5;5'411'003.75;251\n"
        "452'020.0;5'411'001.25;249.5\n", NUMBERS,
    ),
    "degree-signs.txt": ("lat lon h\n48.1° 11.5° 500\n48.2° 11.6° 510\n48.3° 11.7° 520\n", None),
    "minutes-and-seconds.csv": (
        "name;lat;lon;h\na;48°08'06\";11°30'00\";500\nb;48°08'07\";11°30'00\";500\n", None,
    ),
    "minus-of-typesetters.txt": ("1.5 2.25 \u22123\n4 5.5 6\n7 8 9.75\n", ROWS),
    "doubled-header.csv": ("x,y,z\n1.5,2.25,-3\n4,5.5,6\nz,y,x\n9.75,8,7\n", ROWS),
    "quoted-decimal-commas.csv": (
        '"X","Y","Z"\n"1,5","2,25","-3"\n"4","5,5","6"\n"7","8","9,75"\n', ROWS,
    ),
    "quoted-thousands.csv": (
        'x,y,z\n"452,013.125","5,411,000.5",250.25\n"452,014.5","5,411,003.75",251\n'
        '"452,020.0","5,411,001.25",249.5\n', NUMBERS,
    ),
    "quoted-size-before-x.csv": (
        'id,size,x,y,z\n1,"3,5",1.5,2.25,-3\n2,"4,5",4,5.5,6\n3,"5,5",7,8,9.75\n', ROWS,
    ),
    "comma-blank-between-decimal-commas.txt": (
        "1,5, 2,25, -3,0\n4,0, 5,5, 6,0\n7,0, 8,0, 9,75\n", ROWS,
    ),
    "date-and-colours.csv": (
        "01.02.2024;1,5;2,25;-3,0;100;200;30\n01.02.2024;4,0;5,5;6,0;101;201;30\n"
        "01.02.2024;7,0;8,0;9,75;10;20;30\n", ROWS,
    ),
    "reflectance-with-a-point.txt": (
        "1,5;2,25;-3,0;0.5;200;30\n4,0;5,5;6,0;0.5;201;30\n7,0;8,0;9,75;0.5;20;30\n", ROWS,
    ),
    "row-names-of-R.txt": ("x y z\n1 1.5 2.25 -3\n2 4 5.5 6\n3 7 8 9.75\n", ROWS),
    "faces-below-vertices.txt": ("v 1.5 2.25 -3\nv 4 5.5 6\nv 7 8 9.75\nf 1 2 3\n", ROWS),
}  # fmt: skip


@pytest.mark.parametrize("name", members(AMBIGUOUS))
def test_text_is_read_right_or_refused(tmp_path, name):
    content, expected = AMBIGUOUS[name]
    path = written(tmp_path, name, content)
    if expected is None:
        with pytest.raises(ValueError, match=re.escape(name)):
            io.read_cloud(path)
    else:
        right_or_refused(path, expected)


HOLED = {
    "first-row.csv": "x,y,z\nnan,nan,nan\n4,5.5,6\n7,8,9.75\n",
    "first-row-empty.csv": "x,y,z\n,,\n4,5.5,6\n7,8,9.75\n",
    "first-row-without-header.xyz": "nan nan nan\n4 5.5 6\n7 8 9.75\n",
    "middle.txt": "4 5.5 6\n-1.#IND 1.#INF 1.#QNAN\n7 8 9.75\n",
    "last.csv": "x;y;z\n4;5,5;6\n7;8;9,75\n-;-;-\n",
}


@pytest.mark.parametrize("name", members(HOLED))
def test_a_row_that_is_no_point_stays_in_its_place(tmp_path, name):
    found = io.read_cloud(written(tmp_path, name, HOLED[name]))
    holed = np.flatnonzero(~np.isfinite(found).all(axis=1))
    np.testing.assert_array_equal(holed, [{"f": 0, "m": 1, "l": 2}[name[0]]])
    np.testing.assert_array_equal(np.delete(found, holed, axis=0), ROWS[1:])


WIDE = np.random.default_rng(0).uniform(-100, 100, (3, 300)).round(3)


def shuffled_survey():
    numbers = np.random.default_rng(1).permutation(40) + 1000
    points = np.random.default_rng(2).uniform(0, 90, (40, 3)) + UTM
    return "".join(
        f"{n},{x:.3f},{y:.3f},{z:.3f}\n" for n, (x, y, z) in zip(numbers, points, strict=True)
    )


def npy(array):
    file = streams.BytesIO()
    np.save(file, array)
    return file.getvalue()


NO_CLOUDS = {
    "longitude-latitude.csv": "lon,lat\n11.5,48.1\n11.6,48.2\n11.7,48.3\n",
    "three-rows.npy": npy(WIDE),
    "names-in-capitals.npy": npy(np.ones(9, [("lat", "f8"), ("lon", "f8"), ("h", "f8")])),
    "complex.npy": npy(ROWS + 1j),
    "numbers-of-pandas.csv": ",0,1,2\n0,1.5,2.25,-3\n1,4.5,5.5,6.5\n2,7.5,8,9.75\n",
    "angles.txt": "range azimuth elevation\n10 0.1 0.2\n11 0.2 0.2\n12 0.3 0.3\n",
    "three-rows.txt": "\n".join(" ".join(map(str, row)) for row in WIDE),
    "three-rows.csv": "\n".join(",".join(map(str, row)) for row in WIDE),
    "four-rows.npy": npy(np.vstack([WIDE, np.ones(300)])),
    "shuffled-numbers.csv": shuffled_survey(),
}


@pytest.mark.parametrize("name", members(NO_CLOUDS))
def test_what_is_no_cloud_is_refused(tmp_path, name):
    with pytest.raises(ValueError, match=re.escape(name)) as caught:
        io.read_cloud(written(tmp_path, name, NO_CLOUDS[name]))
    assert "\n" not in str(caught.value)


PLANS = {
    "northing-first.csv": "N,E\n2.25,1.5\n5.5,4\n8,7\n",
    "y-first.csv": "y;x\n2,25;1,5\n5,5;4\n8;7\n",
    "easting-first.csv": "E,N\n1.5,2.25\n4,5.5\n7,8\n",
}


@pytest.mark.parametrize("name", members(PLANS))
def test_two_columns_are_read_by_their_names(tmp_path, name):
    found = io.read_cloud(written(tmp_path, name, PLANS[name]))
    np.testing.assert_array_equal(found, ROWS * [1, 1, 0])


# --- C12: PLY, PCD, arrays, PTX, LAS ---------------------------------------------------------------


def ply(kind, elements):
    return f"ply\nformat {kind} 1.0\n{elements}end_header\n".encode()


def xyz(kind="float", names="xyz"):
    return "element vertex 3\n" + "".join(f"property {kind} {axis}\n" for axis in names)


def pcd(fields, sizes, kinds, counts, data, height=1):
    return (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {kinds}\nCOUNT {counts}\n"
        f"WIDTH {3 // height}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA {data}\n"
    ).encode()


def literals(content):
    """What LZF makes of bytes that it cannot pack: runs of at most 32."""
    runs = (content[i : i + 32] for i in range(0, len(content), 32))
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


SINGLE, BIG = ROWS.astype("<f4"), ROWS.astype(">f8")
WHOLE = np.array([[1, 2, -3], [4, 5, 6], [7, 8, 9]])
COLUMNS = b"".join(np.ascontiguousarray(c).tobytes() for c in SINGLE.T) + bytes(12 + 60)
SPLAT = [*"xyz", "nx", "ny", "nz", "f_dc_0", "opacity", "rot_0", "rot_1", "rot_2", "rot_3"]
RAYS = "1.5 2.25 -3 0.5 1 2 3\n0 0 0 0.5 0 0 0\n4 5.5 6 0.5 1 2 3\n"
STATION = "3\n1\n1 2 3\n1 0 0\n0 1 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n10 20 30 1\n"
BESIDE = STATION.replace(
    "0 1 0 0\n-1 0 0 0\n0 0 1 0\n10 20 30 1", "0 -1 0 10\n1 0 0 20\n0 0 1 30\n0 0 0 1"
)
PLACED = ROWS[:2] @ QUARTER.T + SHIFT
STORED = {
    "lists-in-vertices.ply": (
        ply("binary_little_endian", "element vertex 3\nproperty list uchar int links\n"
            "property double x\nproperty double y\nproperty double z\n")
        + b"".join(struct.pack(f"<B{k}i3d", k, *range(k), *row)
                   for k, row in zip((0, 3, 1), ROWS, strict=True)), ROWS),
    "a-list-before-the-vertices.ply": (
        ply("binary_big_endian", "element camera 1\nproperty list uchar float m\n"
            + xyz("double").replace("3\n", "3\nproperty uchar red\n", 1))
        + struct.pack(">B4f", 4, 1, 2, 3, 4)
        + b"".join(b"\7" + row.tobytes() for row in BIG), ROWS),
    "camera-first.ply": (
        ply("ascii", "obj_info a\ncomment \u00e4\nelement camera 1\nproperty float a\n" + xyz("float32")
            + "element edge 1\nproperty int vertex1\nproperty int vertex2\n")
        + b"9\n" + PLAIN.encode() + b"0 1\n", ROWS),
    "line-ends-of-old-macs.ply": (
        ply("binary_little_endian", xyz()).replace(b"\n", b"\r") + SINGLE.tobytes(), ROWS),
    "tabs-in-the-header.ply": (
        ply("ascii", xyz()).replace(b"float ", b"float\t").replace(b"element ", b"element\t")
        + PLAIN.encode(), ROWS),
    "whole-numbers.ply": (
        ply("binary_little_endian", xyz("short")) + WHOLE.astype("<i2").tobytes(), WHOLE),
    "bytes-after-the-end.ply": (
        ply("binary_little_endian", xyz()) + SINGLE.tobytes() + b"\0\1\2", ROWS),
    "gaussian-splats.ply": (
        ply("binary_little_endian", xyz(names=SPLAT))
        + np.hstack([SINGLE, np.ones((3, len(SPLAT) - 3), "<f4")]).tobytes(), ROWS),
    "a-blank-after-the-header.ply": (
        ply("binary_little_endian", xyz()).replace(b"end_header", b"end_header ") + SINGLE.tobytes(),
        ROWS),
    "names-in-capitals.ply": (ply("ascii", xyz(names="XYZ")) + PLAIN.encode(), ROWS),
    "padding.pcd": (
        pcd("x y z _ normal _", "4 4 4 1 4 1", "F F F U F U", "1 1 1 4 3 4", "binary")
        + b"".join(row.tobytes() + bytes(20) for row in SINGLE), ROWS),
    "padding-compressed.pcd": (
        pcd("x y z _ histogram", "4 4 4 1 4", "F F F U F", "1 1 1 4 5", "binary_compressed")
        + struct.pack("<2I", len(literals(COLUMNS)), len(COLUMNS)) + literals(COLUMNS), ROWS),
    "doubles-and-time.pcd": (
        pcd("t x y z", "8 8 8 8", "U F F F", "1 1 1 1", "binary")
        + b"".join(struct.pack("<Q3d", 2**60, *row) for row in ROWS), ROWS),
    "whole-numbers.pcd": (
        pcd("x y z", "2 2 2", "I I I", "1 1 1", "binary") + WHOLE.astype("<i2").tobytes(), WHOLE),
    "organised.pcd": (
        pcd("x y z", "4 4 4", "F F F", "1 1 1", "ascii", height=3)
        + b"1.5 2.25 -3\nnan nan nan\n7 8 9.75\n", [ROWS[0], [NAN] * 3, ROWS[2]]),
    "windows-header.pcd": (
        pcd("x y z", "4 4 4", "F F F", "1 1 1", "binary").replace(b"\n", b"\r\n")
        + SINGLE.tobytes(), ROWS),
    "another-order.pcd": (
        pcd("z rgb y x", "4 4 4 4", "F U F F", "1 1 1 1", "ascii")
        + b"-3 1 2.25 1.5\n6 1 5.5 4\n9.75 1 8 7\n", ROWS),
    "fortran.npy": (npy(np.asfortranarray(ROWS)), ROWS),
    "big-endian.npy": (npy(ROWS.astype(">f4")), ROWS),
    "half.npy": (npy(ROWS.astype(np.float16)), ROWS),
    "bytes.npy": (npy(np.abs(WHOLE).astype(np.uint8)), np.abs(WHOLE)),
    "organised.npy": (npy(ROWS[None]), ROWS),
    "windows.ptx": ((STATION + RAYS).replace("\n", "\r\n"), PLACED),
    "packed.ptx.gz": (gzip.compress((STATION + RAYS).encode()), PLACED),
    "utf16.ptx": ((STATION + RAYS).encode("utf-16"), PLACED),
    "shift-beside-the-rotation.ptx": (BESIDE + RAYS, PLACED),
    "three-columns.ptx": (re.sub(r" 0\.5 .*", "", STATION + RAYS), PLACED),
}  # fmt: skip


@pytest.mark.parametrize("name", members(STORED))
def test_stored_points_are_read_right(tmp_path, name):
    content, expected = STORED[name]
    found = io.read_cloud(written(tmp_path, name, content))
    np.testing.assert_array_equal(found, np.asarray(expected, float))


@pytest.mark.parametrize("name", ["format-6.las", "uneven-steps.las", "packed.las.gz", "UPPER.LAZ"])
def test_las_is_read_to_its_steps(tmp_path, name):
    laspy = pytest.importorskip("laspy", reason="the extra `las` is not installed")
    points = np.random.default_rng(0).integers(0, 200, (40, 3)) * 0.5 + UTM
    format_6 = name.startswith("format-6")
    cloud = laspy.LasData(laspy.LasHeader(point_format=6 if format_6 else 3, version="1.4"))
    steps = [0.01, 0.02, 0.5] if "uneven" in name else [1e-3] * 3
    for holder in (cloud.header, cloud.points):
        holder.offsets, holder.scales = [450000.0, 5.4e6, -1e3], steps
    cloud.xyz = points
    plain = tmp_path / ("a.laz" if name.endswith("LAZ") else "a.las")
    cloud.write(str(plain))
    content = plain.read_bytes()
    path = written(tmp_path, name, gzip.compress(content) if name.endswith("gz") else content)
    np.testing.assert_allclose(io.read_cloud(path), points, rtol=0, atol=1e-9 * 5e6)


# --- C11: meshes in, meshes out, and what goes with a point ----------------------------------------

CORNERS = "v 0 0 5\nv 2 0 5\nv 2 1 5\nv 0 1 5\n"
OFF = "0 0 5\n2 0 5\n2 1 5\n0 1 5\n"
TRIANGLES = np.array(
    [[[0, 0, 5], [2, 0, 5], [2, 1, 5]], [[0, 0, 5], [2, 1, 5], [0, 1, 5]]], np.float64
)
FACET = "facet normal 0 0 1\nouter loop\n{}endloop\nendfacet\n"
FACETS = [
    FACET.format("".join("vertex {:.6E} {:.6E} {:.6E}\n".format(*corner) for corner in triangle))
    for triangle in TRIANGLES
]
FACE = "element face {}\nproperty list uchar uint vertex_index\n"
QUAD = xyz().replace("vertex 3", "vertex 4")
BINARY_CORNERS = np.array(TRIANGLES[0].tolist() + [TRIANGLES[1, 2].tolist()], "<f4").tobytes()


def scene(*parts):
    """GLB of triangles at z = 0 in a node that is shifted by 5."""
    shift = trimesh.transformations.translation_matrix([0, 0, 5])
    whole = trimesh.Scene()
    for faces in parts:
        corners = [[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]]
        whole.add_geometry(trimesh.Trimesh(corners, faces, process=False), transform=shift)
    return whole.export(file_type="glb")


RECTANGLES = {
    "faces-between-vertices.obj": "v 0 0 5\nv 2 0 5\nv 2 1 5\nf -3 -2 -1\nv 0 1 5\nf -4 -2 -1\n",
    "polygon.obj": CORNERS + "f 1 2 3 4\n",
    "from-the-end.obj": CORNERS + "f -4 -3 -2 -1\n",
    "colours.obj": CORNERS.replace(" 5\n", " 5 255 0 9\n") + "f 1 2 3 4\n",
    "continued-line.obj": CORNERS + "f 1 2 \\\n3 4\n",
    "materials.obj": "mtllib none.mtl\n" + CORNERS + "usemtl a\nf 1 2 3\nusemtl b\nf 1 3 4\n",
    "normals-and-lines.obj": CORNERS + "vn 0 0 1\nl 1 2\np 1\nf 1//1 2//1 3//1 4//1\n",
    "textures.obj": CORNERS + "vt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3\nf 1/1 3/3 4/2\n",
    "decimal-commas.obj": CORNERS.replace("5", "5,0") + "f 1 2 3 4\n",
    "tabs.obj": CORNERS.replace(" ", "\t") + "f\t1\t2\t3\t4\n",
    "remark-after-a-vertex.obj": CORNERS.replace("5\n", "5 # a corner\n", 1) + "f 1 2 3 4\n",
    "comments.off": "# by hand\nOFF # a plate\n# sizes\n4 1 0\n" + OFF + "4 0 1 2 3 # all\n",
    "colours-of-vertices.off": "COFF\n4 1 0\n" + OFF.replace(" 5\n", " 5 255 0 0 9\n") + "4 0 1 2 3\n",
    "normals.off": "NOFF\n4 1 0\n" + OFF.replace(" 5\n", " 5 0 0 1\n") + "4 0 1 2 3\n",
    "colours-of-faces.off": "OFF\n4 2 0\n" + OFF + "3 0 1 2 255 0 0\n3 0 2 3 0.5 0.5 0.5\n",
    "mark.off": b"\xef\xbb\xbfOFF\r\n4 1 0\r\n" + (OFF + "4 0 1 2 3\n").encode(),
    "two-solids.stl": "".join(f"solid {i}\n{f}endsolid {i}\n" for i, f in enumerate(FACETS)),
    "one-line.stl": f"Solid\n{''.join(FACETS)}EndSolid\n".replace("\n", " "),
    "tabs.stl": "solid\r" + "".join(FACETS).replace("\n", "\r").replace("vertex ", "\tvertex\t")
    + "endsolid\r",
    "binary-called-solid.stl": b"solid facet vertex \0".ljust(80, b" ") + struct.pack("<I", 2)
    + b"".join(bytes(12) + t.astype("<f4").tobytes() + b"\1\2" for t in TRIANGLES),
    "node.glb": scene([[0, 1, 2], [0, 2, 3]]),
    "two-nodes.glb": scene([[0, 1, 2]], [[0, 2, 3]]),
    "packed.off.gz": gzip.compress(("OFF\n4 1 0\n" + OFF + "4 0 1 2 3\n").encode()),
    "mixed-polygons.ply": ply("binary_little_endian", QUAD + FACE.format(3)) + BINARY_CORNERS
    + struct.pack("<B3IB2IB3I", 3, 0, 1, 2, 2, 0, 1, 3, 0, 2, 3),
    "flags-of-faces.ply": ply("binary_little_endian", QUAD + FACE.format(2) + "property uchar f\n")
    + BINARY_CORNERS + struct.pack("<B3IBB3IB", 3, 0, 1, 2, 7, 3, 0, 2, 3, 9),
    "faces-first.ply": ply("ascii", FACE.format(1) + QUAD) + b"4 0 1 2 3\n" + OFF.encode(),
    "textures-of-faces.ply": ply(
        "ascii", QUAD + FACE.format(1) + "property list uchar float texcoord\n"
    ) + OFF.encode() + b"4 0 1 2 3 8 0 0 1 0 1 1 0 1\n",
}  # fmt: skip


@pytest.mark.parametrize("name", members(RECTANGLES))
def test_a_rectangle_is_sampled_evenly_from_any_mesh(tmp_path, name):
    points, notes, _ = io.read_scan(written(tmp_path, name, RECTANGLES[name]))
    assert "sampled over its surface" in notes[0]
    np.testing.assert_allclose(points[:, 2], 5, atol=1e-6)
    np.testing.assert_allclose(points[:, :2].min(axis=0), [0, 0], atol=1e-2)
    np.testing.assert_allclose(points[:, :2].max(axis=0), [2, 1], atol=1e-2)
    for half in (points[:, 0] < 1, points[:, 1] < 0.5, points[:, 0] < 2 * points[:, 1]):
        assert np.mean(half) == pytest.approx(0.5, abs=0.02)


def moved(tmp_path, name, content, out, scale=1.0, shift=SHIFT):
    source = written(tmp_path, name, content)
    io.check_output(tmp_path / out, source)
    points = io.read_cloud(source)
    return io.write_moved(tmp_path / out, source, scale * QUARTER, shift, points=points)


PAIRS = np.array([[1.0, 2, 3, 1, 0, 0], [4, 5, 6, 0, 1, 0]])
TURNED = np.array([[8.0, 21, 33, 0, 1, 0], [5, 24, 36, -1, 0, 0]])


def test_text_with_normals_in_utf16_is_moved(tmp_path):
    rows = "\n".join(" ".join(f"{v:g}" for v in row) for row in PAIRS)
    moved(tmp_path, "a.txt", f"x y z nx ny nz\r\n{rows}\r\n".encode("utf-16"), "b.txt")
    found = np.loadtxt(tmp_path / "b.txt", skiprows=1)
    np.testing.assert_allclose(found, TURNED)


@pytest.mark.parametrize(
    ("head", "between"),
    [
        pytest.param("//X Y Z R G B Nx Ny Nz\n", "9 8 7 ", id="with-a-header"),
        pytest.param("", "9 8 7 ", id="without-a-header"),
    ],
)
def test_normals_beside_colours_are_turned(tmp_path, head, between):
    row = "{:g} {:g} {:g} " + between + "{:g} {:g} {:g}\n"
    before, after = (head + "".join(row.format(*r) for r in rows) for rows in (PAIRS, TURNED))
    moved(tmp_path, "a.asc", before, "b.asc")
    assert (tmp_path / "b.asc").read_text() == after


def test_northing_before_easting_is_moved_in_its_own_columns(tmp_path):
    moved(tmp_path, "a.csv", "No,N,E,H\n7,2,1,3\n8,5,4,6\n", "b.csv")
    assert (tmp_path / "b.csv").read_text() == "No,N,E,H\n7,21,8,33\n8,24,5,36\n"


def test_padding_and_histograms_of_pcd_keep_every_bit_and_scale_leaves_normals_alone(tmp_path):
    fields = "x y z _ normal_x normal_y normal_z histogram"
    head = pcd(fields, "4 4 4 1 4 4 4 2", "F F F U F F F I", "1 1 1 4 1 1 1 3", "binary")
    rows = b"".join(struct.pack("<3f4B3f3h", *row, 1, 2, 3, 4, 1, 0, 0, -1, -2, -3) for row in ROWS)
    moved(tmp_path, "a.pcd", head + rows, "b.pcd", scale=2.0)
    body = (tmp_path / "b.pcd").read_bytes().partition(b"DATA binary\n")[2]
    expected = b"".join(
        struct.pack("<3f4B3f3h", *row, 1, 2, 3, 4, 0, 1, 0, -1, -2, -3)
        for row in ROWS @ (2 * QUARTER.T) + SHIFT
    )
    assert body == expected


def test_a_packed_ply_mesh_keeps_polygons_and_colours(tmp_path):
    vertex = QUAD + "property uchar red\n"
    content = ply("ascii", vertex + FACE.format(1)) + OFF.replace("5\n", "5 9\n").encode()
    moved(tmp_path, "a.ply.gz", gzip.compress(content + b"4 0 1 2 3\n"), "b.ply")
    found = PlyData.read(str(tmp_path / "b.ply"))
    np.testing.assert_array_equal(found["vertex"]["red"], [9] * 4)
    np.testing.assert_array_equal(found["face"].data[0][0], [0, 1, 2, 3])
    np.testing.assert_allclose(found["vertex"]["x"], [10, 10, 9, 9])
    np.testing.assert_allclose(found["vertex"]["y"], [20, 22, 22, 20])


def test_indices_from_the_end_of_an_obj_stay(tmp_path):
    moved(tmp_path, "a.obj", RECTANGLES["faces-between-vertices.obj"], "b.obj")
    lines = (tmp_path / "b.obj").read_text().splitlines()
    assert lines[3:] == ["f -3 -2 -1", "v 9 20 35", "f -4 -2 -1"]


def test_a_continued_vertex_of_an_obj_is_moved_or_refused_by_name(tmp_path):
    content = CORNERS.replace("v 0 0 5", "v 0 0 \\\n5") + "f 1 2 3 4\n"
    try:
        moved(tmp_path, "a.obj", content, "b.obj")
    except ValueError as error:
        assert "a.obj" in str(error)  # noqa: PT017 - either outcome is right
    else:
        np.testing.assert_allclose(trimesh.load(tmp_path / "b.obj").vertices[:, 2], 35)


def npz(**arrays):
    file = streams.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


COLOURED = ply("ascii", QUAD + "property uchar red\n" + FACE.format(1))
COLOURED += OFF.replace("5\n", "5 9\n").encode() + b"4 0 1 2 3\n"
TOLD = {
    "pcd-to-text": ("a.pcd", pcd("x y z i", "4 4 4 4", "F F F F", "1 1 1 1", "ascii")
                    + b"1 2 3 9\n4 5 6 9\n7 8 9 9\n", "b.xyz"),
    "ply-to-pcd": ("a.ply", ply("ascii", xyz() + "property uchar red\n")
                   + PLAIN.replace("\n", " 9\n").encode(), "b.pcd"),
    "text-to-ply": ("a.xyz", "X Y Z R G B\n1 2 3 9 8 7\n4 5 6 9 8 7\n", "b.ply"),
    "npy-to-npy": ("a.npy", npy(np.ones((5, 6))), "b.npy"),
    "npz-to-npz": ("a.npz", npz(points=ROWS, colors=np.ones((3, 3))), "b.npz"),
    "obj-to-ply": ("a.obj", RECTANGLES["colours.obj"], "b.ply"),
    "off-to-off": ("a.off", RECTANGLES["colours-of-vertices.off"], "b.off"),
    "mesh-of-ply-to-obj": ("a.ply", COLOURED, "b.obj"),
}  # fmt: skip


@pytest.mark.parametrize("name", members(TOLD))
def test_what_is_kept_or_its_loss_is_told(tmp_path, name):
    source, content, out = TOLD[name]
    told = moved(tmp_path, source, content, out)
    kept = (tmp_path / out).read_bytes()
    assert told or b"red" in kept or b"255" in kept


def test_gaussian_splats_turn_with_their_points_or_it_is_told(tmp_path):
    rows = np.zeros((3, len(SPLAT)), "<f4")
    rows[:, :3], rows[:, SPLAT.index("rot_0")] = ROWS, 1
    content = ply("binary_little_endian", xyz(names=SPLAT)) + rows.tobytes()
    told = moved(tmp_path, "a.ply", content, "b.ply")
    vertex = PlyData.read(str(tmp_path / "b.ply"))["vertex"]
    w, *axis = (float(vertex[f"rot_{i}"][0]) for i in range(4))
    assert told or np.allclose(Rotation.from_quat([*axis, w]).as_matrix(), QUARTER, atol=1e-6)


@pytest.mark.parametrize("out", ["b.las", "b.laz"])
def test_las_keeps_its_steps_and_its_own_dimensions(tmp_path, out):
    laspy = pytest.importorskip("laspy", reason="the extra `las` is not installed")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.add_extra_dim(laspy.ExtraBytesParams("quality", "f4"))
    header.offsets, header.scales = [450000.0, 5.4e6, 0], [0.01] * 3
    cloud = laspy.LasData(header)
    points = np.random.default_rng(0).uniform(0, 90, (40, 3)).round(2) + UTM
    cloud.xyz, cloud.quality, cloud.gps_time = points, np.arange(40.0), np.arange(40.0) + 1e9
    cloud.write(str(tmp_path / "a.las"))
    points = io.read_cloud(tmp_path / "a.las")
    middle = points.mean(axis=0).round()
    shift = middle - QUARTER @ middle + [1, 2, 3]
    io.write_moved(tmp_path / out, tmp_path / "a.las", QUARTER, shift, points=points)
    found = laspy.read(tmp_path / out)
    np.testing.assert_allclose(found.xyz, points @ QUARTER.T + shift, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(found.header.scales, [0.01] * 3)
    np.testing.assert_array_equal(found.quality, np.arange(40.0))
    np.testing.assert_array_equal(found.gps_time, np.arange(40.0) + 1e9)


def test_masked_rows_are_not_written_as_points(tmp_path):
    cloud = np.ma.masked_array(ROWS.copy(), mask=[[True] * 3, [False] * 3, [False] * 3])
    try:
        io.write_cloud(tmp_path / "a.ply", cloud)
    except ValueError:
        return
    found = io.read_cloud(tmp_path / "a.ply")
    np.testing.assert_array_equal(found[np.isfinite(found).all(axis=1)], ROWS[1:])


def test_an_object_with_points_is_written_or_refused_in_one_line(tmp_path):
    cloud = types.SimpleNamespace(points=ROWS)
    try:
        io.write_cloud(tmp_path / "a.ply", cloud)
    except ValueError as error:
        assert "points" in str(error)  # noqa: PT017 - either outcome is right
    else:
        np.testing.assert_array_equal(io.read_cloud(tmp_path / "a.ply"), ROWS)


START = np.array([[0.0, -1, 0, 5.5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])
LINES = "\n".join(" ".join(f"{value:g}" for value in row) for row in START)
STARTS = {
    "one-line.txt": LINES.replace("\n", " "),
    "a-number-a-line.txt": LINES.replace(" ", "\n"),
    "semicolons.txt": LINES.replace(" ", "; "),
    "mark.txt": b"\xef\xbb\xbf" + LINES.encode(),
    "utf16.txt": LINES.encode("utf-16"),
    "decimal-commas.txt": LINES.replace(".", ","),
    "decimal-commas-and-semicolons.csv": LINES.replace(".", ",").replace(" ", ";"),
    "decimal-commas-and-commas.txt": LINES.replace("5.5", "5,5").replace(" ", ", "),
    "mark.json": b"\xef\xbb\xbf" + json.dumps(START.tolist()).encode(),
}


@pytest.mark.parametrize("name", members(STARTS))
def test_a_start_is_read_from_text_of_any_kind(tmp_path, name):
    np.testing.assert_array_equal(io.read_matrix(written(tmp_path, name, STARTS[name])), START)


def test_poses_are_read_from_text_in_any_encoding(tmp_path):
    for name, content in {
        "marked": b"\xef\xbb\xbf" + LINES.encode(),
        "wide": LINES.encode("utf-16"),
    }.items():
        found = io.read_poses(written(tmp_path, f"{name}.txt", content))
        np.testing.assert_array_equal(found["0"], START)


# --- The shell -------------------------------------------------------------------------------------


@pytest.fixture
def run(capsys, monkeypatch):
    """`jaxreg ARGUMENTS`: exit status, output, error output."""
    monkeypatch.setattr(process, "enable_compilation_cache", lambda **_: None)
    monkeypatch.setattr(process, "restart_with_huge_pages", lambda: None)

    def run(*arguments):
        status = main([str(part) for part in arguments])
        return status, *capsys.readouterr()

    return run


TARGETS = np.array([[0.0, 0, 0], [12, 1, 0.5], [7, 9, 2], [1, 8, 0.25], [4, 3, 1.5], [9, 5, 1]])
DIALECTS = {
    "northing-first.csv": lambda p: "No,N,E,H\n" + "".join(
        f"{i},{y:.4f},{x:.4f},{z:.4f}\n" for i, (x, y, z) in enumerate(p)),
    "utf16.txt": lambda p: ("X;Y;Z\r\n" + "".join(
        "{:.4f};{:.4f};{:.4f}\r\n".format(*q) for q in p).replace(".", ",")).encode("utf-16"),
    "packed.pts.gz": lambda p: gzip.compress((f"{len(p)}\n" + "".join(
        "{:.4f} {:.4f} {:.4f} -7 1 2 3\n".format(*q) for q in p)).encode()),
    "points-of-a-mesh.off": lambda p: f"OFF\n{len(p)} 0 0\n" + "".join(
        "{:.4f} {:.4f} {:.4f}\n".format(*q) for q in p),
    "old.pcd": lambda p: f"VERSION .5\nCOLUMNS x y z\nPOINTS {len(p)}\nDATA ascii\n" + "".join(
        "{:.4f} {:.4f} {:.4f}\n".format(*q) for q in p),
}  # fmt: skip


@pytest.mark.parametrize("name", members(DIALECTS))
def test_targets_of_any_dialect_are_registered_in_the_shell(tmp_path, run, name):
    turn = Rotation.from_euler("z", 110, degrees=True).as_matrix()
    source = written(tmp_path, name, DIALECTS[name](TARGETS))
    io.write_cloud(tmp_path / "b.npy", (TARGETS @ turn.T + UTM)[::-1])
    status, _, err = run("register", source, tmp_path / "b.npy", "--json", tmp_path / "r.json")
    assert status == 0, err
    found = json.loads((tmp_path / "r.json").read_text())
    np.testing.assert_allclose(found["rotation"], turn, atol=1e-4)
    np.testing.assert_allclose(found["translation"], UTM, atol=1e-3)


@pytest.mark.parametrize("command", ["info", "view"])
@pytest.mark.parametrize("name", ["lfs.ply", "page.csv", "archive.zip", "twice.xyz.gz.gz"])
def test_what_is_no_scan_is_one_line_and_status_2(tmp_path, run, monkeypatch, command, name):
    content = {
        "lfs.ply": "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n",
        "page.csv": "<!DOCTYPE html><html><body>404 not found 1 2 3</body></html>\n",
        "archive.zip": b"PK\3\4" + bytes(60),
        "twice.xyz.gz.gz": gzip.compress(gzip.compress(PLAIN.encode())),
    }[name]
    monkeypatch.chdir(tmp_path)
    written(tmp_path, name, content)
    status, out, err = run(command, name)
    assert (status, out) == (2, "")
    assert len(err.strip().splitlines()) == 1
    assert name in err


# --- C13: diagnosis ----------------------------------------------------------------------------------


def ellipsoid(seed, count=4000):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * [5, 4, 3]


TURN = Rotation.random(random_state=3).as_matrix()
BODY = ellipsoid(0)
LINE = np.random.default_rng(4).uniform(0, 100, 3000)
REACH = 10 ** np.random.default_rng(5).uniform(-0.3, 2, 6000)
AROUND = np.random.default_rng(6).uniform(0, 2 * np.pi, 6000)
GROUND = np.c_[REACH * np.cos(AROUND), REACH * np.sin(AROUND), np.sin(REACH)]
ODD = {
    "two-files-in-mm-and-m.npy": (np.r_[BODY, 1000 * ellipsoid(1)], "uneven: the density"),
    "a-tenth-in-mm.npy": (np.r_[BODY, 1000 * ellipsoid(1, 400)], "uneven: the density"),
    "a-few-in-mm.xyz": (np.r_[BODY, 1000 * ellipsoid(1, 80)], "80 points lie"),
    "geocentric-single.npy": (
        (BODY + [4.2e6, 8e5, 4.7e6]).astype(np.float32), "z comes in steps of 0.5 .*single",
    ),
    "utm-in-mm-single.npy": (
        (1000 * (BODY + UTM)).astype(np.float32), "y comes in steps of 512 .*single",
    ),
    "one-column-cut.csv": (
        np.c_[(10 * BODY[:, 0]).round(-1), 10 * BODY[:, 1:]], "x comes in steps of 10",
    ),
    "written-thrice.npz": (np.r_[BODY, BODY, BODY], "67% of the points repeat"),
    "wall.pcd": (np.c_[BODY[:, 0], np.full(4000, 7.0), BODY[:, 2]], "two-dimensional: y is the same"),
    "oblique-plane.npy": ((BODY * [1, 1, 0]) @ TURN.T + UTM, "planar"),
    "pipe.xyz": (np.c_[LINE, 0.05 * np.cos(LINE), 0.05 * np.sin(LINE)] @ TURN.T, "thin"),
    "from-one-station.npy": (GROUND, "uneven: the density"),
    "one-point-only.csv": (np.ones((9, 3)), "only 1 distinct point"),
    "twice-through-single.npy": (
        np.r_[BODY, BODY.astype(np.float32).astype(float)], "repeat|twice|coincide",
    ),
    "twice-through-text.npy": (np.r_[BODY, BODY.round(5)], "100% of the points nearly coincide"),
}  # fmt: skip


@pytest.mark.parametrize("name", members(ODD))
def test_info_says_what_is_odd(tmp_path, run, name):
    points, told = ODD[name]
    if points.dtype == np.float32:
        np.save(tmp_path / name, points)
    else:
        io.write_cloud(tmp_path / name, points)
    status, out, _ = run("info", tmp_path / name)
    assert status == 0
    notes = [line for line in out.splitlines() if line.startswith("note")]
    assert any(re.search(told, note) for note in notes), out


FINE = {
    "voxels.npy": np.unique((5 * BODY).round() / 5, axis=0),
    "millimetres-of-las.xyz": (BODY + UTM).round(3),
    "corners-of-a-box.csv": np.stack(np.meshgrid([0.0, 1], [0, 2], [0, 3]), -1).reshape(-1, 3),
    "half-a-body.pcd": BODY[BODY[:, 0] > 1],
}


@pytest.mark.parametrize("name", members(FINE))
def test_info_says_nothing_of_what_is_not_odd(tmp_path, run, name):
    io.write_cloud(tmp_path / name, FINE[name])
    _, out, _ = run("info", tmp_path / name)
    assert "note" not in out


def contour(count, seed):
    t = np.random.default_rng(seed).uniform(0, 2 * np.pi, count)
    radius = 3 + np.cos(2 * t) + 0.5 * np.sin(3 * t)
    return np.c_[radius * np.cos(t), (2 + 0.5 * np.cos(t)) * np.sin(t)]


SIZES = {
    "mm": (1000.0, "metres and millimetres"),
    "feet": (1 / 3.2808, "metres and feet"),
    "photogrammetry": (1.25, "scales differ"),
}


@pytest.mark.parametrize("name", members(SIZES))
def test_plans_at_other_sizes_are_told_in_the_shell(tmp_path, run, name):
    factor, told = SIZES[name]
    np.savetxt(tmp_path / "a.csv", contour(400, 0), delimiter=",")
    np.savetxt(tmp_path / "b.xyz", factor * contour(500, 1))
    status, out, _ = run("register", tmp_path / "a.csv", tmp_path / "b.xyz")
    hints = [line for line in out.splitlines() if line.startswith("hint")]
    assert (status, any(told in hint for hint in hints)) == (3, True), out


@pytest.mark.parametrize("name", members(SIZES))
def test_plans_at_other_sizes_are_told_in_python(name):
    factor, told = SIZES[name]
    found = jaxreg.register(contour(400, 0), factor * contour(500, 1))
    assert not found.success
    assert told in found.reason
