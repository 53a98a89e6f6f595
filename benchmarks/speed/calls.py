"""Seconds of later calls on pairs of clouds, of a process of its own: see `benchmarks.speed.second_call`.

    PYTHONPATH=CHECKOUT python -P benchmarks/speed/calls.py KIND CLOUDS.npz

Of `jaxreg` only what an old checkout has, too, is imported here, and nothing of `benchmarks`.
"""

import functools
import json
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np

import jaxreg

_CALLS = 10
_VOXEL = 0.05
"""Metres: what suits fragments of rooms best of those tried (docs/notes/0005)."""


def prepared(*pair: np.ndarray) -> Callable[[], object]:
    """`register` of clouds that were prepared before."""
    return functools.partial(jaxreg.register, *(jaxreg.prepare(cloud) for cloud in pair))


def arrays(*pair: np.ndarray) -> Callable[[], object]:
    """`register` of arrays."""
    return functools.partial(jaxreg.register, *pair)


def open3d(*pair: np.ndarray) -> Callable[[], object]:
    """RANSAC on FPFH and ICP."""
    from jaxreg.evaluation import methods

    return functools.partial(methods.choose(f"open3d_ransac_icp@{_VOXEL}").clouds, *pair)


def seconds(call: Callable[[], object]) -> Iterator[float]:
    """Of every call after the first, which compiles."""
    call()
    for _ in range(_CALLS):
        begin = time.perf_counter()
        call()
        yield time.perf_counter() - begin


if __name__ == "__main__":
    kind = {function.__name__: function for function in (prepared, arrays, open3d)}[sys.argv[1]]
    clouds = list(np.load(sys.argv[2]).values())
    pairs = zip(clouds[::2], clouds[1::2], strict=True)
    print(json.dumps([min(seconds(kind(*pair))) for pair in pairs]))
