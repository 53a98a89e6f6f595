"""Whether the device that JAX finds here agrees with its CPU, and how many pairs a second it takes.

    python -m benchmarks.speed.accelerator [--points 512] [--pairs 16] [--batches 1 8 64 256]

The same pairs run on both, by the same functions in float32. The network and the refinements must give
the same poses up to rounding; the search chooses among candidates, and rounding may choose another one,
so that most of its poses must agree. Exit status 1 if they do not: then something on that device is less
exact than float32, as products are whose precision is not asked for. Where there is only a CPU it says so.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Float

from benchmarks.speed import timing, workload
from jaxreg.batching import map_pairs
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.network.model import register_pair
from jaxreg.refine.gicp import gicp
from jaxreg.refine.point_to_point import icp
from jaxreg.search.pipeline import register_global

_SAME_DEG = 0.05
"""Rotations that differ by less are one: float32 and other orders of sums leave some .001."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    points: int = 512
    """Points of each cloud."""
    pairs: int = 16
    """Pairs that are compared."""
    batches: tuple[int, ...] = (1, 8, 64, 256)
    """Sizes of a batch that are timed."""
    rounds: int = 3
    """Timed runs of every size; the fastest counts."""


class Method(NamedTuple):
    """A function of two clouds (n, 3), and the share of pairs on which devices must agree."""

    run: Callable
    least: float


def methods() -> dict[str, Method]:
    """The functions of one pair that run on any device."""
    variables, config = workload.released()
    network = functools.partial(register_pair, jax.device_get(variables), config=config)
    return {
        "register_pair": Method(network, 1.0),
        "register_global": Method(register_global, 0.9),
        "icp": Method(icp, 1.0),
        "gicp": Method(gicp, 1.0),
    }


def rotations(
    run: Callable, batch: workload.Batch, device: jax.Device
) -> Float[np.ndarray, "b 3 3"]:
    """What the function makes of a batch on a device."""
    return np.asarray(_batched(run)(*jax.device_put(batch[:2], device)), np.float64)


def _batched(run: Callable) -> Callable:
    """The compiled rotations of batches of pairs."""
    return jax.jit(map_pairs(lambda *pair: run(*pair).transform.rotation))


def agreement(
    run: Callable, batch: workload.Batch, devices: tuple[jax.Device, jax.Device]
) -> float:
    """Share of the pairs whose rotations are the same on both devices."""
    one, other = (rotations(run, batch, device) for device in devices)
    return float(np.mean(rotation_angle_deg(one, other) < _SAME_DEG))


def pairs_per_second(
    run: Callable, batch: workload.Batch, options: Options, device: jax.Device
) -> dict[int, float]:
    """By the size of a batch, whose pairs are those of `batch` again and again; the fastest runs."""
    compiled, tasks = _batched(run), {}
    for size in options.batches:
        rows = np.arange(size) % len(batch.sources)
        clouds = jax.device_put((batch.sources[rows], batch.references[rows]), device)
        tasks[str(size)] = lambda _, clouds=clouds: compiled(*clouds)
    taken = timing.alternate(tasks, rounds=options.rounds)
    return {size: size / taken[str(size)].minimum for size in options.batches}


def main(options: Options) -> int:
    """Compare, time and print; the exit status."""
    device, cpu = jax.devices()[0], jax.devices("cpu")[0]
    print(f"{device.device_kind} ({device.platform}), {options.points} points")
    alone = device.platform == "cpu"
    if alone:
        print("no accelerator: there is nothing to compare with the CPU")
    batch = workload.draw(options.points, options.pairs)
    failed = False
    for name, (run, least) in methods().items():
        told = f"{name:<16}"
        if not alone:
            share = agreement(run, batch, (device, cpu))
            failed |= share < least
            told += f"  same pose on {share:.0%} of {options.pairs} pairs (asked {least:.0%})"
        for size, rate in pairs_per_second(run, batch, options, device).items():
            told += f"  {size}: {rate:.3g}/s"
        print(told, flush=True)
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Options, description=__doc__)))
