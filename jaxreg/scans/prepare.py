"""Clouds as people have them, made ready for the solver: checked, centred, scaled, reduced.

Everything here is float64 on the host. Float32 at an offset of 1e6 m has a resolution of 6 cm, so
offset and unit are taken off before any array reaches the device, and put back at the end.
"""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from jaxreg.geometry.clouds import check_points

FINEST = 1e-6
"""The resolution of float32 in a cloud of radius 1: a spacing below it is none."""
_CUBES = 1 << 20
"""Up to so many cubes a table of all of them is quicker than to sort the occupied ones."""


class Scan(NamedTuple):
    """A checked cloud in canonical order.

    `points` are the distinct finite points in lexicographic order, so that neither the order nor the
    repetition of the input's rows can change a result. `kept` says which input rows are finite, and
    ``points[row]`` are the kept rows in their own order.
    """

    points: Float[np.ndarray, "p 3"]
    kept: Bool[np.ndarray, "n"]
    row: Int[np.ndarray, "k"]


def make_scan(points: object, name: str, *, nonfinite: Literal["raise", "drop"] = "raise") -> Scan:
    """The canonical form of a cloud; errors as `check_points`."""
    array, finite = check_points(points, name, nonfinite=nonfinite)
    points, row = _distinct(array[finite])
    return Scan(points, finite, row)


def _distinct(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct rows in lexicographic order (numpy.unique on rows is several times slower).

    Also which of them every given row is.
    """
    points = points + 0.0  # -0.0 and 0.0 are one number.
    order = np.lexsort(points.T[::-1])
    ordered = points[order]
    new = np.ones(len(ordered), bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    row = np.empty(len(points), np.int64)
    row[order] = np.cumsum(new) - 1
    return ordered[new], row


def per_input_row(scan: Scan, values: np.ndarray, *, missing: float) -> np.ndarray:
    """Values of the scan's points as rows of the input, `missing` where a row was dropped."""
    rows = np.full((len(scan.kept), *values.shape[1:]), missing)
    rows[scan.kept] = values[scan.row]
    return rows


def voxel_reduced(points: Float[np.ndarray, "n 3"], size: float) -> Float[np.ndarray, "v 3"]:
    """The mean of the points in every occupied cube of edge `size`, in lexicographic order."""
    cell = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    extent = cell.max(axis=0) + 1
    key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    if np.prod(extent.astype(float)) > _CUBES:
        _, key = np.unique(key, return_inverse=True)
    count = np.bincount(key)
    occupied = np.flatnonzero(count)
    sums = np.stack([np.bincount(key, weights=axis)[occupied] for axis in points.T], axis=1)
    return sums / count[occupied, None]


def reduce_to(points: Float[np.ndarray, "n 3"], most: int) -> Float[np.ndarray, "v 3"]:
    """At most `most` points that cover the cloud evenly; the cloud itself where it is small enough.

    Voxel means with the smallest voxel that does it, to a few per cent.
    """
    if len(points) <= most:
        return points
    extent = float(np.ptp(points, axis=0).max())
    low, high = 0.0, extent
    reduced = points[:1]
    size = extent / np.sqrt(most)
    for _ in range(12):
        candidate = voxel_reduced(points, size)
        if len(candidate) > most:
            low = size
        else:
            high, reduced = size, candidate
            if len(candidate) > 0.92 * most:
                break
        # A surface has about 1 / size^2 occupied voxels.
        guess = size * np.sqrt(len(candidate) / (0.96 * most))
        size = guess if low < guess < high else (low + high) / 2
    return reduced


def at_one_density(
    source: Float[np.ndarray, "n 3"], reference: Float[np.ndarray, "m 3"], most: int
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "w 3"], float]:
    """Both clouds with at most `most` points and alike spacing, and the larger spacing of the two.

    What is counted around a point depends on the density, and clouds are compared by such counts.
    """
    clouds = [reduce_to(points, most) for points in (source, reference)]
    spacings = [spacing(points) for points in clouds]
    size = max(spacings)
    for k in (0, 1):
        if 1.3 * spacings[k] < size:
            clouds[k] = voxel_reduced(clouds[k], size)
            spacings[k] = spacing(clouds[k])
    return *clouds, max(*spacings, FINEST)


def nearest(
    tree: cKDTree, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Distance to, and index of, the nearest point of the tree, on all cores."""
    distance, index = tree.query(points, workers=-1)
    return np.asarray(distance), np.asarray(index)


def spacing(points: Float[np.ndarray, "n 3"]) -> float:
    """How far apart neighbouring points of the surface are: the median distance to the 4th nearest.

    On a surface covered by squares of edge a, one point each, this is about a; 0 of a single point.
    """
    k = min(4, len(points) - 1)
    if k < 1:
        return 0.0
    distance = cKDTree(points).query(points, k=k + 1, workers=-1)[0][:, -1]
    return float(np.median(distance))
