import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural import surfaces


def area(surface):
    return sum(np.linalg.norm(np.cross(b - a, c - a)) / 2 for a, b, c in surface)


def volume(surface):
    """By the divergence theorem: right only for a closed surface of consistent orientation."""
    return abs(sum(np.dot(a, np.cross(b, c)) for a, b, c in surface)) / 6


TURN = np.linspace(0, 2 * np.pi, 201)
CIRCLE = np.stack([np.cos(TURN), np.sin(TURN), 0 * TURN], axis=1)
LINE = np.linspace(0, 1, 11)[:, None] * np.array([0.0, 0.0, 3.0])
HEXAGON = np.stack([np.cos(TURN[:-1:33][:6]), np.sin(TURN[:-1:33][:6])], axis=1)


@pytest.mark.parametrize(
    ("surface", "expected_area", "expected_volume"),
    [
        (surfaces.box((1.0, 2.0, 3.0), (5.0, 6.0, 7.0)), 22.0, 6.0),
        (surfaces.cylinder(2.0, 3.0), 2 * np.pi * 2 * 5, np.pi * 4 * 3),
        (surfaces.cylinder(3.0, 4.0, top=0.0), np.pi * 3 * 8, np.pi * 9 * 4 / 3),
        (
            surfaces.superellipsoid((2.0, 2.0, 2.0), (1, 1), resolution=80),
            16 * np.pi,
            32 * np.pi / 3,
        ),
        (surfaces.superellipsoid((1.0, 2.0, 3.0), (2, 2), resolution=80), None, 8.0),
        (surfaces.tube(LINE, 0.5, sections=60), 2 * np.pi * 0.5 * 3.5, np.pi * 0.25 * 3),
        (surfaces.tube(CIRCLE, 0.2, sections=40), 4 * np.pi**2 * 0.2, 2 * np.pi**2 * 0.04),
        (surfaces.prism(HEXAGON, 2.0), None, None),
        (surfaces.revolve([(0, 0), (1, 0), (1, 2), (0, 2)], sections=200), 6 * np.pi, 2 * np.pi),
    ],
)
def test_area_and_volume_of_primitives(surface, expected_area, expected_volume):
    assert surface.shape[1:] == (3, 3)
    if expected_area is not None:
        assert area(surface) == pytest.approx(expected_area, rel=0.04)
    if expected_volume is not None:
        assert volume(surface) == pytest.approx(expected_volume, rel=0.04)
    # A volume that does not depend on the origin says that the surface is closed.
    assert volume(surface + 10.0) == pytest.approx(volume(surface), rel=1e-6)


def test_place_rotates_then_moves(seed):
    surface = surfaces.box((1.0, 2.0, 3.0))
    rotation = Rotation.random(rng=seed).as_matrix()
    placed = surfaces.place(surface, offset=(1.0, 2.0, 3.0), rotation=rotation)
    expected = [[rotation @ corner + [1, 2, 3] for corner in triangle] for triangle in surface]
    np.testing.assert_allclose(placed, expected, atol=1e-12)
    both = surfaces.union(surface, placed)
    assert area(both) == pytest.approx(44.0)


def test_samples_are_uniform_by_area(seed):
    rng = np.random.default_rng(seed)
    # A long and a short triangle in one plane, joined to the unit square.
    square = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]], float)
    points = surfaces.sample(rng, square, 5000)
    for axis in points[:, :2].T:
        assert stats.kstest(axis, stats.uniform(0, 1).cdf).pvalue > 1e-3
    assert abs(np.corrcoef(points[:, 0], points[:, 1])[0, 1]) < 0.05
    unequal = surfaces.union(square, 3 * square[:1] + 10)
    share = np.mean(surfaces.sample(rng, unequal, 5000)[:, 0] > 5)
    assert share == pytest.approx(4.5 / 5.5, abs=0.03)


def test_samples_never_land_on_triangles_without_area(seed):
    rng = np.random.default_rng(seed)
    surface = np.zeros((5, 3, 3))
    surface[2] = [[1, 0, 0], [2, 0, 0], [1, 1, 0]]
    assert surfaces.sample(rng, surface, 1000)[:, 0].min() >= 1


def test_warp_keeps_planes_flat_and_breaks_the_symmetry(seed):
    rng = np.random.default_rng(seed)
    plane = surfaces.from_grid(
        np.stack(np.meshgrid(*2 * [np.linspace(-0.5, 0.5, 9)], [0.3]), -1)[..., 0, :]
    )
    corners = surfaces.warp(rng, plane, amount=0.15).reshape(-1, 3)
    assert np.linalg.svd(corners - corners.mean(axis=0))[1][2] < 1e-12
    edges = surfaces.warp(rng, surfaces.box((0.5, 0.5, 0.5)), amount=0.15)
    lengths = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    assert np.ptp(lengths[lengths > 0.2]) > 0.01
