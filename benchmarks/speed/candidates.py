"""Who takes part: the library, the equations as written, and what one would pick instead."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.speed import timing, workload
from jaxreg import training
from jaxreg.evaluation import methods
from jaxreg.geometry.rigid import rotation_angle_deg

PEERS = (
    "open3d_ransac_icp",
    "open3d_fpfh_ransac",
    "open3d_fgr_gicp",
    "open3d_fgr",
    "open3d_icp",
    "small_gicp",
)


class Candidate(NamedTuple):
    """A function of the number of a pair that returns its rotation, or those of the whole batch."""

    rotations: Callable[[int], object]
    pairs: int


def candidates(drawn: workload.Batch, *, transcription: bool) -> tuple[dict[str, Candidate], list]:
    """Everyone who can take part, and the reasons why the others cannot."""
    found, missing = _networks(drawn, "jaxreg"), []
    if transcription:
        found |= _networks(drawn, "transcription")
    for name in PEERS:
        try:
            register = methods.choose(name).clouds
        except ValueError as error:
            missing.append(f"left out: {error}")
            continue
        found[name] = Candidate(
            lambda i, f=register: f(drawn.sources[i], drawn.references[i]).transform.rotation, 1
        )
    return found, missing


def _networks(drawn: workload.Batch, name: workload.Implementation) -> dict[str, Candidate]:
    """The whole batch at once, and one pair at a time."""
    variables, _ = workload.released()
    clouds = [jnp.asarray(x) for x in drawn[:2]]
    batch = len(clouds[0])
    many, one = (workload.registration(name, batched=x) for x in (True, False))
    return {
        f"{name}, batch {batch}": Candidate(lambda _: many(variables, *clouds).rotation, batch),
        f"{name}, batch 1": Candidate(
            lambda i: one(variables, *(x[i] for x in clouds)).rotation, 1
        ),
    }


def register(
    points: int, *, batch: int, rounds: int, seconds: float, transcription: bool
) -> tuple[list[dict], list[str]]:
    """A row for every candidate at one size, and the reasons why others are missing."""
    drawn = workload.draw(points, batch)
    found, missing = candidates(drawn, transcription=transcription)
    tasks = {name: lambda number, f=who.rotations: f(number % batch) for name, who in found.items()}
    taken = timing.alternate(tasks, rounds=rounds, seconds=seconds)
    rows = []
    for name, who in found.items():
        if who.pairs == 1:
            rotations = np.stack([np.asarray(who.rotations(i)) for i in range(batch)])
        else:
            rotations = np.asarray(who.rotations(0))
        errors = rotation_angle_deg(rotations.astype(np.float64), drawn.rotations)
        rows.append(
            {
                "candidate": name,
                "points": points,
                "minimum": taken[name].minimum / who.pairs,
                "median": taken[name].median / who.pairs,
                "median_error_deg": float(np.median(errors)),
                "worst_error_deg": float(np.max(errors)),
            }
        )
    return rows, missing


def train(points: int, *, batch: int, rounds: int, seconds: float) -> list[dict]:
    """The training step of `train.py`, and loss and gradient alone, in both implementations."""
    config = workload.training_config(points, batch)
    shapes = jnp.asarray(workload.draw(config.pairs.points, 2 * batch).sources)
    step, held = workload.training_step(config), [training.create_train_state(config)]
    parameters = [held[0].variables[kind] for kind in ("params", "batch_stats")]
    parameters = jax.tree.map(jnp.copy, parameters)  # The step takes the state's own buffers.

    def one_step(_):
        held[0], logged = step(held[0], shapes)
        return logged

    tasks = {"jaxreg, step": one_step}
    for name in ("jaxreg", "transcription"):
        gradient = workload.gradient(name, config)
        inputs = *parameters, *workload.loss_inputs(name, workload.draw(points, batch))
        tasks[f"{name}, gradient"] = lambda _, f=gradient, x=inputs: f(*x)
    taken = timing.alternate(tasks, rounds=rounds, seconds=seconds)
    return [
        {"candidate": name, "minimum": found.minimum / batch, "median": found.median / batch}
        for name, found in taken.items()
    ]
