"""An alignment in numbers for other programs: the information of its edges, against finite motions."""

import numpy as np
import pytest
from scipy.linalg import expm, logm

from jaxreg.scans import alignment_summary
from jaxreg.scans.many import AlignedPair, Alignment
from jaxreg.scans.relation import Relation
from tests.graph.graphs import random_poses

PLANAR = np.array([0.0, 0, 1, 1, 1, 0])


def edge_of(matrix, covariance, centre, reach=0.1):
    """The edge of a used pair from scan 1 to scan 0, whose centre is given."""
    relation = Relation(1, 0, "search", matrix, 0.99, True, "", 0.5, reach, covariance)
    refused = Relation(1, 0, "search", np.eye(4), 0.1, False, "No.", 0.1, reach, np.eye(6))
    alignment = Alignment(
        np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)), ((0, 1),), np.ones(2),
        np.zeros((2, 6, 6)), np.stack([centre, np.zeros(3)]),
        (AlignedPair(relation, 0.99, True, ""), AlignedPair(refused, 0.1, False, "No.")),
        ("", ""), (), (),
    )  # fmt: skip
    return alignment_summary.edges(alignment)


def matrix_of(rng):
    pose = random_poses(rng, 1)
    return np.block([[pose.rotation[0], pose.translation[0][:, None]], [np.eye(4)[3]]])


def hat(twist):
    """The 4x4 matrix of a twist, rotation vector first."""
    generator = np.zeros((4, 4))
    generator[:3, :3] = np.cross(np.eye(3), twist[:3])
    generator[:3, 3] = twist[3:]
    return generator


def in_the_source_s_frame(matrix, motion, centre):
    """The twist ``xi`` of ``Z exp(xi)`` if the moved source turns and shifts about a centre."""
    about = np.eye(4)
    about[:3, 3] = centre
    moved = about @ expm(hat(motion)) @ np.linalg.inv(about) @ matrix
    found = logm(np.linalg.inv(matrix) @ moved).real
    return np.array([found[2, 1], found[0, 2], found[1, 0], *found[:3, 3]])


def deviations(rng):
    root = rng.normal(size=(6, 6)) * np.repeat([1e-3, 2e-2], 3)[:, None]
    return root @ root.T


@pytest.mark.parametrize("centre", [np.zeros(3), np.array([30.0, -40, 5])])
def test_a_motion_is_as_likely_in_either_frame(seed, centre):
    rng = np.random.default_rng(seed)
    matrix, covariance = matrix_of(rng), deviations(rng)
    edges = edge_of(matrix, covariance, centre)
    assert edges.information.shape == (1, 6, 6)
    for motion in 1e-5 * rng.normal(size=(5, 6)):
        twist = in_the_source_s_frame(matrix, motion, centre)
        expected = motion @ np.linalg.solve(covariance, motion)
        assert twist @ edges.information[0] @ twist == pytest.approx(expected, rel=1e-3)


def test_so_is_a_motion_in_the_plane_of_planar_scans_and_none_leaves_it(seed):
    """Their covariance is zero in three motions, which has no inverse."""
    rng = np.random.default_rng(seed)
    matrix, free = np.eye(4), PLANAR > 0
    covariance = deviations(rng) * np.outer(PLANAR, PLANAR)
    information = edge_of(matrix, covariance, np.zeros(3)).information[0]
    assert np.isfinite(information).all()
    np.linalg.cholesky(information)
    inside = covariance[np.ix_(free, free)]
    for motion in 1e-5 * rng.normal(size=(5, 3)):
        twist = np.zeros(6)
        twist[free] = motion
        expected = motion @ np.linalg.solve(inside, motion)
        assert twist @ information @ twist == pytest.approx(expected, rel=1e-3)
    assert np.diag(information)[~free].min() > np.linalg.eigvalsh(np.linalg.inv(inside)).max()


def test_what_is_not_known_counts_as_one():
    edges = edge_of(np.eye(4), np.full((6, 6), np.nan), np.zeros(3))
    np.testing.assert_array_equal(edges.information[0], np.eye(6))


def test_far_from_the_origin_the_information_is_still_that_of_a_covariance(seed):
    """In map coordinates, where the lever arms are 10,000 km long, and of planar scans."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    covariance = deviations(rng) * np.outer(PLANAR, PLANAR)
    information = edge_of(matrix, covariance, np.array([4e5, 5e6, 0])).information[0]
    assert np.isfinite(information).all()
    # Shifts of the source are shifts of the result, wherever the origin is.
    near = edge_of(matrix, covariance, np.zeros(3)).information[0]
    np.testing.assert_allclose(information[3:, 3:], near[3:, 3:], rtol=1e-6)
