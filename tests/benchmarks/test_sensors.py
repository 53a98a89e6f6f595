"""The table of the sensors: what is right, and the calibration of what was said of it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.scans import sensors
from jaxreg.types import RigidTransform

pytestmark = pytest.mark.float32


def entries(probability, *, right, wrong):
    return [{"probability": probability, "right": k < right} for k in range(right + wrong)]


def test_calibration_error_is_how_far_the_promise_is_from_the_count():
    kept = entries(0.75, right=3, wrong=1)
    broken = entries(0.95, right=0, wrong=12)
    assert sensors.calibration_error(kept) == pytest.approx(0)
    assert sensors.calibration_error(broken) == pytest.approx(0.95)
    assert sensors.calibration_error(kept + broken) == pytest.approx(0.95 * 12 / 16)


def test_every_pair_is_in_one_bin_and_certainty_in_the_last():
    rows = sensors.reliability([*entries(0.0, right=0, wrong=2), *entries(1.0, right=3, wrong=1)])
    assert [row["pairs"] for row in rows.values()] == [2, *[0] * (sensors.BINS - 2), 4]
    assert rows["bin9"]["right"] == 0.75
    assert rows["bin5"]["right"] is None


@pytest.mark.parametrize(("times", "right"), [(0.9, True), (1.1, False)])
def test_a_pose_is_right_within_the_tolerance_at_the_centre(times, right):
    centre = np.array([10.0, 0, 0])
    pair = sensors.TruePair("", np.zeros((1, 3)), np.zeros((1, 3)), np.eye(4), 1, (5, 0.5), centre)
    moved = RigidTransform(np.eye(3), np.array([0, 0.5 * times, 0]))
    assert pair.is_right(moved) is right
    turn = Rotation.from_euler("z", 5 * times, degrees=True).as_matrix()
    about_centre = RigidTransform(turn, centre - turn @ centre)
    assert pair.is_right(about_centre) is right
