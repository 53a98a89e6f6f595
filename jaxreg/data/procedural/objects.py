"""Procedural everyday objects: each function draws one surface of its kind, z up, in any unit.

Dimensions, counts and the details that break the symmetry are random.
"""

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural.surfaces import (
    Triangles,
    box,
    cylinder,
    from_grid,
    place,
    prism,
    revolve,
    superellipsoid,
    tube,
    union,
)

_TO_X = Rotation.from_euler("y", 90, degrees=True).as_matrix()  # From the z axis to the x axis.
_TO_Y = Rotation.from_euler("x", -90, degrees=True).as_matrix()


def stairs(rng: Generator) -> Triangles:
    """A flight of steps, a landing, and sometimes a wall on one side."""
    count, width = rng.integers(3, 8), rng.uniform(0.6, 2.0)
    run, rise = rng.uniform(0.2, 0.5, 2)
    parts = [box((run, width, rise * i), (run * i, 0, rise * i / 2)) for i in range(1, count + 1)]
    parts.append(box((3 * run, width, rise), (run * (count + 2), 0, rise * (count - 0.5))))
    if rng.random() < 0.5:
        height = rise * (count + rng.uniform(0, 2))
        parts.append(box((run * count, 0.08, height), (run * count / 2, width / 2, height / 2)))
    return union(*parts)


def _legs(rng: Generator, width: float, depth: float, height: float) -> Triangles:
    """Four legs below z = 0, either straight and square or round and splayed."""
    thick = rng.uniform(0.05, 0.12)
    x, y = width / 2 - thick, depth / 2 - thick
    if rng.random() < 0.5:
        leg = box((thick, thick, height), (0, 0, -height / 2))
    else:
        leg = place(cylinder(thick / 2, height, top=0.8 * thick), offset=(0, 0, -height / 2))
    return union(*(place(leg, offset=(i * x, j * y, 0)) for i in (-1, 1) for j in (-1, 1)))


def table(rng: Generator) -> Triangles:
    """A top on four legs with a drawer, a shelf or things on it."""
    width, depth, height = rng.uniform(1.2, 2.2), rng.uniform(0.7, 1.2), rng.uniform(0.5, 1.1)
    parts = [box((width, depth, 0.08), (0, 0, 0.04)), _legs(rng, width, depth, height)]
    drawer = rng.uniform(0.2, 0.45, 3)
    side = (width - drawer[0]) / 2
    parts.append(box(drawer, (side, rng.uniform(-0.2, 0.2), -drawer[2] / 2)))
    if rng.random() < 0.5:
        things = rng.uniform(0.1, 0.4, 3)
        parts.append(box(things, (-side * rng.random(), depth / 4, 0.08 + things[2] / 2)))
    return union(*parts)


def chair(rng: Generator) -> Triangles:
    """Seat, back, legs, and sometimes one or two arms."""
    width, depth, height = rng.uniform(0.8, 1.2), rng.uniform(0.8, 1.1), rng.uniform(0.6, 1.0)
    back, lean = rng.uniform(0.7, 1.3), rng.uniform(0.0, 0.3)
    panel = place(
        box((0.08, width, back), (0, 0, back / 2)),
        offset=(-depth / 2, 0, 0),
        rotation=Rotation.from_euler("y", -lean).as_matrix(),
    )
    parts = [box((depth, width, 0.1)), panel, _legs(rng, depth, width, height)]
    for side in (-1, 1)[: rng.integers(0, 3)]:
        parts.append(box((0.8 * depth, 0.08, 0.08), (0, side * width / 2, 0.35)))
        parts.append(box((0.08, 0.08, 0.35), (0.35 * depth, side * width / 2, 0.175)))
    return union(*parts)


def mug(rng: Generator) -> Triangles:
    """An open vessel with a handle."""
    radius, height = rng.uniform(0.4, 0.7), rng.uniform(0.7, 1.3)
    top = radius * rng.uniform(0.9, 1.3)
    wall = 0.9
    profile = [(0, 0), (radius, 0), (top, height), (wall * top, height), (wall * radius, 0.08)]
    angle = np.linspace(-np.pi / 2, np.pi / 2, 14)
    reach, tall = rng.uniform(0.25, 0.5), rng.uniform(0.2, 0.4) * height
    curve = np.stack([reach * np.cos(angle), 0 * angle, tall * np.sin(angle)], axis=1)
    handle = tube(curve, rng.uniform(0.04, 0.1))
    start = (radius + top) / 2 * 0.97
    return union(
        revolve([*profile, (0, 0.08)]),
        place(handle, offset=(start, 0, rng.uniform(0.4, 0.6) * height)),
    )


