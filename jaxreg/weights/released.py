"""Released weights: plain arrays in `.npz` files, no pickle, each with a card in `.json`.

The card holds the configuration, the data and command of the training, and the validation figures.
"""

import dataclasses
import io
import json
import re
import zipfile
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from jaxreg import config as configuration
from jaxreg.config import Config


def available_weights() -> tuple[str, ...]:
    """Names that `load_pretrained` knows."""
    folder = resources.files("jaxreg") / "weights"
    if not folder.is_dir():
        return ()
    names = (item.name for item in folder.iterdir())
    return tuple(sorted(name.removesuffix(".npz") for name in names if name.endswith(".npz")))


def check_new_name(name: str) -> None:
    """Raises ValueError unless weights can be released as `name`: a plain name that is not taken.

    To replace released weights, delete their two files first.
    """
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        raise ValueError(f"weights cannot be called {name!r}: use letters, digits, _ and - only.")
    if name in available_weights():
        raise ValueError(
            f"there are weights '{name}' already: choose another name, or delete {name}.npz and "
            f"{name}.json in {resources.files('jaxreg') / 'weights'} to replace them."
        )


def load_pretrained(name: str = "modelnet40") -> tuple[dict[str, Any], Config]:
    """The variables (numpy arrays) and the configuration of released weights.

    Raises:
      ValueError: there are no weights of that name; the message lists the names.
    """
    if name not in available_weights():
        raise ValueError(
            f"no released weights '{name}': choose from {', '.join(available_weights()) or 'none'}."
        )
    folder = resources.files("jaxreg") / "weights"
    with np.load(io.BytesIO((folder / f"{name}.npz").read_bytes()), allow_pickle=False) as arrays:
        variables = unflatten_dict({key: arrays[key] for key in arrays.files}, sep="/")
    return variables, configuration.from_dict(load_card(name)["config"], where=f"{name}.json")


def load_card(name: str) -> dict[str, Any]:
    """How the weights were made: `config`, `command`, `data`, `seed`, `step`, `validation`."""
    return json.loads((resources.files("jaxreg") / "weights" / f"{name}.json").read_text("utf-8"))


def save_weights(
    directory: str | Path, name: str, variables: Any, config: Config, card: dict[str, Any]
) -> None:
    """Write `name`.npz and `name`.json in the released form; equal weights give equal bytes."""
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    arrays = {k: np.asarray(v) for k, v in flatten_dict(variables, sep="/").items()}
    with zipfile.ZipFile(directory / f"{name}.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for key, value in sorted(arrays.items()):
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, value, allow_pickle=False)
            # np.savez stamps the time of writing into the archive.
            archive.writestr(zipfile.ZipInfo(f"{key}.npy"), buffer.getvalue())
    content = card | {"config": dataclasses.asdict(config)}
    (directory / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
