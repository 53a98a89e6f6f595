"""All turns and shifts of one outline against another in the plane, at once, by Fourier transforms.

Three unknowns can be searched without descriptors: for every turn the correlation of two rasters
gives the agreement of all shifts. Raster cells hold ``exp(2 i phi)`` of the direction phi of the
normal, so that lines which run alike add and lines that cross subtract (Bülow and Birk, 2009, and
Cox et al. correlate in this way without directions).
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

_GRID = 256
"""Cells of a side of the raster."""
_BLUR = 0.7
"""Standard deviation, in cells, of the blur of the reference."""
_TURN = 1.0
"""How far a turn moves the rim of the source, in cells."""
_PEAKS = 6
"""Best shifts that are kept of a turn."""
_AT_ONCE = 24
"""Turns that are transformed at once."""


class Placements(NamedTuple):
    """Turns (radians) and shifts (leading axis), the best first, and how well the outlines agree.

    A point x of the source goes to ``R(turn) x + shift``.
    """

    turn: Float[np.ndarray, "k"]
    shift: Float[np.ndarray, "k 2"]
    score: Float[np.ndarray, "k"]
    cell: float


class Outline(NamedTuple):
    """Points of curves in the plane and unit normals of any sign."""

    points: Float[np.ndarray, "n 2"]
    normals: Float[np.ndarray, "n 2"]


def placed(
    source: Outline, reference: Outline, *, most: int, max_turn: float = math.pi
) -> Placements:
    """The `most` distinct placements at which outlines agree best, turned by at most `max_turn`.

    Points should lie evenly along their curves, and around the origin.
    """
    from scipy import fft, ndimage  # pairs in space do without

    rim = float(np.linalg.norm(source.points, axis=1).max())
    low, high = reference.points.min(axis=0), reference.points.max(axis=0)
    cell = (2 * rim + float(np.max(high - low))) / (_GRID - 4) or 1.0
    corner = low - rim
    fixed = _raster(reference.points - corner, _directions(reference.normals), cell)
    fixed = ndimage.gaussian_filter(fixed, _BLUR, mode="wrap")
    against = np.conj(np.asarray(fft.fft2(fixed.astype(np.complex64), workers=-1)))
    count = max(8, int(2 * math.pi * rim / (_TURN * cell)))
    turns = np.arange(-count // 2, count - count // 2) * (2 * math.pi / count)
    turns = turns[np.abs(turns) <= max_turn + 1e-9]
    turns = turns if len(turns) else np.zeros(1)
    found = [_of_turns(source, part, against, cell) for part in _parts(turns)]
    turn, row, score = (np.concatenate(values) for values in zip(*found, strict=True))
    # The raster of the source is about its own origin, that of the reference begins at its corner.
    shift = -(np.stack(np.divmod(row, _GRID), axis=1) * cell) % (_GRID * cell) + corner
    chosen = _distinct(turn, shift, score, rim, most)
    return Placements(turn[chosen], shift[chosen], score[chosen], cell)


def _parts(turns: np.ndarray) -> list[np.ndarray]:
    return np.array_split(turns, -(-len(turns) // _AT_ONCE))


def _directions(normals: Float[np.ndarray, "n 2"]) -> Complex[np.ndarray, "n"]:
    """``exp(2 i phi)``: the same for a normal and its opposite."""
    return (normals[:, 0] + 1j * normals[:, 1]) ** 2


def _raster(points: np.ndarray, values: np.ndarray, cell: float) -> Complex[np.ndarray, "g g"]:
    """Values summed in cells, wrapped around the sides, no cell larger than 1."""
    index = np.round(points / cell).astype(np.int64) % _GRID
    row = index[:, 0] * _GRID + index[:, 1]
    raster = np.bincount(row, np.real(values), _GRID**2) + 0j
    raster += 1j * np.bincount(row, np.imag(values), _GRID**2)
    return (raster / np.maximum(np.abs(raster), 1)).reshape(_GRID, _GRID)


def _of_turns(
    source: Outline, turns: np.ndarray, against: np.ndarray, cell: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The best shifts of every turn: turn, place in the raster, score."""
    from scipy import fft

    values = _directions(source.normals)
    rasters = np.stack(
        [
            _raster(_turned(source.points, angle), values * np.exp(2j * angle), cell)
            for angle in turns
        ]
    )
    # What is left is the correlation at minus the shift.
    product = np.asarray(fft.fft2(rasters.astype(np.complex64), workers=-1)) * against
    agreement = np.real(np.asarray(fft.ifft2(product, workers=-1))).reshape(len(turns), -1)
    best = np.argpartition(-agreement, _PEAKS, axis=1)[:, :_PEAKS]
    return (
        np.repeat(turns, _PEAKS),
        best.ravel(),
        np.take_along_axis(agreement, best, axis=1).ravel(),
    )


def _turned(points: np.ndarray, angle: float) -> np.ndarray:
    cosine, sine = math.cos(angle), math.sin(angle)
    return points @ np.array([[cosine, sine], [-sine, cosine]])


def _distinct(
    turn: np.ndarray, shift: np.ndarray, score: np.ndarray, rim: float, most: int
) -> list[int]:
    chosen: list[int] = []
    for i in np.argsort(-score, kind="stable").tolist():
        if len(chosen) == most:
            break
        apart = np.abs((turn[chosen] - turn[i] + math.pi) % (2 * math.pi) - math.pi)
        moved = np.linalg.norm(shift[chosen] - shift[i], axis=1)
        if np.all((apart > 0.1) | (moved > 0.1 * rim)):
            chosen.append(i)
    return chosen
