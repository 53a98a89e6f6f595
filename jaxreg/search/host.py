"""The search for a pose as the host runs it: clouds of any size in, the best verified pose out.

Trees answer what is near on the host; everything that is computed from it is jitted, on clouds
padded to a few sizes.
"""

import functools
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from jaxreg import compilation, scans
from jaxreg.config import RegisterConfig
from jaxreg.dense.register import search_dense
from jaxreg.refine.gicp import gicp_step
from jaxreg.refine.normals import normals, plane_covariances
from jaxreg.refine.pairing import Pairs, Weighting
from jaxreg.search import starts
from jaxreg.search.compatibility import hypotheses
from jaxreg.search.descriptors import fpfh, outward
from jaxreg.search.matches import match_histograms
from jaxreg.types import RigidTransform

_SMALLEST = 128
"""Smallest size of a padded cloud."""
_NORMAL_NEIGHBORS = 16
_SAMPLES = 400
"""Points of each cloud that a pose is judged by."""
_DENSE_POINTS = 1024
_START_POINTS = 256
_START_REACH, _START_TRIM, _START_ITERATIONS, _START_KEPT = 0.25, 0.7, 8, 16
"""The covering is coarse: 20 degrees turn a point by a third of its radius."""
_POLISH_WIDTHS = np.geomspace(4, 1, 8).astype(np.float32)
_POLISHED, _POLISH_SAMPLES = 12, 512
_POLISH_THICKNESS = 0.05
"""Coarse points are means over voxels, which lie off a curved surface."""


class Coarse(NamedTuple):
    """A cloud as the search sees it: `points` are padded float32, `tree` holds the valid ones."""

    points: Float[np.ndarray, "n 3"]
    mask: Bool[np.ndarray, "n"]
    neighbors: Int[np.ndarray, "n k"]
    normals: Float[np.ndarray, "n 3"]
    tree: cKDTree

    @property
    def valid(self) -> Float[np.ndarray, "v 3"]:
        """The points without the padding, float64."""
        return np.asarray(self.tree.data)


def coarse_pair(
    source: Float[np.ndarray, "n 3"], reference: Float[np.ndarray, "m 3"], config: RegisterConfig
) -> tuple[Coarse, Coarse, float]:
    """Both clouds at one density, and their spacing: histograms of unlike densities do not compare."""
    x, y = (scans.reduce_to(points, config.search_points) for points in (source, reference))
    spacing = max(scans.spacing(x), scans.spacing(y))
    x, y = (
        scans.voxel_reduced(points, spacing) if 1.3 * scans.spacing(points) < spacing else points
        for points in (x, y)
    )
    return _coarse(x, config), _coarse(y, config), max(scans.spacing(x), scans.spacing(y))


def _coarse(points: np.ndarray, config: RegisterConfig) -> Coarse:
    size = scans.bucket(len(points), smallest=_SMALLEST, largest=config.search_points)
    tree = cKDTree(points)
    k = min(config.feature_neighbors, len(points) - 1)
    neighbors = np.tile(np.arange(size, dtype=np.int32)[:, None], (1, config.feature_neighbors))
    if k > 0:
        neighbors[: len(points), :k] = tree.query(points, k=k + 1, workers=-1)[1][:, 1:]
    rows, mask = scans.padded(points, size)
    directions = np.asarray(_normals()(rows, neighbors[:, :_NORMAL_NEIGHBORS], mask))
    return Coarse(rows, mask, neighbors, directions, tree)


@functools.cache
def _normals():
    return compilation.jit(normals)


def feature_poses(
    source: Coarse, reference: Coarse, spacing: float, config: RegisterConfig
) -> RigidTransform:
    """Poses (leading axis) from matched histograms, best supported first."""
    poses, support = _feature_poses()(
        *source[:4],
        *reference[:4],
        np.float32(spacing),
        radius=config.feature_radius,
        kept=config.correspondences,
        tolerance=config.tolerance,
        seeds=config.seeds,
        partners=config.partners,
    )
    return _taken(poses, np.argsort(-np.asarray(support), kind="stable"))


