"""Rows of the refinement: its steps and its whole loops, with pairs that do not change."""

import functools

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxreg.geometry import frame, normals
from jaxreg.refine import (
    correspondences,
    gauss_newton,
    gicp,
    point_to_plane,
    point_to_point,
    robust,
    uncertainty,
)
from jaxreg.types import RigidTransform
from tests.transforms.rows import N, Row, every, neighbor_graph, nowhere, points, pose

RNG = np.random.default_rng(2)
IDENTITY = RigidTransform(np.eye(3), np.zeros(3))
WIDE = robust.Weighting("geman_mcclure", 0.5, 10.0, 1.0)


def pairs():
    rows = np.arange(N, dtype=np.int32)
    return correspondences.Pairs(rows, rows[::-1].copy(), np.ones(N, bool))


def none(these):
    return these._replace(mask=np.zeros(N, bool))


def moved_a_little(x):
    return x @ Rotation.from_euler("xyz", [0.02, 0.05, 0.03]).as_matrix().T + 0.02


def definite(n=N):
    """Symmetric positive definite matrices (n, 3, 3)."""
    factor = RNG.normal(size=(n, 3, 3))
    return factor @ factor.transpose(0, 2, 1) + 0.1 * np.eye(3)


def entered(source, reference):
    return frame.enter(source, reference, None, None)


def closest(moved, reference):
    return correspondences.closest_pairs(moved, reference, None, None, both_directions=True)


def weights(distance, residual, these, scale):
    weighting = WIDE._replace(scale=scale)
    return robust.pair_weights(distance, residual, these.mask, weighting, 2.0)


def small_parts() -> dict[str, Row]:
    where = frame.Frame(RNG.normal(size=3), RNG.normal(size=3), np.float64(1.7))
    graph, mask = neighbor_graph(), np.arange(N) < 6
    zero = np.zeros(3)
    return {
        "geometry.frame.enter": Row(entered, (points(), points(5)), every(lambda x: (x, x))),
        "geometry.frame.transform_in": Row(frame.transform_in, (where, pose())),
        "geometry.frame.transform_out": Row(frame.transform_out, (where, pose())),
        "refine.gauss_newton.normal_equations": Row(
            gauss_newton.normal_equations, (points(), points(), definite())
        ),
        "refine.gauss_newton.solve_damped": Row(
            gauss_newton.solve_damped,
            (np.eye(6) + 0.1 * np.ones((6, 6)), RNG.normal(size=6)),
            ((np.zeros((6, 6)), np.zeros(6)), (np.diag([1.0, 1, 1, 0, 0, 0]), np.ones(6))),
        ),
        "refine.gauss_newton.update_left": Row(
            gauss_newton.update_left,
            (pose(), RNG.normal(size=3), RNG.normal(size=3)),
            ((IDENTITY, zero, zero), (nowhere(), zero, zero)),
        ),
        "refine.gauss_newton.rotation_from_vector": Row(
            gauss_newton.rotation_from_vector,
            (RNG.normal(size=3),),
            ((zero,), (np.array([1e-9, 0, 0]),), (np.array([0.0, np.pi, 0]),)),
        ),
        "refine.gauss_newton.skew": Row(gauss_newton.skew, (RNG.normal(size=3),)),
        "geometry.normals.neighborhood_covariances": Row(
            normals.neighborhood_covariances, (points(), graph), every(lambda x: (x, graph))
        ),
        # Away from the rank of three that four points of a plane lack.
        "geometry.normals.normals": Row(
            lambda x, i: jnp.abs(normals.normals(x, i)),
            (points() * [1.0, 1.0, 0.1], graph),
            every(lambda x: (x, graph)),
        ),
        "geometry.normals.surface_covariances": Row(
            lambda n, e: normals.surface_covariances(n, 0.01, e), (points(), points())
        ),
        "geometry.normals.edge_normals": Row(
            lambda x, i: normals.edge_normals(x, i, normals.normals(x, i)),
            (points() * [1.0, 1.0, 0.1], graph),
            every(lambda x: (x, graph)),
        ),
        "geometry.normals.smallest_eigenvector": Row(
            lambda m: jnp.abs(normals.smallest_eigenvector(m)),
            (np.diag([1.0, 2.0, 4.0]) + 0.1 * np.ones((3, 3)),),
            ((np.zeros((3, 3)),), (np.eye(3),), (np.diag([1.0, 1.0, 2.0]),), (np.ones((3, 3)),)),
        ),
        "refine.correspondences.closest_pairs": Row(
            closest, (points(), points(5)), every(lambda x: (x, x)), smooth=False
        ),
        "refine.correspondences.with_neighbors": Row(
            lambda x, y: correspondences.with_neighbors(
                closest(x, y), jnp.asarray(graph), jnp.asarray(graph % 5), forward=N
            ),
            (points(), points(5)),
            smooth=False,
        ),
        "refine.robust.pair_weights": Row(
            weights,
            (RNG.uniform(size=N), RNG.uniform(size=N), pairs(), np.float64(0.5)),
            ((np.zeros(N), np.zeros(N), none(pairs()), np.float64(0.5)),),
        ),
        "refine.robust.kernel_weight": Row(
            lambda x: [robust.kernel_weight(x, k) for k in ("huber", "cauchy", "gaussian")],
            (RNG.uniform(0.1, 3, N),),
            ((np.zeros(N),), (np.full(N, 1e30),)),
        ),
        "refine.robust.widenings": Row(lambda: robust.widenings(4, 3.0, jnp.float64), ()),
        "refine.robust.masked_quantile": Row(
            lambda x, m: robust.masked_quantile(x, m, 0.5),
            (RNG.uniform(size=N), mask),
            ((np.zeros(N), mask), (np.ones(N), ~mask & mask)),
        ),
    }


