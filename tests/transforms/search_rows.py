"""Rows of the search: its stages one by one, and the whole of it with few candidates."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxreg.geometry.neighbors import squared_distances
from jaxreg.search import (
    alignment,
    candidates,
    compatibility,
    description,
    descriptors,
    hypotheses,
    learned,
    nearest,
    pipeline,
    ranking,
    stages,
    surface,
)
from jaxreg.search.config import SearchConfig
from jaxreg.types import RigidTransform
from tests.transforms.rows import N, Row, clouds_that_break, every, points, pose

RNG = np.random.default_rng(3)
CONFIG = SearchConfig(radii=(0.6,), candidates=12, seeds=6, screened=4, aligned=2)
ALL, NONE = np.ones(N, bool), np.zeros(N, bool)
ONE = np.arange(N) == 2
"""Masks; with the last a cloud is a single point."""
APART = hypotheses.Separation(0.1, 0.05)


def unit_vectors(n=N):
    vectors = points(n)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def surface_of(cloud):
    return surface.Surface(cloud, unit_vectors(), RNG.uniform(0, 0.3, N), unit_vectors(), ALL)


def poses(count=5):
    return RigidTransform(*(np.stack(x) for x in zip(*(pose() for _ in range(count)), strict=True)))


def grid_of(cloud):
    return nearest.nearest_grid(cloud, jnp.asarray(ALL), cells=6, margin=0.1)


def in_grid(queries, cloud):
    return nearest.lookup(grid_of(cloud), queries)


def of_cloud(function):
    """A descriptor as a function of a cloud and its normals."""

    def described(cloud, normals, mask):
        cloud = jnp.where(mask[:, None], cloud, 0)
        return function(cloud, normals, squared_distances(cloud, cloud), mask)

    return described


def by_grids(pose, source, reference):
    grids = grid_of(source.points), grid_of(reference.points)
    return ranking.score_terms_by_grid(pose, source, reference, grids, step=2)


def described(cloud, mask):
    return description.describe(cloud, mask, unit=0.7, config=CONFIG)


def compared(one, other):
    every_row = jnp.asarray(ALL)
    return description.compare(described(one, every_row), described(other, every_row))


def searched(one, other, mask, max_angle):
    found = stages.search_described(
        described(one, mask), described(other, jnp.asarray(ALL)), max_angle=max_angle, config=CONFIG
    )
    return best(found)


def best(found):
    """The best pose: the scores of clouds this small jump where rounding moves a point over a limit."""
    return jax.tree.map(lambda leaf: leaf[0], found.poses)


def search_rows() -> dict[str, Row]:
    return {f"search.{name}": row for name, row in (parts() | descriptions() | whole()).items()}


def parts() -> dict[str, Row]:
    x, y, moved = points(), points(), surface_of(points())
    agree = RNG.uniform(size=(N, N))
    agree = (agree + agree.T) / 2
    pairs = (x, y, unit_vectors(), unit_vectors(), ALL)
    same = every(lambda x: (pose(), surface_of(x), surface_of(x)))
    return {
        "alignment.align_coarse": Row(
            lambda t, a, b: alignment.align_coarse(t, a, b, grid_of(b.points), widths=(2.0, 1.0)),
            (pose(), moved, surface_of(y)),
            same,
        ),
        "alignment.align_fine": Row(
            functools.partial(alignment.align_fine, widths=(2.0, 1.0)),
            (pose(), moved, surface_of(y)),
            (*same, (pose(), moved._replace(mask=NONE), moved)),
        ),
        "candidates.select_candidates": Row(
            lambda c, a, b: candidates.select_candidates(c, a, b, matches=2, keep=9),
            (RNG.uniform(-1, 1, (N, N)), np.arange(N) < 6, ALL),
            ((np.zeros((N, N)), ALL, ALL), (np.full((N, N), np.nan), NONE, ALL)),
            smooth=False,
        ),
        "compatibility.compatibility": Row(
            functools.partial(compatibility.compatibility, tolerance=2.0, cosine_tolerance=1.0),
            pairs,
            (*every(lambda x: (x, x, 0 * x, 0 * x, ALL)), (*pairs[:-1], NONE)),
        ),
        "compatibility.second_order": Row(
            lambda c: compatibility.second_order(c, 4), (agree,), ((0 * agree,),)
        ),
        "compatibility.spectral_weights": Row(
            compatibility.spectral_weights, (agree,), ((0 * agree,),)
        ),
        "hypotheses.pose_hypotheses": Row(
            functools.partial(hypotheses.pose_hypotheses, seeds=3, consensus_size=4),
            (x, y, agree),
            every(lambda x: (x, x, 0 * agree)),
        ),
        "hypotheses.screen": Row(
            lambda t, a, b: hypotheses.screen(t, a, b, grid_of(b.points), width=1.0),
            (poses(), moved, surface_of(y)),
            every(lambda x: (poses(), surface_of(x), surface_of(x))),
        ),
        "hypotheses.pick_distinct": Row(
            lambda t, s: hypotheses.pick_distinct(t, s, count=3, apart=APART),
            (poses(), RNG.uniform(size=5)),
            ((poses(), np.zeros(5)),),
            smooth=False,
        ),
        "hypotheses.best_of": Row(hypotheses.best_of, (poses(), np.array([2, 0], np.int32))),
        "nearest.nearest_packed": Row(
            nearest.nearest_packed, (x, y, ALL), every(lambda x: (x, x, ONE)), smooth=False
        ),
        "nearest.nearest_grid": Row(
            lambda x, m: nearest.nearest_grid(x, m, cells=4, margin=0.1),
            (x, ALL),
            (*every(lambda x: (x, ALL)), (x, NONE)),
        ),
        "nearest.lookup": Row(in_grid, (x, y), every(lambda x: (x, x)), smooth=False),
        "ranking.sparsity_factor": Row(
            ranking.sparsity_factor, (np.float64(0.1), np.float64(0.2)), ((*np.zeros((2,)),),)
        ),
        "ranking.score_terms": Row(
            functools.partial(ranking.score_terms, sparsity=20.0),
            (pose(), moved, surface_of(y)),
            (*same, (pose(), moved._replace(mask=NONE), moved)),
        ),
        "ranking.score_terms_by_grid": Row(by_grids, (pose(), moved, surface_of(y)), same),
        "ranking.move": Row(ranking.move, (pose(), moved)),
        "ranking.score_of": Row(ranking.score_of, (ranking.ScoreTerms(*RNG.uniform(size=(5, 3))),)),
        "ranking.break_ties": Row(
            ranking.break_ties,
            (np.array([0.3, 0.31, 0.1]), np.array([0.2, 0.1, 0.3]), np.ones(3, bool)),
            (
                (np.zeros(3), np.zeros(3), np.ones(3, bool)),
                (np.zeros(3), np.ones(3), ALL[:3] & False),
            ),
        ),
        "surface.thinned": Row(lambda s: surface.thinned(s, 2), (moved,)),
    }


def descriptions() -> dict[str, Row]:
    x, normals = points(), unit_vectors()
    network = jax.tree.map(
        lambda w: np.asarray(w, np.float64), learned.init_network(jax.random.key(0), 4)
    )
    masked = tuple((x, normals, mask) for mask in (ONE, NONE))
    broken = (*every(lambda x: (x, normals, ALL)), *masked)
    return {
        "descriptors.gaussian_normals": Row(
            of_cloud(lambda x, _, d, m: jnp.abs(descriptors.gaussian_normals(x, d, m, radius=2.0))),
            (x, normals, ALL),
            broken,
            smooth=False,
        ),
        "descriptors.moments": Row(
            of_cloud(functools.partial(descriptors.moments, radii=(3.0, 5.0))),
            (x * [1.5, 1.0, 0.5], normals, ALL),
            broken,
            smooth=False,
        ),
        "descriptors.openness": Row(
            of_cloud(functools.partial(descriptors.openness, radius=2.0)), (x, normals, ALL), broken
        ),
        "descriptors.mean_spacing": Row(
            of_cloud(lambda x, _, d, m: descriptors.mean_spacing(d, m)), (x, normals, ALL), broken
        ),
        "descriptors.standardized": Row(
            descriptors.standardized,
            (RNG.normal(size=(N, 4)), RNG.normal(size=(5, 4)), np.arange(N) < 6, ALL[:5]),
            ((np.ones((N, 4)), np.ones((5, 4)), ALL, NONE[:5]),),
        ),
        "learned.learned_features": Row(
            learned.learned_features,
            (network, RNG.normal(size=(N, 4)), RNG.uniform(size=N), x, normals),
            every(lambda x: (network, np.zeros((N, 4)), np.zeros(N), x, 0 * x)),
        ),
        "description.describe": Row(
            described,
            (x, ALL),
            (*every(lambda x: (x, ALL)), (x, ONE), (np.full((N, 3), np.nan), NONE)),
            smooth=False,
        ),
        "description.compare": Row(compared, (x, points()), every(lambda x: (x, x)), smooth=False),
    }


def whole() -> dict[str, Row]:
    """The search itself: what it finds jumps, and only the last refinement has a derivative."""
    # One cloud twice, the second time turned: between unrelated ones rounding chooses the pose. Drawn
    # here, so that no other row of the table changes it.
    rng = np.random.default_rng(3)
    x, bound = rng.normal(size=(N, 3)), np.float64(2.0)
    turn = Rotation.from_rotvec([0.3, -0.5, 0.7]).as_matrix()
    y = x @ turn.T + 0.01 * rng.normal(size=(N, 3))
    broken = (*every(lambda x: (x, x, ALL, bound)), (x, y, ONE, bound), (x, y, NONE, bound))
    entered = lambda x, y, m: pipeline.enter(x, y, m, unit=0.5)  # noqa: E731

    def poses_of(function):
        def pose_of(x, y, mask, angle):
            found = function(x, y, source_mask=mask, max_angle=angle, config=CONFIG)
            return best(found) if hasattr(found, "poses") else found.transform

        return pose_of

    return {
        "pipeline.enter": Row(
            entered, (x, y, ALL), tuple((c, c, ALL) for c in clouds_that_break().values())
        ),
        "stages.search_described": Row(
            searched, (x, y, ALL, bound), broken, smooth=False, rounding=1e-3
        ),
        "pipeline.search_poses": Row(
            poses_of(pipeline.search_poses), (x, y, ALL, bound), broken, smooth=False, rounding=1e-3
        ),
        "pipeline.register_global": Row(
            poses_of(pipeline.register_global),
            (x, y, ALL, bound),
            broken,
            smooth=False,
            rounding=1e-7,
        ),
    }
