import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxreg.geometry import rigid
from jaxreg.search.nearest import nearest_grid
from jaxreg.search.ranking import Evidence, evidence, evidence_by_grid, plausibility, settle
from jaxreg.search.surface import Surface
from jaxreg.types import RigidTransform


def plane(shift, openness=0.0, n=21, local=(1.0, 0.0)):
    line = np.linspace(-1, 1, n)
    points = np.stack([*np.meshgrid(line, line), np.full((n, n), shift)], axis=-1).reshape(-1, 3)
    normals = np.tile([0.0, 0.0, 1.0], (n * n, 1))
    open_, local = np.full(n * n, openness), np.tile(local, (n * n, 1))
    return Surface(*map(jnp.asarray, (points, normals, open_, local)), jnp.ones(n * n, bool))


WIDTHS = {"width": 0.05, "plane_width": 0.02, "rim": 0.25}


def test_a_shifted_plane_by_its_equations():
    identity = rigid.identity(jnp.float64)
    for shift in (0.0, 0.01, 0.04):
        near = 2 * np.exp(-(shift**2) / (2 * 0.05**2))
        found = evidence(identity, plane(0.0, 0.1), plane(shift, 0.2, local=(0.6, 0.8)), **WIDTHS)
        expected = near * np.exp(-(shift**2) / (2 * 0.02**2))
        np.testing.assert_allclose(found.match, expected, rtol=1e-6)
        flush = near * np.exp(-(shift**2) / (2 * (0.02 / 3) ** 2))
        np.testing.assert_allclose(found.flush, flush, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(found.alike, 0.6 * near, rtol=1e-6)
        np.testing.assert_allclose(found.within, (1 - 0.4) * (1 - 0.8) * near, rtol=1e-6)
        assert found.beside == 0


def test_a_plane_that_faces_another_way_does_not_match():
    turn = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    tilted = plane(0.0)
    tilted = tilted._replace(normals=jnp.tile(jnp.asarray([0.6, 0.0, 0.8]), (441, 1)))
    pose = RigidTransform(jnp.asarray(turn), jnp.zeros(3))
    np.testing.assert_allclose(evidence(pose, tilted, plane(0.0), **WIDTHS).match, 2 * 0.64)
    np.testing.assert_allclose(evidence(pose, tilted, tilted, **WIDTHS).match, 2 * 0.64**2)


def test_beside_the_inside_speaks_against_and_beside_a_rim_does_not():
    identity = rigid.identity(jnp.float64)
    found = evidence(identity, plane(0.0), plane(0.1, 0.1), **WIDTHS)
    np.testing.assert_allclose(found.beside, 1 + 0.6, rtol=1e-6)
    assert evidence(identity, plane(0.0, 0.4), plane(0.1, 0.4), **WIDTHS).beside == 0
    for shift in (0.07, 0.16):
        assert evidence(identity, plane(0.0), plane(shift), **WIDTHS).beside == 0


def test_padding_counts_for_nothing():
    a, b = plane(0.0), plane(0.01)
    half = a._replace(mask=jnp.arange(441) < 441 - 21)
    cut = Surface(*(field[:-21] for field in a))
    identity = rigid.identity(jnp.float64)
    np.testing.assert_allclose(
        np.array(evidence(identity, half, b, **WIDTHS)),
        np.array(evidence(identity, cut, b, **WIDTHS)),
        rtol=1e-9,
    )


def test_grids_give_about_the_evidence_and_every_other_point_is_enough(seed):
    rng = np.random.default_rng(seed)
    source, reference = plane(0.0, 0.05), plane(0.0, 0.1, local=(0.8, 0.6))
    # Off the lattice, where the nearest point is one and not any of four.
    shift = jnp.asarray([*rng.uniform(-0.02, 0.02, 2), 0.01])
    pose = RigidTransform(jnp.eye(3), shift)
    grids = [nearest_grid(s.points, s.mask, cells=64, margin=0.06) for s in (source, reference)]
    exact = np.array(evidence(pose, source, reference, **WIDTHS))
    for step in (1, 2):
        found = evidence_by_grid(pose, source, reference, *grids, step=step, **WIDTHS)
        np.testing.assert_allclose(np.array(found), exact, rtol=0.05, atol=1e-6)
    away = pose._replace(translation=shift + jnp.asarray([0.0, 0, 0.1]))
    found = evidence_by_grid(away, source, reference, *grids, step=2, **WIDTHS)
    assert found.beside > 1 > 0.1 > found.match


def test_plausibility_is_linear_in_the_evidence():
    found = Evidence(*(jnp.asarray(x) for x in (1.5, 0.6, 0.3, 0.1, 0.9)))
    score = plausibility(found, alike=0.5, within=2.0, beside=4.0)
    np.testing.assert_allclose(score, 1.5 + 0.3 - 0.6 - 0.4)


def test_a_close_call_goes_to_the_pose_that_lies_flush():
    score, flush = jnp.asarray([0.50, 0.51, 0.40, 0.499]), jnp.asarray([0.9, 0.7, 2.0, 0.6])
    found = settle(score, flush, doubt=0.03, worth=0.25)
    # The third is no close call, however flush it lies.
    np.testing.assert_allclose(found, [0.55, 0.51, 0.40, 0.474])
