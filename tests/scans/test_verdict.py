"""Why a pose is not trusted, in words."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.judge.evidence import Evidence
from jaxreg.refine.uncertainty import WeakDirection
from jaxreg.scans import verdict
from jaxreg.scans.pair import register

GOOD = Evidence(
    smaller=0.9, larger=0.95, distance=0.15, rough_distance=0.2, rough_facing=0.95,
    disagreement=0.02, beside=0.1, unseen=0.01, rough=0.4, ends=0.05, held=0.2,
)  # fmt: skip
SLIDE = WeakDirection("translation", np.array([1.0, 0, 0]), np.zeros(3), 1e-4)
TURN = WeakDirection("rotation", np.array([0.0, 0, 1]), np.zeros(3), 2e-4)


@pytest.mark.parametrize(("n", "m"), [(50, 40), (60, 20)])
def test_a_tilted_raster_of_a_plane_is_no_success(n, m):
    """Its points coincide under several poses; none of them is held by the surfaces."""
    flat = np.stack(np.meshgrid(np.arange(float(n)), np.arange(float(m)), [0.0]), -1).reshape(-1, 3)
    turn = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix()
    found = register(flat, flat @ turn.T + [0.3, -0.2, 0.5])
    assert found.weak_directions
    assert not found.success
    assert "leave the pose free: " in found.reason


def test_a_motion_that_the_refinement_leaves_free_is_free_whatever_the_evidence_says():
    assert not verdict.is_free(GOOD, (SLIDE, TURN)), "weak, but not free"
    free = SLIDE._replace(strength=1e-9)
    assert verdict.is_free(GOOD, (TURN, free))
    assert "leave the pose free: translation" in verdict.reason(GOOD, (free,), 0.0)


def test_planes_leave_the_pose_free_and_say_which_motions():
    """What `held` is for a plane is tested with the evidence: about a millionth."""
    free = GOOD._replace(held=1e-6)
    assert verdict.is_free(free)
    assert not verdict.is_free(GOOD)
    told = verdict.reason(free, (SLIDE, TURN), 0.9)
    assert told == f"The surfaces leave the pose free: {SLIDE.name}, {TURN.name}."
    assert verdict.reason(free, (), 0.0) == "The surfaces leave the pose free: a motion."


def test_a_rival_is_named_before_what_else_is_missing():
    poor = GOOD._replace(smaller=0.01)
    assert "see alternatives" in verdict.reason(poor, (), 0.5)
    assert "see alternatives" not in verdict.reason(poor, (), 0.01)


@pytest.mark.parametrize(
    ("wanting", "told"),
    [
        ({"smaller": 0.01}, "Only 1% of one of the clouds lies near the other."),
        ({"rough_facing": 0.0}, "The surfaces face different ways where they are rough."),
        ({"disagreement": 0.93}, "93% of the points that lie near the other cloud do not"),
        ({"unseen": 1.5}, "should have been seen there too"),
    ],
)
def test_the_reason_is_what_falls_shortest(monkeypatch, wanting, told):
    """With one weight for all that speaks for a pose: the fitted ones decide which is shortest."""
    weights = Evidence(2.0, 0.0, -2.0, -4.0, 8.0, -8.0, 0.0, -30.0, 0.0, 0.0, 1.0)
    monkeypatch.setattr(verdict, "WEIGHTS", weights)
    assert told in verdict.reason(GOOD._replace(**wanting), (), 0.0)


def test_a_weak_motion_is_named(monkeypatch):
    only = Evidence(*np.eye(len(Evidence._fields))[Evidence._fields.index("held")])
    monkeypatch.setattr(verdict, "WEIGHTS", only)
    slack = GOOD._replace(held=1e-4)
    assert verdict.reason(slack, (TURN,), 0.0).endswith(f"hardly resist a motion: {TURN.name}.")
    assert verdict.reason(slack, (), 0.0).endswith("see sigma.")


@pytest.mark.parametrize("name", Evidence._fields)
def test_every_reason_is_a_sentence(monkeypatch, name):
    weight = -1.0 if getattr(GOOD, name) < 0.5 else 1.0
    weights = Evidence(*np.zeros(len(Evidence._fields)))._replace(**{name: weight})
    monkeypatch.setattr(verdict, "WEIGHTS", weights)
    told = verdict.reason(GOOD._replace(**{name: 0.001 if weight > 0 else 3.0}), (), 0.0)
    assert told[0].isupper() or told[0].isdigit()
    assert told.endswith(".")


@pytest.mark.parametrize(
    ("deviations_deg", "loose"), [((1.0, 1.0, 1.0), ""), ((2.0, 2.0, 2.0), "3.5 degrees")]
)
def test_a_rotation_known_to_a_few_degrees_is_held_loosely(deviations_deg, loose):
    """Whatever the translation is known to, and however the axes lie."""
    turn = Rotation.from_rotvec([0.3, 1.0, -0.4]).as_matrix()
    covariance = np.diag([1e6] * 6)
    covariance[:3, :3] = turn @ np.diag(np.radians(deviations_deg)) ** 2 @ turn.T
    told = verdict.held_loosely(covariance)
    assert loose in told
    assert bool(told) == bool(loose)
    assert not verdict.held_loosely(np.full((6, 6), np.nan))


def test_two_scans_that_hardly_meet_are_no_success_and_told():
    """Two strips of a bumpy ground with 2 % of its points in common, and noise."""
    rng = np.random.default_rng(3)

    def ground(first, last):
        x, y = rng.uniform([first, 0], [last, 4], (6000, 2)).T
        z = 0.3 * np.sin(2.1 * x) * np.cos(1.7 * y) + 0.1 * np.sin(5 * x + y)
        return np.column_stack([x, y, z]) + rng.normal(size=(6000, 3)) * 0.02

    source, reference = ground(0, 6.0), ground(5.7, 12)
    found = register(source, reference, initial=np.eye(4))
    assert verdict.rotation_deviation_deg(found.covariance) > 3
    assert not found.success
    assert found.reason
