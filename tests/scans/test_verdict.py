"""Evidence of poses that are right and wrong by construction."""

import numpy as np
import pytest

from jaxreg.data.procedural import shapes
from jaxreg.scans import prepare, verdict
from jaxreg.scans.config import RegisterConfig
from jaxreg.types import RigidTransform

IDENTITY = RigidTransform(np.eye(3), np.zeros(3))


def indexed(source, reference):
    clouds = [
        prepare.prepare(points, config=RegisterConfig(search_points=512))
        for points in (source, reference)
    ]
    levels = prepare.at_one_density(*clouds)
    spacing = max(level.spacing * cloud.radius for level, cloud in zip(levels, clouds, strict=True))
    return *((level, cloud.radius) for level, cloud in zip(levels, clouds, strict=True)), spacing


@pytest.fixture(scope="module")
def clouds():
    cloud = shapes.sample_shape(5, 9, points=1000).astype(np.float64)
    return indexed(cloud[:500], cloud[500:])


def test_right_pose_is_trusted_and_a_wrong_one_is_not(clouds):
    source, reference, spacing = clouds
    right = verdict.evidence(IDENTITY, source, reference, 1.5 * spacing, rival=0.2)
    wrong = verdict.evidence(
        RigidTransform(np.eye(3), np.array([0.3, 0.2, 0.1])),
        source,
        reference,
        1.5 * spacing,
        rival=0.2,
    )
    assert right.overlap > 0.95
    assert right.gap < wrong.gap
    assert right.facing > wrong.facing
    assert verdict.probability(right) > verdict.TRUSTED > verdict.probability(wrong)


def test_far_clouds_give_finite_evidence(clouds):
    source, reference, spacing = clouds
    far = RigidTransform(np.eye(3), np.full(3, 100.0))
    found = verdict.evidence(far, source, reference, spacing, rival=0.0)
    assert np.isfinite(found).all()
    assert found.overlap == 0
    assert verdict.probability(found) < 0.05


def test_what_leaves_a_motion_free_is_never_trusted(clouds):
    source, reference, spacing = clouds
    right = verdict.evidence(IDENTITY, source, reference, 1.5 * spacing, rival=0.2)
    assert verdict.probability(right._replace(constraint=1e-6)) == 0


def test_more_overlap_a_smaller_gap_and_a_weaker_rival_raise_the_probability(clouds):
    source, reference, spacing = clouds
    right = verdict.evidence(IDENTITY, source, reference, 1.5 * spacing, rival=0.2)
    base = right._replace(overlap=0.6, smaller=0.5, gap=1.5, facing=-0.2, rival=0.1)
    better = {"overlap": 0.8, "smaller": 0.7, "gap": 1.0, "facing": -0.1, "rival": 0.3}
    for change, value in better.items():
        changed = verdict.probability(base._replace(**{change: value}))
        assert 0 < verdict.probability(base) < changed < 1, change


def test_constraint_is_small_for_a_plane_and_large_for_a_corner(seed):
    rng = np.random.default_rng(seed)
    plane = np.c_[rng.uniform(size=(300, 2)), np.zeros(300)]
    corner = np.concatenate([np.roll(plane[i::3], i, axis=1) for i in range(3)])
    found = []
    for cloud in (plane, corner):
        a, b, spacing = indexed(cloud, cloud)
        found.append(verdict.evidence(IDENTITY, a, b, spacing, rival=0.2).constraint)
    assert found[0] < 1e-6
    assert found[1] > 0.01
