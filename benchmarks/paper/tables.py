"""The paper's tables: every row that has weights, and the baselines, by one command.

    python -m benchmarks.paper.tables [--data-root DATA] [--rienet rie_modelnet.npz] [--only COLUMN ...]

Networks meet all pairs of a column, classical methods the first `--baseline-pairs`. A finished cell
leaves FOLDER/COLUMN-ROW.json and its transforms (.npz), and is not made again unless `--again`; the
tables are printed, and written to benchmarks/results/, from these files. "+ robust Procrustes" solves
every step's Procrustes again with less weight on pairs that it cannot explain (`--model.robust-rounds
3`); "+ icp" refines the poses of the first row (`--transforms FILE.npz --refine icp`; its seconds are
those of the refinement alone). Both leave the weights as they are.
"""

import concurrent.futures
import dataclasses
import json
import multiprocessing
import os
from pathlib import Path
from typing import Any, NamedTuple

import tyro

from benchmarks.paper import records
from benchmarks.paper.columns import (
    BASELINES,
    COLUMNS,
    CONFIGS,
    NETWORK,
    ROBUST_ROUNDS,
    Column,
)
from jaxreg.cli.process import enable_compilation_cache
from jaxreg.config import Config, load_config
from jaxreg.data import data_root, dataset_label
from jaxreg.evaluation import score


@dataclasses.dataclass(frozen=True)
class Options:
    """What to evaluate."""

    only: tuple[str, ...] = tuple(COLUMNS)
    rows: tuple[str, ...] = ()
    """Rows to make; none named is all. The table shows every row that is there."""
    folder: str = "runs/tables"
    pairs: int = 0
    """Pairs of the networks; 0 is all."""
    baseline_pairs: int = 256
    rienet: str = ""
    """NPZ file with RIENet's released weights."""
    rienet_pairs: int = 0
    again: bool = False
    jobs: int = 1
    """Columns at once, each on a core of its own (1: one after the other, on all cores)."""
    data_root: str = ""
    record: bool = True
    """Write the tables to benchmarks/results/."""


class Row(NamedTuple):
    """What to evaluate for one row of a column."""

    pairs: int
    method: str = ""
    """Of `methods.choose`; none is the released weights of the configuration."""
    robust_rounds: int = 0
    refine: str = ""
    start: str = ""
    """The row whose transforms are refined, which need not be made again."""


def column_config(column: Column, root: Path | None) -> Config:
    """The configuration of a column; a real test scene has one draw of each fragment."""
    config = load_config(CONFIGS / f"{column.config}.toml")
    stand_in = "stand-in" in dataset_label(config.data, root)
    data = dataclasses.replace(
        config.data,
        test_draws=column.draws if stand_in else 1,
        test_pairs_from="file" if column.from_file else "shapes",
    )
    iterations = column.iterations or config.model.iterations
    model = dataclasses.replace(config.model, iterations=iterations)
    return dataclasses.replace(config, data=data, model=model)


def rows(column: Column, options: Options) -> dict[str, Row]:
    """The rows of a column, by name."""
    plain, robust, refined = NETWORK
    of_network = {
        plain: Row(options.pairs),
        robust: Row(options.pairs, robust_rounds=ROBUST_ROUNDS),
        refined: Row(options.pairs, refine="icp", start=plain),
    }
    found = {name: of_network[name] for name in column.rows}
    if column.baselines:
        if options.rienet:
            found["rienet"] = Row(options.rienet_pairs, f"rienet:{options.rienet}")
        found |= {name: Row(options.baseline_pairs, x) for name, x in BASELINES.items()}
    return found