def lamp(rng: Generator) -> Triangles:
    """Foot, a bent stem and a shade off to one side."""
    height, reach = rng.uniform(1.2, 2.0), rng.uniform(0.2, 0.8)
    s = np.linspace(0, 1, 16)
    curve = np.stack([reach * s**3, 0 * s, height * np.sin(s * rng.uniform(1.2, 1.9))], axis=1)
    wide = rng.uniform(0.25, 0.5)
    shade = revolve([(wide, -0.3), (wide * rng.uniform(0.2, 0.7), 0.2), (0, 0.2)])
    tilt = Rotation.from_euler("y", rng.uniform(-0.6, 0.6)).as_matrix()
    foot = box((*rng.uniform(0.4, 0.8, 2), 0.1))
    return union(foot, tube(curve, 0.04), place(shade, offset=curve[-1], rotation=tilt))


def airplane(rng: Generator) -> Triangles:
    """Fuselage, swept wings, fin, tailplane and engines."""
    length, radius = rng.uniform(2.0, 3.0), rng.uniform(0.15, 0.3)
    x = np.linspace(-0.5, 0.5, 18)
    girth = radius * np.sqrt(np.clip(1 - np.abs(2 * x) ** rng.uniform(2, 5), 0, 1)) + 0.01
    body = tube(np.stack([length * x, 0 * x, 0.3 * radius * x**2], axis=1), girth)
    span, sweep = rng.uniform(0.8, 1.5), rng.uniform(0.1, 0.8)
    root = rng.uniform(0.3, 0.6)
    parts = [body]
    for side in (-1, 1):
        parts.append(_wing((0.1, 0, -0.05), (0.1 - sweep, side * span, 0.1), root))
        parts.append(_wing((-0.45 * length, 0, 0.1), (-0.6 * length, side * 0.5, 0.15), 0.25))
        engine = place(cylinder(0.08, 0.35, top=0.1), rotation=_TO_X)
        parts.append(place(engine, offset=(0.1 - sweep / 3, side * span / 2, -0.1)))
    parts.append(_wing((-0.45 * length, 0, 0), (-0.55 * length, 0, rng.uniform(0.4, 0.8)), 0.35))
    return union(*parts)


def _wing(root, tip, chord: float) -> Triangles:
    """A thin blade from root to tip, its chord along x halved on the way."""
    ring = [(0.5, 0.0), (0.0, 0.04), (-0.5, 0.0), (0.0, -0.04), (0.5, 0.0)]
    direction = np.subtract(tip, root)
    across = np.cross((1, 0, 0), direction / np.linalg.norm(direction))
    section = np.array([x * chord * np.array((1, 0, 0)) + y * across for x, y in ring])
    end = section * 0.5 + tip
    return from_grid(np.stack([section + root, end, np.broadcast_to(end.mean(0), end.shape)]))


def shelf(rng: Generator) -> Triangles:
    """A bookcase: sides, boards, a back, and books of different sizes."""
    width, depth, height = rng.uniform(0.8, 1.6), rng.uniform(0.3, 0.5), rng.uniform(1.2, 2.2)
    parts = [box((0.05, depth, height), (i * width / 2, 0, 0)) for i in (-1, 1)]
    parts.append(box((width, 0.03, height), (0, depth / 2, 0)))
    for level in np.linspace(-height / 2, height / 2, rng.integers(3, 6)):
        parts.append(box((width, depth, 0.05), (0, 0, level)))
        size = (*rng.uniform(0.2, 0.5, 1) * width, 0.7 * depth, rng.uniform(0.1, 0.35))
        x = rng.uniform(-0.25, 0.25) * width
        parts.append(box(size, (x, 0, level + size[2] / 2)))
    return union(*parts)


def car(rng: Generator) -> Triangles:
    """Body, cabin towards the rear, four wheels."""
    length, width, height = rng.uniform(1.8, 2.6), rng.uniform(0.8, 1.1), rng.uniform(0.3, 0.6)
    round_ = rng.uniform(0.15, 0.5, 2)
    body = superellipsoid((length / 2, width / 2, height / 2), round_)
    cabin = superellipsoid((length * rng.uniform(0.2, 0.32), 0.45 * width, 0.35), round_)
    parts = [body, place(cabin, offset=(-rng.uniform(0.05, 0.2) * length, 0, height / 2))]
    radius = rng.uniform(0.18, 0.28)
    wheel = place(cylinder(radius, 0.15), rotation=_TO_Y)
    for x in (-0.32, 0.32):
        for side in (-1, 1):
            parts.append(place(wheel, offset=(x * length, side * width / 2, -height / 2)))
    return union(*parts)