@functools.cache
def _feature_poses():
    def describe(points, mask, near, normal, radius):
        return fpfh(points, outward(points, normal, near), near, radius, mask)

    def run(*clouds, radius, kept, tolerance, **options):
        *clouds, spacing = clouds
        source, reference = clouds[:4], clouds[4:]
        described = [describe(*cloud, radius * spacing) for cloud in (source, reference)]
        found = match_histograms(*described, source[1], reference[1], kept=kept)
        return hypotheses(
            source[0][found.source_index],
            reference[0][found.reference_index],
            found.mask,
            tolerance=tolerance * spacing,
            **options,
        )

    static = ("radius", "kept", "tolerance", "seeds", "partners")
    return compilation.jit(run, static_argnames=static)


def start_poses(
    source: Coarse, reference: Coarse, config: RegisterConfig, *, largest_deg: float
) -> RigidTransform:
    """Poses (leading axis) from a covering of the rotations, best first."""
    rotations = starts.rotation_covering(config.starts, largest_deg=largest_deg)
    x, y = (scans.reduce_to(cloud.valid, _START_POINTS) for cloud in (source, reference))
    (x, x_mask), (y, y_mask) = (scans.padded(points, _START_POINTS) for points in (x, y))
    poses, _ = _start_poses()(
        x,
        y,
        rotations.astype(np.float32),
        x_mask,
        y_mask,
        limit=_START_REACH,
        kept=_START_KEPT,
        iterations=_START_ITERATIONS,
        trim=_START_TRIM,
    )
    return _taken(poses, slice(None))


@functools.cache
def _start_poses():
    return compilation.jit(
        starts.multi_start, static_argnames=("limit", "kept", "iterations", "trim")
    )


def dense_poses(source: Coarse, reference: Coarse) -> RigidTransform:
    """The finalists (leading axis) of the dense path, best first."""
    rows = []
    for cloud in (source, reference):
        points = scans.reduce_to(cloud.valid, _DENSE_POINTS)
        size = scans.bucket(len(points), smallest=_SMALLEST, largest=_DENSE_POINTS)
        rows.append(scans.padded(points, size))
    (x, x_mask), (y, y_mask) = rows
    return _taken(_dense()(x, y, source_mask=x_mask, reference_mask=y_mask).poses, slice(None))


@functools.cache
def _dense():
    return compilation.jit(search_dense)


def polished(
    poses: RigidTransform, source: Coarse, reference: Coarse, spacing: float
) -> RigidTransform:
    """Every pose after a few robust steps of generalised ICP on samples, all poses at once."""
    count = len(poses.rotation)
    # One more size of the leading axis would be one more compilation.
    poses = _taken(poses, np.minimum(np.arange(max(count, _POLISHED)), count - 1))
    rows = [_sample(cloud, _POLISH_SAMPLES) for cloud in (source, reference)]
    for width in _POLISH_WIDTHS:
        pairs = _nearest_pairs(poses, source, reference, *rows)
        poses = _polish_step()(
            RigidTransform(*(part.astype(np.float32) for part in poses)),
            (source.points, source.normals),
            (reference.points, reference.normals),
            pairs,
            np.float32(4 * spacing),
            width,
        )
        poses = _taken(poses, slice(None))
    return _taken(poses, slice(count))


