"""The learned methods of the paper's Table 1, measured here and as the paper prints them.

    python -m benchmarks.paper.peers --folder PEERS [--runs idam=RUN fmr=RUN] [--hours idam=3.5] [--pairs 64]

PEERS holds the arrays of the authors' state dicts (cemnet_*.npz, dcp_v1.npz, rie_modelnet.npz); RUN is
the workdir of a training (`python train.py configs/peer_idam_unseen_objects.toml --workdir RUN`), whose
best checkpoint is measured. The same first pairs for every method: the paper's three columns, and pairs
that are jittered, resampled or cropped, with rotations up to 45 degrees an axis and with any rotation.
A method without weights has a row of what the paper prints; one that was trained here says for how long,
beside the budget of its authors. A log has no times: `--hours` are those of the training, by its clock.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import tyro

from benchmarks import record, render
from benchmarks.paper.columns import CONFIGS
from jaxreg.cli.process import enable_compilation_cache
from jaxreg.config import Config, load_config
from jaxreg.data import data_root
from jaxreg.evaluation import score
from jaxreg.io.log import read_metrics
from jaxreg.peers import by_name
from jaxreg.weights.checkpoint import best_config


class Column(NamedTuple):
    """A set of test pairs: a file in configs/, its name on the page, whether any rotation is drawn."""

    config: str
    label: str
    any_rotation: bool = False


_KINDS = {
    "jitter": Column("modelnet40_jitter", "jitter 0.01"),
    "resampled": Column("modelnet40_resampled", "no shared point"),
    "crops": Column("modelnet40_crops70", "crops of 70 %, no shared point"),
}
COLUMNS = (
    {
        "clean": Column("modelnet40_unseen_objects", "unseen objects"),
        "categories": Column("modelnet40_unseen_categories", "unseen categories"),
        "noise": Column("modelnet40_gaussian_noise", "Gaussian noise"),
    }
    | _KINDS
    | {
        f"{key}_any": Column(x.config, f"{x.label}, any rotation", any_rotation=True)
        for key, x in _KINDS.items()
    }
)
CEMNET = "cemnet:{folder}/cemnet_modelnet40_n768_unseen{unseen}_noise{noise}.npz"
METHODS = {
    "cemnet": "CEMNet, its authors' weights",
    "dcp": "DCP v1, its authors' weights",
    "rienet": "RIENet, its authors' weights",
    "idam": "IDAM",
    "rpmnet": "RPM-Net",
    "fmr": "FMR",
}
TRAINABLE = tuple(name for name in by_name.TRAINED if name in METHODS)
BUDGETS = {
    "idam": "40 epochs, 16 pairs a step",
    "rpmnet": "1000 epochs, 8 pairs a step",
    "fmr": "200 epochs, 8 pairs a step",
}
"""How long their authors train them."""
PUBLISHED = {
    "clean": {
        "idam": (0.4243, 0.0020, 0.8170, 0.0040),
        "rpmnet": (0.0051, 0.0000, 0.0201, 0.0000),
        "fmr": (3.6497, 0.0101, 7.2810, 0.0200),
        "cemnet": (0.1385, 0.0001, 0.2489, 0.0002),
        "rienet": (0.0033, 0.0000, 0.0210, 0.0000),
    },
    "categories": {
        "idam": (0.4809, 0.0028, 0.9157, 0.0055),
        "rpmnet": (0.0064, 0.0001, 0.0207, 0.0001),
        "fmr": (3.8594, 0.0114, 7.6450, 0.0225),
        "cemnet": (0.0804, 0.0002, 0.1405, 0.0003),
        "rienet": (0.0059, 0.0000, 0.0228, 0.0001),
    },
    "noise": {
        "idam": (2.3076, 0.0124, 4.5332, 0.0246),
        "rpmnet": (0.0075, 0.0000, 0.0221, 0.0001),
        "fmr": (18.0355, 0.0536, 35.7986, 0.1063),
        "cemnet": (10.7026, 0.0393, 21.1836, 0.0781),
        "rienet": (0.0069, 0.0001, 0.0230, 0.0001),
    },
}
"""MAE(R), MAE(t), MIE(R) and MIE(t) of the paper's Table 1, over all pairs; degrees."""
FIGURES = {
    "mae_r": ("mae_r_deg", "MAE(R)"),
    "mae_t": ("mae_t", "MAE(t)"),
    "mean": ("mie_r_deg", "mean"),
    "mie_t": ("mie_t", "MIE(t)"),
    "median": ("median_rre_deg", "median"),
    "recall_1": ("recall_1deg", "recall 1 deg"),
    "recall": ("recall_5deg", "recall 5 deg"),
    "worst": ("worst_rre_deg", "worst"),
    "worst_pair": ("worst_pair", "worst pair"),
}
"""Columns of the record, the metrics that fill them, and their heads; `mean` is MIE(R)."""
PAPER_HEADS = {"mae_r": "MAE(R)", "mae_t": "MAE(t)", "mean": "MIE(R)", "mie_t": "MIE(t)"}
"""What the paper prints, by the names of our columns and its own."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What to evaluate."""

    folder: str
    """Folder of the NPZ files."""
    runs: tuple[str, ...] = ()
    """Trainings to measure, NAME=WORKDIR with one of the names idam, rpmnet, fmr."""
    hours: tuple[str, ...] = ()
    """Hours that a training took, NAME=HOURS."""
    pairs: int = 64
    only: tuple[str, ...] = tuple(COLUMNS)
    """Columns to make."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Methods to measure; the others have rows without figures."""
    data_root: str = ""
    record: bool = True
    """Write the table to benchmarks/results/."""


