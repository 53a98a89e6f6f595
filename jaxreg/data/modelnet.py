"""ModelNet40 as published in HDF5: 40 categories, official split, any number of points per shape."""

from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np

from jaxreg.data import hdf5

URL = "https://shapenet.cs.stanford.edu/media/modelnet40_ply_hdf5_2048.zip"
LAYOUT = (
    "modelnet40_ply_hdf5_2048/ (or another modelnet40_ply_hdf5_* folder) with train_files.txt, "
    "test_files.txt, shape_names.txt and the ply_data_*.h5 files they list"
)
_FIRST_UNSEEN = 20  # The usual "unseen categories" split: labels below are trained on.

Categories = Literal["all", "first20", "last20"]


def find_folder(root: str | Path) -> Path:
    """The ModelNet40 folder in `root` (or `root` itself): the 2048-point set if it is there.

    Raises:
      ValueError: there is none; the message gives the layout and where it is published.
    """
    root = Path(root)
    found = sorted(path for path in root.glob("modelnet40_ply_hdf5_*") if path.is_dir())
    if root.name.startswith("modelnet40_ply_hdf5_") and root.is_dir():
        found.append(root)
    if not found:
        raise ValueError(
            f"no ModelNet40 in {root}: expected {LAYOUT}. It is published at {URL}; "
            "unzip it there, or give its folder with --data-root or $JAXREG_DATA."
        )
    return max(found, key=lambda path: path.name.endswith("_2048"))


def load(
    root: str | Path, split: Literal["train", "test"], *, categories: Categories = "all"
) -> tuple[np.ndarray, np.ndarray]:
    """Clouds (n, P, 3) float32, zero mean in the unit sphere, and labels (n,) int32.

    The shapes are in the order of `{split}_files.txt`, their points in the order of the files.
    `first20` keeps labels below 20, `last20` the others.

    Raises:
      ValueError: no data set (see `find_folder`), an unknown split, or a file that is missing or
        malformed; the message names file and key or row.
    """
    if split not in ("train", "test"):
        raise ValueError(f"ModelNet40 has the splits 'train' and 'test', got {split!r}.")
    folder = find_folder(root)
    known = len(category_names(folder))
    parts = [_load_file(path, known) for path in _listed(folder, split)]
    sizes = {clouds.shape[1] for clouds, _ in parts}
    if len(sizes) > 1:
        raise ValueError(
            f"{folder}: the {split} files have shapes of {sorted(sizes)} points: they come from "
            "different releases; download one of them again."
        )
    clouds, labels = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    chosen = _chosen(labels, categories)
    return clouds[chosen], labels[chosen]


def category_names(root: str | Path) -> tuple[str, ...]:
    """The name of every label, from `shape_names.txt`; raises what `load` raises."""
    return tuple(_lines(find_folder(root) / "shape_names.txt"))


def _chosen(labels: np.ndarray, categories: Categories) -> np.ndarray:
    if categories == "all":
        return np.ones_like(labels, bool)
    if categories == "first20":
        return labels < _FIRST_UNSEEN
    if categories == "last20":
        return labels >= _FIRST_UNSEEN
    raise ValueError(f"categories must be 'all', 'first20' or 'last20', got {categories!r}.")


def _listed(folder: Path, split: str) -> list[Path]:
    """The files of a split; the list has their paths on the machine that wrote it."""
    return [folder / PurePosixPath(line).name for line in _lines(folder / f"{split}_files.txt")]


def _lines(path: Path) -> list[str]:
    if not path.is_file():
        raise ValueError(f"{path} is missing: expected {LAYOUT}, as published at {URL}.")
    lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    lines = [line for line in lines if line]
    if not lines:
        raise ValueError(f"{path} is empty: expected {LAYOUT}, as published at {URL}.")
    return lines


def _load_file(path: Path, known: int) -> tuple[np.ndarray, np.ndarray]:
    clouds = hdf5.read_clouds(path, "data")
    labels = hdf5.read(path, "label")
    if labels.dtype.kind not in "iu" or labels.shape not in ((len(clouds), 1), (len(clouds),)):
        raise ValueError(
            f"{path}: 'label' must be integer ({len(clouds)}, 1), one for each row of 'data', got "
            f"{labels.dtype} {labels.shape}: download the file again."
        )
    labels = labels.reshape(-1).astype(np.int32)
    outside = np.flatnonzero((labels < 0) | (labels >= known))
    if outside.size:
        raise ValueError(
            f"{path}: 'label' is {labels[outside[0]]} in row {outside[0]}, but shape_names.txt "
            f"names {known} categories: download the data set again."
        )
    return clouds, labels
