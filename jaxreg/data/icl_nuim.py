"""Augmented ICL-NUIM as published in HDF5: indoor scans in metres, any number of points per cloud."""

from pathlib import Path
from typing import Literal

import numpy as np

from jaxreg.data import hdf5

LAYOUT = (
    "train/icl_nuim.h5 with the key 'points' (n, P, 3), and test/icl_nuim.h5 with 'source', "
    "'target' (n, P, 3) and 'transform' (n, 4, 4), below the root or one folder deeper"
)
SOURCE = (
    "Augmented ICL-NUIM (http://redwood-data.org/indoor/dataset.html), in the HDF5 form of DeepGMR "
    "(https://github.com/wentaoyuan/deepgmr)"
)
_ORTHONORMAL = 1e-3  # Largest entry of R^T R - I for a rotation in the file.


def load(root: str | Path, split: Literal["train", "test"]) -> tuple[np.ndarray, np.ndarray]:
    """Clouds (n, P, 3) float32 in metres as they are in the file, and labels (n,) int32, all 0.

    The shapes of `test` are the sources of its pairs; `load_pairs` gives the pairs themselves.

    Raises:
      ValueError: an unknown split, or a file that is missing or malformed (file, key, row, remedy).
    """
    if split not in ("train", "test"):
        raise ValueError(f"ICL-NUIM has the splits 'train' and 'test', got {split!r}.")
    key = "points" if split == "train" else "source"
    clouds = hdf5.read_clouds(find_file(root, split), key)
    return clouds, np.zeros(len(clouds), np.int32)


def load_pairs(root: str | Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The test pairs: sources and references (n, P, 3) float32, transforms (n, 4, 4) float64.

    ``reference = R source + t``, apart from the sampling of the surfaces.

    Raises:
      ValueError: as `load`, or the transforms are not n rigid ones.
    """
    path = find_file(root, "test")
    source, target = hdf5.read_clouds(path, "source"), hdf5.read_clouds(path, "target")
    transform = hdf5.read(path, "transform").astype(np.float64)
    if len(target) != len(source) or transform.shape != (len(source), 4, 4):
        raise ValueError(
            f"{path}: 'source' {source.shape}, 'target' {target.shape} and 'transform' "
            f"{transform.shape} must have one row for each pair: download the file again."
        )
    rotation = transform[:, :3, :3]
    error = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max(axis=(1, 2))
    rigid = (error < _ORTHONORMAL) & (np.linalg.det(rotation) > 0)
    bad = np.flatnonzero(~(rigid & np.isfinite(transform).all(axis=(1, 2))))
    if bad.size:
        raise ValueError(
            f"{path}: 'transform' in row {bad[0]} is not rigid: download the file again."
        )
    return source, target, transform


def label(root: str | Path) -> str:
    """Name in tables of the test data found in `root`: that of its folder.

    Another set in the form of ICL-NUIM goes by the folder that it came in; files in `root` itself
    are taken for ICL-NUIM.
    """
    folder = find_file(root, "test").parent.parent
    return "icl_nuim" if folder == Path(root) else folder.name


def find_file(root: str | Path, split: Literal["train", "test"]) -> Path:
    """The HDF5 file of a split below `root`: nearest first, then by name.

    Raises:
      ValueError: there is none; the message gives the layout and the source.
    """
    root = Path(root)
    found = [root / split / "icl_nuim.h5", *sorted(root.glob(f"*/{split}/icl_nuim.h5"))]
    found = [path for path in found if path.is_file()]
    if not found:
        raise ValueError(f"no ICL-NUIM {split} split in {root}: expected {LAYOUT}. From {SOURCE}.")
    return found[0]
