"""Procedural rooms: a floor, walls with openings, and furniture of the shapes beside this file."""

from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural import objects, solids
from jaxreg.data.procedural.surfaces import Triangles, box, place, union

_FAMILIES = objects.FAMILIES + solids.FAMILIES
_WALL = 0.1
"""Thickness of walls, in metres."""


class Room(NamedTuple):
    """Walls, floor and ceiling, and the pieces of furniture; metres, z up, the floor at 0."""

    shell: Triangles
    pieces: tuple[Triangles, ...]

    @property
    def surface(self) -> Triangles:
        """All of it."""
        return union(self.shell, *self.pieces)


def sample_room(seed: int, index: int) -> Room:
    """Room `index` of a seed: its walls enclose the origin, and no two are alike."""
    rng = np.random.default_rng((seed, index, 1))
    size = rng.uniform((3, 3, 2.3), (9, 7, 3.5))
    parts = [box((size[0], size[1], _WALL), (0, 0, -_WALL / 2))]
    if rng.random() < 0.7:
        parts.append(box((size[0], size[1], _WALL), (0, 0, size[2] + _WALL / 2)))
    for quarter in range(4):
        along, away = (size[0], size[1]) if quarter % 2 == 0 else (size[1], size[0])
        wall = place(_wall(rng, along, size[2]), offset=(0, away / 2, 0))
        parts.append(place(wall, rotation=_about_z(quarter * np.pi / 2)))
    pieces = tuple(_piece(rng, size) for _ in range(int(rng.integers(5, 16))))
    return Room(union(*parts), pieces)


def rearranged(room: Room, rng: Generator, *, share: float) -> Room:
    """The same room on another day: about a `share` of the pieces was moved by up to a metre."""
    pieces = tuple(
        place(piece, offset=(*rng.uniform(-1, 1, 2), 0)) if rng.random() < share else piece
        for piece in room.pieces
    )
    return room._replace(pieces=pieces)


def _wall(rng: Generator, length: float, height: float) -> Triangles:
    """Along x about the origin: up to two openings, pillars, shelves and pictures on it."""
    cuts = np.sort(rng.uniform(-length / 2, length / 2, 2 * int(rng.integers(0, 3))))
    starts, ends = np.append(-length / 2, cuts[1::2]), np.append(cuts[::2], length / 2)
    parts = [_panel(start, end, 0, height) for start, end in zip(starts, ends, strict=True)]
    for start, end in zip(cuts[::2], cuts[1::2], strict=True):
        sill = 0.0 if rng.random() < 0.5 else rng.uniform(0.5, 1.1)  # A door, or a window.
        parts += [_panel(start, end, 2.0, height), _panel(start, end, 0, sill)]
    for _ in range(int(rng.integers(1, 6))):
        size = rng.uniform((0.2, 0.05, 0.2), (1.4, 0.5, 1.2))
        low = np.array([-length / 2, -size[1] / 2, 0.2])
        parts.append(box(size, rng.uniform(low, (length / 2, size[1] / 2, height))))
    return union(*parts)


def _panel(start: float, end: float, low: float, high: float) -> Triangles:
    return box((end - start, _WALL, high - low), ((start + end) / 2, 0, (low + high) / 2))


def _piece(rng: Generator, room: np.ndarray) -> Triangles:
    """A shape of 0.3 to 1.6 m, on the floor or (as on a table or a wall) above it."""
    piece = _FAMILIES[int(rng.integers(len(_FAMILIES)))](rng)
    piece = piece * (rng.uniform(0.3, 1.6) / np.ptp(piece.reshape(-1, 3), axis=0).max())
    piece = place(piece, rotation=_about_z(rng.uniform(0, 2 * np.pi)))
    ground = 0.0 if rng.random() < 0.6 else rng.uniform(0, 0.6 * room[2])
    height = ground - piece.reshape(-1, 3)[:, 2].min()
    return place(piece, offset=(*(rng.uniform(-0.45, 0.45, 2) * room[:2]), height))


def _about_z(angle: float) -> np.ndarray:
    return Rotation.from_euler("z", angle).as_matrix()
