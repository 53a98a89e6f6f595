"""Wrong settings are refused, by name and with what to choose instead."""

import math
import re

import pytest

from jaxreg.refine.config import RefineConfig, check_options


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"method": "plane"}, "method 'plane' does not exist: choose icp, point_to_plane, gicp."),
        ({"kernel": "tukey"}, "kernel 'tukey' does not exist: choose none, huber, cauchy"),
        ({"gradient": "adjoint"}, "gradient 'adjoint' does not exist: choose unrolled, implicit."),
        ({"iterations": 0}, "iterations = 0: choose at least 1."),
        ({"max_correspondence_distance": 0.0}, "max_correspondence_distance = 0.0: choose a"),
        ({"max_correspondence_distance": math.nan}, "max_correspondence_distance = nan: choose a"),
        ({"trim": 0.0}, "trim = 0.0: choose a share of the pairs, 0 < trim <= 1."),
        ({"trim": 1.5}, "trim = 1.5: choose"),
        ({"kernel_annealing": 0.5}, "kernel_annealing = 0.5: choose 1 or more"),
        ({"k": 1}, "k = 1: choose at least 2"),
        ({"epsilon": 0.0}, "epsilon = 0.0: choose 0 < epsilon <= 1."),
        ({"correspondences_per_point": 0}, "correspondences_per_point = 0: choose 1 to k + 1 = 11"),
        ({"correspondences_per_point": 4, "k": 2}, "choose 1 to k + 1 = 3"),
        ({"tolerance": -1.0}, "tolerance = -1.0: choose 0 or more."),
    ],
)
@pytest.mark.untyped
def test_wrong_options_are_named(change, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        check_options(RefineConfig(**change))


def test_the_defaults_and_the_limits_are_welcome():
    check_options(RefineConfig())
    check_options(RefineConfig(iterations=1, trim=1.0, kernel_annealing=1.0, k=2, epsilon=1.0))
    check_options(RefineConfig(correspondences_per_point=11, tolerance=0.0))
