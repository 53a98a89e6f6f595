"""PTX of terrestrial scanners: stations, each a grid of rays with a pose of its own."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxreg.io.contents import Scan
from jaxreg.io.decoding import decoded
from jaxreg.io.layout import lines

_HEADER = 10
"""Lines above the points of a station: two sizes, the scanner's position and axes, a 4x4 matrix."""


def read(path: Path) -> Scan:
    """The points of all stations in their common frame; rays without a return are left out.

    Raises what `jaxreg.io.read_cloud` raises.
    """
    text = decoded(path, path.read_bytes())
    rows = ((n, line) for n, line in lines(text) if line.strip())
    stations, matrices, lost = [], [], 0
    for number, first in rows:
        points, matrix = _station(path, (number, first), rows)
        seen = ~(points == 0).all(axis=1)
        lost += int(np.sum(~seen))
        stations.append(_placed(points[seen], matrix))
        matrices.append(matrix)
    if not stations:
        return Scan(np.empty((0, 3)))
    # The scanner of a station is the origin of its rows.
    place = _placed(np.zeros((1, 3)), matrices[0])[0] if len(matrices) == 1 else None
    return Scan(np.concatenate(stations), (*_told(matrices), *_rays(lost)), place)


def _told(matrices: list[np.ndarray]) -> tuple[str, ...]:
    count = len(matrices)
    if count == 1:
        return ()
    alike = all(np.array_equal(matrix, matrices[0]) for matrix in matrices[1:])
    laid = "which all have the same pose" if alike else "each laid where its own matrix says"
    return (f"{count} stations (scans) as one cloud, {laid}",)


def _rays(lost: int) -> tuple[str, ...]:
    return (f"{lost:,} rays without a return, left out",) if lost else ()


def _station(
    path: Path, first: tuple[int, str], rows: Iterator[tuple[int, str]]
) -> tuple[np.ndarray, np.ndarray]:
    header = [first, *itertools.islice(rows, _HEADER - 1)]
    where = f"{path}, line {first[0]}"
    try:
        (columns,), (height,) = ([int(w) for w in line.split()] for _, line in header[:2])
        matrix = np.array([[float(w) for w in line.split()] for _, line in header[6:10]])
        if matrix.shape != (4, 4) or min(columns, height) < 0:
            raise ValueError
    except ValueError:
        raise ValueError(
            f"{where}: not the header of a station (PTX: columns, rows, four lines of three "
            "numbers, four of four): export it again; if the lines hold x y z alone, name the file "
            ".xyz."
        ) from None
    count = columns * height
    try:
        body = (line for _, line in itertools.islice(rows, count))
        points = np.loadtxt(body, usecols=(0, 1, 2), ndmin=2) if count else np.empty((0, 3))
    except (ValueError, UserWarning) as error:
        told = " ".join(str(error).split())[:100]
        raise ValueError(
            f"{where}: a point of this station is not one ({told}): export it again."
        ) from None
    if len(points) < count:
        raise ValueError(
            f"{path} is truncated: the station of line {first[0]} announces {count} points and has "
            f"{len(points)}: copy it again."
        )
    return points, matrix


def _placed(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """In the common frame: PTX writes matrices for rows, the shift below; some write it beside."""
    if np.any(matrix[:3, 3]) and not np.any(matrix[3, :3]):
        matrix = matrix.T
    return points @ matrix[:3, :3] + matrix[3, :3]
