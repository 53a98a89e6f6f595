"""`jaxreg register`: register one scan to another, and say whether to trust the result."""

import contextlib
import dataclasses
import importlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro
from rich.console import Console

from jaxreg.cli import process
from jaxreg.cli.options import NOT_TRUSTED, SUCCESS, complain, line, say
from jaxreg.refine.config import RefineConfig
from jaxreg.scans.config import RegisterConfig

if TYPE_CHECKING:
    from jaxreg.io import Scan
    from jaxreg.scans.result import ScanRegistration

_CACHE_MISS = "/jax/compilation_cache/cache_misses"
_COMPILING = (
    "compiling for clouds of these sizes, about 10 s; the programs are kept in\n"
    "{directory}, so later runs skip this."
)
_HINT = "look at it with --html PAGE.html"
_START = "; a rough pose to start from helps: --initial T.txt"


def _path(**options):
    """An optional path; the help does not show its default."""
    return tyro.conf.arg(metavar="PATH", help_behavior_hint="", **options)


OptionalPath = Annotated[Path | None, _path()]
Output = Annotated[Path | None, _path(aliases=["-o"])]
Known = tyro.conf.UseAppendAction[tuple[Literal["upright", "inside"], ...]]
Stable = Annotated[str, tyro.conf.arg(metavar="FILE|BOX", help_behavior_hint="")]
Viewpoint = Literal["unknown", "origin", "file"]
Degrees = Annotated[float | None, tyro.conf.arg(metavar="DEGREES", help_behavior_hint="")]


@dataclasses.dataclass(frozen=True)
class Register:
    """Register one scan to another, say whether to trust the result, and write the files asked for.

    Exit status: 0 success; 2 bad input; 3 finished, but the result should not be trusted.
    """

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SOURCE")]
    """Cloud that moves: PLY, PCD, text of points, PTX, E57, LAS/LAZ, NPY/NPZ, or a mesh (PLY, STL, OBJ,
    OFF, GLB), which is sampled; also packed (.gz)."""
    reference: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="REFERENCE")]
    """The cloud to align it with."""
    output: Output = None
    """Write the aligned source here (PLY, PCD, text and LAS keep colours and whatever else they hold; a
    mesh stays a mesh)."""
    json: OptionalPath = None
    """Write transform, numbers and verdict to this file (JSON)."""
    plot: OptionalPath = None
    """Draw before and after, from two sides, to this file (PNG, PDF or SVG)."""
    html: OptionalPath = None
    """Write an interactive HTML page to this file; it works offline."""
    initial: OptionalPath = None
    """Start from this 4x4 matrix (text, NPY, or the JSON of an earlier run)."""
    max_rotation_deg: Degrees = None
    """Largest rotation between the scans in degrees (default: any); decides between the poses of
    symmetric objects."""
    known: Known = ()
    """What is known of the pair: "upright", both scans are level, so that the source is turned about
    the axis --up alone; "inside", the source lies wholly in the reference, which shows far more. May
    be given twice."""
    up: Literal["x", "y", "z"] = "z"
    """The axis that points upwards in both scans (with --known upright)."""
    scale: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """The source may be at another size: estimate it, too."""
    stable: Stable = ""
    """Where the reference has not changed: a box x0,y0,x1,y1 or x0,y0,z0,x1,y1,z1 in its coordinates,
    or a file with a number for each of its points (0: it moved). Only these points take part."""
    viewpoint: Viewpoint = "unknown"
    """Where the scanner of each scan stood: at the origin of its coordinates, or where its file says
    (PCD, PTX). A pose that puts points between a scanner and what it measured is then held to be
    wrong."""
    refine: Literal["gicp", "icp", "point_to_plane", "none"] = "gicp"
    """How to refine the pose that the search found."""
    nonfinite: Literal["raise", "drop"] = "raise"
    """What to do with points that are NaN or infinite."""
    strays: Literal["drop", "keep", "raise"] = "drop"
    """What to do with a few points that lie ten times as far from the middle as all others."""
    config: tyro.conf.AvoidSubcommands[RegisterConfig] = RegisterConfig()
    """Settings; the defaults adapt to the data."""

    def run(self) -> int:
        """Register, write, print; returns the exit status."""
        _check_outputs(self)
        with patience():
            from jaxreg import io

            initial = io.read_matrix(self.initial) if self.initial else None
            scans = [checked_scan(path, self.nonfinite) for path in (self.source, self.reference)]
            check_columns([self.source, self.reference], scans)
            begin = time.perf_counter()
            result = _registered(self, scans, initial)
            seconds = time.perf_counter() - begin
        source, reference = (scan.points for scan in scans)
        lost: list[str] = []
        try:  # Written first: a reader that closes the pipe, as `head` does, ends this process.
            _write_results(self, source, reference, result, lost)
        finally:
            _print_result(self, scans, result, seconds)
        for path in _outputs(self):
            line("wrote", str(path))
        for note in lost:
            line("note", note)
        for hint in _hints(source, reference, result):
            line("hint", hint)
        if not result.success:
            line("hint", _HINT if self.initial else _HINT + _START)
        return SUCCESS if result.success else NOT_TRUSTED


