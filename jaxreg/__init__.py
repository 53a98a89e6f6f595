"""jaxreg: rigid point cloud registration in pure JAX.

Everything public is here. Functions of one pair are pure: `jax.jit`, `jax.vmap` and `jax.grad` them.
"""

from jaxreg.config import Config, load_config
from jaxreg.model import init_variables, register_pair
from jaxreg.neighbors import knn, nearest_neighbor
from jaxreg.numerics import included_angle
from jaxreg.pretrained import available_weights, load_pretrained
from jaxreg.procrustes import weighted_procrustes
from jaxreg.register import ScanRegistration, register
from jaxreg.rigid import apply, compose, from_matrix, identity, inverse, to_matrix
from jaxreg.types import Pair, PointCloud, Registration, RigidTransform

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
