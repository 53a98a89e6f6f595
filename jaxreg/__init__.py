"""jaxreg: rigid point cloud registration in pure JAX.

Everything public is here. Functions of one pair are pure: `jax.jit`, `jax.vmap` and `jax.grad` them.
"""

import importlib
from typing import TYPE_CHECKING

from jaxreg.config import Config, load_config
from jaxreg.geometry.neighbors import knn, nearest_neighbor
from jaxreg.geometry.numerics import included_angle
from jaxreg.geometry.procrustes import weighted_procrustes
from jaxreg.geometry.rigid import apply, compose, from_matrix, identity, inverse, to_matrix
from jaxreg.scans.pair import ScanRegistration, register
from jaxreg.types import Pair, PointCloud, Registration, RigidTransform

if TYPE_CHECKING:
    from jaxreg.network.model import init_variables, register_pair
    from jaxreg.weights.released import available_weights, load_pretrained

__version__ = "0.1.0"

__all__ = [
    "Config",
    "Pair",
    "PointCloud",
    "Registration",
    "RigidTransform",
    "ScanRegistration",
    "apply",
    "available_weights",
    "compose",
    "from_matrix",
    "identity",
    "included_angle",
    "init_variables",
    "inverse",
    "knn",
    "load_config",
    "load_pretrained",
    "nearest_neighbor",
    "register",
    "register_pair",
    "to_matrix",
    "weighted_procrustes",
]

# Flax takes 0.2 s to import: two scans are registered without it, so these wait until they are used.
_WITH_FLAX = {
    "available_weights": "jaxreg.weights.released",
    "init_variables": "jaxreg.network.model",
    "load_pretrained": "jaxreg.weights.released",
    "register_pair": "jaxreg.network.model",
}


def __getattr__(name: str) -> object:
    if name not in _WITH_FLAX:
        raise AttributeError(f"module 'jaxreg' has no attribute '{name}'")
    return getattr(importlib.import_module(_WITH_FLAX[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_WITH_FLAX})
