"""Procedural shapes: seeded, unlimited, and made on the spot, with nothing to download.

Shape `index` of a seed belongs to family ``index % len(families())``. Beyond its family's own
random details it is warped and gets a few random attachments, so that its pose is well defined.
"""

from typing import Literal

import numpy as np
from numpy.random import Generator

from jaxreg.data.procedural import objects, solids, surfaces

_FAMILIES = solids.FAMILIES + objects.FAMILIES
_WARP = 0.15  # Shear, stretch and taper of a shape in the unit sphere.
_ATTACHMENTS = 3  # At most.
_STREAMS = {"train": 0, "validation": 1 << 40, "test": 1 << 41}


def families() -> tuple[str, ...]:
    """The name of every label."""
    return tuple(family.__name__ for family in _FAMILIES)


def sample_shape(seed: int, index: int, *, points: int) -> np.ndarray:
    """A procedural shape in the unit sphere: (points, 3) float32, independent and uniform by area.

    Zero mean and largest norm 1, as in ModelNet40. The two halves of a cloud are independent
    samples of one surface, and ``sampling = "disjoint"`` uses them as such.

    Raises:
      ValueError: `seed` or `index` is negative, or fewer than 2 points are asked for.
    """
    if seed < 0 or index < 0 or points < 2:
        raise ValueError(
            f"seed = {seed} and index = {index} must be 0 or more, points = {points} at least 2."
        )
    rng = np.random.default_rng((seed, index))
    surface = _normalised(_FAMILIES[index % len(_FAMILIES)](rng))
    surface = surfaces.warp(rng, _attached(rng, surface), amount=_WARP)
    cloud = surfaces.sample(rng, surface, points)
    cloud -= cloud.mean(axis=0)
    return (cloud / np.linalg.norm(cloud, axis=1).max()).astype(np.float32)


def load(
    split: Literal["train", "validation", "test"], count: int, *, points: int, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Clouds (count, points, 3) float32 and labels (count,) int32; the splits share no shape.

    A longer load begins with the shapes of a shorter one.

    Raises:
      ValueError: an unknown split, `count` below 1, or as `sample_shape`.
    """
    if split not in _STREAMS:
        raise ValueError(f"split must be one of {', '.join(_STREAMS)}, got {split!r}.")
    if count < 1:
        raise ValueError(f"count = {count} shapes: ask for at least 1.")
    first = _STREAMS[split]
    first -= first % len(_FAMILIES)  # Every split starts with the first family.
    indices = range(first, first + count)
    clouds = np.stack([sample_shape(seed, index, points=points) for index in indices])
    return clouds, np.array([index % len(_FAMILIES) for index in indices], np.int32)


def _normalised(surface: surfaces.Triangles) -> surfaces.Triangles:
    corners = surface.reshape(-1, 3)
    centre = (corners.max(axis=0) + corners.min(axis=0)) / 2
    return (surface - centre) / np.linalg.norm(corners - centre, axis=1).max()


def _attached(rng: Generator, surface: surfaces.Triangles) -> surfaces.Triangles:
    """The surface with small boxes and pegs on it, half sunk in."""
    parts = [surface]
    for place in surfaces.sample(rng, surface, int(rng.integers(1, _ATTACHMENTS + 1))):
        size = rng.uniform(0.08, 0.3, 3)
        part = surfaces.box(size) if rng.random() < 0.5 else surfaces.cylinder(size[0] / 2, size[2])
        parts.append(surfaces.place(part, offset=place))
    return surfaces.union(*parts)
