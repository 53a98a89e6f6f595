"""Registration for any rotation, of clouds that share no point: `register_global`.

Every stage is dense and of a fixed shape: products of (n, n) matrices instead of neighbour lists,
one hypothesis from each of the clearest candidates instead of sampling, a grid instead of a tree.
"""

from jaxreg.search.learned import load_network
from jaxreg.search.pipeline import register_global

__all__ = ["load_network", "register_global"]
