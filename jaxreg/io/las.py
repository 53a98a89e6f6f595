"""LAS and LAZ, the formats of airborne and terrestrial laser scanners, with laspy (extra `las`)."""

import os
import struct
from pathlib import Path

import numpy as np

from jaxreg._extras import extra
from jaxreg.io.contents import Scan

_CHUNK = 16
"""Bytes that a chunk of a LAZ file takes at least: its first point is not packed."""
_PACKED = 100
"""Points are packed to less than this share of their size in damaged files alone."""
_LARGEST = 2**31 - 1
"""LAS stores coordinates as integers of 32 bits, times a scale, plus an offset."""


def read(path: Path) -> Scan:
    """The points (n, 3), float64, scaled and offset. Raises what `jaxreg.io.read_cloud` raises."""
    laspy = _laspy(path)
    try:
        _check_header(path)
        with laspy.open(path) as file:
            # A scan takes two bytes a point or more; a damaged count would be unpacked for minutes.
            size, rows = path.stat().st_size, file.header.point_count
            if file.header.are_points_compressed:
                _check_chunks(path, file.header.offset_to_point_data, size)
            if rows > size or rows * file.header.point_format.size > _PACKED * size:
                raise ValueError(f"it announces {file.header.point_count} points")
            return Scan(np.asarray(file.read().xyz, np.float64))
    except BaseException as error:  # laspy and its backends raise types of their own, panics too
        if isinstance(error, KeyboardInterrupt | SystemExit):
            raise
        raise ValueError(
            f"{path} cannot be read as {path.suffix} ({type(error).__name__}: {error}): "
            "it is malformed or truncated; export it again."
        ) from None


def _check_header(path: Path) -> None:
    """Raises ValueError where the header leads out of the file: laspy would read on regardless."""
    with path.open("rb") as file:
        head = file.read(104)
    size = path.stat().st_size
    if len(head) < 104:
        raise ValueError("its header is cut")
    header, points, records = struct.unpack_from("<HII", head, 94)
    if not 227 <= header <= points <= size or records > size // 54:
        raise ValueError("its header leads out of the file")


def _check_chunks(path: Path, start: int, size: int) -> None:
    """Raises ValueError where the table of a LAZ file's chunks announces more than the file holds.

    The decompressor reserves memory for as many as it says, and ends the process where it gets none.
    """
    with path.open("rb") as file:
        file.seek(start)
        (table,) = struct.unpack("<q", file.read(8))
        if table == -1:  # written to a stream: the place stands at the end
            file.seek(-8, os.SEEK_END)
            (table,) = struct.unpack("<q", file.read(8))
        if not start < table <= size - 8:
            raise ValueError("the table of its chunks lies outside of the file")
        file.seek(table)
        _, chunks = struct.unpack("<II", file.read(8))
    if chunks > size // _CHUNK:
        raise ValueError(f"it announces {chunks} chunks")


def write(path: Path, points: np.ndarray) -> None:
    """Point format 0, steps of a 10^9th of the extent (the format stores integers).

    Rows that are not finite are left out, because integers have no NaN. The file then has fewer points.

    Raises:
      ImportError: laspy is missing.
      ValueError: no row is finite.
    """
    laspy = _laspy(path)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        raise ValueError(
            f"{path}: no point is finite, and LAS stores only finite ones: check the cloud, or choose "
            "another format."
        )
    cloud = laspy.LasData(laspy.LasHeader(point_format=0, version="1.2"))
    offsets, scales = points.min(axis=0), np.maximum(np.ptp(points, axis=0), 1e-9) * 1e-9
    _store(cloud, points, path, offsets, scales)


def write_moved(path: Path, original: Path, rotation: np.ndarray, translation: np.ndarray) -> None:
    """The file `original` with its points turned and moved; raises what `read` raises.

    Intensity, colours, times and whatever else it stores for a point stay, and so do scale and offset
    as long as the integers hold the new coordinates: else the offset becomes a whole number near them,
    and only then the scale a coarser power of ten.
    """
    laspy = _laspy(path)
    cloud = laspy.read(original)
    points = np.asarray(cloud.xyz, np.float64) @ rotation.T + translation
    _store(cloud, points, path, *_steps(points, cloud.header.offsets, cloud.header.scales))


def _steps(
    points: np.ndarray, offsets: np.ndarray, scales: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Offsets and scales that hold the points: those given where they do."""
    offsets, scales = np.array(offsets, float), np.array(scales, float)
    for axis, column in enumerate(points.T):
        if np.abs(column - offsets[axis]).max(initial=0) > _LARGEST * scales[axis]:
            offsets[axis] = np.round((column.min() + column.max()) / 2)
        while np.abs(column - offsets[axis]).max(initial=0) > _LARGEST * scales[axis]:
            scales[axis] *= 10
    return offsets, scales


def _store(cloud, points: np.ndarray, path: Path, offsets: np.ndarray, scales: np.ndarray) -> None:
    # The header is written, but the coordinates are turned to integers by what the record holds.
    for holder in (cloud.header, cloud.points):
        holder.offsets, holder.scales = offsets, scales
    cloud.xyz = points
    cloud.write(str(path))


def check_installed(path: Path) -> None:
    """Raise ImportError if `path` cannot be read or written because laspy is missing."""
    _laspy(path)


def _laspy(path: Path):
    with extra("las", f"{path}: {path.suffix[1:].upper()}"):
        import laspy
    return laspy
