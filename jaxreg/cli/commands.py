"""The command line: register two scans, describe a file, look at clouds.

Exit status: 0 success, 2 bad input, 3 ran but the result is not to be trusted, 130 interrupted.
"""

import contextlib
import dataclasses
import gc
import json
import os
import re
import sys
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.console import Console

from jaxreg import __version__
from jaxreg.cli.options import told
from jaxreg.scans.config import RegisterConfig

SUCCESS, BAD_INPUT, NOT_TRUSTED, INTERRUPTED = 0, 2, 3, 130

_CACHE_MISS = "/jax/compilation_cache/cache_misses"
_COMPILING = (
    "compiling for clouds of these sizes, about 10 s; the programs are kept in\n"
    "{directory}, so that later runs need not."
)
_HINT = "look at it with --html PAGE.html"
_START = "; a rough pose to start from helps: --initial T.txt"


def _path(**options):
    """An optional path; its default is not worth a word of the help."""
    return tyro.conf.arg(metavar="PATH", help_behavior_hint="", **options)


OptionalPath = Annotated[Path | None, _path()]
Output = Annotated[Path | None, _path(aliases=["-o"])]


@dataclasses.dataclass(frozen=True)
class Register:
    """Lay one scan on another, say how far the result can be trusted, and write what is asked for.

    Exit status: 0 success, 2 bad input, 3 ran but the result is not to be trusted.
    """

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SOURCE")]
    """Cloud that moves: PLY, PCD, XYZ/TXT/CSV, NPY/NPZ, OBJ/OFF/STL (sampled), LAS/LAZ."""
    reference: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="REFERENCE")]
    """Cloud that stays."""
    output: Output = None
    """Write the aligned source here (PLY and LAS keep colours and whatever else they hold)."""
    json: OptionalPath = None
    """Write transform, figures and verdict here (JSON)."""
    plot: OptionalPath = None
    """Draw before and after from two sides here (PNG, PDF or SVG)."""
    html: OptionalPath = None
    """Write a page with both clouds to turn here; it needs no network."""
    initial: OptionalPath = None
    """Start from this 4x4 matrix (text, NPY, or the JSON of an earlier run)."""
    rotation: Literal["full", "limited"] = "full"
    """How far the clouds may be turned: by anything, or by less than about 80 degrees."""
    refine: Literal["gicp", "icp", "point_to_plane", "none"] = "gicp"
    """Refinement of the pose that the search finds."""
    nonfinite: Literal["raise", "drop"] = "raise"
    """What to do with points that are NaN or infinite."""
    config: RegisterConfig = RegisterConfig()
    """Settings that the data usually choose well."""


@dataclasses.dataclass(frozen=True)
class Info:
    """Describe a cloud: number of points, extent, spacing, defects."""

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """PLY, PCD, XYZ/TXT/CSV, NPY/NPZ, OBJ/OFF/STL (sampled), LAS/LAZ."""


