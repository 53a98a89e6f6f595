"""The other learned methods of the paper's table, one module each.

`dcp`, `cemnet`, `idam`, `rpmnet` and `fmr` have a function `register` of two clouds; `rienet` loads
weights for the paper's network.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__, submodules=("cemnet", "dcp", "fmr", "idam", "rienet", "rpmnet")
)
