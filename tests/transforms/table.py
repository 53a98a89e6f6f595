"""Every public function of the numerical rooms under every transform of JAX.

TABLE names each one with generic and degenerate inputs. For every row: jit equals eager and vmap equals
a loop (test_values.py); forward mode equals reverse mode, both are finite, and on generic inputs they
equal central differences in float64 (test_derivatives.py). A public function that is not in the table
fails a test (test_table.py).
"""

from typing import Any

import jax.numpy as jnp
import pytest

from tests.transforms.core_rows import core_rows, late_rows
from tests.transforms.judge_rows import judge_rows
from tests.transforms.network_rows import network_and_model_rows
from tests.transforms.peer_rows import peer_rows
from tests.transforms.refine_rows import refine_rows
from tests.transforms.search_rows import search_rows

WHOLE = (
    "network.losses.step_losses",
    "network.model.iterate",
    "peers.cemnet.register",
    "peers.dcp.register",
    "peers.fmr.register",
    "peers.idam.register",
    "peers.rpmnet.register",
    "refine.methods.refine",
    "search.pipeline.register_global",
    "search.pipeline.search_poses",
    "search.stages.search_described",
)
"""Whole programs that take long to compile, or long one operation at a time, and whose parts are rows
of their own: what `make test` leaves out, `make slow` runs."""

TABLE = (
    core_rows()
    | network_and_model_rows()
    | refine_rows()
    | search_rows()
    | judge_rows()
    | late_rows()
    | peer_rows()
)


def rows(names, *, slow=()):
    marked = [pytest.param(n, n, marks=pytest.mark.slow if n in slow else ()) for n in names]
    return pytest.mark.parametrize(("name", "row"), marked, indirect=["row"])


def is_float(x: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)
