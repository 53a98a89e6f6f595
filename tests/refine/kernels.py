"""The kernels that a test of all of them takes: they differ in one formula, so three are slow tests."""

import pytest

KERNELS = (
    "none",
    "geman_mcclure",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("huber", "cauchy", "gaussian")),
)
