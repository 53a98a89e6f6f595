"""The paper's whole table: every method of it, measured here and as the paper prints it.

    python -m benchmarks.paper.peers [--folder PEERS] [--hours idam=1.2] [--runs fmr=RUN] [--pairs 64]

The same first pairs for every method: the paper's three columns, its scans (or what stands in for
them), and pairs that are jittered, resampled or cropped, with rotations up to 45 degrees an axis and
with any rotation. PEERS holds the arrays of the authors' state dicts (cemnet_*.npz, dcp_v1.npz,
rie_modelnet.npz). IDAM, RPM-Net and FMR are measured with the weights that come with jaxreg, or with the
best checkpoint of a run (`jaxreg train peer_idam_unseen_objects --workdir RUN`); their rows say how long
they were trained, beside the budget of their authors. A card has no times: `--hours` are those of the
training, by its clock. A method without weights, or whose library is not installed, has a row of what
the paper prints.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import tyro

from benchmarks import record, render
from benchmarks.paper import columns, printed, tables
from jaxreg.cli.process import enable_compilation_cache
from jaxreg.config import Config, load_config
from jaxreg.data import data_root
from jaxreg.evaluation import score
from jaxreg.io.log import read_metrics
from jaxreg.peers import by_name
from jaxreg.weights.checkpoint import best_config
from jaxreg.weights.released import available_weights, load_card


class Column(NamedTuple):
    """A set of test pairs: its name on the page, and where it comes from.

    `of_paper` is one of `benchmarks.paper.columns`; without it `config` is a file in configs/, of which
    any rotation is drawn if `any_rotation`.
    """

    label: str
    of_paper: str = ""
    config: str = ""
    any_rotation: bool = False


_PAPER = {
    "clean": "unseen_objects",
    "categories": "unseen_categories",
    "noise": "gaussian_noise",
    "scenes": "seven_scenes",
    "icl": "icl_nuim",
}
_KINDS = {
    "jitter": Column("jitter 0.01", config="modelnet40_jitter"),
    "resampled": Column("no shared point", config="modelnet40_resampled"),
    "crops": Column("crops of 70 %, no shared point", config="modelnet40_crops70"),
}
COLUMNS = (
    {
        key: Column(columns.COLUMNS[name].label.partition(",")[0], of_paper=name)
        for key, name in _PAPER.items()
    }
    | _KINDS
    | {
        f"{key}_any": x._replace(label=f"{x.label}, any rotation", any_rotation=True)
        for key, x in _KINDS.items()
    }
)
METHODS = {
    "open3d_icp": "ICP (Open3D)",
    "open3d_fgr": "FGR (Open3D)",
    "open3d_ransac": "FPFH + RANSAC (Open3D)",
    "idam": "IDAM",
    "rpmnet": "RPM-Net",
    "fmr": "FMR",
    "cemnet": "CEMNet, its authors' weights",
    "rienet": "RIENet, its authors' weights",
    "jaxreg": "the paper's network (jaxreg)",
    "dcp": "DCP v1, its authors' weights",
    "register_global": "`register_global` (jaxreg)",
}
"""The nine rows of the paper's table in its order, and two more."""
TRAINABLE = tuple(name for name in by_name.TRAINED if name in METHODS)
BUDGETS = {
    "idam": "40 epochs, 16 pairs a step",
    "rpmnet": "1000 epochs, 8 pairs a step",
    "fmr": "200 epochs, 8 pairs a step",
}
"""How long their authors train them."""
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
"""What the paper prints, by the names of our columns and its own, in the order of `printed.Errors`."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What to evaluate."""

    folder: str = ""
    """Folder of the authors' NPZ files."""
    runs: tuple[str, ...] = ()
    """Trainings to measure in place of the weights that come with jaxreg, NAME=WORKDIR with one of the
    names idam, rpmnet, fmr."""
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
    if method in TRAINABLE:
        own = f"weights:{method}" if method in available_weights() else ""
        return f"checkpoint:{runs[method]}" if method in runs else own
    if method in ("cemnet", "rienet", "dcp"):
        file = f"{folder}/{_authors_file(method, column)}"
        return f"{method}:{file}" if folder else ""
    if method == "jaxreg":
        of_column = {"categories": "modelnet40_first20"}
        return f"weights:{of_column.get(column, 'modelnet40')}"
    return columns.BASELINES.get(method, method)


def _authors_file(method: str, column: str) -> str:
    """CEMNet has weights of their own for jittered clouds, unseen categories, and both kinds of scans."""
    if method != "cemnet":
        return {"rienet": "rie_modelnet.npz", "dcp": "dcp_v1.npz"}[method]
    data = {"scenes": "scene7", "icl": "icl_nuim"}.get(column, "modelnet40")
    unseen, noise = int(column == "categories"), int(column.startswith("jitter"))
    return f"cemnet_{data}_n768_unseen{unseen}_noise{noise}.npz"


