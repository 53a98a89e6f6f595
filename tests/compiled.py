"""Functions of the library as one program each, for tests that call them plainly.

Eager, a call is hundreds of little programs, each traced, lowered and compiled by itself, which took a
third of the time of the suite. That jit equals eager is a test of its own (tests/transforms).
"""

import jax

from jaxreg.geometry import neighbors
from jaxreg.geometry import normals as _normals
from jaxreg.refine import correspondences
from jaxreg.refine import gicp as _gicp
from jaxreg.refine import methods as _methods
from jaxreg.refine import point_to_plane as _point_to_plane
from jaxreg.refine import point_to_point as _icp
from jaxreg.refine import uncertainty as _uncertainty
from jaxreg.search import descriptors

AS_USERS = {"xla_backend_optimization_level": 3}
"""Options with which XLA compiles as in a user's process, not as tests/conftest.py has it."""
if jax.__version_info__ < (0, 11):
    AS_USERS["xla_cpu_use_fusion_emitters"] = True

knn = jax.jit(neighbors.knn, static_argnums=1)
closest_pairs = jax.jit(correspondences.closest_pairs, static_argnames="both_directions")
normals = jax.jit(_normals.normals)
edge_normals = jax.jit(_normals.edge_normals)
neighborhood_covariances = jax.jit(_normals.neighborhood_covariances)
icp = jax.jit(_icp.icp, static_argnames="config")
point_to_plane = jax.jit(_point_to_plane.point_to_plane, static_argnames="config")
gicp = jax.jit(_gicp.gicp, static_argnames="config")
refine = jax.jit(_methods.refine, static_argnames="config")
pose_uncertainty = jax.jit(_uncertainty.pose_uncertainty, static_argnames="config")
gaussian_normals = jax.jit(descriptors.gaussian_normals, static_argnames="radius")
moments = jax.jit(descriptors.moments, static_argnames="radii")
mean_spacing = jax.jit(descriptors.mean_spacing)
standardized = jax.jit(descriptors.standardized)
openness = jax.jit(descriptors.openness, static_argnames="radius")
