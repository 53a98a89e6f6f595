"""What a row of the table of transforms is, and the inputs at which functions break."""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from jaxreg.types import PointCloud, RigidTransform

N, K = 8, 3
RNG = np.random.default_rng(0)


@dataclasses.dataclass(frozen=True)
class Row:
    """A function of arrays, inputs that are generic, and inputs where it could break.

    `smooth` is False for results that jump (an index, the nearest point), which are compared with no
    differences. `loose` lets Flax promote dtypes. `kinks` is True for the whole network: on a line or
    a grid its moved points are parallel up to rounding, which may differ between the two modes and
    puts them on different sides of a kink. `parts` is True where the row is made of other rows, which
    are run eagerly and under vmap in its place. `rounding` is how far results may differ that ought to
    be equal: the search also aligns poses that hardly anything determines, which magnifies rounding.
    """

    function: Callable
    generic: tuple
    degenerate: tuple[tuple, ...] = ()
    smooth: bool = True
    loose: bool = False
    kinks: bool = False
    parts: bool = False
    rounding: float = 1e-10


def points(n=N):
    return RNG.normal(size=(n, 3))


def pose():
    return RigidTransform(Rotation.random(rng=RNG).as_matrix(), RNG.normal(size=3))


def nowhere():
    return RigidTransform(np.zeros((3, 3)), np.zeros(3))


def neighbor_graph(n=N):
    return np.stack([(np.arange(n) + r + 1) % n for r in range(K)], axis=1).astype(np.int32)


def grid():
    return np.array([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (0.0, 1)])


def clouds_that_break():
    return {
        "one place": np.ones((N, 3)),
        "line": np.outer(np.arange(N, dtype=float), [1.0, 2.0, 3.0]),
        "plane": points() * [1.0, 1.0, 0.0],
        "duplicates": np.repeat(points(N // 2), 2, axis=0),
        "cube": grid(),
        "origin": np.zeros((N, 3)),
    }


def every(function):
    """Rows of degenerate inputs from a function of one degenerate cloud."""
    return tuple(function(cloud) for cloud in clouds_that_break().values())


def everything(x):
    return PointCloud(x, np.ones(len(x), bool))
