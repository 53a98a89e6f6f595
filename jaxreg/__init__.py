"""jaxreg: rigid point cloud registration in pure JAX.

Everything public is listed in `__init__.pyi`, by topic, and is imported when it is first used; modules
behind these names may move. Functions of one pair are pure: `jax.jit`, `jax.vmap` and `jax.grad` them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = "0.1.0"
