"""`jaxreg align`: place many scans in one frame, and say which could not be placed."""

import dataclasses
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from jaxreg.cli.options import NOT_TRUSTED, SUCCESS, line, say
from jaxreg.cli.register import (
    OptionalPath,
    Output,
    Viewpoint,
    check_columns,
    check_picture,
    checked_scan,
    patience,
    place_of,
)
from jaxreg.scans.config import RegisterConfig

if TYPE_CHECKING:
    from jaxreg.io import Scan
    from jaxreg.scans.many import Alignment

_LISTED = 12
"""Pairs and scans of each kind that are listed on the terminal."""


@dataclasses.dataclass(frozen=True)
class Align:
    """Place many scans in one frame, say which could not be placed, and write the files asked for.

    Exit status: 0 all scans are in one group; 2 bad input; 3 finished, but some scan is not placed, or
    there are several groups. Interrupted runs with --work go on where they ended.
    """

    scans: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="SCAN...")]
    """The clouds, two or more: any formats that `jaxreg register` reads."""
    output: Output = None
    """Write the merged cloud here (PLY: with a property `scan`, and the colours that came with the
    scans; other formats: points). Of several groups each has its own file, numbered; the last lines say
    which."""
    poses: OptionalPath = None
    """Write the poses, scan to common frame, to this file: .json, .txt (4x4), .tum, .kitti or .g2o."""
    json: OptionalPath = None
    """Write poses, probabilities, covariances, groups, and the pairs used and refused (JSON)."""
    html: OptionalPath = None
    """Write an interactive HTML page to this file; it works offline."""
    plot: OptionalPath = None
    """Draw the aligned scans, from two sides, to this file (PNG, PDF or SVG)."""
    voxel: Annotated[float | None, tyro.conf.arg(metavar="LENGTH", help_behavior_hint="")] = None
    """Of each scan, write one point per cube of this edge (unit of the scans; default: all points)."""
    ordered: bool = False
    """The scans are a sequence: neighbours overlap. Only these and closures of loops are looked for."""
    times: OptionalPath = None
    """The same by the times of the scans: a file with one number a scan (text or NPY, any unit), in the
    order of the scans above. Scans before and after a long pause are no neighbours."""
    initial: OptionalPath = None
    """Start from these poses, all in one frame (the formats of --poses; of a JSON with several groups
    the first one's); scans without one are looked for."""
    viewpoint: Viewpoint = "unknown"
    """Where the scanner of each scan stood, as in `jaxreg register`: worth much where places look
    alike."""
    joint: bool = True
    """Refine all poses together at the end."""
    work: OptionalPath = None
    """Keep prepared scans and finished pairs in this folder, and go on from what is there."""
    workers: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Register pairs in so many processes (0: one after the other in this one)."""
    nonfinite: Literal["raise", "drop"] = "raise"
    """What to do with points that are NaN or infinite."""
    strays: Literal["drop", "keep", "raise"] = "drop"
    """What to do with a few points that lie ten times as far from the middle as all others."""
    config: tyro.conf.AvoidSubcommands[RegisterConfig] = RegisterConfig()
    """Settings; the defaults adapt to the data."""

    def run(self) -> int:
        """Align, write, print; returns the exit status."""
        from jaxreg import io
        from jaxreg.progress import stage_progress
        from jaxreg.scans.many import register_many

        _check(self)
        names = [str(path) for path in self.scans]
        found = io.read_poses(self.initial, names) if self.initial else {}
        initial = [found.get(name) for name in names] if self.initial else None
        begin = time.perf_counter()
        with patience(spinner=False), stage_progress() as progress:
            scans = []
            for k, path in enumerate(self.scans):
                progress(k, len(self.scans), f"reading {path.name}")
                scans.append(checked_scan(path, self.nonfinite))
            check_columns(self.scans, scans)
            alignment = register_many(
                [scan.points for scan in scans],
                order=_order(self),
                initial=initial,
                viewpoints=[
                    place_of(scan, path, self.viewpoint)
                    for scan, path in zip(scans, self.scans, strict=True)
                ],
                nonfinite=self.nonfinite,
                strays=self.strays,
                names=names,
                joint=self.joint,
                work=self.work,
                workers=self.workers,
                config=self.config,
                progress=progress,
            )
        seconds = time.perf_counter() - begin
        written: list[tuple[str, str]] = []
        try:  # Written first: a reader that closes the pipe, as `head` does, ends this process.
            _write(self, scans, alignment, written)
        finally:
            _print(self, scans, alignment, seconds)
        for name, told in written:
            line(name, told)
        return SUCCESS if alignment.success else NOT_TRUSTED


def _order(command: Align) -> Literal["sequence", "unknown"] | list[float]:
    from jaxreg import io

    if command.times is not None:
        return io.read_numbers(command.times, len(command.scans), what="scan").tolist()
    return "sequence" if command.ordered else "unknown"


def _check(command: Align) -> None:
    """Refuse what cannot be read or written before the work, not after it."""
    from jaxreg import io

    if len(command.scans) < 2:
        raise ValueError(f"{len(command.scans)} scan given: name two or more.")
    repeated = [path for k, path in enumerate(command.scans) if path in command.scans[:k]]
    if repeated:
        raise ValueError(f"{repeated[0]} is named twice: name each scan once.")
    if command.ordered and command.times:
        raise ValueError("give --ordered (the order of the files) or --times, not both.")
    if command.voxel is not None and not command.voxel > 0:
        raise ValueError(f"--voxel must be positive, got {command.voxel:g}.")
    if command.output:
        io.check_writable(command.output)
    if command.poses:
        io.check_poses_output(command.poses)
    if command.plot:
        check_picture(command.plot)
    taken = _inputs(command)
    for path in _outputs(command):
        io.check_place(path, taken)
        taken.append(path)


def _inputs(command: Align) -> list[Path]:
    return [*command.scans, *filter(None, [command.initial, command.times])]


def _outputs(command: Align) -> list[Path]:
    """The files to write, of the groups the first alone: how many there are is known at the end."""
    files = (command.output, command.poses, command.json, command.html, command.plot)
    return [path for path in files if path]


def _write(
    command: Align, scans: list["Scan"], alignment: "Alignment", told: list[tuple[str, str]]
) -> None:
    """Write what is asked for; `told` gets lines on it, a name and a text."""
    from jaxreg import io
    from jaxreg.scans import alignment_summary as summary
    from jaxreg.view import alignment_page

    clouds = [scan.points for scan in scans]
    names = [str(path) for path in command.scans]
    if command.output:
        _write_merged(command, command.output, clouds, alignment, told)

    def write_poses(path: Path) -> None:
        edges = summary.edges(alignment) if path.suffix.lower() == ".g2o" else None
        io.write_poses(
            path, alignment.transformation, names=names, edges=edges, groups=alignment.groups
        )

    writers = (
        (command.poses, write_poses),
        (command.json, lambda path: path.write_text(
            json.dumps(summary.record(alignment, names), indent=1, allow_nan=False) + "\n",
            "utf-8")),
        (command.html, lambda path: alignment_page.write_alignment_page(
            path, clouds, alignment, names=names)),
        (command.plot, lambda path: alignment_page.draw_alignment(
            path, clouds, alignment, names=names)),
    )  # fmt: skip
    for path, write in writers:
        if path is not None:
            with io.whole(path) as part:
                write(part)
            apart = len(alignment.groups) > 1 and path == command.poses
            told.append(("wrote", f"{path}{' (each group in a frame of its own)' * apart}"))


def _write_merged(
    command: Align,
    output: Path,
    clouds: list[np.ndarray],
    alignment: "Alignment",
    told: list[tuple[str, str]],
) -> None:
    from jaxreg import io

    if not alignment.groups:
        told.append(("not written", f"{output}: no two scans hang together"))
    paths = _group_paths(command, output, len(alignment.groups))
    for k, path in enumerate(paths):
        points, scan = alignment.merged(clouds, group=k, voxel=command.voxel)
        colors = None
        if command.voxel is None:
            members = alignment.groups[k]
            colors = io.read_colors(
                [command.scans[i] for i in members], [clouds[i] for i in members]
            )
        with io.whole(path) as part:
            io.write_merged(part, points, scan, colors)
        which = f" (group {k + 1})" if len(paths) > 1 else ""
        told.append(("wrote", f"{path}{which}"))


def _group_paths(command: Align, output: Path, count: int) -> list[Path]:
    """The file of every group: OUT, OUT.2 and so on, without names that are read or written."""
    taken = {path.resolve() for path in (*_inputs(command), *_outputs(command))}
    paths, number = [output], 1
    while len(paths) < count:
        number += 1
        path = output.with_name(f"{output.stem}.{number}{output.suffix}")
        # It is too late to refuse it: the work is done.
        if path.resolve() not in taken and not path.is_dir():
            paths.append(path)
    return paths[:count]


def _print(command: Align, scans: list["Scan"], alignment: "Alignment", seconds: float) -> None:
    from jaxreg.scans import alignment_summary as summary

    points = sum(len(scan.points) for scan in scans)
    line("scans", f"{len(scans)} ({points:,} points)")
    for name, value in summary.figures(alignment).items():
        line(name, value)
    line("time", f"{seconds:.2f} s")
    for k, group in enumerate(alignment.groups):
        listed = [command.scans[i].name for i in group]
        line(f"group {k + 1}", summary.listed(listed, _LISTED))
    for note in alignment.notes:
        line("note", note)
    for k in alignment.unplaced[:_LISTED]:
        line("not placed", f"{command.scans[k]}: {alignment.reasons[k]}")
    if len(alignment.unplaced) > _LISTED:
        line("not placed", f"and {len(alignment.unplaced) - _LISTED} more: see --json")
    line("verdict", summary.verdict(alignment))
    if not alignment.success:
        look = "" if command.html else "look at it with --html PAGE.html; "
        say(f"{'hint':<16} {look}poses to start from help: --initial FILE")
