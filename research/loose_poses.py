"""How well the covariance of a pose tells a right one from a wrong one that the judge believes.

    python -m research.loose_poses [--made 80]

Registers virtual scans of procedural shapes and rooms (`research/judge_pairs.py`) and counts, among the
poses that are believed but for `jaxreg.scans.verdict.held_loosely`, how many right and wrong ones have a
standard deviation of the rotation above each of some limits. No real scan takes part.
"""

import dataclasses

import numpy as np
import tyro

import jaxreg
from jaxreg.cli import process
from jaxreg.scans import verdict
from research.judge_pairs import KINDS, made_pairs

_LIMITS = 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0
_NEAR = 2.0
"""Poses within so many times the tolerance are not wrong."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What is registered."""

    made: int = 80
    """Pairs of each kind."""


def believed(options: Options) -> tuple[np.ndarray, np.ndarray]:
    """The deviation (degrees) of every believed pose; wrong (1), right (0) or in between."""
    deviations, wrong = [], []
    for name in KINDS:
        for pair in made_pairs(name, options.made):
            found = jaxreg.register(pair.source, pair.reference)
            if not (found.success or found.reason == verdict.held_loosely(found.covariance)):
                continue
            deviations.append(verdict.rotation_deviation_deg(found.covariance))
            near = pair.is_right(found.transform, _NEAR)
            wrong.append(float(not near) if pair.is_right(found.transform) or not near else 0.5)
    return np.array(deviations), np.array(wrong)


def main(options: Options) -> None:
    """Print the table."""
    process.enable_compilation_cache()
    deviation, wrong = believed(options)
    print(f"{np.sum(wrong == 0)} right and {np.sum(wrong == 1)} wrong poses are believed")
    for limit in _LIMITS:
        above = deviation > limit
        print(
            f"above {limit:.1f} degrees: {np.sum(above & (wrong == 0))} right, "
            f"{np.sum(above & (wrong == 1))} wrong"
        )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
