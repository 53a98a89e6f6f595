"""Which pairs are believed, and where scans are put: made-up registrations whose truth is known."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.scans.placing import Sizes, place
from jaxreg.scans.relation import Relation

REACH = 0.1


def poses(rng, count: int) -> np.ndarray:
    found = np.repeat(np.eye(4)[None], count, 0)
    found[:, :3, :3] = Rotation.random(count, random_state=rng).as_matrix()
    found[:, :3, 3] = rng.normal(scale=3, size=(count, 3))
    return found


def relation(rng, truth, source, reference, *, probability=0.97, wrong=None, noise=0.003):
    """The pair's registration: right but for noise, or `wrong` (4x4)."""
    pose = np.linalg.inv(truth[reference]) @ truth[source] if wrong is None else wrong
    turn = Rotation.from_rotvec(rng.normal(scale=noise, size=3)).as_matrix()
    pose = pose.copy()
    pose[:3, :3] = turn @ pose[:3, :3]
    pose[:3, 3] += rng.normal(scale=noise, size=3)
    return Relation(
        source, reference, "search", pose, probability, probability >= 0.5,
        "" if probability >= 0.5 else "It is unlikely.", 0.5, REACH, noise**2 * np.eye(6),
    )  # fmt: skip


def sizes(count: int, offset=0.0) -> Sizes:
    return Sizes(np.full((count, 3), offset), np.ones(count))


def assert_right(placement, truth, members) -> None:
    first = members[0]
    for k in members:
        expected = np.linalg.inv(truth[first]) @ truth[k]
        assert rotation_angle_deg(placement.poses.rotation[k], expected[:3, :3]) < 1.5
        np.testing.assert_allclose(placement.poses.translation[k], expected[:3, 3], atol=0.05)


def ring(rng, truth, members, **options):
    count = len(members)
    return [
        relation(rng, truth, members[(k + step) % count], members[k], **options)
        for k in range(count)
        for step in (1, 2)
    ]


def test_right_pairs_place_all_scans(seed):
    rng = np.random.default_rng(seed)
    truth = poses(rng, 8)
    found = place(ring(rng, truth, range(8)), sizes(8))
    assert found.members() == (tuple(range(8)),)
    assert found.used.all()
    assert_right(found, truth, range(8))
    np.testing.assert_array_equal(found.poses.rotation[0], np.eye(3))
    assert found.probability.min() > 0.95
    assert np.isfinite(found.covariance).all()


def test_sure_and_wrong_pairs_are_refused(seed):
    """Four pairs of twenty are wrong, and as sure as the others."""
    rng = np.random.default_rng(seed)
    truth = poses(rng, 10)
    relations = ring(rng, truth, range(10))
    for k in (0, 5, 11, 16):
        r = relations[k]
        relations[k] = relation(rng, truth, r.source, r.reference, wrong=poses(rng, 1)[0])
    found = place(relations, sizes(10))
    assert not found.used[[0, 5, 11, 16]].any()
    assert found.used.sum() == 16
    assert "contradicts" in found.refusal[5]
    assert_right(found, truth, range(10))


def test_two_places_are_two_groups_and_a_foreign_scan_is_left_out(seed):
    rng = np.random.default_rng(seed)
    truth = poses(rng, 10)
    relations = ring(rng, truth, [1, 3, 5, 7, 9]) + ring(rng, truth, [0, 2, 4, 6])
    relations += [
        relation(rng, truth, 8, k, probability=0.6, wrong=poses(rng, 1)[0]) for k in (0, 1)
    ]
    found = place(relations, sizes(10))
    assert found.members() == ((1, 3, 5, 7, 9), (0, 2, 4, 6))
    assert found.group[8] == -1
    assert np.isnan(found.poses.translation[8]).all()
    assert found.probability[8] == 0
    assert "not sure enough" in found.refusal[-1]
    assert_right(found, truth, [1, 3, 5, 7, 9])
    assert_right(found, truth, [0, 2, 4, 6])


def test_unlikely_pairs_that_agree_confirm_each_other(seed):
    """None of them would be believed alone."""
    rng = np.random.default_rng(seed)
    truth = poses(rng, 6)
    found = place(ring(rng, truth, range(6), probability=0.6), sizes(6))
    assert found.members() == (tuple(range(6)),)
    single = place([relation(rng, truth, 1, 0, probability=0.6)], sizes(2))
    assert single.members() == ()


def test_a_foreign_scan_that_fits_two_views_alike_is_refused(seed):
    """Both show one thing, so it fits both in the same wrong way: two weak pairs that agree."""
    rng = np.random.default_rng(seed)
    truth = poses(rng, 7)
    relations = ring(rng, truth, range(6))
    weak = [relation(rng, truth, 6, k, probability=p) for k, p in ((0, 0.19), (1, 0.1))]
    found = place([*relations, *weak], sizes(7))
    assert found.members() == (tuple(range(6)),)
    more = [relation(rng, truth, 6, k, probability=0.2) for k in range(5)]
    assert place([*relations, *more], sizes(7)).members() == (tuple(range(7)),)


