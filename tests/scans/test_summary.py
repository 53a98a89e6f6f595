"""A registration in words and figures."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.judge.evidence import Evidence
from jaxreg.refine.uncertainty import WeakDirection
from jaxreg.scans import summary
from jaxreg.scans.result import Alternative, ScanRegistration
from jaxreg.types import RigidTransform

SLIDE = WeakDirection("translation", np.array([1.0, 0, 0]), np.zeros(3), 1e-4)
TURN = WeakDirection("rotation", np.array([0.0, 0, 1]), np.zeros(3), 2e-4)

EVIDENCE = Evidence(0.5, 0.6, np.inf, 0.7, 0.8, 0.1, 0.2, 0.05, 0.3, 0.15, 0.02)


@pytest.fixture
def result(seed):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(rng=rng).as_matrix()
    return ScanRegistration(
        rotation=rotation,
        translation=np.array([1e6, -2.0, 0.5]),
        transformation=np.eye(4),
        confidence=np.array([0.0, 1.0, 0.5]),
        correspondences=np.full((3, 3), np.nan),
        max_correspondence_distance=0.1,
        reason="Only 60% of the points lie near the other cloud.",
        alternatives=(),
        converged=True,
        fitness=0.8,
        inlier_rmse=0.02,
        overlap=0.6,
        covariance=np.diag([1e-6, 4e-6, 1e-6, 1e-4, 9e-4, 1e-4]),
        weak_directions=(SLIDE, TURN),
        success=False,
        probability=0.25,
        evidence=EVIDENCE,
        dropped=2,
        notes=(),
    )


def test_verdict_says_which_and_how_sure(result):
    assert (
        summary.verdict_line(result) == "not trustworthy (probability 0.25 that the pose is right)"
    )
    good = dataclasses.replace(result, success=True, probability=0.9)
    assert summary.verdict_line(good) == "success (probability 0.90)"


def test_figures_have_units(result):
    told = summary.figures(result)
    degrees = np.degrees(Rotation.from_matrix(result.rotation).magnitude())
    assert told["rotation"] == f"{degrees:.3f} deg"
    # The largest standard deviations: 2e-3 rad and 0.03.
    assert told["one sigma"] == f"{np.degrees(2e-3):.2g} deg, 0.03"
    assert told["weak directions"] == f"{SLIDE.name}\n{TURN.name}"
    assert told["translation"] == "1000000, -2, 0.5"


def test_nothing_is_claimed_without_a_refinement(result):
    told = summary.figures(
        dataclasses.replace(result, covariance=np.full((6, 6), np.nan), weak_directions=())
    )
    assert told["one sigma"] == told["weak directions"] == summary._UNKNOWN
    exact = summary.figures(
        dataclasses.replace(result, covariance=np.zeros((6, 6)), weak_directions=())
    )
    assert (exact["one sigma"], exact["weak directions"]) == ("0 deg, 0", "none")


def test_other_poses_are_named_where_they_may_be_right(result):
    assert summary.figures(result)["alternatives"] == "none that may be right"
    turns = [Rotation.from_rotvec(np.radians([0, 0, angle])) for angle in (180, 90, 20)]
    alternatives = tuple(
        Alternative(RigidTransform(turn.as_matrix() @ result.rotation, np.zeros(3)), chance)
        for turn, chance in zip(turns, (0.4, 0.125, 0.01), strict=True)
    )
    found = dataclasses.replace(result, alternatives=alternatives)
    told = summary.figures(found)["alternatives"]
    assert told == "0.40 turned by 180 deg; 0.12 turned by 90 deg"
    listed = summary.record(found)["alternatives"]
    assert [other["probability"] for other in listed] == [0.4, 0.125, 0.01]
    assert listed[0]["transform"]["rotation"] == alternatives[0].transform.rotation.tolist()


def test_record_is_json_and_reads_back(result):
    text = json.dumps(summary.record(result), allow_nan=False)
    read = json.loads(text)
    assert read["evidence"] == EVIDENCE._asdict() | {"distance": None}
    np.testing.assert_array_equal(read["rotation"], result.rotation)
    assert [found["name"] for found in read["weak_directions"]] == [SLIDE.name, TURN.name]
    assert read["weak_directions"][1]["axis"] == [0, 0, 1]
    assert read["mean_confidence"] == 0.5
    assert "confidence" not in read


def test_matrix_text_keeps_twelve_digits_aligned(seed):
    matrix = np.random.default_rng(seed).normal(size=(4, 4)) * 10.0 ** np.array([0, -7, 3, 6])
    lines = summary.matrix_text(matrix).splitlines()
    np.testing.assert_allclose(
        [[float(x) for x in line.split()] for line in lines], matrix, rtol=1e-11
    )
    assert max(map(len, lines)) <= 80


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, np.pi])
def test_axis_angle_is_the_rotation(seed, angle):
    axis = np.random.default_rng(seed).normal(size=3)
    axis /= np.linalg.norm(axis)
    rotation = Rotation.from_rotvec(angle * axis).as_matrix()
    found, size = summary.axis_angle(rotation)
    assert size == pytest.approx(angle, abs=1e-12)
    assert np.linalg.norm(found) == pytest.approx(1)
    np.testing.assert_allclose(Rotation.from_rotvec(size * found).as_matrix(), rotation, atol=1e-12)
