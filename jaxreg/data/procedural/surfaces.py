"""Triangle surfaces for the procedural shapes: primitives, deformation, uniform samples.

A surface is the array (t, 3, 3) of its triangles' corners, so a union is a concatenation. z is up.
Nothing here needs a watertight mesh: only the area of the triangles counts.
"""

import numpy as np
from numpy.random import Generator

Triangles = np.ndarray
"""Corners of triangles, (t, 3, 3) float64."""


def from_grid(vertices: np.ndarray) -> Triangles:
    """Two triangles for every cell of a grid (a, b, 3) of surface points."""
    p, q = vertices[:-1, :-1], vertices[1:, :-1]
    r, s = vertices[1:, 1:], vertices[:-1, 1:]
    cells = np.stack([np.stack([p, q, r], axis=2), np.stack([p, r, s], axis=2)])
    return cells.reshape(-1, 3, 3)


def union(*surfaces: Triangles) -> Triangles:
    """All of them as one surface; parts inside others are kept, as in most CAD models."""
    return np.concatenate(surfaces)


def place(
    surface: Triangles, *, offset=(0.0, 0.0, 0.0), rotation: np.ndarray | None = None
) -> Triangles:
    """The surface rotated, then moved."""
    rotated = surface if rotation is None else surface @ rotation.T
    return rotated + np.asarray(offset)


def box(size, centre=(0.0, 0.0, 0.0)) -> Triangles:
    """A box of edge lengths `size` about `centre`."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    return place(prism(square * np.asarray(size)[:2], size[2]), offset=centre)


def prism(outline: np.ndarray, height: float) -> Triangles:
    """The outline (n, 2), star-shaped about the origin, extruded along z from -h/2 to +h/2."""
    ring = np.concatenate([outline, outline[:1]])
    levels = [(0.0, -height / 2), (1.0, -height / 2), (1.0, height / 2), (0.0, height / 2)]
    rows = [np.column_stack([scale * ring, np.full(len(ring), z)]) for scale, z in levels]
    return from_grid(np.stack(rows))


def revolve(profile, *, sections: int = 24, turn: float = 2 * np.pi) -> Triangles:
    """The profile of (radius, z) rows turned about the z axis."""
    radius, z = np.asarray(profile, float).T
    angle = np.linspace(0, turn, sections + 1)[:, None]
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    return from_grid(np.stack([x, y, np.broadcast_to(z, x.shape)], axis=-1))


def cylinder(radius: float, height: float, *, top: float | None = None) -> Triangles:
    """A closed cylinder about z from -h/2 to +h/2; a frustum or cone with another `top` radius."""
    top = radius if top is None else top
    half = height / 2
    return revolve([(0, -half), (radius, -half), (top, half), (0, half)])


def superellipsoid(radii, exponents, *, resolution: int = 24) -> Triangles:
    """Radii along the axes; exponents (vertical, horizontal): 1 round, near 0 boxy, 2 a diamond."""

    def power(values, exponent):
        return np.sign(values) * np.abs(values) ** exponent

    elevation = np.linspace(-np.pi / 2, np.pi / 2, resolution // 2 + 1)[:, None]
    azimuth = np.linspace(-np.pi, np.pi, resolution + 1)[None, :]
    level = power(np.cos(elevation), exponents[0])
    x = level * power(np.cos(azimuth), exponents[1])
    y = level * power(np.sin(azimuth), exponents[1])
    z = np.broadcast_to(power(np.sin(elevation), exponents[0]), x.shape)
    return from_grid(np.stack([x, y, z], axis=-1) * np.asarray(radii))


def tube(curve: np.ndarray, radius, *, sections: int = 10) -> Triangles:
    """A tube about the curve (k, 3), radius (k,) or one number, closed at both ends."""
    tangent = np.gradient(curve, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.empty_like(curve)
    normal[0] = np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    normal[0] /= np.linalg.norm(normal[0])
    for i in range(1, len(curve)):  # Carried along to keep the tube from twisting.
        normal[i] = normal[i - 1] - (normal[i - 1] @ tangent[i]) * tangent[i]
        normal[i] /= np.linalg.norm(normal[i])
    binormal = np.cross(tangent, normal)
    angle = np.linspace(0, 2 * np.pi, sections + 1)[None, :, None]
    radial = normal[:, None] * np.cos(angle) + binormal[:, None] * np.sin(angle)
    ring = curve[:, None] + np.broadcast_to(radius, len(curve))[:, None, None] * radial
    ends = [np.broadcast_to(curve[i], (1, sections + 1, 3)) for i in (0, -1)]
    return from_grid(np.concatenate([ends[0], ring, ends[1]]))


def sample(rng: Generator, surface: Triangles, points: int) -> np.ndarray:
    """Points (points, 3), independent and uniform by area."""
    edge1, edge2 = surface[:, 1] - surface[:, 0], surface[:, 2] - surface[:, 0]
    area = np.linalg.norm(np.cross(edge1, edge2), axis=1)
    cumulative = np.cumsum(area)
    chosen = np.searchsorted(cumulative, rng.random(points) * cumulative[-1], side="right")
    chosen = np.minimum(chosen, len(surface) - 1)
    u, v = rng.random((2, points, 1))
    fold = u + v > 1  # The other half of the parallelogram, folded back onto the triangle.
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    return surface[chosen, 0] + u * edge1[chosen] + v * edge2[chosen]


def warp(rng: Generator, surface: Triangles, *, amount: float) -> Triangles:
    """A random shear, stretch and taper that leaves no exact symmetry: ``A x / (1 + w.x)``.

    A projective map, so planes stay flat. `amount`, well below 1, is the size of A - I and w on a
    surface inside the unit sphere.
    """
    affine = np.eye(3) + amount / 2 * rng.normal(size=(3, 3))
    taper = rng.normal(size=3)
    taper *= amount / np.linalg.norm(taper)
    return surface @ affine.T / (1 + surface @ taper)[..., None]
