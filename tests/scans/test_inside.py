"""A small scan inside a large one: what is cut, where tiles lie, and whether it is found and judged."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural.surfaces import box, sample, union
from jaxreg.scans import inside, prepare
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.known import Known
from jaxreg.scans.pair import register
from jaxreg.types import RigidTransform
from tests.scenes import angle_deg, moved

CONFIG = RegisterConfig()


def prepared(points):
    return prepare.prepare(points, strays="keep", config=CONFIG)


def boxes(rng, count, area, seed=3):
    """Ground with boxes of different sizes on it; points evenly over all surfaces."""
    form = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(0, area, (count // 2, 2)), np.zeros(count // 2)])
    parts = [ground]
    number = int(area * area / 60)
    for _ in range(number):
        corner, size = form.uniform(0, area, 2), form.uniform([2, 2, 1], [6, 6, 7])
        face = rng.integers(0, 5, count // 2 // number)
        points = rng.uniform(0, 1, (len(face), 3))
        points[face == 0, 0], points[face == 1, 0] = 0, 1
        points[face == 2, 1], points[face == 3, 1] = 0, 1
        points[face == 4, 2] = 1
        parts.append(points * size + [*corner, 0])
    points = np.concatenate(parts)
    return points + rng.normal(size=points.shape) * 0.01


def test_what_the_small_one_covers_is_cut():
    rng = np.random.default_rng(0)
    large = rng.uniform(0, 100, (20_000, 3))
    small = rng.uniform(20, 40, (2000, 3))
    turn, shift = Rotation.from_euler("z", 30, degrees=True).as_matrix(), np.array([5.0, 6, 7])
    pair = inside.Nested(prepared((small - shift) @ turn), prepared(large), 1)
    piece = inside.covered(pair, RigidTransform(turn, shift), CONFIG).cloud
    got = piece.points * piece.radius + piece.centre
    core = np.all((large > 21) & (large < 39), axis=1).sum()
    assert core <= len(got)
    assert got.min() > 18
    assert got.max() < 42
    nowhere = inside.covered(pair, RigidTransform(turn, shift + 500), CONFIG)
    assert nowhere is None


def test_the_large_one_may_be_the_source():
    rng = np.random.default_rng(1)
    large, small = rng.uniform(0, 100, (20_000, 3)), rng.uniform(20, 40, (2000, 3))
    turn, shift = Rotation.from_euler("x", 50, degrees=True).as_matrix(), np.array([1.0, 2, 3])
    pair = inside.Nested(prepared(large), prepared(moved(small, turn, shift)), 0)
    piece = inside.covered(pair, RigidTransform(turn, shift), CONFIG).cloud
    got = piece.points * piece.radius + piece.centre
    assert got.min() > 18
    assert got.max() < 42


def test_a_piece_keeps_the_weights_of_its_points_and_where_it_was_seen_from():
    rng = np.random.default_rng(4)
    large, small = rng.uniform(0, 100, (20_000, 3)), rng.uniform(20, 40, (2000, 3))
    whole = prepare.prepare(large, viewpoint=[50.0, 60, 70], strays="keep", config=CONFIG)
    pair = inside.Nested(whole, prepared(small), 0)
    piece = inside.covered(pair, RigidTransform(np.eye(3), np.zeros(3)), CONFIG)
    weight = whole.points[:, 0] * whole.radius + whole.centre[0]  # of a point: its x
    known = Known(weights=weight)
    found = piece.problem(pair, CONFIG, known)
    cut = found.source
    assert cut.points.shape[0] < 2000
    expected = cut.points[:, 0] * cut.radius + cut.centre[0]
    np.testing.assert_allclose(found.known.weights, expected, atol=1e-9)
    np.testing.assert_allclose(cut.viewpoint * cut.radius + cut.centre, [50, 60, 70], atol=1e-9)


def test_tiles_cover_the_large_one_and_each_holds_the_small_one():
    rng = np.random.default_rng(2)
    large = rng.uniform(0, 1, (30_000, 3)) * [100, 60, 4]
    pair = inside.Nested(prepared(rng.uniform(0, 20, (2000, 3)) * [1, 1, 0.2]), prepared(large), 1)
    seen = [
        tile.cloud.points * tile.cloud.radius + tile.cloud.centre
        for tile in inside.tiles(pair, CONFIG)
    ]
    everything = np.unique(np.round(np.concatenate(seen), 6), axis=0)
    assert len(everything) == len(large)
    for corner in rng.uniform(0, [80, 40], (20, 2)):
        held = [
            np.all(tile[:, :2].min(axis=0) <= corner + 4)
            and np.all(tile[:, :2].max(axis=0) >= corner + 16)
            for tile in seen
        ]
        assert any(held)


def test_sizes_decide_whether_one_may_lie_in_the_other():
    rng = np.random.default_rng(3)
    points = rng.normal(size=(300, 3))
    assert not inside.is_possible(prepared(points), prepared(1.2 * points))
    assert inside.is_possible(prepared(points), prepared(3 * points))
    assert inside.is_possible(prepared(3 * points), prepared(points))


@pytest.mark.slow
@pytest.mark.parametrize("start", [True, False])
def test_a_submap_in_a_map(start):
    rng = np.random.default_rng(4)
    whole, other = boxes(rng, 160_000, 120.0), boxes(rng, 160_000, 120.0)
    part = other[np.linalg.norm(other[:, :2] - [70, 45], axis=1) < 16]
    turn, shift = Rotation.from_euler("z", 70, degrees=True).as_matrix(), np.array([10.0, -5, 2])
    initial = None
    if start:
        initial = np.eye(4)
        initial[:3, :3] = Rotation.from_euler("z", 71, degrees=True).as_matrix()
        initial[:3, 3] = (turn - initial[:3, :3]) @ [70, 45, 0] + shift + [0.4, 0.3, 0.1]
    found = register(part, moved(whole, turn, shift), initial=initial, known="inside")
    assert angle_deg(found.rotation, turn) < 0.3
    middle = part.mean(axis=0)
    off = found.rotation @ middle + found.translation - turn @ middle - shift
    assert np.linalg.norm(off) < 0.15
    assert found.success
    assert found.confidence.shape == (len(part),)


@pytest.mark.parametrize("large", [0, 1])
def test_a_box_in_a_scene_is_turned_by_half_as_well(large):
    rng = np.random.default_rng(6)
    brick = box((1.0, 0.6, 0.4))
    table = box((6, 5, 0.1), (1, 1, -0.26))
    part, whole = (
        prepared(sample(rng, brick, 4000)),
        prepared(sample(rng, union(brick, table), 20_000)),
    )
    turn = Rotation.random(random_state=2).as_matrix()
    whole = prepared(moved(whole.points * whole.radius + whole.centre, turn, np.ones(3)))
    pose = RigidTransform(turn, np.ones(3))
    pair = inside.Nested(whole, part, 0) if large == 0 else inside.Nested(part, whole, 1)
    if large == 0:
        pose = RigidTransform(turn.T, -turn.T @ np.ones(3))
    found = inside._repeats(pair, pose, Known())
    for axis in np.eye(3):
        half = Rotation.from_rotvec(np.pi * axis).as_matrix()
        expected = turn @ half if large == 1 else half @ turn.T
        middle = part.centre if large == 1 else turn @ part.centre + np.ones(3)
        off = [
            np.linalg.norm(expected @ x.rotation.T - np.eye(3))
            + np.linalg.norm(
                (x.rotation - pose.rotation) @ middle + x.translation - pose.translation
            )
            for x in found
        ]
        assert min(off) < 0.3
    limited = inside._repeats(pair, pose, Known(max_rotation_deg=100.0))
    assert {angle_deg(x.rotation, np.eye(3)) <= 100 for x in limited} <= {True}
    assert len(limited) < len(found)
