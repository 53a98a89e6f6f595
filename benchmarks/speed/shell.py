"""From the start of a shell command to its result, and a script of Open3D's beside it.

    python -m benchmarks.speed.shell [--points 15000] [--cold 3] [--warm 7]

`jaxreg register a.ply b.ply` on two crops of a procedural shape that share three quarters, one of them
turned: with an empty cache, as after an installation, and with that of the first call. The warm calls
and the script (benchmarks/speed/open3d_script.py) take turns. By the clock.
"""

import dataclasses
import os
import statistics
import sys
import tempfile
from pathlib import Path

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from benchmarks import record
from benchmarks.speed import processes
from jaxreg.data.procedural import shapes
from jaxreg.io.writing import write_cloud

_VOXEL = 0.05
"""Of the shape's radius."""
COLUMNS = {"shortest": "shortest s", "median": "median s", "longest": "longest s", "runs": "runs"}


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    points: int = 15_000
    """Points of each scan."""
    cold: int = 3
    """Calls that each find an empty cache."""
    warm: int = 7
    record: bool = True
    """Write the table to benchmarks/results/."""


def write_scans(folder: Path, points: int) -> list[str]:
    """Two files of crops that share no point; the second is turned."""
    whole = shapes.sample_shape(0, 7, points=8 * points).astype(np.float64)
    order = np.argsort(whole[:, 0])
    first, second = whole[order[: 6 * points]], whole[order[2 * points :]]
    rng = np.random.default_rng(0)
    turned = Rotation.random(random_state=rng).apply(second) + [3.0, -1.0, 2.0]
    names = []
    for name, cloud in (("a.ply", first), ("b.ply", turned)):
        write_cloud(folder / name, cloud[rng.permutation(len(cloud))[:points]])
        names.append(str(folder / name))
    return names


def seconds(command: list[str], cache: Path) -> float:
    """Of a command, with this folder for the user's caches.

    Raises:
      RuntimeError: it failed; the message ends with what it wrote.
    """
    environment = os.environ | {"XDG_CACHE_HOME": str(cache)}
    return processes.finished(command, environment=environment).seconds


def row(label: str, taken: list[float]) -> dict[str, str | float | int]:
    """The cells of one program."""
    middle = statistics.median(taken)
    return {
        "label": label, "shortest": min(taken), "median": middle, "longest": max(taken),
        "runs": len(taken),
    }  # fmt: skip


def main(options: Options) -> None:
    """Times, prints, and writes the record."""
    script = str(Path(__file__).with_name("open3d_script.py"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = write_scans(folder, options.points)
        shell = [str(Path(sys.executable).with_name("jaxreg")), "register", *files]
        open3d = [sys.executable, script, *files, str(_VOXEL)]
        cold = [seconds(shell, folder / f"cache-{k}") for k in range(options.cold)]
        seconds(open3d, folder)  # Reads the libraries from the disk.
        warm, peer = [], []
        for _ in range(options.warm):
            warm.append(seconds(shell, folder / "cache-0"))
            peer.append(seconds(open3d, folder))
    table = {
        "cold": row("`jaxreg register a.ply b.ply`, empty cache", cold),
        "warm": row("the same, warm cache", warm),
        "open3d": row("a script of Open3D's FPFH + RANSAC + ICP", peer),
    }
    for cells in table.values():
        print(cells)
    if options.record:
        record.write(
            "shell",
            question="How long does a pair take from the shell?",
            command=record.command("benchmarks.speed.shell"),
            columns=COLUMNS,
            rows=table,
            setting={"points": options.points},
        )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
