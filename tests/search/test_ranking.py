import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.geometry import rigid
from jaxreg.search.nearest import nearest_grid
from jaxreg.search.ranking import (
    ScoreTerms,
    break_ties,
    score_of,
    score_terms,
    score_terms_by_grid,
    sparsity_factor,
)
from jaxreg.search.surface import Surface
from jaxreg.types import RigidTransform


def plane(shift, openness=0.0, n=21, local=(1.0, 0.0)):
    line = np.linspace(-1, 1, n)
    points = np.stack([*np.meshgrid(line, line), np.full((n, n), shift)], axis=-1).reshape(-1, 3)
    normals = np.tile([0.0, 0.0, 1.0], (n * n, 1))
    open_, local = np.full(n * n, openness), np.tile(local, (n * n, 1))
    return Surface(*map(jnp.asarray, (points, normals, open_, local)), jnp.ones(n * n, bool))


def test_a_shifted_plane_by_its_equations():
    identity = rigid.identity(jnp.float64)
    for shift in (0.0, 0.01, 0.04):
        near = 2 * np.exp(-(shift**2) / (2 * 0.05**2))
        found = score_terms(identity, plane(0.0, 0.1), plane(shift, 0.2, local=(0.6, 0.8)))
        expected = near * np.exp(-(shift**2) / (2 * 0.02**2))
        np.testing.assert_allclose(found.match, expected, rtol=1e-6)
        flush = near * np.exp(-(shift**2) / (2 * (0.02 / 3) ** 2))
        np.testing.assert_allclose(found.plane, flush, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(found.descriptor, 0.6 * near, rtol=1e-6)
        np.testing.assert_allclose(found.interior, (1 - 0.4) * (1 - 0.8) * near, rtol=1e-6)
        assert found.gap == 0


def test_a_plane_that_faces_another_way_does_not_match():
    turn = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    tilted = plane(0.0)
    tilted = tilted._replace(normals=jnp.tile(jnp.asarray([0.6, 0.0, 0.8]), (441, 1)))
    pose = RigidTransform(jnp.asarray(turn), jnp.zeros(3))
    np.testing.assert_allclose(score_terms(pose, tilted, plane(0.0)).match, 2 * 0.64)
    np.testing.assert_allclose(score_terms(pose, tilted, tilted).match, 2 * 0.64**2)


def test_a_gap_beside_the_interior_speaks_against_and_beside_a_boundary_does_not():
    identity = rigid.identity(jnp.float64)
    found = score_terms(identity, plane(0.0), plane(0.1, 0.1))
    np.testing.assert_allclose(found.gap, 1 + 0.6, rtol=1e-6)
    assert score_terms(identity, plane(0.0, 0.4), plane(0.1, 0.4)).gap == 0
    for shift in (0.07, 0.16):
        assert score_terms(identity, plane(0.0), plane(shift)).gap == 0


def test_padding_counts_for_nothing():
    a, b = plane(0.0), plane(0.01)
    half = a._replace(mask=jnp.arange(441) < 441 - 21)
    cut = Surface(*(field[:-21] for field in a))
    identity = rigid.identity(jnp.float64)
    np.testing.assert_allclose(
        np.array(score_terms(identity, half, b)),
        np.array(score_terms(identity, cut, b)),
        rtol=1e-9,
    )


@pytest.mark.slow
def test_grids_give_about_the_same_terms_and_every_other_point_is_enough(seed):
    rng = np.random.default_rng(seed)
    source, reference = plane(0.0, 0.05), plane(0.0, 0.1, local=(0.8, 0.6))
    # Off the lattice, where the nearest point is one and not any of four.
    shift = jnp.asarray([*rng.uniform(-0.02, 0.02, 2), 0.01])
    pose = RigidTransform(jnp.eye(3), shift)
    grids = [nearest_grid(s.points, s.mask, cells=64, margin=0.06) for s in (source, reference)]
    exact = np.array(score_terms(pose, source, reference))
    for step in (1, 2):
        found = score_terms_by_grid(pose, source, reference, tuple(grids), step=step)
        np.testing.assert_allclose(np.array(found), exact, rtol=0.05, atol=1e-6)
    away = pose._replace(translation=shift + jnp.asarray([0.0, 0, 0.1]))
    found = score_terms_by_grid(away, source, reference, tuple(grids), step=2)
    assert found.gap > 1 > 0.1 > found.match


def test_the_score_is_that_of_the_head_of_the_file():
    found = ScoreTerms(*(jnp.asarray(x) for x in (1.5, 0.6, 0.3, 0.1, 0.9)))
    np.testing.assert_allclose(score_of(found), 1.5 + 0.33 * 0.6 - 1.8 * 0.3 - 4.1 * 0.1)


def test_a_close_call_goes_to_the_pose_whose_planes_agree():
    score, plane_terms = jnp.asarray([0.50, 0.51, 0.40, 0.499]), jnp.asarray([0.9, 0.7, 2.0, 0.6])
    found = break_ties(score, plane_terms)
    # The third is no close call, however well its planes agree.
    np.testing.assert_allclose(found, [0.55, 0.51, 0.40, 0.474])


def test_a_pose_that_is_not_allowed_takes_no_part_in_a_close_call():
    score, plane_terms = jnp.asarray([0.9, 0.51, 0.50]), jnp.asarray([0.9, 0.5, 0.7])
    allowed = jnp.asarray([False, True, True])
    found = break_ties(score, plane_terms, allowed)
    np.testing.assert_allclose(found, [0.9, 0.51, 0.55])
    np.testing.assert_allclose(break_ties(score, plane_terms, allowed & False), score)


def test_sparse_clouds_are_near_at_larger_distances():
    assert sparsity_factor(jnp.asarray(0.01), jnp.asarray(0.03)) == 1
    np.testing.assert_allclose(sparsity_factor(jnp.asarray(0.14), jnp.asarray(0.07)), 4)
    identity = rigid.identity(jnp.float64)
    found = score_terms(identity, plane(0.0), plane(0.04), sparsity=2.0)
    near = 2 * np.exp(-(0.04**2) / (2 * 0.1**2))
    np.testing.assert_allclose(found.match, near * np.exp(-(0.04**2) / (2 * 0.04**2)), rtol=1e-6)
