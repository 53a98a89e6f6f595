"""Weights as files: plain arrays in NAME.npz, and a card in NAME.json that says how they were made.

One format for all, the networks and the search's features. NumPy alone reads NPZ, without pickle;
written here it contains no time stamp; and people and `git diff` can read a card next to it.
(safetensors would do the same at the price of a compiled dependency, and hide the card in its
header.) Every card has the `command` that made the weights, the `data` they were trained on, and
the `config` they need; that of a network also has `seed`, `step`, and the `validation` errors.

Weights that come with the package go by their name. Your own go by their path without a suffix, or
by their name if $JAXREG_WEIGHTS is their directory.
"""

import dataclasses
import io
import json
import os
import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxreg import config as configuration
from jaxreg.config import Config

_SHIPPED = Path(__file__).parent
_VARIABLE = "JAXREG_WEIGHTS"


def available_weights() -> tuple[str, ...]:
    """Names for `load_pretrained`: networks shipped with the package or found in $JAXREG_WEIGHTS."""
    names = {card.stem for folder in _folders() for card in folder.glob("*.json")}
    return tuple(sorted(name for name in names if _is_network(name)))


def _is_network(name: str) -> bool:
    """Whether a JSON file of this name is a network's card; other files may lie beside weights."""
    files = _found(name)
    try:
        return files is not None and "model" in _read_card(files[1])["config"]
    except ValueError:
        return False


def load_pretrained(name: str = "modelnet40") -> tuple[dict[str, Any], Config]:
    """Load a network: its variables (numpy arrays) and its configuration.

    `name` is one of `available_weights`, or the path of such files without a suffix.

    Raises:
      ValueError: there are no such weights (the message lists the names), they are not those of a
        network, or a file is damaged.
    """
    arrays, card = load_arrays(name)
    if "model" not in card["config"]:
        raise ValueError(
            f"the weights '{name}' are not those of a network: choose from "
            f"{', '.join(available_weights())}."
        )
    return _nested(arrays), configuration.from_dict(card["config"], where=f"{name}.json")


def load_network(name: str) -> tuple[dict[str, Any], Config]:
    """`load_pretrained`, or the best weights of a run if `name` is its folder.

    Raises:
      ValueError: there are no such weights or no such checkpoint, or they are damaged.
    """
    if (Path(name) / "best").is_dir():
        from jaxreg.weights.checkpoint import load_checkpoint  # needs the extra `train`

        return load_checkpoint(name)
    return load_pretrained(name)


def load_arrays(name: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays by name, as they were saved, and the card.

    Raises:
      ValueError: there are no such weights (the message lists the names), or a file is damaged.
    """
    from jaxreg.io.arrays import read_arrays  # and with it every format of clouds

    path, _ = weight_files(name)
    return read_arrays(path, remedy="copy it again, or train again"), load_card(name)


def load_card(name: str) -> dict[str, Any]:
    """How the weights were made: `command`, `data`, `config`; raises what `load_arrays` raises."""
    return _read_card(weight_files(name)[1])


def _read_card(path: Path) -> dict[str, Any]:
    try:
        card = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read ({error}): copy it again.") from None
    if not isinstance(card, dict) or not isinstance(card.get("config"), dict):
        raise ValueError(f"{path} is not a card of weights (it lacks `config`): copy it again.")
    return card


def check_new_name(name: str, directory: str | Path) -> None:
    """Raise ValueError unless weights can be saved as `name` in `directory`: plain and not taken.

    To replace weights, delete their two files first.
    """
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        raise ValueError(f"weights cannot be called {name!r}: use letters, digits, _ and - only.")
    for folder in (Path(directory), _SHIPPED):
        if (folder / f"{name}.npz").exists():
            mend = f", or delete {name}.npz and {name}.json in {folder} to replace them"
            raise ValueError(
                f"weights '{name}' already exist: choose another name"
                f"{mend if folder != _SHIPPED else ', for these come with jaxreg'}."
            )


def save_weights(
    directory: str | Path, name: str, variables: Any, config: Any, card: Mapping[str, Any]
) -> Path:
    """Write `name`.npz and `name`.json; equal weights give equal bytes. Returns the path of the card.

    `variables` is a nested dict of arrays, `config` the dataclass that they need.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(directory / f"{name}.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for key, value in sorted(_flat(variables)):
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.asarray(value), allow_pickle=False)
            # np.savez stamps the time of writing into the archive.
            archive.writestr(zipfile.ZipInfo(f"{key}.npy"), buffer.getvalue())
    content = dict(card) | {"config": dataclasses.asdict(config)}
    path = directory / f"{name}.json"
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return path


def _folders() -> list[Path]:
    """The directories in which a name is searched for, in this order."""
    own = os.environ.get(_VARIABLE, "").split(os.pathsep)
    return [_SHIPPED, *(Path(folder) for folder in own if folder)]


def weight_files(name: str) -> tuple[Path, Path]:
    """The arrays and the card of `name`, which may itself be their path without a suffix.

    Raises:
      ValueError: there are no such weights (the message lists the names).
    """
    if files := _found(name):
        return files
    if _is_path(name):
        raise ValueError(
            f"{name}.npz and {name}.json not found: give their common path without a suffix."
        )
    raise ValueError(
        f"no released weights '{name}': choose from {', '.join(available_weights()) or 'none'}, give "
        f"the path of your own without a suffix, or set ${_VARIABLE} to their directory."
    )


def _found(name: str) -> tuple[Path, Path] | None:
    for folder in [Path()] if _is_path(name) else _folders():
        arrays, card = folder / f"{name}.npz", folder / f"{name}.json"
        if arrays.is_file() and card.is_file():
            return arrays, card
    return None


def _is_path(name: str) -> bool:
    return Path(name).name != name


def _nested(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The tree whose paths are the names; by hand, because Flax takes 0.2 s to import."""
    tree: dict[str, Any] = {}
    for name, array in arrays.items():
        *path, leaf = name.split("/")
        branch = tree
        for part in path:
            branch = branch.setdefault(part, {})
        branch[leaf] = array
    return tree


def _flat(tree: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, part in tree.items():
        if isinstance(part, Mapping):
            yield from _flat(part, f"{above}{name}/")
        else:
            yield f"{above}{name}", part
