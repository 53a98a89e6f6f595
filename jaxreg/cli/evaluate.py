"""Evaluate: `jaxreg evaluate CONFIG.toml [--checkpoint DIR | --method NAME | --transforms FILE]`.

Without any of these, the weights named by the configuration or --weights are evaluated. Every
method sees the same pairs; errors are computed in float64 from the transforms. The pairs are those
of [data] and [test_pairs]; a network keeps the settings it was trained with, except iterations,
n_inliers and robust_rounds. Options without effect are refused.
"""

import dataclasses
import json
import sys
from collections.abc import Collection
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from jaxreg import devices, io
from jaxreg.cli import process
from jaxreg.cli.options import SUCCESS, given_fields, parse, say, status_of
from jaxreg.config import Config
from jaxreg.data import root_of
from jaxreg.evaluation import methods, score
from jaxreg.evaluation.parts import Parts
from jaxreg.evaluation.table import results_table
from jaxreg.weights.released import weight_files

_SUFFIXES = {
    "json": (),
    "save_transforms": (".npz",),
    "save_pairs": (".npz",),
    "picture": (".png", ".pdf", ".svg"),
}
"""The options that name an output file, and the suffixes it may have."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `jaxreg evaluate`."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    checkpoint: str = ""
    """Working directory of a training run; its best checkpoint is evaluated, with the iterations
    and n_inliers of the run unless the command line gives others."""
    rienet: str = ""
    """NPZ file with RIENet's published weights (not included)."""
    method: str = ""
    """Another method: register, register_global, register_global_learned, icp, identity, a learned one
    with its authors' weights (cemnet:FILE, dcp:FILE), or a baseline such as open3d_fgr (a wrong name
    lists them all)."""
    transforms: str = ""
    """NPZ file with `rotation` (n,3,3) and `translation` (n,3) of the pairs, from any program."""
    refine: str = ""
    """Refine the resulting poses on the clouds: icp, point_to_plane or gicp."""
    pairs: int = 0
    """Evaluate only the first N pairs; 0 means all."""
    batch: int = 8
    """Pairs per batch."""
    parts: str = ""
    """Keep every batch in this folder as soon as it is registered: the same command goes on after an
    interruption, and many processes may share it (see --processes)."""
    processes: int | None = None
    """How many processes share the folder of --parts, each started with this command; the last one to
    end prints the table. Else JAX_NUM_PROCESSES or SLURM_NTASKS say it, if they are set."""
    process_id: int | None = None
    """The number of this process, from 0 (else JAX_PROCESS_ID or SLURM_PROCID)."""
    json: str = ""
    """Write the results to this file."""
    picture: str = ""
    """Draw the first pair, before and after, to this file (PNG, PDF or SVG)."""
    save_pairs: str = ""
    """Write the pairs to this NPZ file, for another program to register (see --transforms)."""
    save_transforms: str = ""
    """Write the predicted transforms to this NPZ file."""
    data_root: str = ""
    """Folder of the data sets (if left out $JAXREG_DATA, then data/ next to your
    configuration, or in the working directory for one that comes with jaxreg)."""