def named(given: Sequence[str], option: str) -> dict[str, str]:
    """``NAME=VALUE`` by its name.

    Raises:
      ValueError: one is not of that form, or names no method that is trained here.
    """
    found = {}
    for word in given:
        name, equals, value = word.partition("=")
        if name not in TRAINABLE or not (equals and value):
            raise ValueError(
                f"--{option} {word}: give NAME=VALUE with NAME one of {', '.join(TRAINABLE)}."
            )
        found[name] = value
    return found


def name_of(method: str, column: str, folder: str, runs: dict[str, str]) -> str:
    """The method as `methods.choose` takes it; empty where there are no weights."""
    if method in runs:
        return f"checkpoint:{runs[method]}"
    # CEMNet has weights of their own for jittered clouds and for unseen categories.
    noise, unseen = int(column.startswith("jitter")), int(column == "categories")
    return {
        "cemnet": CEMNET.format(folder=folder, noise=noise, unseen=unseen),
        "dcp": f"dcp:{folder}/dcp_v1.npz",
        "rienet": f"rienet:{folder}/rie_modelnet.npz",
    }.get(method, "")


def trained(method: str, workdir: str, hours: str | None) -> dict[str, record.Value]:
    """The label and the budget of a row that was trained here.

    Raises:
      ValueError: there is no checkpoint in `workdir`, or one of another network.
    """
    config = best_config(workdir)[0]
    if config.network != method:
        raise ValueError(f"--runs {method}={workdir}: that is a run of {config.network}.")
    steps = int(read_metrics(Path(workdir) / "metrics.jsonl")["step"][-1])
    time = f", {float(hours):.3g} h" if hours else ""
    return {
        "label": f"{METHODS[method]}, trained here: {steps} steps of {config.train.batch} pairs{time}",
        "steps": steps,
        "pairs_seen": steps * config.train.batch,
        "hours": float(hours) if hours else None,
        "trained_on": config.data.train_categories,
    }


