"""Other places where a scan fits as well: one period on, or turned by half.

A stair, a track or rows of seats agree with themselves one step on, and a search that comes upon one
of these poses has no reason to look for the others: its hypotheses come from a few hundred points, of
which each has twins. The correlation of two rasters tells how much of one cloud every shift lays on
the other (Cox et al. and Bülow and Birk, 2009, in the plane; here with as many cells in space), for the
turn of a pose and for half turns from there, in milliseconds.
"""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxreg.geometry.rigid import nearest_rotation
from jaxreg.types import RigidTransform

COARSE, FINE = 20_000, 150_000
"""Cells of a raster: enough for half turns, and for periods."""
_THINNEST = 0.02
"""Least extent of a raster, as a share of its largest: a plane has few layers of cells."""
_BLUR = 0.7
"""Standard deviation of the blur of the reference, in cells."""
_AS_MANY = 0.8
"""A shift is as good where it lays so much on the other cloud, of what the pose itself does."""
_PEAKS = 400
"""Cells with the largest shares, among which the shifts are."""
_ITSELF = 2
"""Cells within which the share of a pose itself is the largest."""
_AROUND = np.array(list(itertools.product((-1, 0, 1), repeat=3)))


class _Raster(NamedTuple):
    """Cells of edge `cell` that are wrapped around the sides."""

    cell: float
    shape: tuple[int, int, int]

    def of(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "x y z"]:
        """1 in the cells of points, 0 elsewhere."""
        index = np.round(points / self.cell).astype(np.int64) % self.shape
        raster = np.zeros(self.shape, np.float32)
        raster[tuple(index.T)] = 1
        return raster


def others(
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    pose: RigidTransform,
    *,
    axes: Float[np.ndarray, "a 3"],
    most: int,
    resolution: int = FINE,
) -> tuple[RigidTransform, Float[np.ndarray, "k"]]:
    """At most `most` other poses that lay about as much of the source on the reference, best first.

    With each the share of the source that it does lay there, of what the pose does. Points and poses
    are in one frame and unit, and the points should be about as dense in both clouds. The source is
    shifted only, or turned by half about one of the `axes` (unit vectors, in its own frame) as well.
    """
    rotations = np.concatenate([pose.rotation[None], pose.rotation @ half_turns(axes)])
    turned = source @ np.swapaxes(rotations, 1, 2)
    corners, low = turned.min(axis=1), reference.min(axis=0)
    extent = np.ptp(reference, axis=0)
    raster = _raster(extent + np.ptp(turned, axis=1).max(axis=0), resolution)
    shares = _shares(turned - corners[:, None], reference - low, raster)
    start = np.round((pose.translation - low + corners[0]) / raster.cell).astype(np.int64)
    own = max(float(shares[0][tuple(((start + _AROUND) % raster.shape).T)].max()), 1e-6)
    found = [_peaks(share, _AS_MANY * own) for share in shares]
    which = np.repeat(np.arange(len(rotations)), [len(cells) for cells in found])
    cells = np.concatenate(found)
    share = shares[(which, *cells.T)].astype(np.float64) / own
    # A shift beyond the far side of the reference is one from its near side.
    cells = np.where(cells * raster.cell > extent + raster.cell, cells - raster.shape, cells)
    shifts = low - corners[which] + raster.cell * cells
    itself = (which == 0) & (np.abs(cells - start).max(axis=1) < _ITSELF)
    chosen = np.argsort(np.where(itself, np.inf, -share), kind="stable")
    chosen = chosen[: min(most, len(share) - int(itself.sum()))]
    return RigidTransform(rotations[which[chosen]], shifts[chosen]), share[chosen]


def axes_of(
    points: Float[np.ndarray, "n 3"], up: Float[np.ndarray, "3"] | None
) -> Float[np.ndarray, "a 3"]:
    """The principal axes of a cloud, one a row; the one that stays upright, if it is known."""
    if up is not None:
        return up[None]
    return np.linalg.eigh(np.cov((points - points.mean(axis=0)).T, ddof=0))[1].T


def half_turns(axes: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3 3"]:
    """The rotations by half a turn about unit vectors."""
    return nearest_rotation(2 * axes[:, :, None] * axes[:, None, :] - np.eye(3))


def _raster(extent: Float[np.ndarray, "3"], cells: int) -> _Raster:
    from scipy import fft

    extent = np.maximum(extent, _THINNEST * extent.max())
    cell = float(np.prod(extent) / cells) ** (1 / 3) or 1.0
    counts = (extent / cell).astype(int) + 2
    x, y, z = (int(fft.next_fast_len(count, real=True) or count) for count in counts.tolist())
    return _Raster(cell, (x, y, z))


def _shares(
    turned: Float[np.ndarray, "k n 3"], reference: Float[np.ndarray, "m 3"], raster: _Raster
) -> Float[np.ndarray, "k x y z"]:
    """The share of the source's cells that every shift lays on those of the reference, blurred."""
    from scipy import fft

    rasters = np.stack([raster.of(points) for points in (*turned, reference)])
    counts = rasters[:-1].sum(axis=(1, 2, 3), keepdims=True)
    waves = np.asarray(fft.rfftn(rasters, axes=(1, 2, 3), workers=-1))
    against = waves[-1]
    x, y, z = raster.shape
    for axis, waves_of in enumerate((np.fft.fftfreq(x), np.fft.fftfreq(y), np.fft.rfftfreq(z))):
        blur = np.exp(-2 * (np.pi * _BLUR * waves_of) ** 2).astype(np.float32)
        against *= np.expand_dims(blur, [other for other in range(3) if other != axis])
    product = np.conj(waves[:-1]) * against
    lain = np.asarray(fft.irfftn(product, s=raster.shape, axes=(1, 2, 3), workers=-1))
    return lain / counts


def _peaks(share: Float[np.ndarray, "x y z"], least: float) -> Int[np.ndarray, "k 3"]:
    """The cells of at least this share of which no neighbour has more."""
    flat = share.ravel()
    best = np.argpartition(-flat, min(_PEAKS, len(flat) - 1))[:_PEAKS]
    best = np.stack(np.unravel_index(best[flat[best] >= least], share.shape), axis=1)
    around = (best[:, None] + _AROUND) % share.shape
    highest = share[tuple(np.moveaxis(around, -1, 0))].max(axis=1)
    return best[share[tuple(best.T)] >= highest]