def main(arguments: list[str] | None = None) -> int:
    """Parse, evaluate, print, write; returns the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    program = "jaxreg evaluate"
    path, options = parse(Options, description=__doc__, arguments=arguments, program=program)
    return status_of(lambda: _run(options, path, given_fields(Options, arguments)))


def _run(options: Options, path: Path, given: Collection[str]) -> int:
    process.enable_compilation_cache()
    _check(options, path)
    method = _method(options)
    score.check_given(options.config, given, method=method, transforms=options.transforms)
    config = _as_trained(options, path, given, method)
    root = root_of(config.data, options.data_root, path)
    scored = score.evaluate(
        config,
        root=root,
        method=method,
        transforms=options.transforms,
        refine=options.refine,
        pairs=options.pairs,
        batch=options.batch,
        parts=_parts(options),
    )
    if scored is None:
        say(
            f"this process is done: its batches are in {options.parts}. The process that finds all of "
            "them there, the last to end, prints the table."
        )
        return SUCCESS
    # Written even if the other fails, for a bad pose or a full disk: they hold minutes of work.
    try:
        _report(options, path, scored)
    finally:
        _write(options, config, root, scored)
    return SUCCESS


def _parts(options: Options) -> Parts | None:
    """The share of this process, or None if there is one process and no folder."""
    if options.parts:
        return Parts(Path(options.parts), *devices.place_of(options.process_id, options.processes))
    if options.processes is not None or options.process_id is not None:
        raise ValueError("--processes and --process-id need a folder that all share: give --parts.")
    return None


def _method(options: Options) -> str:
    """The method that the options name, as `methods.choose` takes it; empty if they name none."""
    chosen = [
        options.method,
        options.checkpoint and f"checkpoint:{options.checkpoint}",
        options.rienet and f"rienet:{options.rienet}",
    ]
    if sum(map(bool, (*chosen, options.transforms))) > 1:
        raise ValueError("choose one of --checkpoint, --rienet, --method and --transforms.")
    return "".join(chosen)


def _check(options: Options, path: Path) -> None:
    """Refuse what cannot be done before the work, not after it."""
    if options.parts and options.transforms and not options.refine:
        raise ValueError("--parts has no effect with --transforms: there is nothing to register.")
    if options.pairs < 0 or options.batch < 1:
        raise ValueError(
            f"--pairs {options.pairs} --batch {options.batch}: give --pairs 0 (all) or more, and "
            "--batch 1 or more."
        )
    taken = [path, *_inputs(options)]
    for name, suffixes in _SUFFIXES.items():
        if getattr(options, name):
            output = Path(getattr(options, name))
            if suffixes and output.suffix.lower() not in suffixes:
                raise ValueError(
                    f"--{name.replace('_', '-')} {output}: name a file that ends in "
                    f"{' or '.join(suffixes)}."
                )
            io.check_place(output, taken)
            _check_not_among(output, options)
            taken.append(output)


def _inputs(options: Options) -> list[Path]:
    """The files of the method that is evaluated."""
    kind, _, place = options.method.partition(":")  # as in cemnet:FILE
    weights = place if kind == "weights" else ""
    if not (options.method or options.transforms or options.checkpoint or options.rienet):
        weights = options.config.weights
    files = [Path(p) for p in (options.transforms, options.rienet, place) if p]
    return [*files, *(weight_files(weights) if weights else ())]


def _check_not_among(output: Path, options: Options) -> None:
    """Raise ValueError if a folder that is read would hold the output as one of its own files."""
    own, data = False, options.config.data
    if options.parts:
        own = Parts(Path(options.parts)).keeps(output)
    if data.name == "folder" and data.folder and output.suffix.lower() in io.READABLE:
        own |= output.resolve().is_relative_to(Path(data.folder).resolve())
    if options.checkpoint:
        own |= output.resolve().is_relative_to((Path(options.checkpoint) / "best").resolve())
    if own:
        raise ValueError(
            f"{output} is among the files that this command reads: choose another folder or name."
        )


def _as_trained(options: Options, path: Path, given: Collection[str], method: str) -> Config:
    """The configuration to evaluate with; prints what differs from the file at `path`.

    The file says how a training starts; a run may have been made with other options, and its
    network is evaluated as it was trained. Released weights follow the file, and so do robust
    rounds, which belong to the pairs and not to the training.
    """
    config = options.config
    if not options.checkpoint:
        return config
    trained, changed = methods.trained_config(method), {}
    assert trained is not None  # a checkpoint is always a network
    for name in ("iterations", "n_inliers"):
        value, wanted = getattr(trained.model, name), getattr(config.model, name)
        if f"model.{name}" not in given and value != wanted:
            changed[name] = value
            say(
                f"model.{name} = {value} as {options.checkpoint} was trained, not {wanted} as in "
                f"{path} (to have that: {score.option(config, f'model.{name}')})"
            )
    return dataclasses.replace(config, model=dataclasses.replace(config.model, **changed))


def _report(options: Options, path: Path, scored: score.Scored) -> None:
    result = score.figures(scored) | {"config": path.stem}
    Console().print(results_table([result], title=str(path)))
    if options.transforms and (hint := score.other_convention(scored)):
        say(hint)
    if options.json:
        with io.whole(Path(options.json)) as part:
            part.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def _write(options: Options, config: Config, root: Path | None, scored: score.Scored) -> None:
    if options.save_transforms:
        score.save_transforms(options.save_transforms, scored.predicted)
    if options.save_pairs:
        stream = score.pair_stream(config, root=root, pairs=options.pairs)
        score.save_pairs(options.save_pairs, stream.batches())
    if options.picture:
        score.draw_first_pair(options.picture, scored)
