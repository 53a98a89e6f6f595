"""The learned methods of the paper's Table 1, measured here and as the paper prints them.

    python -m benchmarks.paper.peers --folder PEERS [--pairs 64] [--data-root DATA]

PEERS holds the arrays of the authors' state dicts (cemnet_*.npz, dcp_v1.npz, rie_modelnet.npz). The
same first pairs for every method. A method without weights has a row of what the paper prints.
"""

import dataclasses
from pathlib import Path

import tyro

from benchmarks import record
from benchmarks.paper.columns import CONFIGS
from jaxreg.cli.process import enable_compilation_cache
from jaxreg.config import load_config
from jaxreg.data import data_root
from jaxreg.evaluation import score

COLUMNS = {
    "clean": ("modelnet40_unseen_objects", "unseen objects"),
    "jitter": ("modelnet40_jitter", "jitter 0.01"),
    "resampled": ("modelnet40_resampled", "no shared point"),
}
CEMNET = "cemnet:{folder}/cemnet_modelnet40_n768_unseen0_noise{noise}.npz"
METHODS = {
    "cemnet": ("CEMNet", "its authors' weights"),
    "dcp": ("DCP v1", "its authors' weights"),
    "rienet": ("RIENet", "its authors' weights"),
    "idam": ("IDAM", "not trained here"),
    "rpmnet": ("RPM-Net", "not trained here"),
    "fmr": ("FMR", "not built here"),
}
PUBLISHED = {"idam": 0.4243, "rpmnet": 0.0051, "fmr": 3.6497, "cemnet": 0.1385, "rienet": 0.0033}
"""MAE(R) of the paper's Table 1 on unseen objects, over all pairs, in degrees."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What to evaluate."""

    folder: str
    """Folder of the NPZ files."""
    pairs: int = 64
    only: tuple[str, ...] = ("clean", "jitter")
    """Columns to make."""
    data_root: str = ""
    record: bool = True
    """Write the table to benchmarks/results/."""


def name_of(method: str, column: str, folder: str) -> str:
    """The method as `methods.choose` takes it; empty where there are no weights."""
    noise = int(column == "jitter")  # CEMNet has weights for jittered clouds of their own.
    return {
        "cemnet": CEMNET.format(folder=folder, noise=noise),
        "dcp": f"dcp:{folder}/dcp_v1.npz",
        "rienet": f"rienet:{folder}/rie_modelnet.npz",
    }.get(method, "")


def measure(method: str, column: str, options: Options, root: Path | None) -> dict[str, float]:
    """The figures of a cell, by the names of the record's columns."""
    name = name_of(method, column, options.folder)
    if not name:
        return {}
    config = load_config(CONFIGS / f"{COLUMNS[column][0]}.toml")
    scored = score.evaluate(config, root=root, method=name, pairs=options.pairs)
    found = score.figures(scored)
    cell = {
        f"{column}_mae_r": found["mae_r_deg"],
        f"{column}_mean": found["mie_r_deg"],
        f"{column}_median": found["median_rre_deg"],
        f"{column}_recall": found["recall_5deg"],
        f"{column}_worst": found["worst_rre_deg"],
        f"{column}_ms": 1e3 * found["seconds_per_pair"],
    }
    print(method, {key: float(f"{value:.3g}") for key, value in cell.items()}, flush=True)
    return cell


def write(rows: dict[str, dict], options: Options) -> Path:
    """The record `peers`: a row a method."""
    heads = {
        "mae_r": "MAE(R)",
        "mean": "mean",
        "median": "median",
        "recall": "recall 5 deg",
        "worst": "worst",
        "ms": "ms a pair",
    }
    return record.write(
        "peers",
        question="What do the learned methods of the paper's table reach here?",
        command=record.command("benchmarks.paper.peers"),
        columns={"weights": "weights", "paper": "unseen objects: paper's MAE(R)"}
        | {
            f"{column}_{key}": f"{COLUMNS[column][1]}: {head}"
            for column in options.only
            for key, head in heads.items()
        },
        rows=rows,
        setting={"pairs": options.pairs},
    )


def main(options: Options) -> None:
    """Evaluate all, and write the table."""
    enable_compilation_cache()
    root = data_root(options.data_root, CONFIGS / "any.toml")
    rows = {
        method: {"label": label, "weights": weights, "paper": PUBLISHED.get(method)}
        for method, (label, weights) in METHODS.items()
    }
    for column in options.only:
        for method in METHODS:
            rows[method] |= measure(method, column, options, root)
    if options.record:
        print(write(rows, options))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
