"""What speed costs in accuracy: the same evaluation with each optimisation taken away.

The released weights on pairs of the workload, in float32 as people run it and in float64, where
rounding no longer hides a difference.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.paper import transcription
from benchmarks.speed import workload
from jaxreg.evaluation.metrics import euler_zyx_deg
from jaxreg.geometry import rigid
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.network import matching, matching_blocks, model
from jaxreg.types import RigidTransform

Rotations = Callable[[np.ndarray, np.ndarray], np.ndarray]


def _sorted_neighbors(points, k, mask=None):
    """`jaxreg.neighbors.knn` by sorting every row; there is no padding here."""
    return transcription.neighborhoods(points, k)


def _sum_by_indexing(scores, source, reference):
    """`jaxreg.matching.neighborhood_sum` through an (n, k, m) array."""
    indices = (x.idx if isinstance(x, matching.Incidence) else x for x in (source, reference))
    return transcription.neighborhood_sum(scores, *indices)


def _written_out(variables, source, reference, config):
    """One iteration after the other as registrations of their own: no loop, nothing hoisted."""
    once = dataclasses.replace(config, model=dataclasses.replace(config.model, iterations=1))
    total = rigid.identity(source.dtype)
    for _ in range(config.model.iterations):
        moved = rigid.apply(total, source)
        result = model.register_pair(variables, moved, reference, config=once)
        total = rigid.compose(RigidTransform(*result[:2]), total)
    return total


def _padded(variables, source, reference, config):
    """Both clouds with a quarter of padding, as a size in a bucket has it."""
    more = source.shape[0] // 4
    clouds = [jnp.pad(x, ((0, more), (0, 0)), constant_values=jnp.nan) for x in (source, reference)]
    mask = jnp.arange(source.shape[0] + more) < source.shape[0]
    return model.register_pair(
        variables, *clouds, config=config, source_mask=mask, reference_mask=mask
    )


@contextlib.contextmanager
def _without(**replaced) -> Iterator[None]:
    """Other functions in the place of the library's, for what is traced inside."""
    places = {
        "knn": [(model, "knn")],
        "neighborhood_sum": [(model, "neighborhood_sum"), (matching, "neighborhood_sum")],
        "LARGEST": [(matching_blocks, "LARGEST")],
    }
    with contextlib.ExitStack() as stack:
        for name, value in replaced.items():
            for module, attribute in places[name]:
                stack.enter_context(mock.patch.object(module, attribute, value))
        yield


def variants(batch: int) -> dict[str, Rotations]:
    """The rotations of a registration, by what was changed; the first is the library as it is."""
    _, config = workload.released()
    as_it_is = functools.partial(model.register_pair, config=config)

    def batched(one, compiler=jax.jit, **replaced) -> Rotations:
        many = compiler(jax.vmap(lambda v, x, y: one(v, x, y).rotation, in_axes=(None, 0, 0)))

        def run(variables, sources, references):
            parts = []
            for start in range(0, len(sources), batch):
                x, y = (c[start : start + batch] for c in (sources, references))
                with _without(**replaced):
                    parts.append(np.asarray(many(variables, x, y)))
            return np.concatenate(parts)

        return run

    single = jax.jit(lambda v, x, y: as_it_is(v, x, y).rotation)

    def one_at_a_time(variables, sources, references):
        pairs = zip(sources, references, strict=True)
        return np.stack([np.asarray(single(variables, x, y)) for x, y in pairs])

    written = functools.partial(transcription.register, config=config.model)
    return {
        "the library": batched(as_it_is),
        "compiled without the library YNN": batched(as_it_is, workload.jit_without_ynn),
        "neighbours by sorting": batched(as_it_is, knn=_sorted_neighbors),
        "neighbourhood sums by indexing": batched(as_it_is, neighborhood_sum=_sum_by_indexing),
        "matching in blocks of rows": batched(as_it_is, LARGEST=0),
        "nothing hoisted, iterations written out": batched(
            functools.partial(_written_out, config=config)
        ),
        "one pair at a time": one_at_a_time,
        "padded by a quarter": batched(functools.partial(_padded, config=config)),
        "the equations as first written": batched(written, jax.jit),
    }


def measure(points: int, batch: int, pairs: int) -> list[dict]:
    """MAE(R), MIE(R) and the worst pair in degrees of every variant, in float32 and in float64.

    `difference` is that of MAE(R) to the library, `apart` the largest angle between the rotations
    that both find for a pair.
    """
    drawn, rows = workload.draw(points, pairs), []
    for dtype in ("float32", "float64"):
        with jax.enable_x64(dtype == "float64"):
            variables, _ = workload.released()
            given = jax.tree.map(lambda x, d=dtype: jnp.asarray(x, d), (variables, *drawn[:2]))
            first = None
            for name, run in variants(batch).items():
                found = run(*given).astype(np.float64)
                euler = euler_zyx_deg(found) - euler_zyx_deg(drawn.rotations.astype(np.float64))
                angle = rotation_angle_deg(found, drawn.rotations.astype(np.float64))
                mae = float(np.mean(np.abs(euler)))
                first = first or (mae, found)
                rows.append(
                    {
                        "variant": name,
                        "dtype": dtype,
                        "mae_r_deg": mae,
                        "mie_r_deg": float(np.mean(angle)),
                        "worst_deg": float(np.max(angle)),
                        "difference_deg": mae - first[0],
                        "apart_deg": float(np.max(rotation_angle_deg(found, first[1]))),
                    }
                )
    return rows
