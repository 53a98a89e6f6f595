import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from jaxreg.search.alignment import align_coarse, align_fine
from jaxreg.search.nearest import nearest_grid
from jaxreg.search.surface import Surface
from jaxreg.types import RigidTransform

WIDTHS = (0.3, 0.2, 0.15, 0.1, 0.1, 0.1)


def bumpy(rng, n):
    u, v = rng.uniform(-1, 1, (2, n))
    points = np.column_stack([u, v, 0.4 * np.sin(3 * u) * np.cos(2 * v)])
    slope = [-1.2 * np.cos(3 * u) * np.cos(2 * v), 0.8 * np.sin(3 * u) * np.sin(2 * v), 1 + 0 * u]
    normals = np.column_stack(slope)
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def pair(seed, n=300, m=400):
    """Two samplings of one surface, the truth, and a start 8 degrees away."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=rng)
    source, reference = bumpy(rng, n), bumpy(rng, m)
    moved = reference[0] @ turn.as_matrix().T + 0.5, reference[1] @ turn.as_matrix().T
    axis = rng.normal(size=3)
    start = Rotation.from_rotvec(np.radians(8) * axis / np.linalg.norm(axis)) * turn

    def make(p, n):
        flat = jnp.zeros(len(p)), jnp.zeros((len(p), 1))
        return Surface(*map(jnp.asarray, (p, n)), *flat, jnp.ones(len(p), bool))

    pose = RigidTransform(jnp.asarray(start.as_matrix()), jnp.full(3, 0.52))
    return make(*source), make(*moved), turn, pose


def test_both_find_the_motion_of_another_sampling(seed):
    source, reference, turn, start = pair(seed)
    grid = nearest_grid(reference.points, reference.mask, cells=24, margin=0.1)
    coarse = align_coarse(start, source, reference, grid, widths=WIDTHS, epsilon=0.1)
    fine = align_fine(coarse, source, reference, widths=WIDTHS, epsilon=0.01)
    for pose, angle, length in ((coarse, 3, 0.05), (fine, 0.5, 0.01)):
        error = (Rotation.from_matrix(np.asarray(pose.rotation)) * turn.inv()).magnitude()
        assert np.degrees(error) < angle
        np.testing.assert_allclose(pose.translation, 0.5, atol=length)


def test_padding_changes_nothing_and_no_pair_keeps_the_pose(seed):
    source, reference, _, start = pair(seed, n=60, m=80)
    pad = lambda s: Surface(  # noqa: E731
        jnp.concatenate([s.points, jnp.zeros((9, 3))]),
        jnp.concatenate([s.normals, jnp.zeros((9, 3))]),
        jnp.zeros(len(s.mask) + 9),
        jnp.zeros((len(s.mask) + 9, 1)),
        jnp.arange(len(s.mask) + 9) < len(s.mask),
    )
    alone = align_fine(start, source, reference, widths=WIDTHS, epsilon=0.01)
    found = align_fine(start, pad(source), pad(reference), widths=WIDTHS, epsilon=0.01)
    np.testing.assert_allclose(found.rotation, alone.rotation, atol=1e-9)
    empty = source._replace(mask=jnp.zeros(60, bool))
    kept = align_fine(start, empty, reference, widths=WIDTHS, epsilon=0.01)
    np.testing.assert_allclose(kept.rotation, start.rotation, atol=1e-12)


@pytest.mark.slow
def test_derivative_of_the_fine_alignment(seed):
    source, reference, _, start = pair(seed, n=40, m=50)

    @jax.jit
    def total(points, others):
        a, b = source._replace(points=points), reference._replace(points=others)
        pose = align_fine(start, a, b, widths=(0.3, 0.2), epsilon=0.1)
        return jnp.sum(pose.rotation[0]) + jnp.sum(pose.translation)

    check_grads(total, (source.points, reference.points), 1, modes=["rev"], atol=1e-4, rtol=1e-4)