def trained(method: str, runs: dict[str, str], hours: str | None) -> dict[str, record.Value]:
    """The label and the budget of a row that was trained here: a run, or weights with their card.

    Raises:
      ValueError: there is no checkpoint in the folder of the run, or one of another network.
    """
    if method in runs:
        config = best_config(runs[method])[0]
        steps = int(read_metrics(Path(runs[method]) / "metrics.jsonl")["step"][-1])
        if config.network != method:
            raise ValueError(f"--runs {method}={runs[method]}: that is a run of {config.network}.")
        batch, categories = config.train.batch, config.data.train_categories
    else:
        card = load_card(method)
        steps, batch = card["step"], card["config"]["train"]["batch"]
        categories = card["config"]["data"]["train_categories"]
    time = f", {float(hours):.3g} h" if hours else ""
    return {
        "label": f"{METHODS[method]}, trained here: {steps} steps of {batch} pairs{time}",
        "steps": steps,
        "pairs_seen": steps * batch,
        "hours": float(hours) if hours else None,
        "trained_on": categories,
    }


def row_of(method: str, options: Options) -> dict[str, record.Value]:
    """What a row has before anything is measured: its label, its budgets, the paper's figures."""
    runs, hours = named(options.runs, "runs"), named(options.hours, "hours")
    row: dict[str, record.Value] = {"label": METHODS[method]}
    if method in BUDGETS:
        row = {"label": f"{METHODS[method]}, not trained here", "budget": BUDGETS[method]}
    if method in TRAINABLE and name_of(method, "clean", "", runs):
        row |= trained(method, runs, hours.get(method))
    for column in options.only:
        found = printed.TABLES.get(COLUMNS[column].of_paper, {}).get(method)
        if found:
            row |= {paper_key(column, k): x for k, x in zip(PAPER_HEADS, found, strict=True)}
    return row


def paper_key(column: str, figure: str) -> str:
    """What the record calls a figure of the paper; MAE(R) of unseen objects is `paper`."""
    name = "paper" if figure == "mae_r" else f"paper_{figure}"
    return name if column == "clean" else f"{column}_{name}"


def column_config(column: str, root: Path | None) -> Config:
    """The pairs of a column; every network solves its Procrustes as its paper does."""
    chosen = COLUMNS[column]
    if chosen.of_paper:
        config = tables.column_config(columns.COLUMNS[chosen.of_paper], root)
    else:
        config = load_config(columns.CONFIGS / f"{chosen.config}.toml")
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
    config = column_config(column, root)
    try:
        scored = score.evaluate(config, root=root, method=name, pairs=options.pairs)
    except ValueError as error:  # Weights, data or a library that are not there.
        print(f"{method}, {COLUMNS[column].label}: left out: {error}", flush=True)
        return {}
    found = score.figures(scored)
    cell = {f"{column}_{key}": found[metric] for key, (metric, _) in FIGURES.items()}
    cell[f"{column}_ms"] = 1e3 * found["seconds_per_pair"]
    print(method, {key: float(f"{value:.3g}") for key, value in cell.items()}, flush=True)
    return cell


def heads_of(column: str) -> dict[str, str]:
    """The record's columns of a set of pairs: what the paper prints, if it does, and what was measured."""
    heads = {key: head for key, (_, head) in FIGURES.items()}
    of_paper = {paper_key(column, key): f"paper's {PAPER_HEADS[key]}" for key in PAPER_HEADS}
    found = {f"{column}_{key}": head for key, head in heads.items()}
    return (of_paper if COLUMNS[column].of_paper else {}) | found | {f"{column}_ms": "ms a pair"}


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
        question="What does the paper's whole table look like here?",
        command=record.command("benchmarks.paper.peers"),
        columns=columns_of(options),
        rows=rows,
        setting={"pairs": options.pairs},
    )


def show(rows: dict[str, dict], options: Options) -> None:
    """Print a table for every column: what the paper prints beside what was measured."""
    for column in options.only:
        print(f"\n{COLUMNS[column].label}, {options.pairs} pairs\n")
        print(render.table({"columns": heads_of(column), "rows": rows}))


def main(options: Options) -> None:
    """Evaluate all, print and write the table."""
    enable_compilation_cache()
    root = data_root(options.data_root, columns.CONFIGS / "any.toml")
    rows = {method: row_of(method, options) for method in METHODS}
    for column in options.only:
        for method in METHODS:
            rows[method] |= measure(method, column, options, root)
    show(rows, options)
    if options.record:
        print(write(rows, options))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
