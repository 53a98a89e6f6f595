"""Train a network: `python train.py CONFIG.toml --workdir DIR [--section.field value ...]`.

Run again with the same workdir to resume. Writes metrics.jsonl, curves.png, the newest and the best
checkpoint by validation error.
"""

import dataclasses
import shlex
import sys
from typing import Annotated

import tyro

from jaxreg.cli.options import parse, stop, told
from jaxreg.cli.process import enable_compilation_cache, restart_with_huge_pages
from jaxreg.config import Config
from jaxreg.data import root_of
from jaxreg.training import release, train
from jaxreg.view.pictures import plot_curves
from jaxreg.weights.released import check_new_name


@dataclasses.dataclass(frozen=True)
class Options:
    """What train.py takes."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    workdir: str = ""
    """Directory of the run; one that holds a run is resumed."""
    release: str = ""
    """Write the best weights to jaxreg/weights under this new name, with a card of how they were
    made."""
    data_root: str = ""
    """Folder of the data sets (else $JAXREG_DATA, else data/ beside the configuration)."""


def main() -> None:
    """Parse, train, say where the results are."""
    path, options = parse(Options, description=__doc__)
    workdir = options.workdir or f"runs/{path.stem}"
    enable_compilation_cache()
    trained = ""
    try:
        if options.release:
            check_new_name(options.release)
        root = root_of(options.config.data, options.data_root, path)
        train(options.config, workdir, root=root)
        trained = f" ({workdir} holds the whole run: the same command does the rest)"
        plot_curves(f"{workdir}/metrics.jsonl", f"{workdir}/curves.png")
        if options.release:
            command = shlex.join(["python", "train.py", *sys.argv[1:]])
            release(options.release, workdir, command, root=root)
    except (ValueError, FloatingPointError, OSError) as error:
        stop(told(error) + trained)
    except KeyboardInterrupt:
        stop("interrupted: the same command goes on from the last validation", status=130)
    print(f"best checkpoint, metrics.jsonl and curves.png: {workdir}")


if __name__ == "__main__":
    restart_with_huge_pages()
    main()
