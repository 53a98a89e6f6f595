"""The command line: register two scans, describe a file, look at clouds.

Exit status: 0 success, 2 bad input, 3 ran but the result is not to be trusted.
"""

import contextlib
import dataclasses
import json
import sys
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.console import Console

from jaxreg.config import RegisterConfig

SUCCESS, BAD_INPUT, NOT_TRUSTED = 0, 2, 3

_out, _err = Console(highlight=False, soft_wrap=True), Console(stderr=True, highlight=False)

Output = Annotated[Path | None, tyro.conf.arg(aliases=["-o"])]


@dataclasses.dataclass(frozen=True)
class Register:
    """Lay one scan on another, say how far the result can be trusted, and write what is asked for."""

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SOURCE")]
    """Cloud that moves: PLY, PCD, XYZ/TXT/CSV, NPY/NPZ, OBJ/OFF/STL (sampled), LAS/LAZ."""
    reference: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="REFERENCE")]
    """Cloud that stays."""
    output: Output = None
    """Write the aligned source here (PLY keeps colours and other properties)."""
    json: Path | None = None
    """Write transform, figures and verdict here."""
    plot: Path | None = None
    """Draw before and after from two sides here (PNG)."""
    html: Path | None = None
    """Write a page with both clouds to turn here; it needs no network."""
    initial: Path | None = None
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


@dataclasses.dataclass(frozen=True)
class View:
    """Write a page with clouds to turn; it needs no network."""

    files: tyro.conf.Positional[tuple[Path, ...]]
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("view.html")
    """The page."""
    open: bool = False
    """Open it in the browser."""


def main(arguments: list[str] | None = None) -> None:
    """The console script `jaxreg`; ends the process with the exit status."""
    commands = {"register": Register, "info": Info, "view": View}
    command = tyro.extras.subcommand_cli_from_dict(
        {name: _identity_of(kind) for name, kind in commands.items()},
        prog="jaxreg",
        description="Rigid registration of point clouds.",
        args=arguments,
    )
    run = {Register: register_files, Info: describe_file, View: view_files}[type(command)]
    try:
        status = run(command)
    except ValueError as error:
        _err.print(f"error: {error}", markup=False, soft_wrap=True)
        status = BAD_INPUT
    raise SystemExit(status)


def _identity_of(kind: type):
    return kind


def register_files(command: Register) -> int:
    """`jaxreg register`."""
    from jaxreg import io, scans, viewer

    for path in filter(None, (command.json, command.plot, command.html)):
        if not path.parent.is_dir():
            raise ValueError(f"{path}: the folder {path.parent} does not exist: make it first.")
    if command.output:
        io.check_writable(command.output)
    initial = read_matrix(command.initial) if command.initial else None
    source, reference = (_read(path) for path in (command.source, command.reference))
    for path, points in ((command.source, source), (command.reference, reference)):
        scans.check_points(points, str(path), nonfinite=command.nonfinite)
    with _compiling():
        from jaxreg.register import register

        result = register(
            source,
            reference,
            initial=initial,
            rotation=command.rotation,
            refine=None if command.refine == "none" else command.refine,
            nonfinite=command.nonfinite,
            config=command.config,
        )
    for path, points in ((command.source, source), (command.reference, reference)):
        _line(path.name, f"{len(points):,} points")
    for name, value in viewer.figures(result).items():
        _line(name, value.replace("\n", "; "))
    _out.print("transformation (source to reference)", matrix_text(result.transformation), sep="\n")
    _line("verdict", viewer.verdict_line(result))
    _write_results(command, source, reference, result)
    return SUCCESS if result.success else NOT_TRUSTED


def _write_results(command: Register, source, reference, result) -> None:
    from jaxreg import io, viewer

    if command.output:
        if command.output.suffix.lower() == command.source.suffix.lower() == ".ply":
            io.ply.write_moved(command.output, command.source, result.rotation, result.translation)
        else:
            io.write_cloud(command.output, source @ result.rotation.T + result.translation)
    if command.json:
        command.json.write_text(json.dumps(_summary(command, result), indent=1) + "\n", "utf-8")
    if command.plot:
        _draw(command.plot, source, reference, result)
    if command.html:
        names = (command.source.name, command.reference.name)
        viewer.write_registration_page(command.html, source, reference, result, names=names)
    for path in filter(None, (command.output, command.json, command.plot, command.html)):
        _line("wrote", str(path))