def steps_and_loops() -> dict[str, Row]:
    x = points()
    y, tilted, flat = moved_a_little(x), points(), definite()
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    few = {"iterations": 2, "kernel": "geman_mcclure", "scale": 0.5}
    near = {**few, "neighbors": 4}
    from_gicp = functools.partial(gicp.gicp_step, weighting=WIDE, thickness=0.01)
    uncertain = functools.partial(uncertainty.pose_uncertainty, kernel="cauchy", scale=0.5)
    same = every(lambda x: (x, x))
    at_identity = every(lambda x: (IDENTITY, x, x, pairs()))
    frames = frame.Frame(np.zeros(3), np.zeros(3), np.float64(1.0))
    return {
        "refine.gauss_newton.gauss_newton_step": Row(
            gauss_newton.gauss_newton_step,
            (pose(), x, y, definite()),
            ((IDENTITY, x, x, np.zeros((N, 3, 3))), (IDENTITY, 0 * x, 0 * x, flat)),
        ),
        "refine.point_to_point.point_to_point_step": Row(
            functools.partial(point_to_point.point_to_point_step, weighting=WIDE),
            (IDENTITY, x, y, pairs()),
            (*at_identity, (pose(), x, y, none(pairs()))),
        ),
        "refine.point_to_point.icp": Row(
            functools.partial(point_to_point.icp, **few), (x, y), same
        ),
        "refine.point_to_plane.plane_metric": Row(
            functools.partial(point_to_plane.plane_metric, weighting=WIDE),
            (x, y, tilted, pairs()),
            ((x, x, 0 * x, pairs()), (x, x, tilted, none(pairs()))),
        ),
        "refine.point_to_plane.point_to_plane_step": Row(
            functools.partial(point_to_plane.point_to_plane_step, weighting=WIDE),
            (IDENTITY, x, y, tilted, pairs()),
            ((IDENTITY, x, x, 0 * x, pairs()), (pose(), x, y, tilted, none(pairs()))),
        ),
        "refine.point_to_plane.point_to_plane": Row(
            functools.partial(point_to_plane.point_to_plane, **near), (x, y), same, kinks=True
        ),
        "refine.gicp.gicp_step": Row(
            lambda *a: from_gicp(*a[:-1], pairs=a[-1]),
            (IDENTITY, x, y, definite(), definite(), pairs()),
            ((IDENTITY, x, x, definite(), definite(), none(pairs())),),
        ),
        "refine.gicp.gicp": Row(functools.partial(gicp.gicp, **near), (x, y), same, kinks=True),
        "refine.uncertainty.pose_uncertainty": Row(
            lambda t, x, y: uncertain(t, x, y, neighbors=4),
            (IDENTITY, x, y),
            every(lambda x: (IDENTITY, x, x)),
            kinks=True,
        ),
        "refine.uncertainty.uncertainty_of_pairs": Row(
            functools.partial(uncertainty.uncertainty_of_pairs, weighting=WIDE),
            (frames, x, y, tilted, pairs()),
            ((frames, x, x, 0 * x, pairs()), (frames, x, y, tilted, none(pairs()))),
        ),
    }


def refine_rows() -> dict[str, Row]:
    return small_parts() | steps_and_loops()
