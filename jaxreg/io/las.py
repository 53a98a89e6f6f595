"""LAS and LAZ, the files of airborne and terrestrial laser scanners, by laspy (extra `las`)."""

from pathlib import Path

import numpy as np

from jaxreg._extras import extra
from jaxreg.io.contents import Scan

_LARGEST = 2**31 - 1
"""LAS stores coordinates as integers of 32 bits, times a scale, plus an offset."""


def read(path: Path) -> Scan:
    """The points (n, 3), float64, scale and offset applied. Errors as `jaxreg.io.read_cloud`."""
    laspy = _laspy(path)
    try:
        with laspy.open(path) as file:
            # A scan takes two bytes a point or more; a damaged count would be unpacked for minutes.
            if file.header.point_count > path.stat().st_size:
                raise ValueError(f"it announces {file.header.point_count} points")
            return Scan(np.asarray(file.read().xyz, np.float64))
    except Exception as error:  # noqa: BLE001 - laspy and its backends raise types of their own
        raise ValueError(
            f"{path} cannot be read as {path.suffix} ({type(error).__name__}: {error}): "
            "it is malformed or truncated; export it again."
        ) from None


def write(path: Path, points: np.ndarray) -> None:
    """Point format 0, steps of a 10^9th of the extent (the format stores integers).

    Rows that are not finite are left out: integers have no NaN. The file then holds fewer points.

    Raises:
      ImportError: laspy is missing.
      ValueError: no row is finite.
    """
    laspy = _laspy(path)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        raise ValueError(
            f"{path}: no point is finite, and LAS stores no others: check the cloud, or choose "
            "another format."
        )
    cloud = laspy.LasData(laspy.LasHeader(point_format=0, version="1.2"))
    offsets, scales = points.min(axis=0), np.maximum(np.ptp(points, axis=0), 1e-9) * 1e-9
    _store(cloud, points, path, offsets, scales)


def write_moved(path: Path, original: Path, rotation: np.ndarray, translation: np.ndarray) -> None:
    """The file `original` with its points turned and moved; errors as `read`.

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
    """Raises ImportError where the file `path` could not be read or written for want of laspy."""
    _laspy(path)


def _laspy(path: Path):
    with extra("las", f"{path}: {path.suffix[1:].upper()}"):
        import laspy
    return laspy
