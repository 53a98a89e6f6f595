"""Checkpoints of a training run: the latest and the best state, with Orbax.

Released weights are in `weights.released`.
"""

import contextlib
import json
import os
from collections.abc import Container, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict

from jaxreg import config as configuration
from jaxreg._extras import extra
from jaxreg.config import Config
from jaxreg.network.model import Variables
from jaxreg.peers.by_name import init_variables

try:
    import fcntl
except ImportError:  # Windows has no locks that end with the process and leave no file
    fcntl = None

with extra("train", "a checkpoint"):
    import orbax.checkpoint as ocp


class Run:
    """The working directory of one training run: `latest/`, `best/` and `metrics.jsonl`."""

    def __init__(self, directory: Path, config: Config):
        """Open the checkpoints below `directory`, which exists."""
        self.directory, self.config = directory, config
        self._latest, self._best = (
            ocp.CheckpointManager(
                directory / name, options=ocp.CheckpointManagerOptions(max_to_keep=1)
            )
            for name in ("latest", "best")
        )

    def save(self, step: int, state: Any, error: float) -> None:
        """Save as the latest state and, if `error` is the lowest so far, as the best."""
        arguments = ocp.args.Composite(
            state=ocp.args.StandardSave(state),
            config=ocp.args.JsonSave(configuration.to_dict(self.config) | {"error": error}),
        )
        self._check_space(state, step)
        if error < self._best_error():
            self._best.save(step, args=arguments)
            self._best.wait_until_finished()
        self._latest.save(step, args=arguments)

    def restore(self, state: Any) -> Any:
        """The latest state of the run, or `state` if there is none.

        Log entries after it are dropped, because they will be logged again. A run stopped before
        its first checkpoint starts over, with any configuration.

        Raises:
          ValueError: the checkpoints were made with another configuration, have other arrays than
            `state`, or cannot be read.
        """
        newest, best = self._latest.latest_step(), self._best.latest_step()
        # A run killed during its first save has a best state but no latest one.
        if newest is not None or best is not None:
            saved = _saved_config(self._best if newest is None else self._latest)[0]
            if saved != self.config:
                raise ValueError(
                    f"{self.directory} contains a run with another configuration "
                    f"({_difference(saved, self.config)}): choose another --workdir, or the same "
                    "values."
                )
        if newest is not None:
            abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, state)
            state = _restore(self._latest, abstract, ocp.args.StandardRestore(abstract))
        self._forget_after(newest or 0)
        return state

    def log(self, entry: dict[str, float]) -> None:
        """Append one object to `metrics.jsonl`; of many processes the first does."""
        if jax.process_index() > 0:
            return
        with (self.directory / "metrics.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")

    def close(self) -> None:
        """Wait for what is still being written."""
        self._latest.close()
        self._best.close()

    def _check_space(self, state: Any, step: int) -> None:
        """Raise OSError if there is no room for `state`: Orbax says so in hundreds of lines."""
        if jax.process_index() > 0:
            return
        size = sum(x.nbytes for x in jax.tree.leaves(state))
        part = self.directory / "space.part"
        try:
            with part.open("wb") as file:
                file.write(bytes(size))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            told = (
                f"{error.strerror}: no room for the checkpoint of step {step} ({size / 1e6:.1f} MB); "
                "make room and run the same command again to go on from the last one"
            )
            raise OSError(error.errno, told, str(self.directory)) from None
        finally:
            part.unlink(missing_ok=True)

    def _best_error(self) -> float:
        return np.inf if self._best.latest_step() is None else _saved_config(self._best)[1]

    def _forget_after(self, step: int) -> None:
        """Drop logged steps that will be run again, and the incomplete line of a killed run."""
        path = self.directory / "metrics.jsonl"
        if path.exists() and jax.process_index() == 0:
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
            kept = [line + "\n" for line in lines if _logged_step(line) <= step]
            # Replaced in one step: if killed while it writes, this run would lose the lines of the
            # others.
            part = path.with_suffix(".part")
            part.write_text("".join(kept), encoding="utf-8")
            part.replace(path)


def check_place(workdir: str | Path) -> None:
    """Raise ValueError unless `workdir` is a writable directory, or can be made."""
    directory = Path(workdir).resolve()
    place = next(path for path in (directory, *directory.parents) if path.exists())
    if not place.is_dir():
        raise ValueError(f"{place} is a file: name a directory with --workdir.")
    if not os.access(place, os.W_OK | os.X_OK):
        raise ValueError(f"{place} cannot be written to: choose another --workdir.")


@contextlib.contextmanager
def open_run(workdir: str | Path, config: Config) -> Iterator[Run]:
    """The run in `workdir`, created if it does not exist; closed (and written out) at the end.

    Raises:
      ValueError: another process trains there.
    """
    directory = Path(workdir).resolve()
    directory.mkdir(parents=True, exist_ok=True)
    with _alone(directory):
        run = Run(directory, config)
        try:
            yield run
        finally:
            run.close()


