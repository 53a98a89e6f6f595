"""Checkpoints of a training run: the newest and the best state, by Orbax.

Released weights are in `pretrained`.
"""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
from flax.traverse_util import flatten_dict

from jaxreg import config as configuration
from jaxreg.config import Config


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
        """Save as the newest state and, when `error` is the lowest so far, as the best."""
        arguments = ocp.args.Composite(
            state=ocp.args.StandardSave(state),
            config=ocp.args.JsonSave(configuration.to_dict(self.config) | {"error": error}),
        )
        if error < self._best_error():
            self._best.save(step, args=arguments)
            self._best.wait_until_finished()
        self._latest.save(step, args=arguments)

    def restore(self, state: Any) -> Any:
        """The newest state of the run, or `state` when there is none.

        Raises:
          ValueError: the run was made with another configuration.
        """
        if self._latest.latest_step() is None:
            return state
        saved = _saved_config(self._latest)[0]
        if saved != self.config:
            raise ValueError(
                f"{self.directory} holds a run of another configuration "
                f"({_difference(saved, self.config)}): choose another --workdir, or the same values."
            )
        restored = _restore(self._latest, state)
        self._forget_after(self._latest.latest_step())
        return restored

    def log(self, entry: dict[str, float]) -> None:
        """Append one object to `metrics.jsonl`."""
        with (self.directory / "metrics.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")

    def best(self, state: Any) -> Any:
        """The state with the lowest validation error; the given `state` tells the structure."""
        return _restore(self._best, state)

    def close(self) -> None:
        """Wait for what is still being written."""
        self._latest.close()
        self._best.close()

    def _best_error(self) -> float:
        return np.inf if self._best.latest_step() is None else _saved_config(self._best)[1]

    def _forget_after(self, step: int) -> None:
        """Drop logged steps that will be run again."""
        path = self.directory / "metrics.jsonl"
        if path.exists():
            lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
            # A run that was killed while it wrote leaves half a line.
            whole = [line for line in lines if line.endswith("}\n")]
            kept = "".join(line for line in whole if json.loads(line)["step"] <= step)
            path.write_text(kept, encoding="utf-8")


@contextlib.contextmanager
def open_run(workdir: str | Path, config: Config) -> Iterator[Run]:
    """The run in `workdir`, made when it does not exist; closed (and written out) at the end."""
    directory = Path(workdir).resolve()
    directory.mkdir(parents=True, exist_ok=True)
    run = Run(directory, config)
    try:
        yield run
    finally:
        run.close()


def best_config(workdir: str | Path) -> tuple[Config, float]:
    """The configuration of the best checkpoint in `workdir`, and its validation error in degrees.

    Raises:
      ValueError: there is no checkpoint.
    """
    directory = Path(workdir).resolve() / "best"
    if not directory.is_dir():
        raise ValueError(
            f"no checkpoint in {workdir}: give the --workdir of a run of train.py that has "
            "validated at least once."
        )
    with ocp.CheckpointManager(directory) as manager:
        if manager.latest_step() is None:
            raise ValueError(
                f"{directory} holds no finished checkpoint: let train.py validate once."
            )
        return _saved_config(manager)


def _saved_config(manager: ocp.CheckpointManager) -> tuple[Config, float]:
    saved = dict(
        manager.restore(
            manager.latest_step(), args=ocp.args.Composite(config=ocp.args.JsonRestore())
        )["config"]
    )
    error = saved.pop("error")
    return configuration.from_dict(saved, where=str(manager.directory)), error


def _restore(manager: ocp.CheckpointManager, state: Any) -> Any:
    abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, state)
    wanted = ocp.args.Composite(state=ocp.args.StandardRestore(abstract))
    try:
        return manager.restore(manager.latest_step(), args=wanted)["state"]
    except ValueError as error:
        raise ValueError(
            f"the checkpoint in {manager.directory} has other arrays than this version of jaxreg "
            "writes: evaluate or resume it with the version that trained it, or train again."
        ) from error


def _difference(saved: Config, wanted: Config) -> str:
    old, new = (flatten_dict(configuration.to_dict(c), sep=".") for c in (saved, wanted))
    return ", ".join(f"{k}: {old[k]!r} there, {new[k]!r} here" for k in new if old[k] != new[k])
