"""What a training step of many processes sends: read from its compiled program, and timed alone."""

import math
import re
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.speed import timing
from jaxreg import devices, training
from jaxreg.cli import process, train
from jaxreg.data.batches import same_streams


def measure(arguments: list[str], address: str, count: int, rank: int) -> dict:
    """What a training step of `count` processes sends, and seconds of sending it alone.

    The sizes are those of the all-reduce operations of the compiled step: `bytes_sent` of all of them,
    and `sends` of how many there are. They are timed one after the other, as in a step, and as one.
    """
    process.enable_compilation_cache()
    devices.join_processes(address, count, rank)
    sizes = _sent(train.parse(train.Options, description="", arguments=arguments)[1].config)
    sums = _sums(sizes), _sums([sum(sizes)])
    taken = timing.alternate(dict(zip("so", sums, strict=True)), rounds=50)
    jax.distributed.shutdown()
    return {
        "sends": len(sizes),
        "kilobytes": round(4 * sum(sizes) / 1e3),
        "sends_ms": round(1e3 * taken["s"].median, 2),
        "as_one_ms": round(1e3 * taken["o"].median, 2),
    }


def _sent(config) -> list[int]:
    """How many numbers every all-reduce of a training step on all devices sums up."""
    mesh = devices.mesh_of_all()
    whole = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
    forms = (
        jax.eval_shape(lambda: training.create_train_state(config)),
        jax.ShapeDtypeStruct((16, config.pairs.points, 3), np.float32),
    )
    state, shapes = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=whole), forms
    )
    with same_streams():
        step = training._train_step_jit.lower(state, shapes, config=config, mesh=mesh)
        text = step.compile().as_text()
    return sums_of(text)


def sums_of(text: str) -> list[int]:
    """How many numbers every all-reduce of a compiled program sums up; in a loop, every time."""
    parts = re.split(r"\n(?=(?:ENTRY )?%)", text)
    named = {name[1]: part for part in parts if (name := re.match(r"(?:ENTRY )?%([\w.-]+)", part))}

    def of(part: str) -> list[int]:
        found = []
        for line in part.splitlines():
            if sent := re.search(r"= (.*) all-reduce(?:-start)?\(", line):
                forms = re.findall(r"\w+\[([\d,]*)\]", sent[1])
                found.append(sum(math.prod(map(int, filter(None, f.split(",")))) for f in forms))
            elif body := re.search(r" while\(.*body=%([\w.-]+)", line):
                rounds = re.search(r"known_trip_count\D*(\d+)", line)
                found += of(named[body[1]]) * (int(rounds[1]) if rounds else 1)
            elif called := re.search(r" call\(.*to_apply=%([\w.-]+)", line):
                found += of(named[called[1]])
        return found

    return of(next(part for part in parts if part.startswith("ENTRY")))


def _sums(sizes: list[int]) -> Callable[[int], object]:
    """Sums over all devices of arrays of such sizes, each after the one before."""
    mesh = devices.mesh_of_all()

    def local(x):
        for size in sizes:
            # What is sent depends on what came, or XLA would send all as one.
            x = jax.lax.psum(jnp.full(size, x), devices.DEVICE_AXIS)[0] / mesh.size
        return x

    everywhere = jax.sharding.PartitionSpec()
    summed = jax.jit(
        jax.shard_map(local, mesh=mesh, in_specs=everywhere, out_specs=everywhere, check_vma=False)
    )
    x = devices.on_all(jnp.ones(()), mesh)
    return lambda _: summed(x)