@dataclasses.dataclass(frozen=True)
class View:
    """Write a page with clouds to turn; it needs no network."""

    files: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE...")]
    """Clouds in one frame."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = Path("view.html")
    """The page."""
    open: bool = False
    """Open it in the browser."""


def main(arguments: list[str] | None = None) -> int:
    """The console script `jaxreg`; returns the exit status."""
    if (sys.argv[1:] if arguments is None else arguments) == ["--version"]:
        _print(f"jaxreg {__version__}")
        return SUCCESS
    command = tyro.extras.subcommand_cli_from_dict(
        {"register": Register, "info": Info, "view": View},
        prog="jaxreg",
        description="Rigid registration of point clouds (jaxreg --version tells which).",
        args=arguments,
    )
    run = {Register: register_files, Info: describe_file, View: view_files}[type(command)]
    # Tracing makes a million small objects and no garbage worth a search: a tenth of a short run.
    gc.disable()
    try:
        return run(command)
    except KeyboardInterrupt:
        Console(stderr=True).print("interrupted")
        return INTERRUPTED
    except (ValueError, OSError) as error:
        message = told(error)
    finally:
        gc.enable()
    console = Console(stderr=True, highlight=False, soft_wrap=True, emoji=False)
    console.print(f"error: {message}", markup=False)
    return BAD_INPUT


def register_files(command: Register) -> int:
    """`jaxreg register`."""
    from jaxreg.scans.pair import register

    _check_outputs(command)
    initial = read_matrix(command.initial) if command.initial else None
    source, reference = (
        _checked(path, command.nonfinite) for path in (command.source, command.reference)
    )
    with _patience():
        result = register(
            source,
            reference,
            initial=initial,
            rotation=command.rotation,
            refine=None if command.refine == "none" else command.refine,
            nonfinite=command.nonfinite,
            config=command.config,
        )
    try:  # Written first: a reader that closes the pipe, as `head` does, ends this process.
        _write_results(command, source, reference, result)
    finally:
        _print_result(command, source, reference, result)
    for path in _outputs(command):
        _line("wrote", str(path))
    if not result.success:
        _line("hint", _HINT if command.initial else _HINT + _START)
    return SUCCESS if result.success else NOT_TRUSTED


def _print_result(command: Register, source, reference, result) -> None:
    from jaxreg.scans import summary

    _line("source", f"{command.source} ({len(source):,} points)")
    _line("reference", f"{command.reference} ({len(reference):,} points)")
    for name, value in summary.figures(result).items():
        _line(name, value.replace("\n", "; "))
    _print("transformation (source to reference)")
    _print(summary.matrix_text(result.transformation))
    _line("verdict", summary.verdict_line(result))


def _outputs(command: Register) -> list[Path]:
    return [p for p in (command.output, command.json, command.plot, command.html) if p]


def _check_outputs(command: Register) -> None:
    """What cannot be written is said before the work, not after it."""
    from jaxreg import io

    if command.output:
        io.check_writable(command.output)
    if command.plot and command.plot.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise ValueError(f"{command.plot}: pictures are written as .png, .pdf or .svg: choose one.")
    taken = [command.source, command.reference, *filter(None, [command.initial])]
    for path in _outputs(command):
        io.check_place(path, taken)
        taken.append(path)


@contextlib.contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """A file to write to, which takes the place of `path` once it is complete.

    Raises:
      ValueError: it cannot be written there.
    """
    if path.exists() and not path.is_file():  # A device or a pipe is written as it is.
        yield path
        return
    part = path.resolve().with_name(f".{os.getpid()}-{path.name}")
    try:
        yield part
        part.replace(path.resolve())
    except OSError as error:
        raise ValueError(
            f"{path} could not be written ({error.strerror or error}): choose another place."
        ) from None
    finally:
        with contextlib.suppress(OSError):  # of a folder that is none, say
            part.unlink(missing_ok=True)


def _checked(path: Path, nonfinite: str) -> np.ndarray:
    """The points of a file that `register` will accept."""
    from jaxreg import io
    from jaxreg.geometry import clouds

    points = io.read_cloud(path)
    finite = np.isfinite(points).all(axis=1)
    if nonfinite == "raise" and not finite.all():
        row = int(np.argmin(finite))
        raise ValueError(
            f"{path}: {np.sum(~finite):,} of {len(points):,} points are not finite, the first is "
            f"point {row}: remove them, or give --nonfinite drop."
        )
    clouds.check_points(points, str(path), nonfinite="drop")
    return points


def _write_results(command: Register, source, reference, result) -> None:
    from jaxreg import io
    from jaxreg.scans import summary
    from jaxreg.view import page

    def write_output(path: Path) -> None:
        kinds = [p.suffix.lower() for p in (command.source, path)]
        if kinds == [".ply", ".ply"]:
            io.ply.write_moved(path, command.source, result.rotation, result.translation)
        elif set(kinds) <= {".las", ".laz"}:
            io.las.write_moved(path, command.source, result.rotation, result.translation)
        else:
            io.write_cloud(path, source @ result.rotation.T + result.translation)

    def write_json(path: Path) -> None:
        files = {"source": str(command.source), "reference": str(command.reference)}
        content = json.dumps(files | summary.record(result), indent=1, allow_nan=False)
        path.write_text(content + "\n", "utf-8")

    def write_page(path: Path) -> None:
        names = (command.source.name, command.reference.name)
        page.write_registration_page(path, source, reference, result, names=names)

    def draw(path: Path) -> None:
        page.draw_registration(path, source, reference, result)

    for path, write in (
        (command.output, write_output),
        (command.json, write_json),
        (command.plot, draw),
        (command.html, write_page),
    ):
        if path is not None:
            with _whole(path) as part:
                write(part)


def describe_file(command: Info) -> int:
    """`jaxreg info`."""
    from jaxreg import io
    from jaxreg.scans import prepare

    points = io.read_cloud(command.file)
    finite = np.isfinite(points).all(axis=1)
    _line("file", f"{command.file}")
    _line("points", f"{len(points):,}")
    if not finite.all():
        _line("not finite", f"{np.sum(~finite):,} points, the first is point {np.argmin(finite)}")
    points = _finite(points, command.file)
    low, high = points.min(axis=0), points.max(axis=0)
    for axis, a, b in zip("xyz", low, high, strict=True):
        _line(axis, f"{a:.9g} to {b:.9g} (extent {b - a:.4g})")
    distinct = np.unique(points, axis=0)
    _line("repeated", f"{len(points) - len(distinct):,} points")
    _line("spacing", f"{prepare.spacing(distinct - distinct.mean(axis=0)):.4g}")
    return SUCCESS


def view_files(command: View) -> int:
    """`jaxreg view`."""
    from jaxreg import io
    from jaxreg.view import page

    if not command.files:
        raise ValueError("no file to view: name at least one.")
    io.check_place(command.output, command.files)
    clouds = {str(path): _finite(io.read_cloud(path), path) for path in command.files}
    with _whole(command.output) as part:
        page.write_page(part, clouds)
    _line("wrote", str(command.output))
    if command.open:
        webbrowser.open(command.output.resolve().as_uri())
    return SUCCESS


def _finite(points: np.ndarray, path: Path) -> np.ndarray:
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        raise ValueError(f"{path}: no point is finite: export the file again.")
    return points


def read_matrix(path: Path) -> np.ndarray:
    """A 4x4 matrix from text, NPY, or the JSON of an earlier run.

    Raises:
      ValueError: there is no such file, or it holds no 4x4 matrix.
    """
    try:
        if path.suffix.lower() == ".json":
            content = json.loads(path.read_text("utf-8"))
            matrix = content["transformation"] if isinstance(content, dict) else content
            matrix = np.asarray(matrix, float)
        elif path.suffix.lower() == ".npy":
            matrix = np.asarray(np.load(path, allow_pickle=False), float)
        else:
            numbers = re.sub(r"#.*|[\[\],;]", " ", path.read_text("utf-8")).split()
            matrix = np.array(numbers, float).reshape(4, 4)
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no such file: correct the path.") from None
    except (ValueError, KeyError, TypeError, EOFError) as error:
        raise ValueError(
            f"{path} holds no 4x4 matrix ({error}): write four lines of four numbers."
        ) from None
    if matrix.shape != (4, 4):
        raise ValueError(f"{path} holds {matrix.shape}, no 4x4 matrix: write 4 lines of 4 numbers.")
    return matrix


def _line(name: str, value: str) -> None:
    _print(f"{name:<16} {value}")


def _print(text: str) -> None:
    Console(highlight=False, soft_wrap=True, emoji=False).print(text, markup=False)


@contextlib.contextmanager
def _patience() -> Iterator[None]:
    """A spinner on a terminal; and once, where a program is not on disk yet, a word about that."""
    import jax
    from jax import monitoring

    from jaxreg.cli import process

    process.enable_compilation_cache(least_seconds=0.0)
    directory, told = jax.config.jax_compilation_cache_dir, []
    console = Console(stderr=True, highlight=False)

    def listen(event: str, **_) -> None:
        if event == _CACHE_MISS and not told:
            told.append(event)
            console.print(_COMPILING.format(directory=directory), soft_wrap=True, markup=False)

    monitoring.register_event_listener(listen)
    try:
        with console.status("registering"):
            yield
    finally:
        monitoring.unregister_event_listener(listen)
