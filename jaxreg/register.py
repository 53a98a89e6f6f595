"""Register two scans: numpy in, numpy out, any sizes and any unit."""

import functools
import time
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from jaxreg import compilation, scans, search
from jaxreg.refine.gicp import gicp
from jaxreg.refine.icp import icp
from jaxreg.refine.point_to_plane import point_to_plane
from jaxreg.types import RigidTransform

Rotation = Literal["limited", "full"]
Refinement = Literal["gicp", "icp", "point_to_plane"]

_SMALLEST, _LARGEST = 64, 2048
_SEARCHED = 256


class ScanRegistration(NamedTuple):
    """Where the source lies in the frame of the reference, and how far that can be trusted.

    float64, in the unit of the input; a row for every row of the source. `confidence[i]`, in [0, 1],
    says how well point `i` agrees with the reference after alignment, and `correspondences[i]` is
    the reference point nearest to it there (NaN for a dropped point). `fitness` is the share of the
    source within reach of the reference, `inlier_rmse` the root mean square distance of those,
    `overlap` the share of both clouds within reach of the other. `covariance` is that of a rotation
    vector (rad) and a translation about the reference's centroid. `weak_directions` names motions that
    the clouds do not resist. `success` is False when the pose should not be trusted; `probability`
    is the calibrated chance that it is right. `dropped` counts the non-finite rows of both clouds.
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    transformation: Float[np.ndarray, "4 4"]
    confidence: Float[np.ndarray, "n"]
    correspondences: Float[np.ndarray, "n 3"]
    fitness: float
    inlier_rmse: float
    overlap: float
    covariance: Float[np.ndarray, "6 6"]
    weak_directions: tuple[str, ...]
    success: bool
    probability: float
    seconds: float
    dropped: int


def register(
    source: object,
    reference: object,
    *,
    initial: object = None,
    rotation: Rotation = "limited",
    refine: Refinement | None = "gicp",
    nonfinite: Literal["raise", "drop"] = "raise",
    seed: int = 0,
) -> ScanRegistration:
    """The rigid transform ``y = R x + t`` that lays `source` on `reference`, with a verdict.

    Clouds are (n, 3) and (m, 3), anything numpy understands, in one unit. `initial` (4x4 or a
    `RigidTransform`) starts from a known pose and skips the search. `rotation` says how far apart the
    clouds may be turned: "limited" to about 75 degrees, or "full". Deterministic; the order of the
    points plays no role.

    Raises:
      ValueError: a cloud is not numeric (n, 3) with three finite points or more (the message names
        the row), `initial` is no rigid transform, or an option is unknown.
    """
    begin = time.perf_counter()
    _check_options(rotation, refine)
    start = None if initial is None else _check_initial(initial)
    moving = scans.make_scan(source, "source", nonfinite=nonfinite)
    fixed = scans.make_scan(reference, "reference", nonfinite=nonfinite)
    frame = scans.common_frame(moving.points, fixed.points)
    x = (moving.points - frame.source_centre) / frame.length
    y = (fixed.points - frame.reference_centre) / frame.length
    x, y = (scans.reduce_to(points, _LARGEST) for points in (x, y))
    pose = _search(x, y, rotation) if start is None else _into(frame, start)
    pose = _refined(x, y, pose, refine)
    return _result(source, reference, moving, fixed, _out_of(frame, pose), frame, begin)


def _check_options(rotation: str, refine: str | None) -> None:
    if rotation not in ("limited", "full"):
        raise ValueError(f"rotation must be 'limited' or 'full', got {rotation!r}.")
    if refine not in ("gicp", "icp", "point_to_plane", None):
        raise ValueError(f"refine must be 'gicp', 'icp', 'point_to_plane' or None, got {refine!r}.")


def _check_initial(initial: object) -> RigidTransform:
    if isinstance(initial, RigidTransform):
        rotation, translation = (np.asarray(part, np.float64) for part in initial)
    else:
        matrix = np.asarray(initial, np.float64)
        if matrix.shape != (4, 4):
            raise ValueError(f"initial must be a 4x4 matrix [[R, t], [0, 1]], got {matrix.shape}.")
        rotation, translation = matrix[:3, :3], matrix[:3, 3]
    finite = np.isfinite(rotation).all() and np.isfinite(translation).all()
    if not finite or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        raise ValueError("initial is no rigid transform: R must be orthogonal and all be finite.")
    if np.linalg.det(rotation) < 0:
        raise ValueError("initial mirrors (det R = -1): give a rotation.")
    return RigidTransform(_orthogonal(rotation), translation)


def _orthogonal(rotation: np.ndarray) -> np.ndarray:
    """The nearest rotation, in float64."""
    u, _, vt = np.linalg.svd(np.asarray(rotation, np.float64))
    return u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt


def _into(frame: scans.Frame, pose: RigidTransform) -> RigidTransform:
    shift = pose.rotation @ frame.source_centre + pose.translation - frame.reference_centre
    return RigidTransform(pose.rotation, shift / frame.length)


def _out_of(frame: scans.Frame, pose: RigidTransform) -> RigidTransform:
    rotation = _orthogonal(pose.rotation)
    shift = np.asarray(pose.translation, np.float64) * frame.length
    return RigidTransform(rotation, frame.reference_centre - rotation @ frame.source_centre + shift)


def _pad(points: np.ndarray):
    return scans.padded(points, scans.bucket(len(points), smallest=_SMALLEST, largest=_LARGEST))


@functools.cache
def _compiled_search():
    return compilation.jit(
        search.multi_start, static_argnames=("limit", "kept", "iterations", "trim")
    )


@functools.cache
def _compiled_refinement(name: str):
    method = {"gicp": gicp, "icp": icp, "point_to_plane": point_to_plane}[name]

    def run(x, y, pose, x_mask, y_mask):
        return method(
            x,
            y,
            initial=pose,
            source_mask=x_mask,
            reference_mask=y_mask,
            kernel="cauchy",
            anneal=4.0,
        )

    return compilation.jit(run)


def _search(x: np.ndarray, y: np.ndarray, rotation: Rotation) -> RigidTransform:
    rotations = search.rotation_covering(
        *((576,) if rotation == "full" else (1024,)),
        largest_deg=180.0 if rotation == "full" else 80.0,
    )
    x, y = (scans.reduce_to(points, _SEARCHED) for points in (x, y))
    (x, x_mask), (y, y_mask) = _pad(x), _pad(y)
    poses, _ = _compiled_search()(
        x,
        y,
        rotations.astype(np.float32),
        x_mask,
        y_mask,
        limit=0.25,
        kept=32,
        iterations=10,
        trim=0.8,
    )
    return jax.tree.map(lambda a: np.asarray(a[0], np.float64), poses)


def _refined(x, y, pose: RigidTransform, refine: Refinement | None) -> RigidTransform:
    if refine is None:
        return pose
    (x, x_mask), (y, y_mask) = _pad(x), _pad(y)
    pose = RigidTransform(*(np.asarray(part, np.float32) for part in pose))
    pose = _compiled_refinement(refine)(x, y, pose, x_mask, y_mask)
    return jax.tree.map(lambda a: np.asarray(a, np.float64), pose)


def _result(source, reference, moving, fixed, pose, frame, begin) -> ScanRegistration:
    points = np.asarray(source, np.float64)
    centred = (points[moving.kept] - frame.source_centre) / frame.length
    y = (fixed.points - frame.reference_centre) / frame.length
    inner = _into(frame, pose)
    aligned = centred @ inner.rotation.T + inner.translation
    distance, index = scans.nearest(cKDTree(y), aligned)
    back, _ = scans.nearest(cKDTree(aligned), y)
    spacing = _spacing(y)
    reach = 2.5 * spacing
    near = distance <= reach
    confidence = np.zeros(len(points))
    confidence[moving.kept] = np.exp(-0.5 * (distance / (0.5 * reach)) ** 2)
    matches = np.full(points.shape, np.nan)
    matches[moving.kept] = fixed.points[index]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose
    fitness = float(near.mean())
    overlap = float((near.sum() + (back <= reach).sum()) / (len(near) + len(back)))
    rmse = float(np.sqrt(np.mean(distance[near] ** 2)) * frame.length) if near.any() else 0.0
    dropped = int(np.sum(~moving.kept) + np.sum(~fixed.kept))
    return ScanRegistration(
        rotation=pose.rotation,
        translation=pose.translation,
        transformation=matrix,
        confidence=confidence,
        correspondences=matches,
        fitness=fitness,
        inlier_rmse=rmse,
        overlap=overlap,
        covariance=np.zeros((6, 6)),
        weak_directions=(),
        success=bool(overlap > 0.5),
        probability=overlap,
        seconds=time.perf_counter() - begin,
        dropped=dropped,
    )


def _spacing(points: np.ndarray) -> float:
    """Median distance of a point to its nearest other one."""
    if len(points) < 2:
        return 1e-6
    return float(np.median(cKDTree(points).query(points, k=2, workers=-1)[0][:, 1]))
