"""Shapes to make pairs from: the one entry to every source of data."""

import dataclasses
import os
from pathlib import Path
from typing import Literal

import numpy as np

from jaxreg.config import DataConfig
from jaxreg.data import folder, icl_nuim, modelnet, seven_scenes
from jaxreg.data.pairs import make_pair, make_pair_from_scans, pair_sizes
from jaxreg.data.procedural import shapes

__all__ = [
    "Split",
    "data_root",
    "dataset_label",
    "load_shapes",
    "load_training",
    "make_pair",
    "make_pair_from_scans",
    "pair_sizes",
    "root_of",
    "training_label",
]

Split = Literal["train", "validation", "test"]
_ANY_POINTS = ("folder", "seven_scenes")
"""Sources whose files are resampled to the number of points asked for."""


def data_root(
    argument: str | Path | None = None, config_path: str | Path | None = None
) -> Path | None:
    """The folder of the data sets: `argument` (--data-root), else $JAXREG_DATA, else data/.

    data/ is searched for next to the configuration file, or in the working directory for a
    configuration that comes with jaxreg. None if there is no such folder and nothing else was asked
    for.

    Raises:
      ValueError: the folder that `argument` or $JAXREG_DATA names does not exist.
    """
    for named, origin in (
        (argument, "--data-root"),
        (os.environ.get("JAXREG_DATA"), "$JAXREG_DATA"),
    ):
        if named:
            if not Path(named).is_dir():
                raise ValueError(
                    f"{origin} is {named}, which is not a folder: correct it or leave it out."
                )
            return Path(named)
    beside = None if config_path is None else Path(config_path).parent / "data"
    return beside if beside is not None and beside.is_dir() else None


def root_of(
    config: DataConfig, argument: str | Path | None, config_path: str | Path | None
) -> Path | None:
    """`data_root` if the source that `config` names reads from it, else None."""
    return None if config.name in ("shapes", "folder") else data_root(argument, config_path)


def load_shapes(
    config: DataConfig,
    split: Split,
    *,
    root: str | Path | None = None,
    points: int,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Clouds (n, P, 3) float32 and labels (n,) int32 of the source that `config.name` names.

    `validation` is a share of the *training* shapes, chosen by `seed` and left out of `train`.
    `points` is P if the source can choose (procedural shapes, resampled scans, your own files);
    ModelNet40 and ICL-NUIM give the P of their files. `root` is what `data_root` returns;
    procedural shapes and `config.folder` need none.

    Raises:
      ValueError: an unknown name or split, missing data (the message gives the layout and where it
        is published), malformed files, or a share that leaves no shape on one side.
    """
    if split not in ("train", "validation", "test"):
        raise ValueError(f"split must be 'train', 'validation' or 'test', got {split!r}.")
    if config.name == "shapes":
        return _load_procedural(config, split, points, seed)
    if split == "test":
        return _load_files(config, "test", root, points, seed)
    clouds, labels = _load_files(config, "train", root, points, seed)
    chosen = _held_out_rows(config, len(clouds), seed) == (split == "validation")
    return clouds[chosen], labels[chosen]


def load_training(
    config: DataConfig,
    *,
    root: str | Path | None = None,
    points: int,
    validation_points: int,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """The clouds of `load_shapes` for training and for validation, from one reading of the files.

    If the source can choose, they have `points` and `validation_points` points. Raises what
    `load_shapes` raises.
    """

    def load(split: Split, points: int) -> np.ndarray:
        return load_shapes(config, split, root=root, points=points, seed=seed)[0]

    if config.name == "shapes" or (points != validation_points and config.name in _ANY_POINTS):
        return load("train", points), load("validation", validation_points)
    clouds, _ = _load_files(config, "train", root, points, seed)
    held_out = _held_out_rows(config, len(clouds), seed)
    return clouds[~held_out], clouds[held_out]


def dataset_label(config: DataConfig, root: str | Path | None) -> str:
    """Name of the test data in tables: `config.label`, else chosen from what is in `root`.

    A stand-in is labelled as one, so its results never pass for those of the published data.

    Raises:
      ValueError: the data is missing.
    """
    if config.label or root is None:
        return config.label or config.name
    sources = {"icl_nuim": icl_nuim, "seven_scenes": seven_scenes}
    return sources[config.name].label(root) if config.name in sources else config.name


def training_label(config: DataConfig, root: str | Path | None) -> str:
    """Name of the training shapes on a card; `config.label` names those tested on.

    Raises what `dataset_label` raises.
    """
    match config.name:
        case "folder":
            return f"folder {config.folder}"
        case "icl_nuim" if root is not None:
            place = icl_nuim.find_file(root, "train").parent.parent
            return "icl_nuim" if place == Path(root) else place.name
    found = dataset_label(dataclasses.replace(config, label=""), root)
    if config.name == "modelnet40":
        return f"{found}, training shapes: {config.train_categories}"
    return found


def _load_procedural(
    config: DataConfig, split: Split, points: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Every split has its own stream, so validation takes nothing away from training."""
    counts = {
        "train": config.train_shapes,
        "validation": max(1, round(config.validation_share * config.train_shapes)),
        "test": config.test_shapes,
    }
    return shapes.load(split, counts[split], points=points, seed=seed)


def _load_files(
    config: DataConfig,
    split: Literal["train", "test"],
    root: str | Path | None,
    points: int,
    seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    if config.name == "folder":
        return folder.load(
            config.folder, split, points=points, test_share=config.test_share, seed=seed
        )
    if root is None:
        raise ValueError(
            f"data.name = '{config.name}' needs files, and their folder is not known: give "
            "--data-root, set $JAXREG_DATA, or create data/ next to the configuration file (in the "
            "working directory for one that comes with jaxreg). data.name = 'shapes' needs no "
            "files."
        )
    if config.name == "modelnet40":
        categories = config.train_categories if split == "train" else config.test_categories
        return modelnet.load(root, split, categories=categories)
    if config.name == "icl_nuim":
        return icl_nuim.load(root, split)
    if config.name == "seven_scenes":
        stand_in = seven_scenes.TEST_SCENE not in seven_scenes.find_scenes(root)
        draws = config.train_draws if split == "train" else config.test_draws
        return seven_scenes.load(
            root, split, points=points, draws=draws, stand_in=stand_in, seed=seed
        )
    raise ValueError(
        "data.name must be 'modelnet40', 'shapes', 'folder', 'seven_scenes' or 'icl_nuim', "
        f"got {config.name!r}."
    )


def _held_out_rows(config: DataConfig, count: int, seed: int) -> np.ndarray:
    """Which of `count` training clouds are for validation."""
    # By fragment, so no draw of a validated fragment is trained on.
    draws = config.train_draws if config.name == "seven_scenes" else 1
    return np.repeat(_held_out(count // draws, config.validation_share, seed), draws)


def _held_out(count: int, share: float, seed: int) -> np.ndarray:
    """Which of `count` training shapes are for validation: at least one, and not all."""
    held = max(1, round(share * count))
    if not 0 < share < 1 or held >= count:
        raise ValueError(
            f"validation_share = {share} of {count} training shapes leaves none on one side: "
            "choose a share between 0 and 1, or more shapes."
        )
    mask = np.zeros(count, bool)
    mask[np.random.default_rng(seed).permutation(count)[:held]] = True
    return mask
