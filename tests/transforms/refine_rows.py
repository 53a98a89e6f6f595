"""Rows of the refinement: its steps and its whole loops, with pairs that do not change."""

import functools

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxreg.geometry import frame, normals
from jaxreg.refine import (
    config,
    correspondences,
    cost,
    gauss_newton,
    gicp,
    methods,
    point_to_plane,
    point_to_point,
    robust,
    solve,
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
    weighting = WIDE._replace(kernel_scale=scale)
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
        # Its value is zero.
        "refine.gauss_newton.perturbation": Row(
            gauss_newton.perturbation, (pose(),), ((IDENTITY,), (nowhere(),)), smooth=False
        ),
        "refine.gauss_newton.rotation_from_vector": Row(
            gauss_newton.rotation_from_vector,
            (RNG.normal(size=3),),
            ((zero,), (np.array([1e-9, 0, 0]),), (np.array([0.0, np.pi, 0]),)),
        ),
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
        "refine.robust.pair_curvatures": Row(
            lambda r, these: robust.pair_curvatures(r, these.mask, WIDE._replace(kernel_scale=0.5)),
            (RNG.uniform(size=N), pairs()),
            ((np.zeros(N), none(pairs())),),
            smooth=False,
        ),
        "refine.robust.counting_pairs": Row(
            lambda d, these: robust.counting_pairs(d, these.mask, WIDE._replace(trim=0.7)),
            (RNG.uniform(size=N), pairs()),
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


def scene(x, y, of_source=None, of_reference=None):
    return cost.Scene(x, y, of_source, of_reference, WIDE)


def matched(method):
    """`match` of given pairs, as a function of pose, clouds and what is known of the surfaces."""

    def function(pose, x, y, *surfaces_and_pairs):
        *surfaces, these = surfaces_and_pairs
        return cost.match(scene(x, y, *surfaces), pose, these, method, 2.0)

    return function


def cost_of(function):
    def of_residuals(pose, x, y, *surfaces_and_pairs):
        *surfaces, these = surfaces_and_pairs
        return function(scene(x, y, *surfaces), pose, these, x - y[::-1])

    return of_residuals


def entered_problem(x, y):
    where, start, clouds, *_ = problem(x, y)
    return where, start, clouds.source, clouds.reference


def problem(x, y):
    options = {"initial": None, "source_mask": None, "reference_mask": None}
    options |= {"max_correspondence_distance": None, "kernel_scale": 0.5}
    return solve.set_up(x, y, config=FEW, **options)


def fixed_point(pose, x, y, across):
    these = problem(x, y)
    these = these._replace(scene=these.scene._replace(reference_surface=across))
    return solve.at_fixed_point(these, point_to_plane.POINT_TO_PLANE, pose, config=FEW)


FEW = config.RefineConfig(iterations=2, k=4)
SOLUTION = config.RefineConfig(iterations=60, kernel_annealing=1.0, k=4, gradient="implicit")
"""Its derivative is that of the solution: enough iterations to be there."""


def steps_and_loops() -> dict[str, Row]:
    x = points()
    # Of exact copies the residual is zero, where its derivative jumps.
    y, tilted, flat = moved_a_little(x) + 0.02 * points(), points(), definite()
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    few, solution = ({"config": c, "kernel_scale": 0.5} for c in (FEW, SOLUTION))
    same = every(lambda x: (x, x))
    at_identity = every(lambda x: (IDENTITY, x, x, pairs()))
    frames = frame.Frame(np.zeros(3), np.zeros(3), np.float64(1.0))
    generalized = gicp.generalized(config.RefineConfig(epsilon=0.01))
    counts, weights = np.ones(N, bool), RNG.uniform(0.5, 1, N)
    weighed = cost.Matched(x, x, y, definite(), RNG.uniform(size=N), weights, counts)
    nothing = weighed._replace(weights=0 * weighed.weights, metric=0 * weighed.metric)
    turned = RigidTransform(Rotation.from_rotvec([0.02, 0.01, 0.03]).as_matrix(), np.full(3, 0.01))
    return {
        "refine.gauss_newton.gauss_newton_step": Row(
            gauss_newton.gauss_newton_step,
            (pose(), x, y, definite()),
            ((IDENTITY, x, x, np.zeros((N, 3, 3))), (IDENTITY, 0 * x, 0 * x, flat)),
        ),
        "refine.cost.match": Row(
            matched(point_to_point.POINT_TO_POINT),
            (IDENTITY, x, y, pairs()),
            (*at_identity, (pose(), x, y, none(pairs()))),
        ),
        "refine.cost.lower_by_gauss_newton": Row(
            cost.lower_by_gauss_newton, (IDENTITY, weighed), ((pose(), nothing),)
        ),
        "refine.point_to_point.point_cost": Row(
            cost_of(point_to_point.point_cost), (IDENTITY, x, y, pairs()), at_identity
        ),
        "refine.point_to_point.procrustes_step": Row(
            point_to_point.procrustes_step, (IDENTITY, weighed), ((pose(), nothing),)
        ),
        "refine.point_to_point.icp": Row(
            functools.partial(point_to_point.icp, **few), (x, y), same, kinks=True
        ),
        "refine.point_to_plane.plane_cost": Row(
            lambda *a: cost_of(point_to_plane.plane_cost)(*a[:3], None, *a[3:]),
            (IDENTITY, x, y, tilted, pairs()),
            ((IDENTITY, x, x, 0 * x, pairs()), (pose(), x, y, tilted, none(pairs()))),
        ),
        "refine.point_to_plane.point_to_plane": Row(
            functools.partial(point_to_plane.point_to_plane, **few), (x, y), same, kinks=True
        ),
        "refine.gicp.surface_cost": Row(
            cost_of(generalized.cost),
            (IDENTITY, x, y, definite(), definite(), pairs()),
            ((IDENTITY, x, x, definite(), definite(), none(pairs())),),
        ),
        "refine.gicp.gicp": Row(functools.partial(gicp.gicp, **few), (x, y), same, kinks=True),
        "refine.methods.refine": Row(
            functools.partial(methods.refine, **solution), (x, y), same, kinks=True
        ),
        "refine.solve.set_up": Row(entered_problem, (x, y), same),
        "refine.solve.solve": Row(
            lambda x, y: solve.solve(problem(x, y), point_to_point.POINT_TO_POINT, config=SOLUTION),
            (x, y),
            same,
            kinks=True,
        ),
        # Its value is the pose that it is given.
        "refine.solve.at_fixed_point": Row(
            fixed_point,
            (turned, x, y, tilted),
            ((IDENTITY, x, x, 0 * x), (IDENTITY, x, x + 100, tilted), (IDENTITY, 0 * x, 0 * x, x)),
            smooth=False,
        ),
        "refine.solve.change_of_pose": Row(
            solve.change_of_pose, (pose(), pose()), ((IDENTITY, IDENTITY),), smooth=False
        ),
        "refine.uncertainty.pose_uncertainty": Row(
            functools.partial(uncertainty.pose_uncertainty, **few),
            (IDENTITY, x, y),
            every(lambda x: (IDENTITY, x, x)),
            kinks=True,
        ),
        "refine.uncertainty.uncertainty_of_pairs": Row(
            functools.partial(uncertainty.uncertainty_of_pairs, weighting=WIDE),
            (frames, x, y, tilted, pairs()),
            ((frames, x, x, 0 * x, pairs()), (frames, x, y, tilted, none(pairs()))),
        ),
        "refine.uncertainty.scan_covariance": Row(
            lambda x, y, across, these, centre: uncertainty.scan_covariance(
                x, y, across, these, WIDE, centre
            ),
            (x, y, tilted, pairs(), np.zeros(3)),
            ((x, x, 0 * x, pairs(), np.zeros(3)), (x, y, tilted, none(pairs()), np.zeros(3))),
            smooth=False,
        ),
    }


def refine_rows() -> dict[str, Row]:
    return small_parts() | steps_and_loops()
