"""Procedural solids: each function draws one surface of its kind, z up, in any unit.

Dimensions, counts and the details that break the symmetry are random.
"""

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural.surfaces import (
    Triangles,
    box,
    cylinder,
    place,
    prism,
    revolve,
    superellipsoid,
    tube,
    union,
)

_TO_X = Rotation.from_euler("y", 90, degrees=True).as_matrix()  # From the z axis to the x axis.


def crate(rng: Generator) -> Triangles:
    """Boxes of falling size stacked off-centre."""
    parts, level, size = [], 0.0, rng.uniform(0.8, 1.6, 3)
    for _ in range(rng.integers(1, 4)):
        shift = rng.uniform(-0.2, 0.2, 2) * size[:2]
        parts.append(box(size, (*shift, level + size[2] / 2)))
        level += size[2]
        size = size * rng.uniform(0.4, 0.8, 3)
    return union(*parts)


def drum(rng: Generator) -> Triangles:
    """A cylinder or frustum with a pipe out of its side."""
    radius, height = rng.uniform(0.4, 1.0), rng.uniform(0.6, 2.0)
    pipe = place(cylinder(0.3 * radius, radius), rotation=_TO_X)
    level = rng.uniform(-0.3, 0.3) * height
    body = cylinder(radius, height, top=radius * rng.uniform(0.6, 1.1))
    return union(body, place(pipe, offset=(1.3 * radius, 0, level)))


def cone(rng: Generator) -> Triangles:
    """A cone on a slab, off-centre."""
    radius, height = rng.uniform(0.4, 0.9), rng.uniform(0.8, 2.0)
    slab = box((*(2 * radius * rng.uniform(1.0, 1.5, 2)), 0.15), (0, 0, -height / 2))
    tip = cylinder(radius, height, top=radius * rng.uniform(0.0, 0.4))
    return union(slab, place(tip, offset=(*rng.uniform(-0.3, 0.3, 2), 0)))


def torus(rng: Generator) -> Triangles:
    """A ring whose tube swells and thins along the way, sometimes with a part missing."""
    turn = rng.choice([2 * np.pi, rng.uniform(3.5, 5.5)])
    angle = np.linspace(0, turn, 40)
    swell = 1 + rng.uniform(0.2, 0.5) * np.sin(angle + rng.uniform(0, 6))
    curve = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return tube(curve * (1, rng.uniform(0.6, 1.0), 1), rng.uniform(0.15, 0.35) * swell)


def pebble(rng: Generator) -> Triangles:
    """Two superellipsoids grown together."""
    first = superellipsoid(rng.uniform(0.5, 1.2, 3), rng.uniform(0.2, 2.0, 2))
    second = superellipsoid(rng.uniform(0.3, 0.7, 3), rng.uniform(0.2, 2.0, 2))
    return union(first, place(second, offset=rng.uniform(-0.8, 0.8, 3)))


def bracket(rng: Generator) -> Triangles:
    """An L, T, U or Z of plates, with a boss."""
    arms = rng.uniform(0.6, 1.6, 3)
    thick, depth = rng.uniform(0.1, 0.3), rng.uniform(0.4, 1.2)
    base = box((arms[0], depth, thick))
    ends = {"L": (-0.5,), "T": (rng.uniform(-0.2, 0.2),), "U": (-0.5, 0.5), "Z": (-0.5, 0.5)}
    kind = rng.choice(list(ends))
    parts = [base]
    for i, end in enumerate(ends[kind]):
        down = -1 if kind == "Z" and i else 1
        parts.append(box((thick, depth, arms[1 + i]), (end * arms[0], 0, down * arms[1 + i] / 2)))
    boss = cylinder(0.2 * depth, 3 * thick)
    parts.append(place(boss, offset=(0.1 * arms[0], rng.uniform(-0.25, 0.25) * depth, 0)))
    return union(*parts)


def vase(rng: Generator) -> Triangles:
    """A bottle or vase with a spout."""
    z = np.linspace(0, rng.uniform(1.2, 2.2), 16)
    wave = np.sin(rng.uniform(1.5, 4.0) * z + rng.uniform(0, 6))
    radius = rng.uniform(0.3, 0.5) * (1 + rng.uniform(0.2, 0.5) * wave)
    body = revolve([(0, 0), *zip(radius, z, strict=True)])
    level = rng.integers(6, 12)
    length = rng.uniform(0.4, 0.9)
    bend = np.linspace(0, 1, 8)[:, None] ** (1, 1, 2) * (length, 0, rng.uniform(0.2, 0.7))
    return union(body, place(tube(bend, 0.09), offset=(radius[level] * 0.95, 0, z[level])))