def _sample(cloud: Coarse, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows spread over the cloud, filled up to `size`, and the mask of those that count."""
    count = len(cloud.valid)
    rows = np.linspace(0, count - 1, min(size, count)).round().astype(np.int32)
    return np.resize(rows, size), np.arange(size) < count


def _nearest_pairs(poses, source: Coarse, reference: Coarse, source_rows, reference_rows) -> Pairs:
    """Sampled points with their nearest in the other cloud, both ways, for every pose."""
    (rows, mask), (other_rows, other_mask) = source_rows, reference_rows
    moved = np.einsum("pij,nj->pni", poses.rotation, source.valid[rows])
    _, index = reference.tree.query(moved + poses.translation[:, None], workers=-1)
    back = reference.valid[other_rows][None] - poses.translation[:, None]
    _, other_index = source.tree.query(np.einsum("pji,pnj->pni", poses.rotation, back), workers=-1)
    rows, other_rows = (np.broadcast_to(r, index.shape) for r in (rows, other_rows))
    mask = np.broadcast_to(np.concatenate([mask, other_mask]), (len(index), 2 * len(mask)))
    return Pairs(
        np.concatenate([rows, other_index], axis=1).astype(np.int32),
        np.concatenate([index, other_rows], axis=1).astype(np.int32),
        mask,
    )


@functools.cache
def _polish_step():
    def run(poses, source, reference, pairs, max_distance, width):
        (x, x_normals), (y, y_normals) = source, reference
        covariances = [plane_covariances(n, _POLISH_THICKNESS) for n in (x_normals, y_normals)]
        weighting = Weighting("geman_mcclure", None, max_distance, 1.0)

        def step(pose, pairs):
            return gicp_step(
                pose, x, y, *covariances, pairs, weighting, width, thickness=_POLISH_THICKNESS
            )

        return jax.vmap(step)(poses, pairs)

    return compilation.jit(run)


def disagreement(
    poses: RigidTransform, source: Coarse, reference: Coarse, reach: float
) -> Float[np.ndarray, "p"]:
    """Mean over samples of both clouds of ``min(d / reach, 1)^2``, for every pose: 0 is the best."""
    x, y = (cloud.valid[:: max(1, len(cloud.valid) // _SAMPLES)] for cloud in (source, reference))
    moved = np.einsum("pij,nj->pni", poses.rotation, x) + poses.translation[:, None]
    back = np.einsum("pji,pnj->pni", poses.rotation, y[None] - poses.translation[:, None])
    total = 0.0
    for tree, points in ((reference.tree, moved), (source.tree, back)):
        distance, _ = tree.query(points, distance_upper_bound=reach, workers=-1)
        total = total + np.minimum(distance / reach, 1) ** 2 @ np.ones(points.shape[1])
    return total / (len(x) + len(y))


def distinct_best(
    poses: RigidTransform, scores: Float[np.ndarray, "p"], count: int, *, apart: float
) -> RigidTransform:
    """The `count` best poses that differ by more than `apart` (chord of R, or length of t)."""
    chosen: list[int] = []
    for index in np.argsort(scores, kind="stable"):
        turned = np.linalg.norm(poses.rotation[chosen] - poses.rotation[index], axis=(1, 2))
        shifted = np.linalg.norm(poses.translation[chosen] - poses.translation[index], axis=1)
        if not np.any((turned < apart) & (shifted < apart)):
            chosen.append(int(index))
        if len(chosen) == count:
            break
    return _taken(poses, np.array(chosen))


def _taken(poses: RigidTransform, index) -> RigidTransform:
    return jax.tree.map(lambda part: np.asarray(part, np.float64)[index], RigidTransform(*poses))


def joined(*poses: RigidTransform) -> RigidTransform:
    """Poses one after the other along the leading axis."""
    return RigidTransform(*(np.concatenate(parts) for parts in zip(*poses, strict=True)))


def angles(poses: RigidTransform) -> Float[np.ndarray, "p"]:
    """Rotation angles in [0, pi], radians."""
    chord = np.linalg.norm(poses.rotation - np.eye(3), axis=(1, 2)) / np.sqrt(8)
    return 2 * np.arcsin(np.minimum(chord, 1))


def turned_less(poses: RigidTransform, largest_deg: float) -> RigidTransform:
    """The poses whose rotation angle is at most `largest_deg`; the identity always is."""
    return _taken(poses, angles(poses) <= np.radians(largest_deg) + 1e-6)


def differs(poses: RigidTransform, index: int) -> Bool[np.ndarray, "p"]:
    """Which poses turn by over 15 degrees from that at `index`, or lie a fifth of a radius from it."""
    chord = np.linalg.norm(poses.rotation - poses.rotation[index], axis=(1, 2)) / np.sqrt(8)
    apart = np.linalg.norm(poses.translation - poses.translation[index], axis=1)
    return (2 * np.arcsin(np.minimum(chord, 1)) > np.radians(15)) | (apart > 0.2)
