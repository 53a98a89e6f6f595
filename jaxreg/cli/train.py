"""Train a network: `jaxreg train CONFIG.toml --workdir DIR [--section.field value ...]`.

CONFIG.toml is your own file or the name of one that comes with jaxreg (a wrong name lists them).
--weights NAME fine-tunes released weights, or the best ones of a run if NAME is its folder. Run again
with the same --workdir to resume. Writes metrics.jsonl, curves.png, the latest checkpoint
and the one with the lowest validation error.
"""

import dataclasses
import shlex
import sys
from collections.abc import Collection
from pathlib import Path
from typing import Annotated

import jax
import tyro

from jaxreg import devices
from jaxreg.cli import process
from jaxreg.cli.options import SUCCESS, given_fields, parse, say, status_of, told
from jaxreg.config import Config, load_config
from jaxreg.data import root_of
from jaxreg.training import release, train
from jaxreg.weights.released import check_new_name


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of `jaxreg train`."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    workdir: str = ""
    """Directory of the run (runs/CONFIG if left out); an existing run is resumed."""
    release: str = ""
    """Write the best weights under this new name, with a card of how they were made."""
    release_to: str = ""
    """Directory to write them to (the workdir if left out); `jaxreg.load_pretrained` takes
    DIRECTORY/NAME, or just NAME if $JAXREG_WEIGHTS is that directory."""
    coordinator: str | None = None
    """HOST:PORT of process 0, if many processes train together; see also --processes, --process-id."""
    processes: int | None = None
    """How many processes train together; each takes a share of every batch."""
    process_id: int | None = None
    """The number of this process, from 0."""
    data_root: str = ""
    """Folder of the data sets (if left out $JAXREG_DATA, then data/ next to your
    configuration, or in the working directory for one that comes with jaxreg)."""


def main(arguments: list[str] | None = None) -> int:
    """Parse, train, print where the results are; returns the exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    path, options = parse(Options, description=__doc__, arguments=arguments, program="jaxreg train")
    command = shlex.join(["jaxreg", "train", *arguments])
    return status_of(
        lambda: _run(_with_start(options, path, given_fields(Options, arguments)), path, command),
        interrupted="interrupted: run the same command to go on from the last validation",
    )


def _with_start(options: Options, path: Path, given: Collection[str]) -> Options:
    """`--weights NAME` as the weights to start from; those that the file names are for evaluation."""
    config = options.config
    if "weights" not in given or not config.weights:
        return options
    if "train.start" in given and config.train.start != config.weights:
        raise ValueError(
            f"--weights {config.weights} and --train.start {config.train.start} differ: give one."
        )
    training = dataclasses.replace(config.train, start=config.weights)
    config = dataclasses.replace(config, train=training, weights=load_config(path).weights)
    return dataclasses.replace(options, config=config)


def _run(options: Options, path: Path, command: str) -> int:
    workdir = options.workdir or f"runs/{path.stem}"
    place = options.release_to or workdir
    process.enable_compilation_cache()
    devices.join_processes(options.coordinator, options.processes, options.process_id)
    if options.release and jax.process_count() > 1:
        raise ValueError(
            "--release with many processes: train without it, then run the same command with it in one "
            "process, which finds the run finished."
        )
    if options.release:
        check_new_name(options.release, place)
    root = root_of(options.config.data, options.data_root, path)
    train(options.config, workdir, root=root)
    if not devices.is_first():
        return SUCCESS
    try:
        drawn = _draw_curves(workdir)
        if options.release:
            card = release(options.release, workdir, command, root=root, directory=place)
            say(f"weights and card: {card.with_suffix('')}")
    except (ValueError, OSError) as error:
        rest = f"({workdir} has the whole run: run the same command again to do the rest)"
        raise ValueError(f"{told(error)} {rest}") from error
    say(f"best checkpoint, metrics.jsonl{drawn}: {workdir}")
    return SUCCESS


def _draw_curves(workdir: str) -> str:
    """Draw curves.png if matplotlib is installed; training does not need it."""
    try:
        from jaxreg.view.pictures import plot_curves
    except ImportError as error:
        say(f"{workdir}/curves.png is not drawn: {error}")
        return ""
    plot_curves(f"{workdir}/metrics.jsonl", f"{workdir}/curves.png")
    return " and curves.png"
