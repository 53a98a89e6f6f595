"""A folder of your own clouds: any files that `jaxreg.io` reads, with no class to write.

Folders `train/` and `test/` in it are the split. Without them the last files, in the order of their
names, are for the test: scans taken one after the other show the same things, and a random split
would test on what was trained on.
"""

import re
from pathlib import Path
from typing import Literal

import numpy as np

from jaxreg import io


def load(
    folder: str | Path,
    split: Literal["train", "test"],
    *,
    points: int,
    test_share: float,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Clouds (n, points, 3) float32 and labels (n,) int32, the index of a file's own folder.

    `points` distinct finite points are drawn from every file without replacement, then moved and
    scaled as ModelNet40: zero mean, largest norm 1.

    Raises:
      ValueError: no such folder, no file for the split, or a file that is malformed or has fewer
        points; the message names it.
    """
    files = split_files(folder, split, test_share=test_share)
    parents = sorted({path.parent for path in files})
    clouds = [_drawn(path, points, (seed, i)) for i, path in enumerate(files)]
    return np.stack(clouds), np.array([parents.index(path.parent) for path in files], np.int32)


def split_files(
    folder: str | Path, split: Literal["train", "test"], *, test_share: float
) -> list[Path]:
    """The files of a split, with subfolders, in the order of their names; raises what `load` raises.

    Numbers in names count as numbers: scan_9 comes before scan_10.
    """
    if folder == "":
        raise ValueError("no folder given: name yours with --data.folder.")
    folder = Path(folder)
    if (folder / "train").is_dir() and (folder / "test").is_dir():
        return _files(folder / split)
    files = _files(folder)
    held = max(1, round(test_share * len(files)))
    if not 0 < test_share < 1 or held >= len(files):
        raise ValueError(
            f"test_share = {test_share} of the {len(files)} file(s) in {folder} leaves none on one "
            "side: add files, choose another share, or make folders train/ and test/ in it."
        )
    return files[-held:] if split == "test" else files[:-held]


def _files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise ValueError(f"there is no folder {folder}: name yours with --data.folder.")
    files = [p for p in folder.rglob("*") if io.suffix(p) in io.READABLE and p.is_file()]
    if not files:
        raise ValueError(f"no cloud in {folder}: expected files {', '.join(io.READABLE)}.")
    return sorted(files, key=lambda path: _natural(path.relative_to(folder)))


def _natural(path: Path) -> list[tuple[int, str]]:
    words = re.split(r"(\d+)", str(path).lower())
    return [(int(word), "") if word.isdecimal() else (0, word) for word in words]


def _drawn(path: Path, points: int, seed: tuple[int, int]) -> np.ndarray:
    cloud = io.read_cloud(path)
    cloud = np.unique(cloud[np.isfinite(cloud).all(axis=1)], axis=0)
    if len(cloud) < points:
        raise ValueError(
            f"{path} has {len(cloud)} distinct points, but pairs need {points}: "
            "set --pairs.points and --test-pairs.points lower, or remove the file."
        )
    cloud = cloud - cloud.mean(axis=0)
    rng = np.random.default_rng(seed)
    cloud = cloud[rng.choice(len(cloud), points, replace=False)]
    return (cloud / np.linalg.norm(cloud, axis=1).max()).astype(np.float32)
