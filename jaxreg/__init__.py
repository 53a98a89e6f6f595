"""jaxreg: rigid point cloud registration in pure JAX.

`__init__.pyi` lists the public API by topic; a name is imported when it is first used, and the
modules behind these names may move. Functions of one pair are pure: use them under `jax.jit`,
`jax.vmap` and `jax.grad`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__version__ = "0.1.0"
