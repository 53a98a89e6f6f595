"""The traps of XLA:CPU, each taken and avoided: what the library does about them, in milliseconds.

    python -m benchmarks.paper.traps [--points 768] [--batch 8] [--only forward search sum loop]

`forward` a batch pair by pair and at once, and compiled without the library YNN
`search`  neighbours by one selection, by a selection that slices turn into a sort, by sorting rows
`sum`     the neighbourhood sum and its gradient: row gathers in loops, indexing, 0/1 matrices
`loop`    seconds to compile the gradient of the iterations as a loop, and written out

The first line of each group is what the library does. `tests/test_compiled.py` keeps it so.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax.lax import Precision

from benchmarks import record
from benchmarks.paper import transcription
from benchmarks.speed import timing, workload
from jaxreg.batching import map_pairs
from jaxreg.geometry import neighbors, rigid
from jaxreg.network import matching
from jaxreg.network.model import register_pair
from jaxreg.types import RigidTransform

GROUPS = ("forward", "search", "sum", "loop")


@dataclasses.dataclass(frozen=True)
class Options:
    """What to measure."""

    points: int = 768
    batch: int = 8
    rounds: int = 5
    only: tuple[str, ...] = GROUPS
    record: bool = True
    """Write the table to benchmarks/results/."""


def forward(options: Options) -> dict[str, Callable]:
    """The same function as `vmap` has it, and as XLA compiles it without YNN."""
    variables, config = workload.released()
    clouds = [jnp.asarray(x) for x in workload.draw(options.points, options.batch)[:2]]

    def many(over_batch, variables, *clouds):
        return over_batch(functools.partial(register_pair, variables, config=config))(*clouds)

    loop, at_once = (functools.partial(many, way) for way in (map_pairs, jax.vmap))
    programs = {
        "forward pass, pair by pair": jax.jit(loop),
        "forward pass, the batch at once (vmap)": jax.jit(at_once),
        "forward pass, pair by pair, without YNN": workload.jit_without_ynn(loop),
    }
    return {name: lambda _, f=program: f(variables, *clouds) for name, program in programs.items()}


def search(options: Options) -> dict[str, Callable]:
    """Three searches for the same neighbours."""
    clouds = jnp.asarray(workload.draw(options.points, options.batch).sources)
    k = workload.released()[1].model.k

    def sliced(points):
        distance = neighbors.squared_distances(points, points)
        idx = jax.lax.top_k(-distance, k + 1)[1]
        return idx[:, 1:], idx[:, 1]

    programs = {
        "neighbours, one selection": functools.partial(neighbors.knn, k=k),
        "neighbours, a selection that is sliced twice": sliced,
        "neighbours, every row sorted": functools.partial(transcription.neighborhoods, k=k),
    }
    compiled = {name: jax.jit(jax.vmap(program)) for name, program in programs.items()}
    return {name: lambda _, f=program: f(clouds) for name, program in compiled.items()}


def by_products(scores, source, reference):
    """``A_P M A_Q^T`` with dense matrices of zeros and ones."""
    one, other = (
        jnp.sum(jax.nn.one_hot(idx, size, dtype=scores.dtype), axis=1)
        for idx, size in zip((source, reference), scores.shape, strict=True)
    )
    rows = jnp.matmul(one, scores, precision=Precision.HIGHEST)
    return jnp.matmul(rows, other.T, precision=Precision.HIGHEST)


def sums(options: Options) -> dict[str, Callable]:
    """Three neighbourhood sums, forward and with their gradient."""
    n, k = options.points, workload.released()[1].model.k_matching
    rng = np.random.default_rng(0)
    scores = jnp.asarray(rng.uniform(size=(options.batch, n, n)), jnp.float32)
    clouds = workload.draw(n, options.batch)[:2]
    graphs = [jax.vmap(lambda x: neighbors.knn(x, k))(jnp.asarray(x)) for x in clouds]
    both_ways = jax.jit(jax.vmap(matching.incidence))
    candidates = {
        "gathers in loops": (matching.neighborhood_sum, [both_ways(g) for g in graphs]),
        "indexing": (transcription.neighborhood_sum, graphs),
        "0/1 matrices": (by_products, graphs),
    }
    tasks = {}
    for name, (function, graph) in candidates.items():
        loss = lambda x, p, q, f=function: jnp.sum(f(x, p, q) ** 2)  # noqa: E731
        for label, program in (("sum", function), ("sum and gradient", jax.grad(loss))):
            compiled = jax.jit(jax.vmap(program))
            tasks[f"{label}, {name}"] = lambda _, f=compiled, g=graph: f(scores, *g)
    return dict(sorted(tasks.items(), key=lambda item: "gradient" in item[0]))


def loop(options: Options) -> dict[str, float]:
    """Seconds to compile the gradient of a registration with respect to the parameters."""
    variables, config = workload.released()
    clouds = [jnp.asarray(x[0]) for x in workload.draw(options.points, 1)[:2]]
    once = dataclasses.replace(config, model=dataclasses.replace(config.model, iterations=1))

    def looped(variables, source, reference):
        return jnp.sum(register_pair(variables, source, reference, config=config).correspondences)

    def written_out(variables, source, reference):
        for _ in range(config.model.iterations):
            result = register_pair(variables, source, reference, config=once)
            source = rigid.apply(RigidTransform(*result[:2]), source)
        return jnp.sum(result.correspondences)

    found = {}
    for name, program in (("in a loop", looped), ("written out", written_out)):
        begin = time.perf_counter()
        jax.jit(jax.grad(program)).lower(variables, *clouds).compile()
        found[f"compile the gradient, iterations {name}"] = time.perf_counter() - begin
    return found


def show(rows: dict[str, float], unit: str) -> None:
    """A line each, with the ratio to the first."""
    first = next(iter(rows.values()))
    for name, value in rows.items():
        print(f"{name:48s} {value:9.2f} {unit}  x {value / first:.2f}", flush=True)


ROWS = {
    "batch": (
        "a batch: pair by pair; at once, by `vmap`",
        "forward pass, pair by pair",
        "forward pass, the batch at once (vmap)",
    ),
    "neighbours": (
        "neighbours: one selection; one sliced twice; every row sorted",
        "neighbours, one selection",
        "neighbours, a selection that is sliced twice",
        "neighbours, every row sorted",
    ),
    "sum_and_gradient": (
        "neighbourhood sum and its gradient: gathers in loops; indexing; matrices of 0 and 1",
        "sum and gradient, gathers in loops",
        "sum and gradient, indexing",
        "sum and gradient, 0/1 matrices",
    ),
    "sum_alone": (
        "the sum alone: the same three",
        "sum, gathers in loops",
        "sum, indexing",
        "sum, 0/1 matrices",
    ),
    "compile_s": (
        "compiling the gradient: iterations in a loop; written out",
        "compile the gradient, iterations in a loop",
        "compile the gradient, iterations written out",
    ),
    "fusion": (
        "XLA's kernels of the library YNN: on; off",
        "forward pass, pair by pair",
        "forward pass, pair by pair, without YNN",
    ),
}
"""Rows of the record: what a reader sees, what the library does, and the one or two other ways."""


def write(taken: dict[str, float]) -> Path:
    """The record `traps`: a row a trap, of those that were measured."""
    rows = {}
    for key, (label, *ways) in ROWS.items():
        if ways[0] in taken:
            values = [taken[way] for way in ways] + [None] * (3 - len(ways))
            named = zip(("library", "other", "third"), values, strict=True)
            rows[key] = {"label": label} | dict(named)
    return record.write(
        "traps",
        question="What do the traps of XLA:CPU cost (milliseconds a pair; compiling in seconds)?",
        command=record.command("benchmarks.paper.traps"),
        columns={"library": "what the library does", "other": "otherwise", "third": "or"},
        rows=rows,
    )


def main(options: Options) -> None:
    """Print every group that is asked for, and write them."""
    jax.config.update("jax_enable_compilation_cache", False)
    print(f"{options.points} points, batch {options.batch}; milliseconds a pair, fastest run")
    found: dict[str, float] = {}
    for name, make in (("forward", forward), ("search", search), ("sum", sums)):
        if name in options.only:
            taken = timing.alternate(make(options), rounds=options.rounds)
            milliseconds = {k: 1e3 * t.minimum / options.batch for k, t in taken.items()}
            show(milliseconds, "ms")
            found |= milliseconds
    if "loop" in options.only:
        seconds = loop(options)
        show(seconds, "s ")
        found |= seconds
    if options.record:
        print(write(found))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
