"""Values under jit and vmap, for every row of the table."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.transforms.table import TABLE, WHOLE, is_float, rows

PLAIN = sorted(name for name, row in TABLE.items() if row.generic and not row.parts)


def assert_close(a, b, tolerance):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        x, y = np.asarray(x), np.asarray(y)
        scale = max(1.0, np.abs(np.where(np.isfinite(y), y, 0)).max(initial=0))
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance * scale)


def arrays(inputs):
    return jax.tree.map(jnp.asarray, inputs)


@functools.cache
def jitted(name: str) -> Callable:
    return jax.jit(TABLE[name].function)


@rows(
    PLAIN,
    slow=[name for name in PLAIN if name.startswith(("network.", "peers.", "refine.", "search."))],
)
def test_jit_equals_eager(name, row):
    for inputs in (row.generic, *row.degenerate[:1]):
        assert_close(jitted(name)(*inputs), row.function(*arrays(inputs)), row.rounding)


@rows(PLAIN, slow=set(WHOLE) - {"search.pipeline.register_global"})
def test_vmap_equals_a_loop(name, row):
    leaves, tree = jax.tree.flatten(row.generic)
    batch = [
        np.stack([x, 0.9 * x, x[::-1] if np.ndim(x) else x]) if is_float(x) else np.stack([x] * 3)
        for x in leaves
    ]
    batch_of_inputs = jax.tree.unflatten(tree, batch)
    lowered = jax.jit(jax.vmap(row.function)).lower(*batch_of_inputs)
    # Two threads that call a batch of LAPACK's functions may wait for each other for ever.
    assert "lapack" not in lowered.as_text()
    together = lowered.compile()(*batch_of_inputs)
    for i in range(3):
        one = jitted(name)(*jax.tree.unflatten(tree, [x[i] for x in batch]))
        assert_close(jax.tree.map(lambda x, i=i: x[i], together), one, 10 * row.rounding)


@pytest.mark.untyped
@pytest.mark.parametrize(
    "row",
    ["geometry.neighbors.knn", "geometry.numerics.included_angle", "geometry.rigid.apply"],
    indirect=True,
)
def test_numpy_arrays_are_welcome(row):
    assert_close(row.function(*row.generic), row.function(*arrays(row.generic)), 1e-12)
