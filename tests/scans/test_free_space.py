"""Free space against shapes whose answer is plain, and what it does to a registration."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural.scanner import Sensor, scan
from jaxreg.data.procedural.surfaces import box, union
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.io.places import whole
from jaxreg.scans import free_space, stored
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.pair import register
from jaxreg.scans.prepare import prepare
from jaxreg.types import RigidTransform


def wall(rng, *, away, count=2000, half=2.0):
    """Points of a square wall at x = `away`, seen straight on from the origin."""
    return np.column_stack([np.full(count, away), rng.uniform(-half, half, (count, 2))])


@pytest.mark.parametrize(
    ("away", "share"),
    [(2.7, 1.0), (3.9, 1.0), (4.6, 0.0), (5.0, 0.0), (8.0, 0.0)],
)
def test_only_what_lies_before_the_wall_is_in_front(away, share, seed):
    rng = np.random.default_rng(seed)
    seen = free_space.view(wall(rng, away=5.0), np.zeros(3))
    # As wide as the wall seems from the origin, and a little less.
    points = wall(rng, away=away, half=0.9 * 2 * away / 5)
    assert free_space.share_in_front(seen, points) == pytest.approx(share, abs=0.02)


def test_directions_that_were_not_seen_say_nothing(seed):
    rng = np.random.default_rng(seed)
    seen = free_space.view(wall(rng, away=5.0), np.zeros(3))
    assert free_space.share_in_front(seen, -wall(rng, away=2.0)) == 0
    nearer = free_space.view(
        np.concatenate([wall(rng, away=5.0), wall(rng, away=0.5)]), np.zeros(3)
    )
    # Nor does what is far nearer than all that was measured.
    assert free_space.share_in_front(nearer, wall(rng, away=0.1, half=0.03)) == 0


@pytest.fixture(scope="module")
def two_scans():
    """A room from two places, each in the frame of its scanner, the pose between them, and the source's
    vertical axis."""
    rng = np.random.default_rng(5)
    furniture = [
        box((1.2, 0.6, 1.9), (2.3, 1.6, 0.95)),
        box((0.1, 1.6, 2.5), (-1.8, 1.2, 1.25)),
        box((1.6, 0.8, 0.7), (1.0, -1.5, 0.35)),
    ]
    room = union(box((6, 4, 2.5), (0, 0, 1.25)), *furniture)
    eyes = np.array([[-0.5, 0.3, 1.2], [0.4, -0.2, 1.3]])
    sensor, turns = Sensor(rings=40, noise=0.0005), Rotation.random(2, random_state=rng).as_matrix()
    clouds = [
        scan(rng, room, eye, np.eye(3), sensor, points=4000) @ turn.T
        for eye, turn in zip(eyes, turns, strict=True)
    ]
    truth = RigidTransform(turns[1] @ turns[0].T, turns[1] @ (eyes[0] - eyes[1]))
    return clouds, truth, turns[0][:, 2]


def turned(pose, degrees, up):
    """The pose after a turn of the source about its vertical axis."""
    turn = Rotation.from_rotvec(degrees * up, degrees=True).as_matrix()
    return RigidTransform(pose.rotation @ turn, pose.translation)


def test_the_true_pose_is_not_contradicted_and_others_are(two_scans):
    clouds, truth, up = two_scans
    prepared = [prepare(cloud, viewpoint=np.zeros(3)) for cloud in clouds]
    sides = free_space.Sides(
        (prepared[0].view, prepared[1].view),
        (prepared[0].points, prepared[1].points),
        (prepared[0].radius, prepared[1].radius),
    )

    def centred(pose):
        return RigidTransform(
            pose.rotation[None],
            (pose.rotation @ prepared[0].centre + pose.translation - prepared[1].centre)[None],
        )

    assert sides.share_in_front(centred(truth)) < 0.05
    assert sides.log_odds(centred(truth)) > 0
    for degrees in (45, 90, 135, 225, 270):
        other = centred(turned(truth, degrees, up))
        assert sides.share_in_front(other) > 0.08, degrees
        assert sides.log_odds(other) < 0


def test_a_registration_believes_more_where_free_space_agrees(two_scans):
    clouds, truth, up = two_scans
    plain = register(*clouds)
    found = register(*clouds, viewpoint=(np.zeros(3), np.zeros(3)))
    assert rotation_angle_deg(found.rotation, truth.rotation) < 3
    assert found.probability >= plain.probability
    # From a pose that is wrong and given, the reason is told.
    config = RegisterConfig(refine=None)
    wrong = turned(truth, 90, up)
    told = register(*clouds, initial=wrong, viewpoint=np.zeros(3), config=config)
    assert not told.success
    assert "in front of what the other scanner measured" in told.reason


def test_a_prepared_cloud_keeps_its_viewpoint(two_scans, tmp_path):
    cloud = prepare(two_scans[0][0], viewpoint=[1.0, 2, 3])
    with whole(tmp_path / "a.npz") as part:
        stored.save(cloud, part)
    again = stored.load(tmp_path / "a.npz", cloud.config)
    np.testing.assert_array_equal(again.viewpoint, cloud.viewpoint)
    np.testing.assert_allclose(cloud.viewpoint * cloud.radius + cloud.centre, [1, 2, 3])
    assert stored.fingerprint(cloud) == stored.fingerprint(again)
    assert stored.fingerprint(cloud) != stored.fingerprint(prepare(two_scans[0][0]))


@pytest.mark.untyped
@pytest.mark.parametrize("place", [[1.0, 2], np.array([1.0, 2, np.nan]), "here", 3])
def test_a_viewpoint_is_three_numbers(two_scans, place):
    with pytest.raises(ValueError, match="viewpoint of the source must be three finite numbers"):
        register(*two_scans[0], viewpoint=(place, None))


def test_a_prepared_cloud_has_its_viewpoint_already(two_scans):
    first = prepare(two_scans[0][0])
    with pytest.raises(ValueError, match="give its viewpoint to jaxreg.prepare"):
        register(first, two_scans[0][1], viewpoint=np.zeros(3))
