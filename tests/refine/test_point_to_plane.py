"""Point-to-plane ICP against a loop of least squares on the linearised distances."""

import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg.refine.config import RefineConfig
from tests.compiled import point_to_plane


def surface(rng, n):
    uv = rng.uniform(-1, 1, (n, 2))
    points = np.column_stack(
        [uv, 0.3 * uv[:, 0] ** 2 + 0.2 * uv[:, 0] * uv[:, 1] - 0.1 * uv[:, 1] ** 3]
    )
    slope = [0.6 * uv[:, 0] + 0.2 * uv[:, 1], 0.2 * uv[:, 0] - 0.3 * uv[:, 1] ** 2]
    normal = np.column_stack([-slope[0], -slope[1], np.ones(n)])
    return points, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def test_fixed_point_is_the_least_squares_solution(seed):
    rng = np.random.default_rng(seed)
    source, (reference, normal) = surface(rng, 100)[0], surface(rng, 140)
    turned = Rotation.from_rotvec([0.03, -0.05, 0.04]).as_matrix()
    source = (source + 0.01 * rng.normal(size=source.shape)) @ turned.T + 0.02
    pose = point_to_plane(
        jnp.asarray(source), jnp.asarray(reference), reference_normals=jnp.asarray(normal),
        config=RefineConfig(kernel="none", iterations=60),
    )  # fmt: skip
    rotation, translation = np.asarray(pose.rotation), np.asarray(pose.translation)
    index = cKDTree(reference).query(source @ rotation.T + translation)[1]

    def distances(step):
        turn = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
        residual = source @ turn.T + translation + step[3:] - reference[index]
        return (residual * normal[index]).sum(axis=1)

    best = least_squares(distances, np.zeros(6), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(best.x, 0, atol=1e-6)


def test_zero_normals_count_for_nothing(seed):
    rng = np.random.default_rng(seed)
    reference, normal = surface(rng, 140)
    source = surface(rng, 100)[0] + 0.01
    dropped = np.arange(140) % 10 == 0
    far = reference + np.where(dropped[:, None], [0, 0, 0.2], 0)
    # The dropped points keep their places, so that the pairs stay; only their planes are gone.
    poses = [
        point_to_plane(
            jnp.asarray(source), jnp.asarray(reference),
            config=RefineConfig(kernel="none", iterations=1),
            reference_normals=jnp.asarray(np.where(dropped[:, None], 0, n)),
        )
        for n in (normal, np.where(dropped[:, None], far, normal))
    ]  # fmt: skip
    np.testing.assert_array_equal(poses[0].rotation, poses[1].rotation)


def test_slides_along_a_plane_by_nothing(seed):
    rng = np.random.default_rng(seed)
    plane = np.column_stack([rng.uniform(-1, 1, (80, 2)), np.zeros(80)])
    pose = point_to_plane(jnp.asarray(plane + [0, 0, 0.1]), jnp.asarray(plane))
    np.testing.assert_allclose(pose.rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(pose.translation, [0, 0, -0.1], atol=1e-9)
