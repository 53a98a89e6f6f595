"""The check of clouds is tested through `register`; here padding, and the nearest rotation."""

import numpy as np
import pytest

from jaxreg.geometry import clouds
from jaxreg.geometry.rigid import nearest_rotation


@pytest.mark.parametrize(
    ("count", "size"), [(1, 128), (128, 128), (129, 256), (1000, 1024), (0, 128)]
)
def test_sizes_are_few(count, size):
    assert clouds.padded_size(count, smallest=128) == size


def test_padding():
    rows, mask = clouds.padded(np.ones((3, 3)), 8)
    assert rows.dtype == np.float32
    np.testing.assert_array_equal(mask, [1, 1, 1, 0, 0, 0, 0, 0])
    assert not rows[3:].any()


def test_nearest_rotation_of_a_mirror_is_a_rotation():
    turned = nearest_rotation(np.diag([1.0, 1, -1]))
    assert np.linalg.det(turned) == pytest.approx(1)
