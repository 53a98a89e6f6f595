"""The kernels and methods that a test of all of them takes.

The kernels differ in one formula, so three are slow tests; so are the methods but one in the tests of
what all of them share.
"""

import pytest

KERNELS = (
    "none",
    "geman_mcclure",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("huber", "cauchy", "gaussian")),
)
SHARED = (
    "point_to_plane",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("icp", "gicp")),
)
