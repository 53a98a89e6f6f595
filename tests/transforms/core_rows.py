"""Rows of the functions of the core: what every stage of the network is made of."""

import functools

import jax.numpy as jnp
import numpy as np

from jaxreg.config import LossConfig
from jaxreg.geometry import eigen3x3, neighbors, numerics, procrustes, rigid
from jaxreg.network import features, inliers, invariants, losses, matching, matching_blocks
from jaxreg.types import RigidTransform
from tests.transforms.network_rows import SMALL
from tests.transforms.rows import (
    RNG,
    K,
    N,
    Row,
    every,
    everything,
    grid,
    neighbor_graph,
    nowhere,
    points,
    pose,
)


def maps_of(distance, nearest, source_idx, reference_idx):
    graphs = matching.incidence(source_idx), matching.incidence(reference_idx)
    return matching.matching_maps(distance, nearest, *graphs, alpha=0.7)


def in_blocks(source, reference, source_idx, reference_idx, points):
    graphs = matching.incidence(source_idx), matching.incidence(reference_idx)
    branch = matching_blocks.Branch(source, reference, *graphs)
    return matching_blocks.match_in_blocks((branch,), points, alpha=0.7)


def core_rows() -> dict[str, Row]:
    idx, inlier_idx = neighbor_graph(), np.array([1, 4, 5, 0], np.int32)
    valid, mask = np.ones(4, bool), np.ones(N, bool)
    part = np.arange(N) < 5
    u = np.array([0.5, -1.0, 2.0])
    zero3 = np.zeros(3)
    tilted = np.diag([1.0, 2.0, 4.0]) + 0.1 * np.ones((3, 3))
    scores = RNG.uniform(0.1, 1, (N, N))
    huber = functools.partial(losses.huber, beta=0.5)
    structure = functools.partial(invariants.geometric_structure, edge="vector", angles="all")
    lengths = functools.partial(invariants.edges, kind="length")
    gc = functools.partial(losses.global_consistency, beta=0.01)
    gs = functools.partial(losses.geometric_consistency, config=SMALL)
    return {
        "geometry.numerics.safe_sqrt": Row(
            numerics.safe_sqrt, (RNG.uniform(1, 2, 4),), ((np.array([0.0, -1]),),)
        ),
        "geometry.numerics.safe_norm": Row(numerics.safe_norm, (points(),), ((np.zeros((2, 3)),),)),
        "geometry.numerics.all_finite": Row(
            numerics.all_finite, (np.ones((2, 3)),), ((np.array([0.0, 1e300]),),), smooth=False
        ),
        "geometry.numerics.leading_max": Row(
            numerics.leading_max,
            (points(),),
            ((np.zeros((3, 4)),), (np.repeat(points(2), 3, axis=0),)),
        ),
        "geometry.numerics.included_angle": Row(
            numerics.included_angle,
            (points(), points()),
            ((u, u), (u, -u), (u, zero3), (zero3, u), (zero3, zero3), (u, 1e-9 * u)),
        ),
        "geometry.eigen3x3.eigh": Row(
            lambda m: (eigen3x3.eigh(m).values, jnp.abs(eigen3x3.eigh(m).vectors)),
            (tilted,),
            tuple((m,) for m in (np.zeros((3, 3)), np.eye(3), np.ones((3, 3)))),
        ),
        "geometry.eigen3x3.inverse": Row(eigen3x3.inverse, (tilted,)),
        "geometry.eigen3x3.pseudo_inverse": Row(eigen3x3.pseudo_inverse, (tilted,)),
        "geometry.rigid.identity": Row(lambda: rigid.identity(jnp.float64), ()),
        "geometry.rigid.apply": Row(
            rigid.apply, (pose(), points()), ((nowhere(), np.zeros((N, 3))),)
        ),
        "geometry.rigid.compose": Row(rigid.compose, (pose(), pose()), ((nowhere(), nowhere()),)),
        "geometry.rigid.inverse": Row(rigid.inverse, (pose(),), ((nowhere(),),)),
        "geometry.rigid.to_matrix": Row(rigid.to_matrix, (pose(),)),
        "geometry.rigid.from_matrix": Row(rigid.from_matrix, (RNG.normal(size=(4, 4)),)),
        "geometry.neighbors.squared_distances": Row(
            neighbors.squared_distances, (points(), points(5)), every(lambda x: (x, x))
        ),
        "geometry.neighbors.without_padding": Row(
            neighbors.without_padding,
            (points(), part),
            ((np.where(part[:, None], np.ones(3), np.nan), part),),
        ),
        "geometry.neighbors.knn": Row(
            lambda x: neighbors.knn(x, K), (points(),), every(lambda x: (x,)), smooth=False
        ),
        "geometry.neighbors.nearest_neighbor": Row(
            neighbors.nearest_neighbor, (points(),), every(lambda x: (x,)), smooth=False
        ),
        "geometry.neighbors.nearest_in": Row(
            neighbors.nearest_in, (points(), points(5)), every(lambda x: (x, x)), smooth=False
        ),
        "geometry.procrustes.weighted_procrustes": Row(
            procrustes.weighted_procrustes,
            (points(), points(), RNG.uniform(0.5, 1, N)),
            (
                *every(lambda x: (x, x, np.ones(N))),
                (points(), points(), np.zeros(N)),
                (points(), points(), np.eye(N)[2]),
                (points(), points(), -np.ones(N)),
                (grid(), grid() * [1.0, 1.0, -1.0], np.ones(N)),
            ),
        ),
        "geometry.procrustes.robust_procrustes": Row(
            functools.partial(procrustes.robust_procrustes, rounds=2),
            (points(), points(), RNG.uniform(0.5, 1, N)),
            (
                *every(lambda x: (x, x, np.ones(N))),
                (points(), points(), np.zeros(N)),
                (points(), points(), np.eye(N)[2]),
                (grid(), grid() * [1.0, 1.0, -1.0], np.ones(N)),
            ),
            kinks=True,  # Exact pairs are weighed by residuals that are rounding.
        ),
        "geometry.procrustes.geman_mcclure_weights": Row(
            procrustes.geman_mcclure_weights,
            (points(), points(), RNG.uniform(0.5, 1, N), pose()),
            every(lambda x: (x, x, np.ones(N), RigidTransform(np.eye(3), zero3))),
        ),
        "geometry.procrustes.special_procrustes": Row(
            procrustes.special_procrustes,
            (RNG.normal(size=(3, 3)),),
            ((np.eye(3),), (np.zeros((3, 3)),), (-np.eye(3),), (np.diag([1.0, 1, 0]),)),
        ),
        "network.features.relative_neighbors": Row(
            features.relative_neighbors, (points(), idx), every(lambda x: (x, idx))
        ),
        "network.matching.feature_distance": Row(
            matching.feature_distance,
            (RNG.normal(size=(N, 4)), RNG.normal(size=(5, 4))),
            (
                (np.ones((N, 4)), np.ones((5, 4))),
                (np.eye(N, 4), np.eye(N, 4)),
                (np.zeros((N, 4)), np.zeros((5, 4))),
            ),
        ),
        "network.matching.squared_feature_distance": Row(
            matching.squared_feature_distance,
            (RNG.normal(size=(N, 4)), RNG.normal(size=(5, 4))),
            ((np.ones((N, 4)), np.ones((5, 4))),),
        ),
        "network.matching.matching_scores": Row(
            matching.matching_scores,
            (scores, part),
            ((np.zeros((N, N)), part), (scores, np.zeros(N, bool)), (1e8 * scores, part)),
        ),
        "network.matching.incidence": Row(
            matching.incidence, (idx,), ((np.zeros((N, K), np.int32),),), smooth=False
        ),
        "network.matching.neighborhood_sum": Row(
            matching.neighborhood_sum,
            (scores, idx, idx[::-1]),
            ((scores, np.zeros((N, K), np.int32), idx),),
        ),
        "network.matching.final_distance": Row(
            functools.partial(matching.final_distance, alpha=0.7),
            (scores, scores.T),
            ((np.zeros((N, N)), np.zeros((N, N))),),
        ),
        "network.matching.matching_maps": Row(
            maps_of, (scores, scores.T, idx, idx), ((np.zeros((N, N)), np.zeros((N, N)), idx, idx),)
        ),
        "network.matching.match": Row(
            matching.match,
            (scores.T, scores**2, points()),
            ((*(np.full((N, N), 1 / N),) * 2, np.ones((N, 3))),),
        ),
        "network.matching_blocks.match_in_blocks": Row(
            in_blocks,
            (RNG.normal(size=(N, 4)), RNG.normal(size=(N, 4)), idx, idx, points()),
            ((np.ones((N, 4)), np.ones((N, 4)), idx, idx, np.ones((N, 3))),),
        ),
        "network.invariants.edges": Row(lengths, (points(), idx), every(lambda x: (x, idx))),
        "network.invariants.included_angles": Row(
            invariants.included_angles,
            (RNG.normal(size=(N, K, 3)),),
            ((np.zeros((N, K, 3)),), (np.ones((N, K, 3)),)),
        ),
        "network.invariants.rounding_error": Row(
            invariants.rounding_error, (points(),), every(lambda x: (x,)), smooth=False
        ),
        "network.invariants.geometric_structure": Row(
            structure, (points(), idx), every(lambda x: (x, idx))
        ),
        "network.inliers.select_inliers": Row(
            lambda w, m: inliers.select_inliers(w, 4, m),
            (RNG.uniform(size=N), part),
            ((np.ones(N), mask), (np.ones(N), np.zeros(N, bool))),
            smooth=False,
        ),
        "network.losses.huber": Row(
            huber, (RNG.uniform(0, 1, 9),), ((np.array([0.0, 0.5, 1e9]),),)
        ),
        "network.losses.global_consistency": Row(
            gc,
            (everything(points()), everything(points(6))),
            every(lambda x: (everything(x), everything(x))),
        ),
        "network.losses.neighborhood_consistency": Row(
            losses.neighborhood_consistency,
            (points(), points(), pose(), idx, inlier_idx, valid),
            (
                *every(lambda x: (x, x, RigidTransform(np.eye(3), zero3), idx, inlier_idx, valid)),
                (points(), points(), pose(), idx, inlier_idx, ~valid),
            ),
        ),
        "network.losses.geometric_consistency": Row(
            gs,
            (points(), points(), idx, inlier_idx, valid),
            every(lambda x: (x, x, idx, inlier_idx, valid)),
        ),
        "network.losses.spatial_consistency": Row(
            losses.spatial_consistency,
            (RNG.uniform(0.1, 1, N), inlier_idx, valid),
            ((np.zeros(N), inlier_idx, valid), (np.ones(N), inlier_idx, ~valid)),
        ),
        "network.losses.pose_error": Row(
            losses.pose_error,
            (everything(points()), points()),
            every(lambda x: (everything(x), x)),
        ),
        "network.losses.total_loss": Row(
            functools.partial(losses.total_loss, config=LossConfig()),
            (losses.LossTerms(*RNG.uniform(size=(4, 2))),),
        ),
    }


def late_rows() -> dict[str, Row]:
    """Drawn after all others, so that these keep their inputs."""
    return {
        "geometry.procrustes.upright_procrustes": Row(
            procrustes.upright_procrustes,
            (points(), points(), RNG.uniform(0.5, 1, N), np.array([0.0, 0.6, 0.8])),
            (
                *every(lambda x: (x, x, np.ones(N), np.array([0.0, 0.6, 0.8]))),
                (points(), points(), np.zeros(N), np.array([0.0, 0.6, 0.8])),
                (points(), points(), np.eye(N)[2], np.array([0.0, 0.6, 0.8])),
            ),
        ),
        "geometry.rigid.identity_unless": Row(
            rigid.identity_unless, (np.array(True), pose()), ((np.array(False), nowhere()),)
        ),
    }