def _registered(
    command: Register, scans: list["Scan"], initial: np.ndarray | None
) -> "ScanRegistration":
    from jaxreg.scans.pair import register

    source, reference = (scan.points for scan in scans)
    paths = (command.source, command.reference)
    refinement = command.config.refine or RefineConfig()
    method = command.refine
    refinement = None if method == "none" else dataclasses.replace(refinement, method=method)
    return register(
        source,
        reference,
        initial=initial,
        max_rotation_deg=command.max_rotation_deg,
        known=command.known,
        up=command.up,
        scale=command.scale,
        viewpoint=tuple(
            place_of(scan, path, command.viewpoint) for scan, path in zip(scans, paths, strict=True)
        ),
        mask=(None, _stable(command.stable, reference)) if command.stable else None,
        nonfinite=command.nonfinite,
        strays=command.strays,
        config=dataclasses.replace(command.config, refine=refinement),
    )


def place_of(scan: "Scan", path: Path, told: Viewpoint) -> np.ndarray | None:
    """Where the scanner stood, as --viewpoint says; an error if the file does not say it."""
    if told == "unknown":
        return None
    if told == "origin":
        return np.zeros(3)
    if scan.viewpoint is None:
        raise ValueError(
            f"{path} does not say where the scanner stood (PCD does, and PTX of one station): leave "
            "out --viewpoint file."
        )
    return scan.viewpoint


def _stable(told: str, reference: np.ndarray) -> np.ndarray:
    """Which points of the reference --stable names: those of a box, or of a file of numbers."""
    from jaxreg import io
    from jaxreg.scans import masks

    box = _box(told)
    if box is None:
        return io.read_numbers(Path(told), len(reference)) != 0
    return masks.in_box(reference, box)


def _box(told: str) -> list[float] | None:
    """The numbers of --stable; None if it names a file."""
    try:
        return [float(word) for word in told.replace(",", " ").split()]
    except ValueError:
        return None


def _print_result(
    command: Register, scans: list["Scan"], result: "ScanRegistration", seconds: float
) -> None:
    from jaxreg.scans import summary

    for name, scan in zip(("source", "reference"), scans, strict=True):
        told = "; ".join([f"{len(scan.points):,} points", *scan.notes])
        line(name, f"{getattr(command, name)} ({told})")
    for name, value in (summary.figures(result) | {"time": f"{seconds:.2f} s"}).items():
        line(name, value.replace("\n", "; "))
    for note in result.notes:
        line("note", note)
    say("transformation (source to reference)")
    say(summary.matrix_text(result.transformation))
    line("verdict", summary.verdict_line(result))
    if result.reason:
        line("reason", result.reason)


def _hints(source: np.ndarray, reference: np.ndarray, result: "ScanRegistration") -> list[str]:
    """What is odd about the clouds; of a success only that their sizes differ, at the scale found."""
    from jaxreg.scans import diagnosis

    clouds = {"source": source, "reference": reference}
    clouds = {name: p[np.isfinite(p).all(axis=1)] for name, p in clouds.items()}
    least = 1.2 if result.success else 1.1
    sized = clouds["source"] * result.scale
    hints = diagnosis.compared(sized, clouds["reference"], least=least)
    if not result.success:
        for name, points in clouds.items():
            hints += [f"the {name}: {told}" for told in diagnosis.findings(points)]
    return hints


def _outputs(command: Register) -> list[Path]:
    return [p for p in (command.output, command.json, command.plot, command.html) if p]


