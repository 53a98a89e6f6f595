"""The paper's tables: every row that has weights, and the baselines, by one command.

    python -m benchmarks.paper.tables [--data-root DATA] [--rienet rie_modelnet.npz] [--only COLUMN ...]

Networks meet all pairs of a column, classical methods the first `--baseline-pairs`. A finished cell
leaves FOLDER/COLUMN-ROW.json and its transforms (.npz), and is not made again unless `--again`; the
tables are printed from these files. "+ robust Procrustes" solves every step's Procrustes again with
less weight on pairs that it cannot explain (`--model.robust-rounds 3`); "+ icp" refines the poses of
the first row (`--transforms FILE.npz --refine icp`; its seconds are those of the refinement alone).
Both leave the weights as they are.
"""

import concurrent.futures
import dataclasses
import json
import multiprocessing
import os
from pathlib import Path
from typing import Any, NamedTuple

import tyro

from jaxreg.cli.process import enable_compilation_cache
from jaxreg.config import Config, load_config
from jaxreg.data import data_root
from jaxreg.evaluation import score

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
BASELINES = (
    "identity",
    "icp",
    "open3d_icp",
    "open3d_icp_coarse_to_fine@0.07",
    "open3d_fgr",
    "open3d_fgr_gicp",
    "open3d_fgr_gicp@0.02",
    "open3d_fpfh_ransac",
    "open3d_ransac_gicp@0.02",
    "small_gicp",
)
"""As usually run, and with the spacing (`@`) that tune_baselines.py finds best on training shapes."""


class Column(NamedTuple):
    """One set of test pairs: a file in configs/, what deviates from it, the paper's MAE(R)."""

    config: str
    paper: str
    draws: int = 1
    from_file: bool = False
    baselines: bool = True


COLUMNS = {
    "unseen_objects": Column("modelnet40_unseen_objects", "0.0006"),
    "unseen_categories": Column("modelnet40_unseen_categories", "0.0007"),
    "gaussian_noise": Column("modelnet40_gaussian_noise", "0.0006"),
    "seven_scenes": Column("seven_scenes", "0.0036 on office", draws=64),
    "icl_nuim": Column("icl_nuim", "0.0005 on ICL-NUIM"),
    "icl_nuim_given_pairs": Column("icl_nuim", "none", from_file=True),
    "unseen_objects_717": Column("modelnet40_unseen_objects_717", "none", baselines=False),
}


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
    predecessor_pairs: int = 0
    again: bool = False
    jobs: int = 1
    """Columns at once, each on a core of its own (1: one after the other, on all cores)."""
    data_root: str = ""


def column_config(column: Column, root: Path | None) -> Config:
    """The configuration of a column; a real test scene has one draw of each fragment."""
    config = load_config(CONFIGS / f"{column.config}.toml")
    stand_in = "stand-in" in score.dataset_label(config.data, root)
    data = dataclasses.replace(
        config.data,
        test_draws=column.draws if stand_in else 1,
        test_pairs_from="file" if column.from_file else "shapes",
    )
    return dataclasses.replace(config, data=data)


def rows(column: Column, options: Options) -> dict[str, dict[str, Any]]:
    """The rows of a column, by name, as options of `scoring.score`."""
    found = {
        "jaxreg": {"pairs": options.pairs},
        "jaxreg + robust Procrustes": {"pairs": options.pairs, "rounds": 3},
        # From the transforms of the first row, which need not be made again.
        "jaxreg + icp": {"pairs": options.pairs, "refine": "icp", "start": "jaxreg"},
    }
    if options.rienet:
        chosen = {"rienet": options.rienet, "pairs": options.rienet_pairs}
        found["predecessor's weights"] = chosen
    if column.baselines:
        for method in BASELINES:
            found[method] = {"method": method, "pairs": options.baseline_pairs}
    return found


def evaluate(name: str, options: Options, root: Path | None) -> None:
    """Make the cells of a column that are missing."""
    column, folder = COLUMNS[name], Path(options.folder)
    config = column_config(column, root)
    for row, chosen in rows(column, options).items():
        model = dataclasses.replace(config.model, robust_rounds=chosen.pop("rounds", 0))
        path = _cell(folder, name, row)
        if start := chosen.pop("start", ""):
            chosen["transforms"] = str(_cell(folder, name, start).with_suffix(".npz"))
        unwanted = options.rows and row not in options.rows
        if unwanted or (path.is_file() and not options.again):
            continue
        print(f"{name}: {row}", flush=True)
        try:
            result = score.score(
                dataclasses.replace(config, model=model),
                root=root,
                save_transforms=str(path.with_suffix(".npz")),
                **chosen,
            )
        except ValueError as error:  # Weights or a library that are not there.
            print(f"  left out: {error}")
            continue
        path.write_text(json.dumps({"row": row, "config": column.config} | result, indent=1) + "\n")


def _cell(folder: Path, column: str, row: str) -> Path:
    return folder / f"{column}-{''.join(c if c.isalnum() else '_' for c in row)}.json"


def table(name: str, options: Options) -> str:
    """One column in Markdown, from the files of its cells."""
    files = sorted(Path(options.folder).glob(f"{name}-*.json"))
    results = {r["row"]: r for r in (json.loads(path.read_text("utf-8")) for path in files)}
    order = rows(COLUMNS[name], dataclasses.replace(options, rienet="x"))
    head = ("row", "pairs", "MAE(R)", "MIE(R)", "printed MIE(R)", "median", "MAE(t)")
    head += ("recall 1 deg", "worst (pair)", "s / pair")
    lines = [head, ("---",) * len(head)]
    for row in order:
        if r := results.get(row):
            figures = (
                "mae_r_deg",
                "mie_r_deg",
                "mie_r_deg_float32_acos",
                "median_rre_deg",
                "mae_t",
            )
            numbers = tuple(f"{r[key]:.3g}" for key in figures)
            worst = f"{r['worst_rre_deg']:.3g} ({r['worst_pair']})"
            ends = (f"{r['recall_1deg']:.4f}", worst, f"{r['seconds_per_pair']:.3f}")
            lines.append((row, str(r["pairs"]), *numbers, *ends))
    dataset = next(iter(results.values()))["dataset"] if results else "nothing evaluated"
    body = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"\n{name} ({dataset}); the paper's MAE(R): {COLUMNS[name].paper}\n\n{body}"


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


def main() -> None:
    """Evaluate what is missing, print all."""
    options = tyro.cli(Options, description=__doc__)
    root = data_root(options.data_root, CONFIGS / "any.toml")
    Path(options.folder).mkdir(parents=True, exist_ok=True)
    if options.jobs > 1:
        evaluate_side_by_side(options, root)
    else:
        for name in options.only:
            evaluate_if_there(name, options, root)
    for name in options.only:
        print(table(name, options))


if __name__ == "__main__":
    main()
