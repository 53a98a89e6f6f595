"""Real scans, by this library, Open3D and KISS-Matcher on the same pairs.

    python -m benchmarks.scans.red_kitchen --data-root DATA [--rotations full] [--pairs 3 --no-record]

Fragments of 7Scenes *redkitchen* whose overlap is 0.5 or more, the source turned about its centroid by
any rotation or by up to 30 degrees, and moved. Right is an error below 15 degrees and 0.3 m. The peers
get the voxel size that suits these scans (5 cm); jaxreg gets no setting. Seconds are those of the
processor, so that they hold on a machine that does other work too.
"""

import dataclasses
import time
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from benchmarks import record
from benchmarks.scans.sensors import logged_pairs
from jaxreg.cli import process
from jaxreg.data import data_root
from jaxreg.data.seven_scenes import read_fragment
from jaxreg.evaluation import methods
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.types import RigidTransform

VOXEL = 0.05
METHODS = {
    "register": "`jaxreg.register`",
    f"open3d_ransac_icp@{VOXEL}": "Open3D FPFH + RANSAC + ICP",
    f"kiss_matcher_icp@{VOXEL}": "KISS-Matcher + ICP",
    f"open3d_fgr_icp@{VOXEL}": "Open3D FGR + ICP, as FGR's authors run it",
    f"open3d_fgr_icp_default@{VOXEL}": "Open3D FGR + ICP, Open3D's defaults",
}
KEYS = {name: name.partition("@")[0] for name in METHODS} | {"register": "jaxreg"}
RIGHT_DEG, RIGHT_M = 15, 0.3
SETTING = {
    "within_deg": RIGHT_DEG,
    "within_m": RIGHT_M,
    "voxel_cm": round(100 * VOXEL),
    "truth_exact_to_deg": 1,
}
NOT_DETERMINISTIC = "kiss_matcher_icp"
COLUMNS = {
    "right": "right",
    "median_deg": "median error, deg",
    "s": "median s",
    "s_max": "longest s",
}
TURNS = {"full": "any rotation", "limited": "up to 30 degrees"}

Turn = Literal["full", "limited"]


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    methods: tuple[str, ...] = tuple(METHODS)
    """Names as of `jaxreg.evaluation.methods.choose`."""
    rotations: tuple[Turn, ...] = ("full", "limited")
    """Any rotation, or up to 30 degrees."""
    pairs: int = 20
    overlap: float = 0.5
    seed: int = 0
    repeats: int = 3
    """Runs of KISS-Matcher, which is not deterministic; the first is in the table."""
    data_root: str | None = None
    record: bool = True
    """Write the table to benchmarks/results/."""


class Case(NamedTuple):
    """Two scans, and the true 4x4 transform from the first to the second."""

    name: str
    source: np.ndarray
    reference: np.ndarray
    truth: np.ndarray


class Result(NamedTuple):
    """How far a pose is off, what it took, and what the method says of it."""

    degrees: float
    metres: float
    seconds: float
    outcome: methods.Outcome

    @property
    def right(self) -> bool:
        """Whether it counts as found."""
        return self.degrees < RIGHT_DEG and self.metres < RIGHT_M


class Table(NamedTuple):
    """One kind of rotation: the cells of every method, and what the text says besides them."""

    rows: dict[str, dict]
    setting: dict[str, int]


def scan_pairs(folder: Path, overlap: float) -> list[tuple[int, int, np.ndarray]]:
    """(i, j, T) of the pairs with enough overlap; T maps fragment j into the frame of fragment i."""
    rows = [line.split() for line in (folder / "gt_overlap.txt").read_text().splitlines()[1:]]
    enough = {
        (int(i), int(j))
        for name, i, j, a, b, *_ in rows
        if name == "3DMatch" and (float(a) + float(b)) / 2 >= overlap
    }
    return [pair for pair in logged_pairs(folder / "gt.log") if pair[:2] in enough]


def turned(points: np.ndarray, rng: np.random.Generator, rotation: Turn) -> np.ndarray:
    """A random 4x4 motion about the centroid of `points`."""
    if rotation == "full":
        turn = Rotation.random(random_state=rng)
    else:
        axis = rng.normal(size=3)
        angle = np.radians(rng.uniform(0, 30))
        turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    motion, centre = np.eye(4), points.mean(axis=0)
    motion[:3, :3] = turn.as_matrix()
    motion[:3, 3] = centre - turn.apply(centre) + rng.uniform(-0.5, 0.5, 3)
    return motion


def read_cases(folder: Path, rotation: Turn, options: Options) -> list[Case]:
    """The pairs, the same for every method."""
    rng, cases = np.random.default_rng(options.seed), []
    for i, j, truth in scan_pairs(folder, options.overlap)[: options.pairs]:
        source, reference = (read_fragment(folder / f"cloud_bin_{k}.ply") for k in (j, i))
        motion = turned(source, rng, rotation)
        moved = source @ motion[:3, :3].T + motion[:3, 3]
        cases.append(Case(f"{i}-{j}", moved, reference, truth @ np.linalg.inv(motion)))
    return cases


