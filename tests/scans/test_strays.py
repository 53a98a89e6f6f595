"""Strays: found whatever else is there, told, and never decisive."""

import numpy as np
import pytest

from jaxreg.scans import diagnosis, prepare
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.pair import register
from jaxreg.scans.strays import strays, told
from tests.scenes import moved, pose, shape

UTM = np.array([452_000.0, 5_411_000.0, 250.0])


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def with_strays(rng, points, places):
    """The points with others inserted among them, and which these are."""
    rows = np.sort(rng.choice(len(points), len(places), replace=False))
    marked = np.insert(np.zeros(len(points), bool), rows, True)
    return np.insert(points, rows, places, axis=0), marked


@pytest.mark.parametrize("offset", [np.zeros(3), UTM, -1e3 * UTM], ids=["near", "utm", "far"])
@pytest.mark.parametrize("count", [0, 1, 3])
def test_strays_are_found_wherever_the_cloud_is(rng, offset, count):
    places = offset + 1e3 * rng.uniform(0.5, 1, (count, 3))
    cloud, marked = with_strays(rng, shape(rng, 300) + offset, places)
    np.testing.assert_array_equal(strays(cloud), marked)


def test_a_scan_that_thins_out_has_none(rng):
    """Seen from one place in the open, distances have a long tail."""
    direction = rng.normal(size=(20_000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    scan = direction * np.exp(rng.normal(1.0, 0.8, (20_000, 1)))
    assert np.linalg.norm(scan, axis=1).max() > 20 * np.median(np.linalg.norm(scan, axis=1))
    assert not strays(scan).any()
    assert not strays(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [500, 0, 0]])).any()


def test_they_are_told_with_count_and_distance(rng):
    cloud, marked = with_strays(rng, shape(rng, 300) + UTM, [[0, 0, 0]])
    away = np.linalg.norm(UTM)
    assert told(cloud, marked).startswith(f"1 point lies {away:.3g} from the rest, which is ")
    cloud, marked = with_strays(rng, shape(rng, 300), 1e5 * np.eye(3) * [1, 1, 2])
    assert told(cloud, marked).startswith("3 points lie 1e+05 to 2e+05 from the rest")
    assert diagnosis.findings(cloud)[0] == told(cloud, marked)


def test_a_stray_changes_no_bit_of_the_result(rng):
    source, reference = shape(rng, 300), moved(shape(rng, 300), *pose(rng))
    config = RegisterConfig(wide=None)
    clean = register(source, reference, config=config)
    cloud, marked = with_strays(rng, source, [[1e4, 2e4, -3e4]])
    found = register(cloud, reference, config=config)
    np.testing.assert_array_equal(found.transformation, clean.transformation)
    np.testing.assert_array_equal(found.confidence[~marked], clean.confidence)
    assert np.isnan(found.correspondences[marked]).all()
    assert found.dropped == 1
    assert found.notes[0].startswith("source: 1 point lies 3.74e+04 from the rest")
    assert clean.notes == ()
    with pytest.raises(ValueError, match="source: 1 point lies .* strays='drop'"):
        register(cloud, reference, strays="raise")


@pytest.mark.untyped
def test_another_word_is_refused():
    with pytest.raises(ValueError, match="strays must be 'drop', 'keep' or 'raise', got 'no'"):
        register(np.eye(3), np.eye(3), strays="no")  # pyright: ignore[reportArgumentType]


def test_strays_that_are_kept_decide_neither_centre_nor_radius(rng):
    points = shape(rng, 300)
    cloud, _ = with_strays(rng, points, [[1e4, 2e4, -3e4]])
    clean, kept = prepare.prepare(points), prepare.prepare(cloud, strays="keep")
    np.testing.assert_allclose(kept.centre, clean.centre, atol=1e-12)
    assert kept.radius == pytest.approx(clean.radius, rel=1e-12)
    assert kept.kept.all()
    assert len(kept.points) == len(clean.points) + 1
