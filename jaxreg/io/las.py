"""LAS and LAZ, the formats of airborne and terrestrial laser scanners, with laspy (extra `las`)."""

from pathlib import Path

import numpy as np

from jaxreg._extras import extra


def read(path: Path) -> np.ndarray:
    """The points (n, 3), float64, scaled and offset. Raises what `jaxreg.io.read_cloud` raises."""
    laspy = _laspy(path)
    try:
        with laspy.open(path) as file:
            # A scan takes at least two bytes per point; a damaged count would be unpacked for minutes.
            if file.header.point_count > path.stat().st_size:
                raise ValueError(f"it announces {file.header.point_count} points")
            return np.asarray(file.read().xyz, np.float64)
    except Exception as error:  # noqa: BLE001 - laspy and its backends raise types of their own
        raise ValueError(
            f"{path} cannot be read as {path.suffix} ({type(error).__name__}: {error}): "
            "it is malformed or truncated; export it again."
        ) from None


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
    _store(laspy.LasData(laspy.LasHeader(point_format=0, version="1.2")), points, path)


def write_moved(path: Path, original: Path, rotation: np.ndarray, translation: np.ndarray) -> None:
    """The file `original` with its points turned and moved; raises what `read` raises.

    Intensity, colours, times and everything else that it stores for a point stay.
    """
    laspy = _laspy(path)
    cloud = laspy.read(original)
    _store(cloud, np.asarray(cloud.xyz, np.float64) @ rotation.T + translation, path)


def _store(cloud, points: np.ndarray, path: Path) -> None:
    offsets, scales = points.min(axis=0), np.maximum(np.ptp(points, axis=0), 1e-9) * 1e-9
    # The header is written, but the record's own scales turn the coordinates into integers.
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
