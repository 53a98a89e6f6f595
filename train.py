"""Train a network: `python train.py CONFIG.toml --workdir DIR [--section.field value ...]`.

Run again with the same workdir to resume. Writes metrics.jsonl, curves.png, the newest and the best
checkpoint by validation error.
"""

import dataclasses
from typing import Annotated

import tyro

from jaxreg.compilation import enable_compilation_cache, restart_with_huge_pages
from jaxreg.config import Config
from jaxreg.data import data_root
from jaxreg.options import parse, stop
from jaxreg.pictures import plot_curves
from jaxreg.training import release, train


@dataclasses.dataclass(frozen=True)
class Options:
    """What train.py takes."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    workdir: str = ""
    """Directory of the run; one that holds a run is resumed."""
    release: str = ""
    """Write the best weights to jaxreg/weights under this name, with a card of how they were made."""
    data_root: str = ""
    """Folder of the data sets (else $JAXREG_DATA, else data/ beside the configuration)."""


def main() -> None:
    """Parse, train, say where the results are."""
    path, options = parse(Options, description=__doc__)
    workdir = options.workdir or f"runs/{path.stem}"
    enable_compilation_cache()
    try:
        root = data_root(options.data_root, path)
        train(options.config, workdir, root=root)
    except (ValueError, FloatingPointError) as error:
        stop(str(error))
    except KeyboardInterrupt:
        stop("interrupted: the same command goes on from the newest checkpoint", status=130)
    plot_curves(f"{workdir}/metrics.jsonl", f"{workdir}/curves.png")
    if options.release:
        command = f"python train.py {path} --workdir {workdir}"
        release(options.release, workdir, command, root=root)
    print(f"best checkpoint, metrics.jsonl and curves.png: {workdir}")


if __name__ == "__main__":
    restart_with_huge_pages()
    main()