def run(method: methods.Method, cases: list[Case]) -> list[Result]:
    """The method on every case."""
    results = []
    for case in cases:
        begin = time.process_time()
        outcome = method.clouds(case.source, case.reference)
        seconds = time.process_time() - begin
        results.append(Result(*errors(outcome.transform, case), seconds, outcome))
    return results


def errors(found: RigidTransform, case: Case) -> tuple[float, float]:
    """Degrees, and metres between where the pose and the truth take the centroid of the source."""
    truth, centre = case.truth, case.source.mean(axis=0)
    apart = (found.rotation - truth[:3, :3]) @ centre + found.translation - truth[:3, 3]
    angle = rotation_angle_deg(found.rotation[None], truth[None, :3, :3])[0]
    return float(angle), float(np.linalg.norm(apart))


def row(results: list[Result]) -> dict[str, float | int | None]:
    """The cells of one method and kind of rotation; the error is that of the right poses."""
    right = [result.degrees for result in results if result.right]
    seconds = [result.seconds for result in results]
    return {
        "right": len(right),
        "median_deg": float(np.median(right)) if right else None,
        "s": float(np.median(seconds)),
        "s_max": max(seconds),
    }


def report(name: str, cells: dict, cases: list[Case], results: list[Result]) -> None:
    """A line for the method, and one for every pair that it fails or does not trust."""
    middle = "-" if cells["median_deg"] is None else f"{cells['median_deg']:.2f}"
    print(
        f"{name:32s} right {cells['right']} of {len(results)}  median {middle} deg  "
        f"processor {cells['s']:.2f} s (median) {cells['s_max']:.2f} (longest)",
        flush=True,
    )
    for case, result in zip(cases, results, strict=True):
        success, probability = result.outcome[1:]
        if not result.right or success is False:
            said = "" if success is None else f" said {success} (p {probability:.2f})"
            print(f"    {case.name}: {result.degrees:.1f} deg {result.metres:.2f} m{said}")


def measure(rotation: Turn, chosen: dict[str, methods.Method], options: Options) -> Table:
    """Every method on the same cases."""
    folder = Path(data_root(options.data_root)) / "7scene" / "7-scenes-redkitchen"
    cases, rows, setting = read_cases(folder, rotation, options), {}, {}
    print(f"{TURNS[rotation]}: {len(cases)} pairs")
    for name, method in chosen.items():
        method.clouds(cases[0].source, cases[0].reference)  # Compiles.
        results = run(method, cases)
        rows[name] = row(results)
        report(name, rows[name], cases, results)
        if name == "register":
            setting["called_success"] = sum(bool(x.outcome.success) for x in results)
            setting["all_pairs"] = len(results)
        if name.startswith(NOT_DETERMINISTIC):
            again = [rows[name]["right"]]
            again += [row(run(method, cases))["right"] for _ in range(options.repeats - 1)]
            setting["kiss_matcher_low"], setting["kiss_matcher_high"] = min(again), max(again)
            print(f"    right in {len(again)} runs: {again}", flush=True)
    return Table(rows, setting)


def choose_all(names: tuple[str, ...]) -> dict[str, methods.Method]:
    """The methods that can run here, with a line for each that cannot."""
    found = {}
    for name in names:
        try:
            found[name] = methods.choose(name)
        except ValueError as error:
            print(f"{name} left out: {error}")
    return found


def write(tables: dict[Turn, Table], options: Options) -> Path:
    """The record `scans`: a row a method, the kinds of rotation side by side."""
    rows = {}
    for turn, table in tables.items():
        for name, cells in table.rows.items():
            label = METHODS.get(name, name)
            cells = {f"{turn}_{key}": value for key, value in cells.items()}
            rows[name] = rows.get(name, {"label": label}) | cells
    settings = [table.setting for table in tables.values()]
    summed = ("called_success", "all_pairs")
    called = {key: sum(x[key] for x in settings) for key in summed if key in settings[-1]}
    return record.write(
        "scans",
        question="How often are two real scans registered?",
        command=record.command("benchmarks.scans.red_kitchen"),
        columns={
            f"{turn}_{key}": f"{TURNS[turn]}: {text}"
            for turn in tables
            for key, text in COLUMNS.items()
        },
        rows={KEYS.get(name, record.key(name)): cells for name, cells in rows.items()},
        setting=SETTING | {"pairs": options.pairs} | settings[-1] | called,
        note="Seconds are those of the processor, over all its cores.",
    )


def main(options: Options) -> None:
    """Print a table for each kind of rotation, and write both."""
    process.enable_compilation_cache()
    chosen = choose_all(options.methods)
    tables = {rotation: measure(rotation, chosen, options) for rotation in options.rotations}
    if options.record:
        print(write(tables, options))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