def evaluate(name: str, options: Options, root: Path | None) -> None:
    """Make the cells of a column that are missing."""
    column, folder = COLUMNS[name], Path(options.folder)
    config = column_config(column, root)
    for label, row in rows(column, options).items():
        path = _cell(folder, name, label)
        unwanted = options.rows and label not in options.rows
        if unwanted or (path.is_file() and not options.again):
            continue
        print(f"{name}: {label}", flush=True)
        try:
            result = make_cell(config, row, path, _cell(folder, name, row.start), root)
        except ValueError as error:  # Weights or a library that are not there.
            print(f"  left out: {error}")
            continue
        found = {"row": label, "config": column.config} | result
        path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def make_cell(
    config: Config, row: Row, path: Path, start: Path, root: Path | None
) -> dict[str, Any]:
    """The figures of a row; its transforms are left beside `path`."""
    model = dataclasses.replace(config.model, robust_rounds=row.robust_rounds)
    scored = score.evaluate(
        dataclasses.replace(config, model=model),
        root=root,
        method=row.method,
        transforms=str(start.with_suffix(".npz")) if row.start else "",
        refine=row.refine,
        pairs=row.pairs,
    )
    score.save_transforms(path.with_suffix(".npz"), scored.predicted)
    return score.figures(scored)


def _cell(folder: Path, column: str, row: str) -> Path:
    return folder / f"{column}-{''.join(c if c.isalnum() else '_' for c in row)}.json"


def read_cells(name: str, options: Options) -> dict[str, dict]:
    """The cells of a column that are there, by their rows."""
    paths = {
        row: _cell(Path(options.folder), name, row) for row in (*NETWORK, "rienet", *BASELINES)
    }
    found = {row: path for row, path in paths.items() if path.is_file()}
    return {row: json.loads(path.read_text(encoding="utf-8")) for row, path in found.items()}


def table(name: str, options: Options) -> str:
    """One column in Markdown, from the files of its cells."""
    cells = read_cells(name, options)
    head = ("row", "pairs", "MAE(R)", "MIE(R)", "printed MIE(R)", "median", "MAE(t)")
    head += ("recall 1 deg", "worst (pair)", "s / pair")
    lines = [head, ("---",) * len(head)]
    figures = ("mae_r_deg", "mie_r_deg", "mie_r_deg_float32_acos", "median_rre_deg", "mae_t")
    for row, r in cells.items():
        numbers = tuple(f"{r[key]:.3g}" for key in figures)
        worst = f"{r['worst_rre_deg']:.3g} ({r['worst_pair']})"
        ends = (f"{r['recall_1deg']:.4f}", worst, f"{r['seconds_per_pair']:.3f}")
        lines.append((BASELINES.get(row, row), str(r["pairs"]), *numbers, *ends))
    dataset = next(iter(cells.values()))["dataset"] if cells else "nothing evaluated"
    body = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    paper = COLUMNS[name].paper or "none"
    return f"\n{name} ({dataset}); the paper's MAE(R): {paper}\n\n{body}"


def evaluate_if_there(name: str, options: Options, root: Path | None) -> None:
    """`evaluate`, or a line that says which data is missing."""
    enable_compilation_cache()
    try:
        evaluate(name, options, root)
    except ValueError as error:
        print(f"{name} left out: {error}", flush=True)


def evaluate_side_by_side(options: Options, root: Path | None) -> None:
    """All columns, `options.jobs` at once, in processes that keep to one core each."""
    context = multiprocessing.get_context("spawn")
    cores = context.Queue()
    for job in range(options.jobs):
        cores.put(job)
    with concurrent.futures.ProcessPoolExecutor(
        options.jobs, context, initializer=_keep_to_one_core, initargs=(cores,)
    ) as pool:
        jobs = [pool.submit(evaluate_if_there, name, options, root) for name in options.only]
        for job in jobs:
            job.result()


def _keep_to_one_core(cores) -> None:
    # Before JAX or Open3D count the cores.
    if hasattr(os, "sched_setaffinity"):
        allowed = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {allowed[cores.get() % len(allowed)]})


def main(options: Options) -> None:
    """Evaluate what is missing, print all, write both records."""
    root = data_root(options.data_root, CONFIGS / "any.toml")
    Path(options.folder).mkdir(parents=True, exist_ok=True)
    if options.jobs > 1:
        evaluate_side_by_side(options, root)
    else:
        for name in options.only:
            evaluate_if_there(name, options, root)
    for name in options.only:
        print(table(name, options))
    if options.record:
        cells = {name: read_cells(name, options) for name in options.only}
        print(records.write_paper(cells, root), records.write_others(cells, options.baseline_pairs))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