def plant(rng: Generator) -> Triangles:
    """A pot, a stem and leaves or twigs."""
    parts = [cylinder(rng.uniform(0.2, 0.35), 0.5, top=rng.uniform(0.3, 0.45))]
    for _ in range(rng.integers(4, 9)):
        azimuth, reach, rise = rng.uniform(0, 6.3), rng.uniform(0.4, 1.0), rng.uniform(0.5, 1.5)
        s = np.linspace(0, 1, 10)
        out = reach * s**1.5
        curve = [out * np.cos(azimuth), out * np.sin(azimuth), 0.2 + rise * s - 0.4 * s**3]
        leaf = 0.02 + rng.uniform(0.05, 0.2) * np.sin(np.pi * s) ** 2
        parts.append(tube(np.stack(curve, axis=1), leaf, sections=6))
    return union(*parts)


def house(rng: Generator) -> Triangles:
    """Walls, a gable roof, a chimney and an annexe."""
    width, depth, height = rng.uniform(0.8, 1.4), rng.uniform(1.0, 1.8), rng.uniform(0.5, 1.0)
    ridge = rng.uniform(0.3, 0.8)
    gable = np.array([(-0.6 * width, -ridge / 3), (0.6 * width, -ridge / 3), (0, 2 * ridge / 3)])
    roof = place(
        prism(gable, 1.1 * depth), rotation=Rotation.from_euler("x", 90, degrees=True).as_matrix()
    )
    annexe = rng.uniform(0.3, 0.6, 3)
    return union(
        box((width, depth, height), (0, 0, height / 2)),
        place(roof, offset=(0, 0, height + ridge / 3)),
        box((0.15, 0.15, 0.5), (0.3 * width, rng.uniform(-0.4, 0.4) * depth, height + ridge * 0.8)),
        box(annexe, (width / 2 + annexe[0] / 2, rng.uniform(-0.3, 0.3) * depth, annexe[2] / 2)),
    )


def guitar(rng: Generator) -> Triangles:
    """A waisted body, neck and head."""
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    waist = 1 + rng.uniform(0.15, 0.3) * np.cos(2 * angle) - 0.1 * np.cos(angle)
    outline = 0.5 * waist[:, None] * np.stack([np.cos(angle), 0.8 * np.sin(angle)], axis=1)
    body = prism(outline, rng.uniform(0.12, 0.25))
    length = rng.uniform(0.8, 1.3)
    neck = box((length, 0.12, 0.06), (0.4 + length / 2, 0, 0.08))
    head = box((0.3, rng.uniform(0.18, 0.3), 0.05), (0.5 + length, rng.uniform(-0.05, 0.05), 0.04))
    bridge = box((0.08, 0.3, 0.06), (-0.25, rng.uniform(-0.05, 0.05), 0.12))
    return union(body, neck, head, bridge)


def monitor(rng: Generator) -> Triangles:
    """A screen on a stand, tilted, sometimes with a box below."""
    width, height = rng.uniform(1.2, 2.0), rng.uniform(0.8, 1.2)
    tilt = Rotation.from_euler("y", rng.uniform(-0.3, 0.1)).as_matrix()
    screen = union(box((0.1, width, height)), box((0.2, 0.5 * width, 0.5 * height), (-0.12, 0, 0)))
    stand = box((0.08, rng.uniform(0.1, 0.3), 0.6), (-0.15, 0, -height / 2 - 0.1))
    foot = box((rng.uniform(0.4, 0.7), rng.uniform(0.4, 0.9), 0.06), (-0.1, 0, -height / 2 - 0.4))
    extra = rng.uniform(0.15, 0.4, 3)
    parts = [place(screen, rotation=tilt), stand, foot]
    return union(*parts, box(extra, (0.2, 0.5 * width * rng.random(), -height / 2 - 0.4)))


FAMILIES = (
    stairs,
    table,
    chair,
    mug,
    lamp,
    airplane,
    shelf,
    car,
    plant,
    house,
    guitar,
    monitor,
)
"""The labels after those of the solids."""