def helix(rng: Generator) -> Triangles:
    """A spring, its radius growing along the way, with a straight end."""
    turns, radius = rng.uniform(2, 5), rng.uniform(0.4, 0.7)
    angle = np.linspace(0, 2 * np.pi * turns, int(20 * turns))
    grow = np.linspace(1, rng.uniform(0.4, 1.4), len(angle))
    curve = np.stack([radius * grow * np.cos(angle), radius * grow * np.sin(angle)], axis=1)
    z = rng.uniform(0.12, 0.3) * angle / np.pi
    curve = np.column_stack([curve, z])
    bar = curve[-1] + np.linspace(0.05, 1, 5)[:, None] * (0.2, 0.5, rng.uniform(0.2, 0.6))
    return tube(np.concatenate([curve, bar]), rng.uniform(0.06, 0.1), sections=8)


def gear(rng: Generator) -> Triangles:
    """A toothed wheel on a shaft, with a key beside it."""
    teeth, tooth = rng.integers(6, 15), rng.uniform(0.12, 0.25)
    radius = np.tile([1.0, 1.0, 1 - tooth, 1 - tooth], teeth)
    angle = np.linspace(0, 2 * np.pi, len(radius), endpoint=False)
    outline = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    shaft = place(cylinder(rng.uniform(0.15, 0.35), 1.2), offset=(0, 0, rng.uniform(0.1, 0.5)))
    key = box((rng.uniform(0.2, 0.5), 0.2, 0.5), (0.5, 0, 0.2))
    return union(prism(outline, rng.uniform(0.2, 0.5)), shaft, key)


def star(rng: Generator) -> Triangles:
    """A prism over a star with rays of different lengths."""
    rays = rng.integers(3, 8)
    radius = np.stack([rng.uniform(0.7, 1.3, rays), rng.uniform(0.3, 0.6, rays)], axis=1).ravel()
    angle = np.linspace(0, 2 * np.pi, 2 * rays, endpoint=False)
    outline = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return prism(outline, rng.uniform(0.2, 0.8))


def blob(rng: Generator) -> Triangles:
    """A ball whose radius is a sum of random waves."""
    ball = superellipsoid((1, 1, 1), (1, 1), resolution=40)
    waves = rng.normal(size=(3, 6)) * 2.0
    phase, height = rng.uniform(0, 6, 6), rng.uniform(0.05, 0.16, 6)
    return ball * (1 + np.sin(ball @ waves + phase) @ height)[..., None]


def composite(rng: Generator) -> Triangles:
    """Four to eight primitives in random poses."""
    parts = []
    for _ in range(rng.integers(4, 9)):
        size = rng.uniform(0.2, 0.9, 3)
        part = (
            box(size),
            cylinder(size[0] / 2, size[2], top=size[1] / 2),
            superellipsoid(size / 2, rng.uniform(0.3, 1.5, 2), resolution=16),
        )[rng.integers(3)]
        rotation = Rotation.from_quat(rng.normal(size=4)).as_matrix()
        parts.append(place(part, offset=rng.uniform(-0.6, 0.6, 3), rotation=rotation))
    return union(*parts)


def pipe(rng: Generator) -> Triangles:
    """A tube along a smooth random curve, with flanges at its ends."""
    corners = rng.uniform(-1, 1, (4, 3)) + np.linspace(-0.6, 0.6, 4)[:, None] * (1, 0, 0)
    s = np.linspace(0, 1, 40)[:, None]
    basis = [(1 - s) ** 3, 3 * s * (1 - s) ** 2, 3 * s**2 * (1 - s), s**3]
    curve = np.concatenate(basis, axis=1) @ (2 * corners)
    radius = np.full(40, rng.uniform(0.15, 0.3))
    radius[:3] *= rng.uniform(1.2, 2.0)
    radius[-3:] *= rng.uniform(1.2, 2.0)
    return tube(curve, radius)


def wheel(rng: Generator) -> Triangles:
    """A rim, a hub, spokes and a crank."""
    angle = np.linspace(0, 2 * np.pi, 33)
    rim = tube(np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), rng.uniform(0.07, 0.15))
    parts = [rim, cylinder(rng.uniform(0.12, 0.25), rng.uniform(0.2, 0.6))]
    count = rng.integers(3, 7)
    for turn in np.linspace(0, 2 * np.pi, count, endpoint=False):
        rotation = Rotation.from_euler("z", turn).as_matrix()
        parts.append(place(box((1, 0.08, 0.08), (0.5, 0, 0)), rotation=rotation))
    crank = cylinder(0.08, rng.uniform(0.5, 1.0))
    return union(*parts, place(crank, offset=(0.9, 0.3, 0.3)))


FAMILIES = (
    crate,
    drum,
    cone,
    torus,
    pebble,
    bracket,
    vase,
    helix,
    gear,
    star,
    blob,
    composite,
    pipe,
    wheel,
)
"""The first labels of the procedural shapes."""