def check_picture(path: Path) -> None:
    """Raise ValueError if pictures are not written in this format, ImportError without matplotlib."""
    if path.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise ValueError(f"{path}: pictures are written as .png, .pdf or .svg: choose one.")
    importlib.import_module("jaxreg.view.pictures")


def _check_outputs(command: Register) -> None:
    """Refuse what cannot be written before the work, not after it."""
    from jaxreg import io

    if command.output:
        io.check_output(command.output, command.source)
    if command.plot:
        check_picture(command.plot)
    stable = Path(command.stable) if command.stable and _box(command.stable) is None else None
    taken = [command.source, command.reference, *filter(None, [command.initial, stable])]
    for path in _outputs(command):
        io.check_place(path, taken)
        taken.append(path)


def checked_scan(path: Path, nonfinite: str) -> "Scan":
    """What is in a file, with points that `register` will accept."""
    from jaxreg import io
    from jaxreg.geometry import clouds

    scan = io.read_scan(path)
    points = scan.points
    finite = np.isfinite(points).all(axis=1)
    if nonfinite == "raise" and not finite.all():
        row = int(np.argmin(finite))
        raise ValueError(
            f"{path}: {np.sum(~finite):,} of {len(points):,} points are not finite, the first is "
            f"point {row}: remove them, or give --nonfinite drop."
        )
    clouds.check_points(points, str(path), nonfinite="drop")
    return scan


def check_columns(paths: Sequence[Path], scans: Sequence["Scan"]) -> None:
    """Raise ValueError where a file of x and y stands beside one whose points have a height."""
    from jaxreg.io.contents import TWO_COLUMNS

    named = list(zip(paths, scans, strict=True))
    flat = next((path for path, scan in named if TWO_COLUMNS in scan.notes), None)
    tall = next((path for path, scan in named if _has_height(scan.points)), None)
    if flat is not None and tall is not None:
        raise ValueError(
            f"{flat} has two columns, x and y, and {tall} has three: give all in the plane, or all "
            "in space."
        )


def _has_height(points: np.ndarray) -> bool:
    height = points[np.isfinite(points).all(axis=1), 2]
    return len(height) > 0 and bool(np.ptp(height) > 0)


def _write_results(
    command: Register,
    source: np.ndarray,
    reference: np.ndarray,
    result: "ScanRegistration",
    lost: list[str],
) -> None:
    """Write what is asked for; `lost` gets what a format cannot hold."""
    from jaxreg import io
    from jaxreg.view import page

    def write_page(path: Path) -> None:
        names = (command.source.name, command.reference.name)
        page.write_registration_page(path, source, reference, result, names=names)

    def draw(path: Path) -> None:
        page.draw_registration(path, source, reference, result)

    def write_moved(path: Path) -> None:
        moved = (result.scale * result.rotation, result.translation)
        lost.extend(io.write_moved(path, command.source, *moved, points=source))

    writers: tuple[tuple[Path | None, Callable[[Path], None]], ...] = (
        (command.output, write_moved),
        (command.json, lambda path: _write_json(path, command, result)),
        (command.plot, draw),
        (command.html, write_page),
    )
    for path, write in writers:
        if path is not None:
            with io.whole(path) as part:
                write(part)


def _write_json(path: Path, command: Register, result: "ScanRegistration") -> None:
    from jaxreg.scans import summary

    files = {"source": str(command.source), "reference": str(command.reference)}
    content = json.dumps(files | summary.record(result), indent=1, allow_nan=False)
    path.write_text(content + "\n", "utf-8")


@contextlib.contextmanager
def patience(*, spinner: bool = True) -> Iterator[None]:
    """A spinner on a terminal; and one message when a program must first be compiled."""
    from jax import monitoring

    process.enable_compilation_cache(least_seconds=0.0)
    directory, said = process.cache_directory(), False

    def listen(event: str, **_) -> None:
        nonlocal said
        if event == _CACHE_MISS and not said:
            said = True
            complain(_COMPILING.format(directory=directory))

    monitoring.register_event_listener(listen)
    try:
        waiting = Console(stderr=True, highlight=False).status("registering")
        with waiting if spinner else contextlib.nullcontext(), process.traced_programs_kept():
            yield
    finally:
        monitoring.unregister_event_listener(listen)
