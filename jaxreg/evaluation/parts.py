"""An evaluation in parts: processes that share a folder, and one that goes on where it ended.

Every batch of pairs is a part. Which process registers it changes no bit of the result, since all of
them make the same batch and run the same program. A part is kept as soon as it is done; whoever finds
all of them there has the whole.
"""

import hashlib
import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import jax
import numpy as np

from jaxreg.io.arrays import read_arrays
from jaxreg.types import RigidTransform

_WHAT = "evaluation.json"
_ARRAYS = ("rotation", "translation", "true_rotation", "true_translation", "seconds")


class Registered(NamedTuple):
    """Predicted and true transforms of some pairs (numpy, stacked), and the seconds they took."""

    predicted: RigidTransform
    truth: RigidTransform
    seconds: float


class Parts(NamedTuple):
    """The folder of an evaluation, and which batches are this process' own.

    Its own are every `processes`-th, from the `number`-th of them on.
    """

    folder: Path
    number: int = 0
    processes: int = 1

    def opened(self, what: dict[str, Any]) -> None:
        """Make the folder, or look whether it holds parts of the same evaluation.

        `what` says all that the results follow from, alike on every host: no paths, but what is in
        the files.

        Raises:
          ValueError: it holds those of another; the numbers of the processes do not fit.
        """
        if not 0 <= self.number < self.processes:
            raise ValueError(
                f"process {self.number} of {self.processes}: processes are counted from 0 to "
                f"{self.processes - 1}."
            )
        self.folder.mkdir(parents=True, exist_ok=True)
        place, text = self.folder / _WHAT, json.dumps(what, indent=1, default=str) + "\n"
        if not place.exists():
            self._write(place, lambda file: file.write(text.encode()))
        elif (there := place.read_text(encoding="utf-8")) != text:
            raise ValueError(
                f"{self.folder} holds parts of another evaluation ({_difference(there, text)}; {place} "
                "says which): give another folder, or delete it."
            )

    def keeps(self, path: Path) -> bool:
        """Whether a file is one of those that this folder is for."""
        known = path.name == _WHAT or re.fullmatch(r"batch_\d{6,}\.npz", path.name)
        return bool(known) and path.resolve().parent == self.folder.resolve()

    def own(self, batches: int) -> list[int]:
        """The numbers of this process' batches that are not there yet, of so many."""
        mine = range(self.number, batches, self.processes)
        return [number for number in mine if not self._place(number).exists()]

    def missing(self, batches: int) -> int:
        """How many batches are not there yet, of so many."""
        return sum(not self._place(number).exists() for number in range(batches))

    def keep(self, number: int, found: Registered) -> None:
        """Write a batch, whole or not at all."""
        values = (*found.predicted, *found.truth, np.asarray(found.seconds))
        arrays = dict(zip(_ARRAYS, values, strict=True))
        self._write(self._place(number), lambda file: np.savez(file, **arrays))

    def kept(self, number: int) -> Registered:
        """A batch that is there."""
        arrays = read_arrays(self._place(number), _ARRAYS, remedy="delete it, and run again")
        rotation, translation, *truth, seconds = (arrays[name] for name in _ARRAYS)
        return Registered(
            RigidTransform(rotation, translation), RigidTransform(*truth), float(seconds)
        )

    def _place(self, number: int) -> Path:
        return self.folder / f"batch_{number:06d}.npz"

    def _write(self, place: Path, save: Callable[[BinaryIO], Any]) -> None:
        temporary = place.with_name(f".{place.name}.{self.number}")
        with temporary.open("wb") as file:
            save(file)
        os.replace(temporary, place)


def digest(tree: Any) -> str:
    """32 hexadecimal digits that stand for the arrays of a tree: their names, kinds and numbers."""
    found = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        array = np.ascontiguousarray(leaf)
        found.update(f"{jax.tree_util.keystr(path)} {array.dtype.str} {array.shape}\n".encode())
        found.update(array.tobytes())
    return found.hexdigest()[:32]


def _difference(there: str, here: str) -> str:
    """Which entries of two records differ, in words."""
    try:
        old, new = dict(json.loads(there)), json.loads(here)
    except (ValueError, TypeError):
        return "its record is damaged"
    names = [name for name in new if name not in old or old[name] != new[name]]
    return f"with another {' and another '.join(names)}" if names else "made in another way"
