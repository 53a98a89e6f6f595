"""NEES of poses whose errors have the covariance that is said."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.scans import covariance
from jaxreg.scans.pair import register
from jaxreg.types import Pair, PointCloud, RigidTransform
from tests.scenes import shape


def test_normal_errors_of_that_covariance_have_a_mean_of_one(seed):
    """The truth is drawn about the pose that is found; that no axis is mixed up shows in the mean."""
    rng = np.random.default_rng(seed)
    reference = shape(rng, 400) + 1.0
    found = register(reference - [0.2, 0.1, 0.3], reference)
    spread = rng.normal(size=(6, 6)) * np.repeat([1e-3, 4e-3], 3)[:, None]
    stated = spread @ spread.T
    object.__setattr__(found, "covariance", stated)
    centre, values = reference.mean(axis=0), []
    for _ in range(2000):
        error = spread @ rng.normal(size=6)
        turn = Rotation.from_rotvec(error[:3]).as_matrix()
        truth = RigidTransform(
            turn @ found.rotation, turn @ (found.translation - centre) + centre + error[3:]
        )
        pair = Pair(PointCloud(reference, None), PointCloud(reference, None), truth)
        values.append(covariance.nees(found, pair))
    assert np.mean(values) == pytest.approx(1, abs=0.06)
    assert np.median(values) == pytest.approx(0.89, abs=0.06)


def test_wrong_poses_are_left_out_and_counted():
    cells = covariance.summary([1.0, None, 5.0])
    assert (cells["pairs"], cells["right"], cells["mean"], cells["above_3"]) == (3, 2, 3.0, 0.5)
