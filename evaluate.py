"""Evaluate: `python evaluate.py CONFIG.toml [--checkpoint DIR | --method NAME | --transforms FILE]`.

Without any of them the released weights that the configuration (or --weights) names are evaluated.
Every method meets the same pairs and the same metrics, in float64 from transforms.
"""

import dataclasses
import json
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from jaxreg import io, scoring
from jaxreg.compilation import enable_compilation_cache
from jaxreg.config import Config
from jaxreg.data import data_root
from jaxreg.options import parse, stop
from jaxreg.report import results_table

_CHOICE = (
    "checkpoint",
    "predecessor",
    "method",
    "transforms",
    "refine",
    "pairs",
    "batch",
    "save_transforms",
)


@dataclasses.dataclass(frozen=True)
class Options:
    """What evaluate.py takes."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    checkpoint: str = ""
    """Working directory of a run of train.py; its best checkpoint is evaluated."""
    predecessor: str = ""
    """NPZ file with the released weights of the predecessor, RIENet (not ours to ship)."""
    method: str = ""
    """Another method: identity, icp, or a baseline such as open3d_fgr (a wrong name lists them)."""
    transforms: str = ""
    """NPZ file with `rotation` (n,3,3) and `translation` (n,3) of the pairs, by any program."""
    refine: str = ""
    """Refine the poses of the method on the clouds afterwards: icp, point_to_plane or gicp."""
    pairs: int = 0
    """Evaluate the first N pairs only; 0 is all."""
    batch: int = 8
    """Pairs registered at once."""
    json: str = ""
    """Write the figures to this file."""
    picture: str = ""
    """Draw the first pair before and after to this PNG file."""
    save_pairs: str = ""
    """Write the pairs to this NPZ file, for --transforms by another program."""
    save_transforms: str = ""
    """Write the predicted transforms to this NPZ file."""
    data_root: str = ""
    """Folder of the data sets (else $JAXREG_DATA, else data/ beside the configuration)."""


def _check(options: Options) -> None:
    """What cannot be done is said before the work, not after it."""
    if options.pairs < 0 or options.batch < 1:
        raise ValueError(
            f"--pairs {options.pairs} --batch {options.batch}: give --pairs 0 (all) or more, and "
            "--batch 1 or more."
        )
    for path in (options.json, options.picture, options.save_pairs, options.save_transforms):
        if path:
            io.check_folder(Path(path))


def main() -> None:
    """Parse, evaluate, print."""
    path, options = parse(Options, description=__doc__)
    enable_compilation_cache()
    chosen = {name: getattr(options, name) for name in _CHOICE}
    try:
        _check(options)
        root = data_root(options.data_root, path)
        result = scoring.score(options.config, root=root, **chosen)
        _write_extras(options, root)
    except ValueError as error:
        stop(str(error))
    except KeyboardInterrupt:
        stop("interrupted", status=130)
    result["config"] = path.stem
    Console().print(results_table([result], title=str(path)))
    if options.json:
        Path(options.json).write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def _write_extras(options: Options, root: Path | None) -> None:
    if options.save_pairs:
        _, batches = scoring.pair_stream(options.config, root=root, pairs=options.pairs)
        scoring.save_pairs(options.save_pairs, batches)
    if options.picture:
        scoring.draw_first_pair(
            options.picture,
            options.config,
            root=root,
            checkpoint=options.checkpoint,
            predecessor=options.predecessor,
            method=options.method,
        )


if __name__ == "__main__":
    main()
