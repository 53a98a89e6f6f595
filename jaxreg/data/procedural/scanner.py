"""A virtual scanner: what a depth camera or a spinning lidar sees of a surface, with its faults."""

import dataclasses

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural.surfaces import Triangles, sample

_CELL = np.radians(0.7)
"""Resolution at which a nearer point hides a farther one."""
_HIDDEN = 1.03
"""How many times as far as the nearest point of its cell a point may lie and still be seen."""


@dataclasses.dataclass(frozen=True)
class Sensor:
    """What a scanner adds to the truth; lengths in the unit of the surface, angles in radians."""

    field_of_view: tuple[float, float] | None = None
    """Width and height of a camera's view; None: all around, within 0.5 of the horizon."""
    noise: float = 0.0
    """Standard deviation of a range at distance 1; it grows with the square of the distance."""
    step: float = 0.0
    """Ranges are rounded to multiples of it; 0: they are not."""
    rings: int = 0
    """Elevations of a lidar; 0: a camera, dense in both directions."""
    dropout: float = 0.0
    """Share of the points lost, in patches."""
    warp: float = 0.0
    """Slow bending of the scan from drift and calibration: its largest turn."""


def look_at(eye: np.ndarray, target: np.ndarray, up=(0.0, 0.0, 1.0)) -> np.ndarray:
    """The rotation (3, 3) from a scanner at `eye` that faces `target` along x, z up, to the world."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    side = np.cross(np.asarray(up), forward)
    side /= max(np.linalg.norm(side), 1e-9)
    return np.stack([forward, side, np.cross(forward, side)], axis=1)


def scan(
    rng: Generator,
    surface: Triangles,
    eye: np.ndarray,
    orientation: np.ndarray,
    sensor: Sensor,
    *,
    points: int,
) -> np.ndarray:
    """Points (about `points`, 3) that a scanner at `eye` sees, in its own frame (x ahead, z up).

    `orientation` is the rotation from that frame to the world. Fewer points where little is in view.
    """
    seen = (sample(rng, surface, 12 * points) - eye) @ orientation
    reach = np.linalg.norm(seen, axis=1)
    azimuth = np.arctan2(seen[:, 1], seen[:, 0])
    elevation = np.arcsin(seen[:, 2] / np.maximum(reach, 1e-9))
    if sensor.field_of_view is None:
        inside = np.abs(elevation) < 0.5
    else:
        width, height = sensor.field_of_view
        inside = (np.abs(azimuth) < width / 2) & (np.abs(elevation) < height / 2)
    if sensor.rings:
        ring = 1.0 / sensor.rings
        inside &= np.abs(elevation / ring - np.round(elevation / ring)) < 0.12
    seen, reach, azimuth, elevation = (x[inside] for x in (seen, reach, azimuth, elevation))
    if not len(seen):
        return seen
    visible = _visible(azimuth, elevation, reach) & ~_dropped(rng, azimuth, elevation, sensor)
    # A scanner's points are equally many per angle, samples of a surface per area.
    weight = 1 / np.maximum(reach, 1e-3) ** 2
    chance = np.where(visible, weight, 0)
    count = min(points, int(visible.sum()))
    if not count:
        return seen[:0]
    keep = rng.choice(len(seen), count, replace=False, p=chance / chance.sum())
    seen, reach = seen[keep], reach[keep]
    measured = reach + sensor.noise * reach**2 * rng.normal(size=count)
    if sensor.step:
        measured = np.round(measured / sensor.step) * sensor.step
    return _bent(rng, seen * (measured / reach)[:, None], sensor.warp)


def _visible(azimuth: np.ndarray, elevation: np.ndarray, reach: np.ndarray) -> np.ndarray:
    across = np.floor((azimuth + np.pi) / _CELL).astype(np.int64)
    up = np.floor((elevation + np.pi / 2) / _CELL).astype(np.int64)
    cell = across * (int(np.pi / _CELL) + 2) + up
    nearest = np.full(int(cell.max()) + 1, np.inf)
    np.minimum.at(nearest, cell, reach)
    return reach < _HIDDEN * nearest[cell]


def _dropped(
    rng: Generator, azimuth: np.ndarray, elevation: np.ndarray, sensor: Sensor
) -> np.ndarray:
    """Patches of directions, as glass and black cloth are lost."""
    lost = np.zeros(len(azimuth), bool)
    if not sensor.dropout:
        return lost
    while lost.mean() < sensor.dropout:
        centre = rng.integers(len(azimuth))
        radius = rng.uniform(0.02, 0.15)
        lost |= np.hypot(azimuth - azimuth[centre], elevation - elevation[centre]) < radius
    return lost


def _bent(rng: Generator, points: np.ndarray, warp: float) -> np.ndarray:
    """The scan turned by an angle that grows from -warp/2 to warp/2 along a random direction."""
    if not warp:
        return points
    axis, along = rng.normal(size=(2, 3))
    place = points @ along
    share = (place - place.mean()) / max(np.ptp(place), 1e-9)
    turn = warp * share[:, None] * axis / np.linalg.norm(axis)
    return Rotation.from_rotvec(turn).apply(points)