def test_pairs_with_rivals_do_not_confirm_each_other(seed):
    """As of a vase, whose scans agree in every turn; beside pairs without rivals they do count."""
    rng = np.random.default_rng(seed)
    truth = poses(rng, 6)
    vase = ring(rng, truth, range(6), probability=0.25)
    assert place(vase, sizes(6)).members() == (tuple(range(6)),)
    vase = [dataclasses.replace(r, rivals=0.7) for r in vase]
    found = place(vase, sizes(6))
    assert found.members() == ()
    assert found.posterior.max() < 0.5
    anchored = [*vase[:1], *ring(rng, truth, range(6))[1:]]
    assert place(anchored, sizes(6)).used[0]


def across(rng, truth, probability):
    """Pairs of the first ring with the second, from where the one pair between them lays them."""
    return [
        dataclasses.replace(
            relation(rng, truth, 4 + k, k, probability=probability), how="start", reason="Unlikely."
        )
        for k in range(3)
    ]


@pytest.mark.parametrize(("probability", "groups"), [(0.05, 2), (0.8, 1)])
def test_a_single_link_is_refused_if_the_scans_that_it_joins_do_not_fit(probability, groups, seed):
    rng = np.random.default_rng(seed)
    truth = poses(rng, 8)
    link = relation(rng, truth, 7, 3, probability=0.98)
    relations = [*ring(rng, truth, range(4)), *ring(rng, truth, range(4, 8)), link]
    assert len(place(relations, sizes(8)).members()) == 1  # nothing speaks against it
    found = place([*relations, *across(rng, truth, probability)], sizes(8))
    assert len(found.members()) == groups
    if groups == 2:
        assert "do not fit each other" in found.refusal[len(relations) - 1]


def test_where_a_wide_search_finds_little_it_is_believed_less(seed):
    rng = np.random.default_rng(seed)
    truth = poses(rng, 80)

    def wide(k, probability):
        found = relation(rng, truth, 2 * k + 1, 2 * k, probability=probability)
        return dataclasses.replace(found, how="wide search")

    alone = place([wide(0, 0.95)], sizes(80))
    assert alone.used.all()
    among = place([wide(0, 0.95), *(wide(k, 0.03) for k in range(1, 40))], sizes(80))
    assert not among.used.any()
    # By hand: 40 pairs with odds 19 and 0.031, of which one or two are right.
    assert 0.3 < among.posterior[0] < 0.8
    assert place([wide(k, 0.95) for k in range(40)], sizes(80)).used.all()


def test_triangles_say_little_where_wrong_pairs_close_them(seed):
    """In a corridor a pair that is a room off agrees with two others that are."""
    rng = np.random.default_rng(seed)
    truth = poses(rng, 12)
    weak = ring(rng, truth, range(6), probability=0.4)
    assert place(weak, sizes(12)).members() == (tuple(range(6)),)
    doubtful = [
        relation(rng, truth, i, j, probability=0.05)
        for i in range(6, 12) for j in range(6, 12) if i != j
    ]  # fmt: skip
    assert place([*weak, *doubtful], sizes(12)).members() == ()


def test_one_sure_pair_is_enough_and_says_how_sure(seed):
    rng = np.random.default_rng(seed)
    truth = poses(rng, 2)
    found = place([relation(rng, truth, 1, 0, probability=0.95)], sizes(2))
    assert found.members() == ((0, 1),)
    assert found.probability[1] == pytest.approx(0.95, abs=1e-6)


def test_no_pair_at_all_places_nothing():
    found = place([], sizes(3))
    assert found.members() == ()
    assert np.isnan(found.poses.rotation).all()


def test_map_coordinates_and_units_change_nothing(seed):
    rng = np.random.default_rng(seed)
    truth = poses(rng, 6)
    relations = ring(rng, truth, range(6))
    plain = place(relations, sizes(6))
    shift, scale = np.array([4e5, 5e6, 30.0]), 1000.0
    away = np.eye(4)
    away[:3, 3] = shift
    moved = []
    for r in relations:
        pose = r.transformation.copy()
        pose[:3, 3] *= scale
        units = np.repeat([1.0, scale], 3)
        covariance = r.covariance * np.outer(units, units)
        moved.append(Relation(
            r.source, r.reference, r.how, away @ pose @ np.linalg.inv(away), r.probability, r.success,
            r.reason, r.overlap, r.max_correspondence_distance * scale, covariance,
        ))  # fmt: skip
    found = place(moved, Sizes(np.full((6, 3), shift), np.full(6, scale)))
    np.testing.assert_allclose(found.poses.rotation, plain.poses.rotation, atol=1e-8)
    for k in range(6):
        expected = scale * plain.poses.translation[k] + shift - plain.poses.rotation[k] @ shift
        np.testing.assert_allclose(found.poses.translation[k], expected, atol=1e-3)
    assert found.members() == plain.members()
