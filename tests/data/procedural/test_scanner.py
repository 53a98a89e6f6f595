"""The virtual scanner, against scenes whose view is known by geometry."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxreg.data.procedural.rooms import rearranged, sample_room
from jaxreg.data.procedural.scanner import Sensor, look_at, scan
from jaxreg.data.procedural.surfaces import box, sample, union

EYE, AHEAD = np.zeros(3), np.eye(3)


def test_a_box_hides_the_wall_behind_it():
    wall, screen = box((0.01, 4, 4), (3, 0, 0)), box((0.01, 1, 1), (1.5, 0, 0))
    seen = scan(
        np.random.default_rng(0), union(wall, screen), EYE, AHEAD,
        Sensor(field_of_view=(1.5, 1.5)), points=20_000,
    )  # fmt: skip
    on_wall = seen[seen[:, 0] > 2.5]
    # By the intercept theorem the shadow of a screen at half the distance is twice its size: a
    # quarter of the wall's samples, of which gaps between those of the screen let a few through.
    in_shadow = np.abs(on_wall[:, 1:]).max(axis=1) < 0.95
    assert len(on_wall) > 1000
    assert in_shadow.mean() < 0.01
    assert (np.abs(seen[seen[:, 0] < 2, 1:]) <= 0.5 + 1e-9).all()


def test_noise_and_steps_are_along_the_ray_and_of_the_size_asked():
    wall = box((0.001, 1, 1), (2, 0, 0))
    sensor = Sensor(field_of_view=(0.4, 0.4), noise=0.005)
    seen = scan(np.random.default_rng(1), wall, EYE, AHEAD, sensor, points=5000)
    across = seen[:, 0] - 2
    np.testing.assert_allclose(across.std(), 0.005 * 4, rtol=0.1)
    stepped = scan(
        np.random.default_rng(1), wall, EYE, AHEAD,
        Sensor(field_of_view=(0.4, 0.4), step=0.01), points=500,
    )  # fmt: skip
    reach = np.linalg.norm(stepped, axis=1) / 0.01
    np.testing.assert_allclose(reach, np.round(reach), atol=1e-6)


@pytest.mark.parametrize("index", range(3))
def test_a_scan_of_a_room_lies_on_its_surface_in_the_frame_of_the_scanner(index):
    room = sample_room(3, index)
    eye = np.array([0.2, -0.3, 1.5])
    turn = look_at(eye, np.array([2.0, 1.0, 1.0]))
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)
    seen = scan(np.random.default_rng(index), room.surface, eye, turn, Sensor(), points=4000)
    dense = sample(np.random.default_rng(9), room.surface, 400_000)
    assert len(seen) > 2000
    assert np.quantile(cKDTree(dense).query(seen @ turn.T + eye)[0], 0.99) < 0.1


def test_warp_bends_a_scan_by_about_its_angle():
    wall = box((0.001, 4, 4), (3, 0, 0))
    sensor = Sensor(field_of_view=(1.2, 1.2), warp=np.radians(2))
    flat, bent = (
        scan(np.random.default_rng(4), wall, EYE, AHEAD, s, points=3000)
        for s in (Sensor(field_of_view=(1.2, 1.2)), sensor)
    )
    assert np.ptp(flat[:, 0]) < 0.01
    moved = np.linalg.norm(flat - bent, axis=1)
    # Half of two degrees at the ends, at a range of three to four.
    assert 0.01 < moved.max() < np.radians(1) * 4.5


def test_a_rearranged_room_keeps_its_walls():
    room = sample_room(5, 0)
    other = rearranged(room, np.random.default_rng(0), share=1.0)
    np.testing.assert_array_equal(other.shell, room.shell)
    assert all(not np.array_equal(a, b) for a, b in zip(other.pieces, room.pieces, strict=True))
    np.testing.assert_array_equal(sample_room(5, 0).surface, room.surface)
    assert not np.array_equal(sample_room(5, 1).shell[:12], room.shell[:12])