def _summary(command: Register, result) -> dict:
    """The record without its rows per point, for machines."""
    values = result._asdict()
    confidence = values.pop("confidence")
    values.pop("correspondences")
    values = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}
    files = {"source": str(command.source), "reference": str(command.reference)}
    return files | values | {"mean_confidence": float(np.mean(confidence))}


def _draw(path: Path, source, reference, result) -> None:
    from jaxreg import viewer
    from jaxreg.pictures import plot_pair
    from jaxreg.types import RigidTransform

    rows = viewer.shown_rows(source)
    moving, fixed = source[rows], reference[viewer.shown_rows(reference)]
    shift = viewer.brought_near(moving, fixed)
    title = viewer.verdict_line(result)
    if shift.any():
        title += "; before: source brought near"
    plot_pair(
        moving + shift,
        fixed,
        RigidTransform(result.rotation, result.translation - result.rotation @ shift),
        path,
        confidence=result.confidence[rows],
        title=title,
    )


def describe_file(command: Info) -> int:
    """`jaxreg info`."""
    from jaxreg import scans

    points = _read(command.file)
    finite = np.isfinite(points).all(axis=1)
    _line(str(command.file), f"{len(points):,} points")
    if not finite.all():
        _line("not finite", f"{np.sum(~finite):,} points, the first in row {np.argmin(finite)}")
    points = points[finite]
    if len(points) == 0:
        raise ValueError(f"{command.file}: no point is finite: export the file again.")
    low, high = points.min(axis=0), points.max(axis=0)
    for axis, a, b in zip("xyz", low, high, strict=True):
        _line(axis, f"{a:.6g} to {b:.6g} (extent {b - a:.4g})")
    distinct = scans.make_scan(points, str(command.file)).points if len(points) >= 3 else points
    _line("repeated", f"{len(points) - len(distinct):,} points")
    _line("spacing", f"{scans.spacing(distinct - distinct.mean(axis=0)):.4g}")
    return SUCCESS


def view_files(command: View) -> int:
    """`jaxreg view`."""
    from jaxreg import viewer

    if not command.files:
        raise ValueError("no file to view: name at least one.")
    if not command.output.parent.is_dir():
        raise ValueError(f"{command.output}: its folder does not exist: make it first.")
    viewer.write_page(command.output, {str(path): _read(path) for path in command.files})
    _line("wrote", str(command.output))
    if command.open:
        webbrowser.open(command.output.resolve().as_uri())
    return SUCCESS


def read_matrix(path: Path) -> np.ndarray:
    """A 4x4 matrix from text, NPY, or the JSON of an earlier run.

    Raises:
      ValueError: there is no such file, or it holds no 4x4 matrix.
    """
    try:
        if path.suffix == ".json":
            matrix = np.asarray(json.loads(path.read_text("utf-8"))["transformation"], float)
        elif path.suffix == ".npy":
            matrix = np.asarray(np.load(path, allow_pickle=False), float)
        else:
            matrix = np.loadtxt(path, delimiter="," if path.suffix == ".csv" else None)
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no such file: correct the path.") from None
    except (ValueError, KeyError, TypeError, OSError) as error:
        raise ValueError(
            f"{path} holds no 4x4 matrix ({error}): write four lines of four numbers."
        ) from None
    if matrix.shape != (4, 4):
        raise ValueError(f"{path} holds {matrix.shape}, no 4x4 matrix: write 4 lines of 4 numbers.")
    return matrix


def matrix_text(matrix: np.ndarray) -> str:
    """Four lines that `--initial` reads back."""
    return "\n".join("  " + " ".join(f"{value: .9g}".ljust(16) for value in row) for row in matrix)


def _read(path: Path) -> np.ndarray:
    from jaxreg import io

    return io.read_cloud(path)


def _line(name: str, value: str) -> None:
    _out.print(f"{name:<16} {value}", markup=False)


@contextlib.contextmanager
def _compiling() -> Iterator[None]:
    """Programs kept on disk, and a word of patience where there are none yet."""
    import jax

    from jaxreg import compilation

    compilation.enable_compilation_cache()
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    directory = Path(jax.config.jax_compilation_cache_dir or ".")
    first = not any(directory.glob("*"))
    text = "registering"
    if first:
        text = "first run on this machine: compiling, which takes half a minute; later runs do not"
    if sys.stderr.isatty():
        with _err.status(text):
            yield
        return
    if first:
        _err.print(text)
    yield
