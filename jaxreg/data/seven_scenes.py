"""7Scenes fragments as PLY files: real indoor scans, one scene (office) held out for the test.

The standard split needs office. If it is absent, `stand_in` instead holds out the last fragments of
each scene that is present. Such fragments show the rooms that were trained on, in part even the
same surfaces, so results on them must be labelled and never listed next to the published ones.
"""

import re
from pathlib import Path
from typing import Literal

import numpy as np

from jaxreg.io import read_cloud

SCENES = ("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs")
TEST_SCENE = "office"
LAYOUT = "7scene/7-scenes-{chess,...,stairs}/cloud_bin_N.ply with cloud_bin_N.info.txt"
SOURCE = (
    "the 3DMatch benchmark's fragments (https://3dmatch.cs.princeton.edu), packed as 7scene/ by "
    "FMR (https://github.com/XiaoshuiHuang/fmr)"
)
_STAND_IN_SHARE = 0.2  # Share of each scene's fragments: the last ones, at least one.


def find_scenes(root: str | Path) -> dict[str, list[Path]]:
    """The PLY files of every scene present, in the order of their numbers.

    Raises:
      ValueError: there is none; the message gives the layout and the source.
    """
    scenes = {}
    for scene in SCENES:
        files = list(Path(root).glob(f"7scene/7-scenes-{scene}/cloud_bin_*.ply"))
        if files:
            scenes[scene] = sorted(files, key=_number)
    if not scenes:
        raise ValueError(f"no 7Scenes in {root}: expected {LAYOUT}. From {SOURCE}.")
    return scenes


def describe(root: str | Path) -> str:
    """One or two sentences: the scenes found and absent, and what that means for the split."""
    scenes = find_scenes(root)
    absent = [scene for scene in SCENES if scene not in scenes]
    text = f"7Scenes: found {', '.join(scenes)}"
    if not absent:
        return f"{text}; all scenes are present."
    text += f"; absent: {', '.join(absent)}."
    if TEST_SCENE in absent:
        text += (
            f" Without the test scene {TEST_SCENE} only the stand-in split is possible: the last "
            f"{_STAND_IN_SHARE:.0%} of each scene's fragments are held out for the test. "
            "Label its results."
        )
    return text


def label(root: str | Path) -> str:
    """Name in tables of the test data found in `root`."""
    scenes = find_scenes(root)
    if TEST_SCENE in scenes:
        return "seven_scenes"
    return f"seven_scenes stand-in ({', '.join(scenes)})"


def load(
    root: str | Path,
    split: Literal["train", "test"],
    *,
    points: int,
    draws: int = 1,
    stand_in: bool = False,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Clouds (n, points, 3) float32 and labels (n,) int32, the index of the scene in `SCENES`.

    Each fragment is divided by its largest bounding-box side, centred at its mean and resampled
    `draws` times, one after the other in the result: without replacement, or with it if the
    fragment is smaller. `train` is every scene present but office, `test` is office; for `stand_in`
    see the head of this file.

    Raises:
      ValueError: an unknown split, no scene for it, or a malformed file (file, row, remedy).
    """
    chosen = split_files(root, split, stand_in=stand_in)
    clouds = [_resampled(path, points, draws, (seed, i)) for i, (_, path) in enumerate(chosen)]
    labels = np.array([SCENES.index(scene) for scene, _ in chosen], np.int32)
    return np.concatenate(clouds), np.repeat(labels, draws)


def split_files(
    root: str | Path, split: Literal["train", "test"], *, stand_in: bool = False
) -> list[tuple[str, Path]]:
    """The scene and file of every fragment of a split; raises what `load` raises."""
    if split not in ("train", "test"):
        raise ValueError(f"7Scenes has the splits 'train' and 'test', got {split!r}.")
    scenes = find_scenes(root)
    if not stand_in:
        chosen = {s: files for s, files in scenes.items() if (s == TEST_SCENE) == (split == "test")}
    else:
        chosen = {s: _stand_in(files, split) for s, files in scenes.items()}
    pairs = [(scene, path) for scene, files in chosen.items() for path in files]
    if not pairs:
        raise ValueError(
            f"no fragment for the {split} split. {describe(root)} "
            f"Add the scene from {SOURCE}, or choose stand_in=True."
        )
    return pairs


def read_fragment(path: Path) -> np.ndarray:
    """The vertices (n, 3) of a PLY file, float64, in its own unit (metres).

    Raises:
      ValueError: as `read_cloud`, or the file has a non-finite vertex.
    """
    points = read_cloud(path)
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise ValueError(f"{path}: vertex {bad[0]} is not finite: download the file again.")
    return points


def read_pose(path: Path) -> np.ndarray:
    """The 4x4 camera-to-world pose in the info file next to the PLY file `path`.

    Raises:
      ValueError: the info file is missing, or is not one line of text and a 4x4 matrix.
    """
    info = path.with_name(path.stem + ".info.txt")
    try:
        lines = info.read_text(encoding="utf-8").splitlines()[1:]
        return np.array([line.split() for line in lines if line.strip()], float).reshape(4, 4)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"{info} must contain one line of text and a 4x4 pose ({error}): download it again."
        ) from None


def _resampled(path: Path, points: int, draws: int, seed: tuple[int, int]) -> np.ndarray:
    cloud = read_fragment(path)
    side = np.ptp(cloud, axis=0).max()
    if side == 0:
        raise ValueError(f"{path}: all points coincide: download it again, or remove it.")
    cloud = (cloud - cloud.mean(axis=0)) / side
    rng = np.random.default_rng(seed)
    fewer = len(cloud) < points
    chosen = [rng.choice(len(cloud), points, replace=fewer) for _ in range(draws)]
    return cloud[np.stack(chosen)].astype(np.float32)


def _stand_in(files: list[Path], split: str) -> list[Path]:
    held = max(1, round(_STAND_IN_SHARE * len(files)))
    return files[-held:] if split == "test" else files[:-held]


def _number(path: Path) -> int:
    """N of cloud_bin_N.ply; other names come last."""
    match = re.fullmatch(r"cloud_bin_(\d+)", path.stem)
    return int(match[1]) if match else 1 << 62
