"""Variants of `benchmarks.paper.accuracy` differ from the library in how they compute alone."""

import numpy as np
import pytest

from benchmarks.paper import accuracy
from benchmarks.speed import workload

pytestmark = [pytest.mark.float32, pytest.mark.loose, pytest.mark.untyped]

POINTS = 272  # N_c of the released weights is 256.


@pytest.mark.parametrize("name", ["knn", "neighborhood_sum"])
def test_what_is_replaced_is_what_the_library_calls(name):
    def unusable(*_):
        raise NotImplementedError(name)

    variables, _ = workload.released()
    drawn = workload.draw(POINTS, 1)
    run = accuracy.variants(1)["the library"]
    with accuracy._without(**{name: unusable}), pytest.raises(NotImplementedError, match=name):
        run(variables, *drawn[:2])


@pytest.mark.slow
def test_in_float64_every_variant_finds_the_same_rotations():
    rows = accuracy.measure(POINTS, 2, 2)
    assert {row["dtype"] for row in rows} == {"float32", "float64"}
    exact = [row["apart_deg"] for row in rows if row["dtype"] == "float64"]
    assert len(exact) == len(accuracy.variants(1))
    np.testing.assert_array_less(exact, 1e-9)
