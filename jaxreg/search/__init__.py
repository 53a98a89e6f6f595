"""Registration without a start, for clouds that share no point: `register_global`.

Every stage is dense and has a fixed shape: products of (n, n) matrices instead of neighbour lists,
one hypothesis from each of the clearest candidates instead of sampling, a grid instead of a tree.
"""

from jaxreg.search.config import SearchConfig
from jaxreg.search.description import Described, describe
from jaxreg.search.learned import load_features
from jaxreg.search.pipeline import register_global, search_poses
from jaxreg.search.stages import Search, search_described

__all__ = [
    "Described",
    "Search",
    "SearchConfig",
    "describe",
    "load_features",
    "register_global",
    "search_described",
    "search_poses",
]
