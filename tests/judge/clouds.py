"""Clouds as the judge sees them, and their nearest points, that the tests of this room share."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg.judge.evidence import read_evidence
from jaxreg.judge.surface import NEIGHBORS, Examined, examine
from jaxreg.types import RigidTransform
from tests import compiled

read = jax.jit(read_evidence, static_argnames="step")
examined_as = jax.jit(examine)


def examined(points, normals=None, k=NEIGHBORS) -> Examined:
    """A cloud by `examine`, with the normals of its neighbourhoods unless some are given."""
    neighbors = neighbors_of(points, k)
    normals = compiled.normals(points, neighbors) if normals is None else normals
    return examined_as(jnp.asarray(points), jnp.asarray(normals), neighbors)


def neighbors_of(points, k=NEIGHBORS):
    return jnp.asarray(cKDTree(points).query(points, k=k + 1)[1][:, 1:].astype(np.int32))


def arbitrary(rng, n, spacing) -> Examined:
    """Points in the unit cube of which nothing else agrees; some are padding, some lack a normal."""
    normals = rng.normal(size=(n, 3))
    unknown = rng.uniform(size=(n, 1)) < 0.1
    return Examined(
        rng.uniform(size=(n, 3)),
        np.where(unknown, 0, normals / np.linalg.norm(normals, axis=1, keepdims=True)),
        rng.uniform(0, 0.06, n),
        rng.uniform(1, 50, n),
        rng.uniform(0, 1, n),
        rng.uniform(size=n) < 0.9,
        np.float64(spacing),
    )


def random_pose(rng, angle=np.pi, shift=1.0) -> RigidTransform:
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(rng.uniform(0, angle) * axis / np.linalg.norm(axis))
    return RigidTransform(turn.as_matrix(), shift * rng.uniform(-1, 1, 3))


def inverse(pose) -> RigidTransform:
    return RigidTransform(pose.rotation.T, -pose.rotation.T @ pose.translation)


def partners(pose, source, reference):
    """The nearest valid points there and back, by trees of the valid points alone."""
    moved = np.asarray(source.points) @ pose.rotation.T + pose.translation
    clouds = (moved, source.mask), (np.asarray(reference.points), reference.mask)
    (x, here), (y, there) = ((points, np.flatnonzero(mask)) for points, mask in clouds)
    return tuple(
        to[cKDTree(points[to]).query(np.nan_to_num(queries))[1]].astype(np.int32)
        for queries, points, to in ((x, y, there), (y, x, here))
    )


def assert_same(found, expected, *, but=(), tolerance=1e-9):
    for name in set(expected._fields) - set(but):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), rtol=tolerance, atol=1e-12, err_msg=name
        )