@contextlib.contextmanager
def _alone(directory: Path) -> Iterator[None]:
    """Hold a lock on the directory, which ends with the process, however that ends."""
    if fcntl is None or jax.process_index() > 0:
        yield
        return
    handle = os.open(directory, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise ValueError(
            f"another process trains in {directory}: wait until it has ended, or choose another "
            "--workdir."
        ) from None
    except OSError:
        pass  # some network file systems have no locks
    try:
        yield
    finally:
        os.close(handle)


def best_config(workdir: str | Path) -> tuple[Config, float]:
    """The configuration of the best checkpoint in `workdir`, and its validation error in degrees.

    Raises:
      ValueError: there is no checkpoint.
    """
    with _open_best(workdir) as manager:
        return _saved_config(manager)


def restore_best(workdir: str | Path, wanted: dict[str, Any]) -> dict[str, Any]:
    """Parts of the best state in `workdir` as numpy arrays; nothing is written, nothing else read.

    `wanted` maps the names of the parts to trees of anything with the shapes and dtypes that they
    must have.

    Raises:
      ValueError: there is no checkpoint, it has other arrays than `wanted`, or it cannot be read.
    """
    as_numpy = jax.tree.map(lambda _: ocp.RestoreArgs(restore_type=np.ndarray), wanted)
    arguments = ocp.args.PyTreeRestore(wanted, restore_args=as_numpy, partial_restore=True)
    with _open_best(workdir) as manager:
        return _restore(manager, wanted, arguments, parts=wanted)


@contextlib.contextmanager
def _open_best(workdir: str | Path) -> Iterator[ocp.CheckpointManager]:
    directory = Path(workdir).resolve() / "best"
    if not directory.is_dir():
        raise ValueError(
            f"no checkpoint in {workdir}: give the --workdir of a training run that has "
            "validated at least once."
        )
    with ocp.CheckpointManager(directory) as manager:
        if manager.latest_step() is None:
            raise ValueError(
                f"{directory} contains no finished checkpoint: train until the first validation."
            )
        yield manager


def _saved_config(manager: ocp.CheckpointManager) -> tuple[Config, float]:
    saved = dict(
        manager.restore(
            manager.latest_step(), args=ocp.args.Composite(config=ocp.args.JsonRestore())
        )["config"]
    )
    error = saved.pop("error")
    return configuration.from_dict(saved, where=str(manager.directory)), error


def _restore(
    manager: ocp.CheckpointManager,
    wanted: Any,
    arguments: Any,
    *,
    parts: Container[str] | None = None,
) -> Any:
    """What `arguments` ask for of the latest state. Its arrays (of `parts`) must be as `wanted`."""
    step = manager.latest_step()
    try:
        with contextlib.closing(ocp.StandardCheckpointHandler()) as handler:
            saved = handler.metadata(manager.directory / str(step) / "state").tree
        there, here = _arrays(saved), _arrays(wanted)
        if parts is not None:
            there = {name: form for name, form in there.items() if name[0] in parts}
        if there == here:
            return manager.restore(step, args=ocp.args.Composite(state=arguments))["state"]
    except (ValueError, OSError) as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(
            f"the checkpoint in {manager.directory} cannot be read ({reason}): replace it with an "
            "intact copy, or train again in another --workdir."
        ) from error
    name = min(name for name, _ in there.items() ^ here.items())
    raise ValueError(
        f"the checkpoint in {manager.directory} has other arrays than this version of jaxreg writes "
        f"({'/'.join(name)}: {there.get(name, 'none')} there, {here.get(name, 'none')} here): "
        "evaluate or resume it with the version that trained it, or train again."
    )


def _arrays(tree: Any) -> dict[tuple[str, ...], str]:
    """Dtype and shape of every array of a tree, by its path; other leaves are ignored."""
    leaves = ocp.tree.to_flat_dict(tree).items()
    return {k: f"{np.dtype(x.dtype)}{list(x.shape)}" for k, x in leaves if hasattr(x, "shape")}


def _logged_step(line: str) -> float:
    """The step of a line of `metrics.jsonl`; infinity if a killed run left the line unfinished."""
    try:
        return float(json.loads(line)["step"])
    except (ValueError, TypeError, KeyError):
        return np.inf


def _difference(saved: Config, wanted: Config) -> str:
    old, new = (flatten_dict(configuration.to_dict(c), sep=".") for c in (saved, wanted))
    return ", ".join(f"{k}: {old[k]!r} there, {new[k]!r} here" for k in new if old[k] != new[k])


def load_checkpoint(workdir: str | Path) -> tuple[Variables, Config]:
    """The best (averaged) variables of a training run and its configuration. Nothing is written.

    Raises:
      ValueError: there is no checkpoint in `workdir`, it has other arrays than a network of this
        version, or it cannot be read.
    """
    return load_best(workdir)[:2]


def load_best(workdir: str | Path) -> tuple[Variables, Config, int]:
    """The same, and the step. The optimiser's state is not read: other versions may change it."""
    config, _ = best_config(workdir)
    average = jax.eval_shape(lambda: init_variables(jax.random.key(0), config))
    step = jax.ShapeDtypeStruct((), jnp.int32)
    best = restore_best(workdir, {"step": step, "average": average})
    return jax.tree.map(jnp.asarray, best["average"]), config, int(best["step"])
