"""What is said of odd clouds, and that nothing is said of others."""

import re

import numpy as np
import pytest

from jaxreg.scans import diagnosis

UTM = np.array([452000.0, 5411000.0, 250.0])


@pytest.fixture
def surface():
    """An ellipsoid of 5, 4, 3 metres, 5000 points about 0.2 apart."""
    points = np.random.default_rng(1).normal(size=(5000, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * [5, 4, 3]


def test_nothing_is_odd_about_good_clouds(surface):
    x, y = np.meshgrid(np.arange(60.0), np.arange(40.0))
    terrain = np.stack([x, y, np.sin(x / 5) + np.cos(y / 7)], axis=-1).reshape(-1, 3)
    voxels = np.unique((surface * 4).round(), axis=0)
    for cloud in (surface, surface + UTM, (surface + UTM).round(3), terrain, terrain + UTM, voxels):
        assert diagnosis.findings(cloud) == []


ODD = {
    "single precision": (
        lambda p: (p + UTM).astype(np.float32).astype(float),
        "y comes in steps of 0.5",
    ),
    "ten metres": (
        lambda p: np.array([[float(f"{v:.6g}") for v in row] for row in p * 40 + UTM]),
        "y comes in steps of 10",
    ),
    "whole metres": (lambda p: (p * 3 + UTM).round(), "comes in steps of 1"),
    "twice": (lambda p: np.concatenate([p, p]), "50% of the points repeat others"),
    "flat": (lambda p: p * [1, 1, 0] + UTM, "two-dimensional: z is the same"),
    "planar": (lambda p: p @ np.diag([1, 1, 1e-4]) @ ROTATION.T, "planar"),
    "thin": (lambda p: p * [1, 1e-3, 1e-3], "thin"),
    "two points": (lambda p: p[[0, 1, 0, 1]], "only 2 distinct points"),
    "from one station": (
        lambda p: p * (10 ** np.random.default_rng(0).uniform(0, 2.5, (len(p), 1))),
        "uneven",
    ),
}  # fmt: skip
ROTATION = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]


@pytest.mark.parametrize("name", ODD)
def test_odd_clouds_are_told(surface, name):
    change, told = ODD[name]
    assert any(told in finding for finding in diagnosis.findings(change(surface)))


@pytest.mark.parametrize(
    ("factor", "told"),
    [
        (1000, "1,000 times .* metres and millimetres"),
        (25.4, "inches and millimetres"),
        (1 / 304.8, "the first is 305 times the size of the second: .* feet and millimetres"),
        (100, "metres and centimetres"),
        (3.2808, "metres and feet"),
        (0.8, "the first is 1.25 times the size of the second: .* scales differ"),
        (1.2, "the second is 1.2 times"),
    ],
)
def test_sizes_that_differ_are_told(surface, factor, told):
    other = factor * surface @ ROTATION.T + UTM
    (found,) = diagnosis.compared(surface, other, ("first", "second"))
    assert re.search(told, found)


def test_sizes_alike_and_strays_say_nothing(surface):
    stray = np.concatenate([surface + UTM, np.zeros((1, 3))])
    assert diagnosis.compared(surface, stray) == []
    assert diagnosis.compared(surface, 1.05 * surface) == []
    assert diagnosis.compared(surface, np.zeros((5, 3))) == []
