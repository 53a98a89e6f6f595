"""The poses of all scans refined together on their surfaces (multiview generalised ICP)."""

from typing import NamedTuple

from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.placing import Placement
from jaxreg.scans.prepare import Prepared
from jaxreg.scans.relation import Relation


class JointRefinement(NamedTuple):
    """One step: what it was, and the root mean square distance of surfaces before and after it."""

    group: int
    iterations: int
    before: float
    after: float


def refine_jointly(
    placement: Placement, relations: list[Relation], prepared: list[Prepared], config: RegisterConfig
) -> tuple[Placement, tuple[JointRefinement, ...]]:
    """The placement with refined poses."""
    return placement, ()