def row_of(method: str, options: Options) -> dict[str, record.Value]:
    """What a row has before anything is measured: its label, its budgets, the paper's figures."""
    runs, hours = named(options.runs, "runs"), named(options.hours, "hours")
    row: dict[str, record.Value] = {"label": METHODS[method]}
    if method in BUDGETS:
        row = {"label": f"{METHODS[method]}, not trained here", "budget": BUDGETS[method]}
    if method in runs:
        row |= trained(method, runs[method], hours.get(method))
    for column in options.only:
        found = PUBLISHED.get(column, {}).get(method)
        if found:
            row |= {paper_key(column, k): x for k, x in zip(PAPER_HEADS, found, strict=True)}
    return row


def paper_key(column: str, figure: str) -> str:
    """What the record calls a figure of the paper; MAE(R) of unseen objects is `paper`."""
    name = "paper" if figure == "mae_r" else f"paper_{figure}"
    return name if column == "clean" else f"{column}_{name}"


def column_config(column: str) -> Config:
    """The pairs of a column; every network solves its Procrustes as its paper does."""
    chosen = COLUMNS[column]
    config = load_config(CONFIGS / f"{chosen.config}.toml")
    pairs = config.test_pairs
    if chosen.any_rotation:
        pairs = dataclasses.replace(pairs, rotation="full")
    model = dataclasses.replace(config.model, robust_rounds=0)
    return dataclasses.replace(config, test_pairs=pairs, model=model)


def measure(method: str, column: str, options: Options, root: Path | None) -> dict[str, float]:
    """The figures of a cell, by the names of the record's columns."""
    name = name_of(method, column, options.folder, named(options.runs, "runs"))
    if not name or method not in options.methods:
        return {}
    scored = score.evaluate(column_config(column), root=root, method=name, pairs=options.pairs)
    found = score.figures(scored)
    cell = {f"{column}_{key}": found[metric] for key, (metric, _) in FIGURES.items()}
    cell[f"{column}_ms"] = 1e3 * found["seconds_per_pair"]
    print(method, {key: float(f"{value:.3g}") for key, value in cell.items()}, flush=True)
    return cell


def heads_of(column: str) -> dict[str, str]:
    """The record's columns of a set of pairs: what the paper prints, if it does, and what was measured."""
    heads = {key: head for key, (_, head) in FIGURES.items()}
    printed = {paper_key(column, key): f"paper's {PAPER_HEADS[key]}" for key in PAPER_HEADS}
    found = {f"{column}_{key}": head for key, head in heads.items()}
    return (printed if column in PUBLISHED else {}) | found | {f"{column}_ms": "ms a pair"}


def columns_of(options: Options) -> dict[str, str]:
    """The record's columns and their heads."""
    return {
        "budget": "its authors train it for",
        "steps": "steps here",
        "pairs_seen": "pairs seen in training",
        "hours": "hours of training",
        "trained_on": "categories it was trained on",
    } | {
        key: f"{COLUMNS[column].label}: {head}"
        for column in options.only
        for key, head in heads_of(column).items()
    }


def write(rows: dict[str, dict], options: Options) -> Path:
    """The record `peers`: a row a method."""
    return record.write(
        "peers",
        question="What do the learned methods of the paper's table reach here?",
        command=record.command("benchmarks.paper.peers"),
        columns=columns_of(options),
        rows=rows,
        setting={"pairs": options.pairs, "trained": len(options.runs)},
    )


def show(rows: dict[str, dict], options: Options) -> None:
    """Print a table for every column: what the paper prints beside what was measured."""
    for column in options.only:
        print(f"\n{COLUMNS[column].label}, {options.pairs} pairs\n")
        print(render.table({"columns": heads_of(column), "rows": rows}))


def main(options: Options) -> None:
    """Evaluate all, print and write the table."""
    enable_compilation_cache()
    root = data_root(options.data_root, CONFIGS / "any.toml")
    rows = {method: row_of(method, options) for method in METHODS}
    for column in options.only:
        for method in METHODS:
            rows[method] |= measure(method, column, options, root)
    show(rows, options)
    if options.record:
        print(write(rows, options))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
