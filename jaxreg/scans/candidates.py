"""The poses that a search proposes for two scans, refined and judged with more points than it had."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxreg._xla import from_host
from jaxreg.geometry.rigid import nearest_rotation, rotation_angle_deg
from jaxreg.judge.evidence import REACH, Evidence, read_evidence
from jaxreg.judge.odds import log_odds
from jaxreg.judge.surface import Examined
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.kdtree import IndexedCloud, iterate_all
from jaxreg.refine.robust import Weighting
from jaxreg.scans import repeats
from jaxreg.scans.free_space import Sides
from jaxreg.types import RigidTransform

TURN_COST = 0.2
"""Log odds that half a turn costs in the choice of a pose: of poses that agree equally well (a
symmetric shape) the one that turns least is taken."""
APART_DEG, APART = 6.0, 0.1
"""Poses nearer to each other than this (in the unit of the frame) are one and the same."""
REFINE = RefineConfig(iterations=5, kernel_annealing=4.0, both_directions=True, k=16, epsilon=0.01)
"""How a pose is refined before it is judged: surfaces a spacing apart say little."""
STEP = 2
"""Every second point looks for a partner then."""
_CLEAR, _HOPELESS = 1.0, 0.6
"""If the best score of the search is above the first, poses with less than this share of it are not
looked at. On 66 pairs of four sensors the pose that the judge put first had the best score of the
search wherever that was above 0.9."""
_AS_MANY = 0.9
"""Two poses under which so nearly as many points coincide are one as good as the other."""
_COUNTS = (4, 16, 64)
"""Poses are judged in batches of these sizes, so that few programs are compiled."""


class Judged(NamedTuple):
    """Distinct poses (leading axis) in the frame of a pair, the most plausible first, and why."""

    poses: RigidTransform
    evidence: Evidence
    score: Float[np.ndarray, "k"]


class Clouds(NamedTuple):
    """Two clouds in one frame: with trees, and in their own units as judge and free space see them."""

    source: IndexedCloud
    reference: IndexedCloud
    examined: tuple[Examined, Examined]
    sides: Sides

    def judge(self, poses: RigidTransform) -> tuple[Evidence, Float[np.ndarray, "k"]]:
        """The evidence for every pose (leading axis), and its log odds (`jaxreg.judge`).

        Free space is in the log odds, not in the evidence.
        """
        count, free = len(poses.rotation), self.sides.log_odds(poses)
        poses = padded(poses)
        spacings = (
            float(cloud.spacing) * index.scale
            for cloud, index in zip(self.examined, self[:2], strict=True)
        )
        reach = 1.0001 * REACH * max(spacings)
        there = self.reference.nearest(self.source.moved_by(poses), within=reach)[1]
        back = self.source.nearest(self.reference.moved_back_by(poses), within=reach)[1]
        there, back = (
            np.pad(index.astype(np.int32), [(0, 0), (0, len(cloud.padded) - index.shape[1])])
            for index, cloud in zip((there, back), self[:2], strict=True)
        )
        scales = self.source.scale, self.reference.scale
        evidence, score = _read(poses, *self.examined, scales, there, back)
        evidence = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64)[:count], evidence)
        return evidence, np.asarray(score, np.float64)[:count] + free


def read(
    poses: RigidTransform,
    examined: tuple[Examined, Examined],
    scales: tuple[float, float],
    there: Int[np.ndarray, "k n"],
    back: Int[np.ndarray, "k m"],
) -> Evidence:
    """The evidence for poses whose nearest points are known: see `jaxreg.judge.read_evidence`."""
    count = len(poses.rotation)
    poses = padded(poses)
    there, back = (
        np.pad(
            np.concatenate([index, index[-1:].repeat(len(poses.rotation) - count, 0)]),
            [(0, 0), (0, len(cloud.mask) - index.shape[1])],
        ).astype(np.int32)
        for index, cloud in zip((there, back), examined, strict=True)
    )
    evidence, _ = _read(poses, *examined, scales, there, back)
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64)[:count], evidence)


def odds(evidence: Evidence) -> Float[np.ndarray, "k"]:
    """The log odds of evidence in numpy."""
    return np.asarray(_log_odds(evidence), np.float64)


_log_odds = from_host(jax.jit(log_odds))


def padded(poses: RigidTransform) -> RigidTransform:
    """The poses, the last one repeated up to one of a few counts."""
    count = len(poses.rotation)
    size = next((size for size in _COUNTS if size >= count), count)
    return RigidTransform(*(np.concatenate([p, p[-1:].repeat(size - count, 0)]) for p in poses))


@from_host
@jax.jit
def _read(poses, source, reference, scales, there, back):
    source, reference = (
        cloud._replace(points=cloud.points * scale, spacing=cloud.spacing * scale)
        for cloud, scale in zip((source, reference), scales, strict=True)
    )
    poses = RigidTransform(*(part.astype(source.points.dtype) for part in poses))
    read = jax.vmap(read_evidence, in_axes=(0, None, None, 0, 0))
    evidence = read(poses, source, reference, there, back)
    return evidence, log_odds(evidence)


def judged(
    clouds: Clouds,
    poses: RigidTransform,
    score: Float[np.ndarray, "s"],
    *,
    distance: float,
    most: int,
    motions: Float[np.ndarray, "6 f"] | None = None,
) -> Judged:
    """At most `most` distinct ones of the poses, the best by `score`, refined and judged.

    `distance` is the largest between corresponding points, in the unit of the frame.
    """
    weighting = Weighting(REFINE.kernel, None, distance, REFINE.trim)
    if score.max() > _CLEAR:
        poses, score = jax.tree.map(
            lambda leaf: leaf[score > _HOPELESS * score.max()], (poses, score)
        )
    chosen = _distinct(poses, score, most)
    poses = RigidTransform(poses.rotation[chosen], poses.translation[chosen])
    moved = iterate_all(
        padded(poses),
        clouds.source,
        clouds.reference,
        weighting,
        config=REFINE,
        step=STEP,
        motions=motions,
    )
    count = len(chosen)
    poses = RigidTransform(nearest_rotation(moved.rotation[:count]), moved.translation[:count])
    return ranked(poses, *clouds.judge(poses))


def with_half_turns(
    clouds: Clouds,
    points: Float[np.ndarray, "n 3"],
    pose: RigidTransform,
    others: tuple[tuple[RigidTransform, float], ...],
) -> tuple[tuple[RigidTransform, float], ...]:
    """The other poses of a pair and their log odds, with those after half turns about principal axes.

    Copies of an even grid agree to the last digit under these, too, and the pose that a search comes
    upon first leaves it no reason to look for the others. `points` are all of the source, in the
    frame: a part of them has other axes. Distinct poses, the best first.
    """
    centre = points.mean(axis=0)
    turns = repeats.half_turns(repeats.axes_of(points, None))
    shifts = (centre - turns @ centre) @ pose.rotation.T + pose.translation
    turned = RigidTransform(
        np.concatenate([pose.rotation[None], pose.rotation @ turns]),
        np.concatenate([pose.translation[None], shifts]),
    )
    evidence, score = clouds.judge(turned)
    # Where as many points coincide, the rest of the evidence is chance: the points lie on no surface.
    score = np.where(evidence.same >= _AS_MANY * evidence.same[0], np.max(score), score)
    found = zip(map(RigidTransform, *turned), score.tolist(), strict=True)
    return distinct_from(pose, (*others, *list(found)[1:]))


def distinct_from(
    pose: RigidTransform, others: tuple[tuple[RigidTransform, float], ...]
) -> tuple[tuple[RigidTransform, float], ...]:
    """Those of other poses and their log odds that differ from `pose` and each other, best first."""
    found = [(pose, np.inf), *others]
    stacked = RigidTransform(*map(np.stack, zip(*(one for one, _ in found), strict=True)))
    distinct = _distinct(stacked, np.array([score for _, score in found]), len(found))
    return tuple(found[i] for i in distinct[1:])


def ranked(poses: RigidTransform, evidence: Evidence, score: Float[np.ndarray, "k"]) -> Judged:
    """The distinct ones of judged poses, the most plausible first."""
    order = _distinct(poses, score, len(score))
    return Judged(*jax.tree.map(lambda leaf: leaf[order], (poses, evidence, score)))


def merged(one: Judged, other: Judged) -> Judged:
    """Both, the most plausible first, and of poses that are the same the better one."""
    return ranked(*jax.tree.map(lambda a, b: np.concatenate([a, b]), one, other))


def are_apart(poses: RigidTransform, other: RigidTransform) -> Bool[np.ndarray, "*k"]:
    """Whether poses, in the unit of the frame, are not `other` but for noise."""
    turned = rotation_angle_deg(poses.rotation, other.rotation)
    moved = np.linalg.norm(poses.translation - other.translation, axis=-1)
    # numpy makes a number of an array without axes.
    return np.asarray((turned > APART_DEG) | (moved > APART))


def _distinct(poses: RigidTransform, score: np.ndarray, most: int) -> list[int]:
    chosen: list[int] = []
    for i in np.argsort(-score, kind="stable").tolist():
        if len(chosen) == most:
            break
        others = RigidTransform(poses.rotation[chosen], poses.translation[chosen])
        one = RigidTransform(poses.rotation[i : i + 1], poses.translation[i : i + 1])
        if np.all(are_apart(others, one)):
            chosen.append(i)
    return chosen
