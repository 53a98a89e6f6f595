"""Files made from valid ones by flips, cuts and odd headers: read, or refused in one line.

None may crash, hang, or take more than ten times its size in memory (beyond what reading a small file
takes anyway). A smaller number runs each time; all of them with `make slow`.
"""

import gzip
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh

from jaxreg import io

_SIZES = (40, 3000)
_AROUND = 6_000_000
"""Bytes for the 20,000 points of a mesh and for the libraries at work."""
_SECONDS = 20


def valid_files(folder: Path, points: int, seed: int) -> list[Path]:
    """One file of every format, with as many points or vertices."""
    rng = np.random.default_rng(seed)
    cloud = rng.normal(size=(points, 3)) * [30, 30, 3] + [452000, 5411000, 250]
    paths = []
    for suffix in io.WRITABLE:
        if suffix not in (".las", ".laz") or pytest.importorskip("laspy"):
            paths.append(folder / f"cloud{suffix}")
            io.write_cloud(paths[-1], cloud)
    mesh = trimesh.creation.icosphere(subdivisions=1 if points < 1000 else 4)
    for suffix, options in {
        ".obj": {}, ".off": {}, ".stl": {}, ".glb": {}, ".ply": {"encoding": "ascii"},
    }.items():  # fmt: skip
        paths.append(folder / f"mesh{suffix}")
        mesh.export(paths[-1], **options)
    rows = "\n".join("{:.3f} {:.3f} {:.3f} -12 1 2 3".format(*row) for row in cloud)
    head = f"{points}\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    fields = (
        "VERSION .7\nFIELDS x y z i _ c\nSIZE 4 4 4 4 1 1\nTYPE F F F F U U\nCOUNT 1 1 1 1 1 2\n"
    )
    fields += f"WIDTH {points}\nHEIGHT 1\nPOINTS {points}\nDATA ascii\n"
    texts = {
        "scan.pts": f"{points}\n{rows}\n",
        "scan.ptx": f"{head}{rows}\n",
        "scan.asc": f"//X Y Z I R G B\n{rows.replace('.', ',')}\n",
        "survey.csv": "Easting;Northing;Height;I;R;G;B\n" + rows.replace(" ", ";"),
        "ascii.pcd": f"{fields}{rows}\n",
        "mesh-ascii.stl": trimesh.exchange.stl.export_stl_ascii(mesh),
    }
    for name, text in texts.items():
        paths.append(folder / name)
        paths[-1].write_text(text)
    (folder / "wide.txt").write_text(rows, "utf-16")
    (folder / "cloud.ply.gz").write_bytes(gzip.compress((folder / "cloud.ply").read_bytes()))
    return [*paths, folder / "wide.txt", folder / "cloud.ply.gz"]


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """The content with one of the things that happen to files, in the header most of all."""
    kind, result = rng.integers(8), bytearray(content)
    place = int(rng.integers(len(result)))
    if kind == 0:  # cut
        return bytes(result[: max(1, place)])
    if kind in (1, 2):  # flipped
        reach = min(len(result), 300) if kind == 1 else len(result)
        for _ in range(int(rng.integers(1, 8))):
            result[rng.integers(reach)] = rng.integers(256)
    elif kind == 3:  # a piece twice, or missing
        piece = result[place : place + int(rng.integers(1, 2000))]
        result[place : place + (len(piece) if rng.random() < 0.5 else 0)] = (
            b"" if place % 2 else piece
        )
    elif kind == 4:  # a number of the header become another
        digits = [i for i, byte in enumerate(result[:400]) if 48 <= byte <= 57]
        where = digits[int(rng.integers(len(digits)))] if digits else 0
        result[where : where + 1] = rng.choice(
            [b"-1", b"999999999", b"0", b"1e9", b"18446744073709551616"]
        )
    elif kind == 5:  # other line ends, a mark in front
        result = bytearray(rng.choice([b"\xef\xbb\xbf", b"\xff\xfe", b"\r\n", b"\0"])) + result
    elif kind == 6:  # junk after the end
        result += rng.bytes(int(rng.integers(1, 500)))
    else:
        result = bytearray(content.replace(b"\n", b"\r\n" if place % 2 else b"\r"))
    return bytes(result)


def outcome(path: Path) -> str:
    """How the reading ends; raises AssertionError where it may not end so."""
    tracemalloc.start()
    begin = time.process_time()
    try:
        points = io.read_cloud(path)
        assert (points.ndim, points.shape[1], points.dtype) == (2, 3, np.float64)
        told = "read"
    except ValueError as error:
        told = str(error)
        assert str(path) in told
        assert "\n" not in told
        assert len(told) < 700
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert time.process_time() - begin < _SECONDS, (path.name, told)
    inside = {".gz": 4, ".laz": 10}.get(path.suffix, 1)  # of what is packed in it
    assert peak < 10 * inside * path.stat().st_size + _AROUND, (peak, path.stat().st_size)
    return told


def run(folder: Path, count: int, seed: int) -> list[str]:
    """The outcomes of `count` files."""
    rng = np.random.default_rng(seed)
    told = []
    for points in _SIZES:
        paths = valid_files(folder, points, seed)
        whole = {path: path.read_bytes() for path in paths}
        for path in paths:
            assert outcome(path) == "read", path
        for i in range(count // len(_SIZES)):
            path = paths[i % len(paths)]
            bad = path.with_name(f"bad-{i}-{path.name}")
            bad.write_bytes(damaged(whole[path], rng))
            told.append(outcome(bad) if bad.stat().st_size else "empty")
    return told


def test_damaged_files_of_every_format(tmp_path, seed):
    told = run(tmp_path, 30, seed)
    assert 0.1 < np.mean([one == "read" for one in told]) < 0.95


@pytest.mark.slow
def test_three_hundred_damaged_files(tmp_path, seed):
    told = run(tmp_path, 300, seed)
    assert len(told) >= 298
