"""What is known of a pair before it is registered."""

from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from jaxreg.geometry import se3
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.refine.uncertainty import PoseUncertainty
from jaxreg.types import RigidTransform

Fact = Literal["upright", "inside"]
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_ROUNDING_DEG = 1e-6
UP = np.array(_AXES["z"])
"""What clouds in a plane of one z are turned about."""


class Known(NamedTuple):
    """What a caller knows: the axis that both scans have upright, whether the source is a part, limits.

    `up` is a unit vector, or None if the source may be turned in any way. Rotations are by at most
    `max_rotation_deg`. `weights` say how much the distinct points of the source count in the end.
    """

    up: Float[np.ndarray, "3"] | None = None
    inside: bool = False
    max_rotation_deg: float = 180.0
    weights: Float[np.ndarray, "p"] | None = None

    @property
    def motions(self) -> Float[np.ndarray, "6 f"]:
        """A basis of the unknown motions (rotation vector, translation)."""
        basis = np.eye(6)
        if self.up is None:
            return basis
        return np.column_stack([np.concatenate([self.up, np.zeros(3)]), basis[:, 3:]])

    def in_the_plane(self) -> "Known":
        """The same of clouds of one z, which are turned about z alone.

        Raises:
          ValueError: another axis is known to be upright.
        """
        if self.up is not None and abs(self.up @ UP) < 1 - _ROUNDING_DEG:
            raise ValueError(
                f"up is ({', '.join(f'{value:.3g}' for value in self.up)}), but both clouds lie in a "
                "plane of one z, where a turn is about z: leave known='upright' out, or give three "
                "coordinates."
            )
        return self._replace(up=UP)

    def conditional(self, covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
        """The covariance of a pose whose other motions are known: ``B (B^T C^-1 B)^-1 B^T``."""
        if self.up is None or not np.isfinite(covariance).all():
            return covariance
        basis = self.motions
        inner = basis.T @ np.linalg.pinv(covariance, rcond=1e-14, hermitian=True) @ basis
        return basis @ np.linalg.pinv(inner, rcond=1e-14, hermitian=True) @ basis.T

    def held(self, found: PoseUncertainty) -> PoseUncertainty:
        """The uncertainty with every point holding the rotations that are known."""
        if self.up is None:
            return found
        known = np.zeros((6, 6))
        known[:3, :3] = np.eye(3) - np.outer(self.up, self.up)
        weight = float(found.weight) * float(found.length) ** 2
        return found._replace(information=np.asarray(found.information) + weight * known)

    def allowed(self, pose: RigidTransform) -> RigidTransform:
        """The pose, turned about `up` alone: by the angle that is nearest to what it was."""
        if self.up is None:
            return pose
        angle = best_turn(np.asarray(pose.rotation)[None], self.up)
        return RigidTransform(turns_about(self.up, angle)[0], pose.translation)

    def start(self, initial: RigidTransform) -> RigidTransform:
        """`allowed` of a pose to start from.

        Raises:
          ValueError: it turns by more than `max_rotation_deg`.
        """
        pose = self.allowed(initial)
        turned = float(rotation_angle_deg(pose.rotation, np.eye(3)))
        if turned > self.max_rotation_deg + _ROUNDING_DEG:
            raise ValueError(
                f"initial turns by {turned:.4g} degrees, more than max_rotation_deg = "
                f"{self.max_rotation_deg:g}: leave one of the two out."
            )
        return pose


def known_of(
    facts: Fact | Sequence[Fact] | None, up: object, max_rotation_deg: float | None
) -> Known:
    """What the arguments of `register` say.

    Raises:
      ValueError: a fact or an axis that does not exist, an axis that is not known to be upright, or an
        angle out of range.
    """
    facts = [facts] if isinstance(facts, str) else list(facts or ())
    for fact in facts:
        if fact not in get_args(Fact):
            raise ValueError(f"known must be 'upright', 'inside' or both, got {fact!r}.")
    if max_rotation_deg is not None and not 0 < max_rotation_deg <= 180:
        raise ValueError(
            f"max_rotation_deg must be above 0 and at most 180, got {max_rotation_deg}: leave it out "
            "for clouds in any orientation."
        )
    axis = _axis(up)
    if "upright" not in facts and abs(axis @ UP) < 1 - _ROUNDING_DEG:
        raise ValueError(
            f"up={up!r} names the axis that both clouds have upwards: pass known='upright' as well."
        )
    return Known(axis if "upright" in facts else None, "inside" in facts, max_rotation_deg or 180.0)


def _axis(up: object) -> Float[np.ndarray, "3"]:
    if isinstance(up, str) and up.lower() in _AXES:
        return np.array(_AXES[up.lower()])
    try:
        axis = np.asarray(up, np.float64)
    except (TypeError, ValueError):
        axis = np.zeros(0)
    if axis.shape != (3,) or not np.isfinite(axis).all() or not axis.any():
        raise ValueError(f"up must be 'x', 'y', 'z' or a vector of three numbers, got {up!r}.")
    return axis / np.linalg.norm(axis)


def best_turn(
    moments: Float[np.ndarray, "b 3 3"], up: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "b"]:
    """The angle of the turn R about `up` (unit vector) that maximises ``trace(R^T M)``, radians."""
    along = np.einsum("bij,i,j->b", moments, up, up)
    x, y, z = (moments[:, i, j] - moments[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    cosine = np.trace(moments, axis1=1, axis2=2) - along
    return np.arctan2(np.stack([x, y, z], axis=1) @ up, cosine)


def turns_about(
    up: Float[np.ndarray, "3"], angle: Float[np.ndarray, "b"]
) -> Float[np.ndarray, "b 3 3"]:
    """Rotations about a unit vector by angles in radians (Rodrigues)."""
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return cosine * np.eye(3) + sine * se3.skew(up) + (1 - cosine) * np.outer(up, up)
