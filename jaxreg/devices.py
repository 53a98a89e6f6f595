"""Training on many devices, of one process or of many: who is there, and where arrays lie.

Every device holds the whole state and draws its own share of a batch. So the pairs of a step, and
with them the result, are those of one device up to rounding.
"""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxreg.network.features import DEVICE_AXIS

_VARIABLES = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")
_OPTIONS = ("--coordinator", "--processes", "--process-id")
_HEARTBEAT_SECONDS = 20


def join_processes(
    coordinator: str | None = None, processes: int | None = None, number: int | None = None
) -> None:
    """Make this process one of many (`jax.distributed`); nothing if there are no others.

    What is not given is read from JAX_COORDINATOR_ADDRESS (host:port of process 0),
    JAX_NUM_PROCESSES and JAX_PROCESS_ID, or found by JAX under SLURM. Call it before any array is
    made.

    Raises:
      ValueError: one of the three is known and another is not.
    """
    given = dict(zip(_OPTIONS, (coordinator, processes, number), strict=True))
    known = {
        option: os.environ.get(variable) if value is None else value
        for (option, value), variable in zip(given.items(), _VARIABLES, strict=True)
    }
    jax.config.update("jax_enable_recoverability", True)  # or those who are left cannot ask who is
    missing = [option for option, value in known.items() if value is None]
    if len(missing) == len(known):
        # In the shell of an allocation there are tasks to start, and this process is none of them.
        if "SLURM_PROCID" in os.environ and int(os.environ.get("SLURM_NTASKS", "1")) > 1:
            _initialize()
        return
    if missing:
        raise ValueError(
            f"{', '.join(missing)} is missing: give all of --coordinator HOST:PORT, --processes N "
            f"and --process-id K, or set {', '.join(_VARIABLES)}."
        )
    address, count, rank = map(str, known.values())
    _initialize(address, int(count), int(rank))


def _initialize(
    address: str | None = None, count: int | None = None, rank: int | None = None
) -> None:
    """`jax.distributed.initialize`, which finds what is None."""
    _let_holders_of_locks_run()
    jax.distributed.initialize(address, count, rank, heartbeat_timeout_seconds=_HEARTBEAT_SECONDS)


def _let_holders_of_locks_run() -> None:
    """Threads that begin from here on do not take a core from one that runs when they wake up (Linux).

    Gloo's thread that receives wakes up for every message, and then polls until it gets the lock of its
    connection. On a core that it shares with the holder it would keep that from giving the lock back
    until its time slice ends, some 4 ms in each sum of a training step.
    """
    if hasattr(os, "SCHED_BATCH") and os.sched_getscheduler(0) == os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def place_of(number: int | None, processes: int | None) -> tuple[int, int]:
    """The number of this process and how many there are, where they need not know each other.

    What is not given is read from JAX_PROCESS_ID and JAX_NUM_PROCESSES, or SLURM's variables; else
    there is one process. So it is in the shell of an allocation of SLURM, which is no task of it.

    Raises:
      ValueError: one of the two is known and the other is not.
    """
    asked = os.environ.get
    rank = asked("JAX_PROCESS_ID", asked("SLURM_PROCID")) if number is None else number
    count = asked("JAX_NUM_PROCESSES") if processes is None else processes
    if count is None and rank is not None:
        count = asked("SLURM_NTASKS")
    if rank is None and count is None:
        return 0, 1
    if rank is None or count is None:
        raise ValueError(
            "one of --processes N and --process-id K is missing: give both, or set "
            "JAX_NUM_PROCESSES and JAX_PROCESS_ID."
        )
    return int(rank), int(count)


def mesh_of_all() -> Mesh | None:
    """All devices of all processes in one line; None if there is only one."""
    if jax.device_count() == 1:
        return None
    return jax.make_mesh(
        (jax.device_count(),), (DEVICE_AXIS,), axis_types=(jax.sharding.AxisType.Auto,)
    )


def check_shares(batch: int, mesh: Mesh | None) -> None:
    """Raise ValueError unless every device gets as many pairs of a batch as every other."""
    count = 1 if mesh is None else mesh.size
    if batch % count:
        raise ValueError(
            f"train.batch = {batch} pairs cannot be shared by {count} devices: choose a multiple of "
            f"{count}."
        )


def on_all(tree: Any, mesh: Mesh | None) -> Any:
    """The arrays of a tree, which are the same in every process, whole on every device."""
    if mesh is None:
        return tree
    everywhere = NamedSharding(mesh, PartitionSpec())
    return jax.tree.map(lambda x: jax.device_put(np.asarray(x), everywhere), tree)


def on_one(tree: Any, mesh: Mesh | None) -> Any:
    """The same for a program of this process alone."""
    return tree if mesh is None else jax.tree.map(np.asarray, tree)


def as_first_says(numbers: dict[str, float]) -> dict[str, float]:
    """The numbers of the first process, so that all decide alike whatever their rounding."""
    if jax.process_count() == 1:
        return numbers
    values = multihost_utils.broadcast_one_to_all(np.array(list(numbers.values())))
    return dict(zip(numbers, np.asarray(values, float).tolist(), strict=True))


def is_first() -> bool:
    """Whether this process is the one that writes what all know."""
    return jax.process_index() == 0


def _lost() -> str:
    """Which processes are gone, as the coordinator knows once they have missed their heartbeats."""
    try:
        with multihost_utils.live_devices(jax.devices()) as alive:
            left = {device.process_index for device in alive}
    except Exception:  # noqa: BLE001 - an unstable part of JAX, and the coordinator may be gone
        return "another one"
    gone = [str(number) for number in range(jax.process_count()) if number not in left]
    return f"process {', '.join(gone)}" if gone else "another one"


class Watch:
    """Whether this process, or another of the run, was asked to end (SIGTERM, as schedulers send)."""

    def __init__(self) -> None:
        """Nobody was yet."""
        self.asked = False

    def asked_to_end(self, step: int) -> bool:
        """The same answer in all processes at the same step."""
        if jax.process_count() == 1:
            return self.asked
        return multihost_utils.reached_preemption_sync_point(step)

    def end(self, step: int) -> None:
        """End this process as the signal would have, once everything is saved."""
        if jax.process_index() == 0:
            sys.stderr.write(f"SIGTERM: saved step {step}; the same command goes on from there.\n")
            sys.stderr.flush()
        if jax.process_count() > 1:
            jax.distributed.shutdown()
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTERM)


@contextlib.contextmanager
def watched() -> Iterator[Watch]:
    """A `Watch` over the block; where other threads train, signals are left alone.

    If another process dies, the error of this one says which: JAX tells of a lost connection only.
    """
    watch = Watch()
    alone = jax.process_count() == 1  # else JAX's own handler tells all of them
    mine = alone and threading.current_thread() is threading.main_thread()
    before = (
        signal.signal(signal.SIGTERM, lambda *_: setattr(watch, "asked", True)) if mine else None
    )
    try:
        yield watch
    except (jax.errors.JaxRuntimeError, ValueError) as error:
        # JAX's collectives on the host raise ValueError for a lost connection.
        first = str(error).partition("\n")[0]
        if alone or (isinstance(error, ValueError) and "Gloo" not in first):
            raise
        sys.stderr.write(
            f"error: process {jax.process_index()} of {jax.process_count()} lost {_lost()}: start "
            f"all of them again, and the run goes on from its last checkpoint ({first}).\n"
        )
        sys.stderr.flush()
        os._exit(2)  # at a normal end JAX would wait for the process that is gone
    finally:
        if mine:
            signal.signal(signal.SIGTERM, before)
