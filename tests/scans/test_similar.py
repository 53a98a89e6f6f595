"""A source at another size: the scale is found, with its deviation, where it is asked for."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural import shapes
from jaxreg.scans.pair import register
from tests.scenes import angle_deg

TURN = Rotation.from_euler("xyz", [20, -30, 75], degrees=True).as_matrix()
SHIFT = np.array([3.0, -1.0, 2.0])


def resized(scale, *, points=6000, seed=0):
    """Two samplings of a table, the second the size times `scale`, in another frame."""
    cloud = shapes.sample_shape(5, 9, points=points).astype(np.float64)
    cloud += np.random.default_rng(seed).normal(size=cloud.shape) * 0.002
    half = points // 2
    return cloud[:half], scale * cloud[half:] @ TURN.T + SHIFT


def test_scale_from_a_start():
    source, reference = resized(0.96)
    start = np.eye(4)
    start[:3, :3] = Rotation.from_euler("z", 1, degrees=True).as_matrix() @ TURN
    start[:3, 3] = reference.mean(axis=0) - start[:3, :3] @ source.mean(axis=0)
    found = register(source, reference, initial=start, scale=True)
    assert abs(found.scale - 0.96) < max(4 * found.scale_sigma, 1e-4)
    assert 0 < found.scale_sigma < 0.01
    assert angle_deg(found.rotation, TURN) < 0.3
    np.testing.assert_allclose(found.transformation[:3, :3], found.scale * found.rotation)
    at = found.transformation[:3, :3] @ source.mean(axis=0) + found.translation
    expected = 0.96 * TURN @ source.mean(axis=0) + SHIFT
    assert np.linalg.norm(at - expected) < 0.005
    assert found.success
    alone = register(source, reference, initial=start)
    assert alone.scale == 1
    assert alone.scale_sigma == 0


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.8, 1.25, 1000.0])
def test_scale_without_a_start(scale):
    source, reference = resized(scale)
    found = register(source, reference, scale=True)
    assert abs(found.scale / scale - 1) < 0.005
    assert angle_deg(found.rotation, TURN) < 0.5
    assert found.success


@pytest.mark.slow
def test_scale_of_an_outline():
    angle = np.linspace(0, 2 * np.pi, 1400, endpoint=False)
    radius = 5 + np.cos(2 * angle) + 0.6 * np.sin(3 * angle)
    outline = np.column_stack([np.cos(angle), np.sin(angle)]) * radius[:, None]
    turn = Rotation.from_euler("z", 50, degrees=True).as_matrix()
    reference = 1.3 * outline[1::2] @ turn[:2, :2].T + [30, 4]
    found = register(outline[::2], reference, scale=True)
    assert abs(found.scale - 1.3) < 0.005
    assert angle_deg(found.rotation, turn) < 0.3
