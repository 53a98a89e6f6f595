"""Whether a pose is to be trusted, and what speaks against it, in words."""

import jax
import numpy as np
from jaxtyping import Float

from jaxreg._xla import from_host
from jaxreg.judge.evidence import Evidence
from jaxreg.judge.odds import WEIGHTS, features
from jaxreg.judge.surface import Examined
from jaxreg.refine.uncertainty import WeakDirection

TRUSTED = 0.5
"""Probability from which a registration counts as a success."""
RIVAL = 0.25
"""A pose is no success if another one is right with this probability: several agree then."""
_LOOSE_DEG = 3.0
"""Standard deviation of the rotation from which a pose is no success. It says how far halves of the
overlap differ, and under a wrong pose these pull apart: of 159 virtual pairs that were believed it is
above 3 degrees for 7 of 8 wrong poses and for 1 of 151 right ones (docs/notes/0066)."""
_VOLUME = 0.185
"""Median surface variation of points that fill a volume: 0.19 to 0.22 in a cube; surfaces have less,
and of thin parts up to 0.19 (docs/notes/0037)."""
_ANY_WAY = 0.4
"""And normals mean nothing there: .5 to .6 of the near points disagree under the right pose of a filled
volume, .3 at most of a thin wall that is seen from both sides, whose points lie as near each other."""
_COPIED = 0.5
"""Where so many points coincide it does not matter what they fill."""
_LEAST_HELD = 1e-5
"""Below it the clouds leave a motion free, as planes do: no pose is the right one then."""
_USUAL = Evidence(
    smaller=0.75, larger=0.85, distance=0.25, rough_distance=0.35, rough_facing=0.85,
    disagreement=0.08, beside=0.3, unseen=0.03, rough=0.3, ends=0.1, held=0.1,
    same=0.0, sparse=0.0,
)  # fmt: skip
"""What a usual right pose shows, which `reason` compares with."""
_SPEAKS = Evidence(
    smaller=1, larger=1, distance=-1, rough_distance=-1, rough_facing=1, disagreement=-1, beside=-1,
    unseen=-1, rough=1, ends=-1, held=1, same=1, sparse=-1,
)  # fmt: skip
"""Whether more of it speaks for a pose or against it, as the sentences of `reason` presume."""

_features = from_host(jax.jit(features))


def is_free(found: Evidence, weak: tuple[WeakDirection, ...] = ()) -> bool:
    """Whether the near surfaces leave a motion free, or the pairs of the refinement do (`weak`)."""
    return found.held < _LEAST_HELD or any(one.strength < _LEAST_HELD for one in weak)


def fills_volume(*clouds: Examined) -> bool:
    """Whether the points of all clouds lie on no surface, as those of crowns of trees do."""
    return all(
        float(np.median(np.asarray(cloud.variation)[np.asarray(cloud.mask)])) > _VOLUME
        for cloud in clouds
    )


def is_success(chance: float, rivals: Float[np.ndarray, "k"], converged: bool | None) -> bool:
    """Whether a pose is to be trusted, from its probability and those of the others."""
    alone = len(rivals) == 0 or float(np.max(rivals)) < RIVAL
    return chance >= TRUSTED and alone and converged is not False


def rotation_deviation_deg(covariance: Float[np.ndarray, "6 6"]) -> float:
    """The standard deviation of the rotation, about all axes together; NaN if it is not known."""
    return float(np.degrees(np.sqrt(np.trace(covariance[:3, :3]))))


def held_loosely(covariance: Float[np.ndarray, "6 6"]) -> str:
    """A sentence if the rotation is known to a few degrees only, by the covariance of a pose."""
    deviation = rotation_deviation_deg(covariance)
    if not deviation > _LOOSE_DEG:  # NaN where nothing was refined
        return ""
    return (
        f"What overlaps holds the rotation to {deviation:.1f} degrees (a standard deviation), too "
        "loosely to tell the right pose from a wrong one."
    )


def in_a_volume(found: Evidence, *clouds: Examined) -> str:
    """A sentence if the points fill a volume, where overlap alone speaks for a pose; else nothing."""
    if found.same >= _COPIED or found.disagreement < _ANY_WAY or not fills_volume(*clouds):
        return ""
    return "The points fill a volume, where any pose overlaps: there is no surface to judge by."


def reason(found: Evidence, weak: tuple[WeakDirection, ...], rivals: float) -> str:
    """Why a pose is not trusted: the evidence that falls shortest of a usual right pose.

    `rivals` is the probability that another of the poses is right.
    """
    if is_free(found, weak):
        free = ", ".join(direction.name for direction in weak) or "a motion"
        return f"The surfaces leave the pose free: {free}."
    if rivals >= RIVAL:
        return "Another pose agrees about as well (see alternatives)."
    short = np.array(WEIGHTS) * (np.array(_features(found)) - np.array(_features(_USUAL)))
    # The sentence of a field whose fitted weight has the other sign would say what is not the case.
    short = np.where(np.array(WEIGHTS) * np.array(_SPEAKS) > 0, short, 0)
    held = ", ".join(direction.name for direction in weak) or "see sigma"
    texts = Evidence(
        smaller=f"Only {found.smaller:.0%} of one of the clouds lies near the other.",
        larger=f"Only {found.larger:.0%} of each cloud lies near the other.",
        distance=f"The surfaces lie {found.distance:.2f} spacings apart where they meet.",
        rough_distance="The surfaces cross instead of meeting where they are rough "
        f"({found.rough_distance:.2f} spacings apart).",
        rough_facing="The surfaces face different ways where they are rough.",
        disagreement=f"{found.disagreement:.0%} of the points that lie near the other cloud do not "
        "lie on its surface.",
        beside="Many points lie just off the other surface.",
        unseen="Points lie just off the middle of the other surface, which should have been seen "
        "there too.",
        rough="The surfaces that meet are flat, and a flat surface agrees with every other.",
        ends="The surfaces meet where they end.",
        held=f"The surfaces hardly resist a motion: {held}.",
        same="No points coincide.",
        sparse="The clouds have few points.",
    )
    return texts[int(np.argmin(short))]
