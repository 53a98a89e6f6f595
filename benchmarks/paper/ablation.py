"""The paper's ablation and the readings where it is silent, at one small budget each.

    python -m benchmarks.paper.ablation --workdir runs/ablation [--seeds 3] [--data-root DATA]
    python -m benchmarks.paper.ablation --workdir runs/ablation_posed --protocol posed --steps 200

Every row differs from the full method in the fields that `ROWS` names, nothing else. `resampled`
trains and tests on pairs that share no point, with the distance to the true pose as a further loss
(`loss.pose`), since the four losses alone hardly move there; `posed` leaves the four out. Runs are
made seed by seed, so that the first seed of all rows is there first. A finished run leaves
WORKDIR/ROW-SEED.json and is not made again; an unfinished one goes on. The table holds the mean over
the seeds and the range from the lowest to the highest.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

import jax
import tyro
from flax.traverse_util import flatten_dict, unflatten_dict

from jaxreg.cli.process import enable_compilation_cache
from jaxreg.config import Config, from_dict, load_config, to_dict
from jaxreg.data import data_root
from jaxreg.evaluation import score
from jaxreg.training import train

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
FULL = {
    "model.angles": "all",
    "model.n_inliers": 64,
    "pairs.points": 256,
    "pairs.kept": 192,
}
"""Of the configuration for unseen objects, what a small budget changes, the size of the crops; and the
angles, which became `next` by this ablation."""
TEST = {"points": 512, "kept": 384}
ROWS: dict[str, dict[str, Any]] = {
    "full": {},
    "without geometric invariants": {
        "model.edge": "coordinates",
        "model.angles": "none",
        "loss.rho": 0.0,  # L_gs compares what this row does without (the paper's remark).
    },
    "without 1-NN": {"model.one_nn": "none"},
    "without L_gc": {"loss.global_consistency": 0.0},
    "without L_in": {"loss.gamma": 0.0},
    "without L_gs": {"loss.rho": 0.0},
    "without L_sc": {"loss.lambda_": 0.0},
    "1-NN: self (control)": {"model.one_nn": "self"},
    "1-NN: own": {"model.one_nn": "own"},
    "angles: next": {"model.angles": "next"},
    "edges: length": {"model.edge": "length"},
    "Procrustes: all": {"model.svd": "all"},
    "L_sc on F": {"loss.l_sc": "F"},
    "L_in squared": {"loss.l_in": "squared"},
    "RIENet": {
        # Its k of 5 counts the point itself.
        "model.k": 4,
        "model.k_matching": 4,
        "model.include_self": True,
        "model.one_nn": "none",
        "model.angles": "none",
        "model.inlier_network": "rienet",
        "model.svd": "all",
        "loss.rho": 0.0,
        "loss.l_in": "squared",
        "loss.l_sc": "F",
    },
}
_RESAMPLED = {
    "pairs.sampling": "disjoint",
    "test_pairs.sampling": "disjoint",
    "loss.pose": 1.0,
}
PROTOCOLS: dict[str, dict[str, Any]] = {
    "copies": {},
    "resampled": _RESAMPLED,
    "posed": _RESAMPLED
    | {
        "loss.global_consistency": 0.0,
        "loss.gamma": 0.0,
        "loss.rho": 0.0,
        "loss.lambda_": 0.0,
    },
}
COLUMNS = {"clean": "modelnet40_unseen_objects", "100 outliers": "modelnet40_gaussian_noise"}
FIGURES = {
    "copies": ("mae_r_deg", "recall_1deg", "worst_rre_deg"),
    "resampled": ("mae_r_deg", "median_rre_deg", "recall_5deg"),
    "posed": ("mae_r_deg", "median_rre_deg", "recall_5deg"),
}


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    workdir: str = "runs/ablation"
    seeds: int = 3
    protocol: Literal["copies", "resampled", "posed"] = "copies"
    """Clouds of the same points, or of two samplings of the surface with the distance to the true pose
    as a further loss (`resampled`) or as the only one (`posed`)."""
    steps: int = 120
    pairs: int = 64
    """Test pairs of each column."""
    rows: tuple[str, ...] = tuple(ROWS)
    data_root: str = ""
    table_only: bool = False
    """Print the table of the runs that are there."""


def row_config(row: str, seed: int, steps: int, protocol: str = "copies") -> Config:
    """The configuration that a row is trained with: validated once, at its end."""
    base = flatten_dict(to_dict(load_config(CONFIGS / f"{COLUMNS['clean']}.toml")), sep=".")
    small = {f"test_pairs.{name}": value for name, value in TEST.items()}
    budget = {"train.steps": steps, "train.validate_every": steps, "train.validation_pairs": 8}
    return from_dict(
        unflatten_dict(
            base | FULL | budget | {"train.seed": seed} | small | PROTOCOLS[protocol] | ROWS[row],
            sep=".",
        )
    )


def evaluate(
    workdir: Path, root: Path | None, pairs: int, protocol: str
) -> dict[str, dict[str, float]]:
    """The figures of a trained run in every column, with the iterations it was trained with."""
    figures = {}
    for column, name in COLUMNS.items():
        config = load_config(CONFIGS / f"{name}.toml")
        test_pairs = dataclasses.replace(config.test_pairs, **TEST)
        if test_pairs.outliers:
            test_pairs = dataclasses.replace(test_pairs, outliers=100)
        if protocol != "copies":
            test_pairs = dataclasses.replace(test_pairs, sampling="disjoint")
        model = dataclasses.replace(Config().model, n_inliers=128)
        config = dataclasses.replace(config, model=model, test_pairs=test_pairs)
        result = score.score(config, root=root, checkpoint=str(workdir), pairs=pairs)
        figures[column] = {key: result[key] for key in FIGURES[protocol]}
    return figures


def run(row: str, seed: int, options: Options, root: Path | None) -> None:
    """Train and evaluate one row with one seed, unless its JSON file is there."""
    name = "".join(c if c.isalnum() else "_" for c in row)
    workdir = Path(options.workdir) / f"{name}-{seed}"
    record = workdir.with_suffix(".json")
    if record.is_file():
        return
    print(f"{row}, seed {seed}", flush=True)
    train(row_config(row, seed, options.steps, options.protocol), workdir, root=root)
    content = {
        "row": row,
        "seed": seed,
        "steps": options.steps,
        "pairs": options.pairs,
        "figures": evaluate(workdir, root, options.pairs, options.protocol),
    }
    record.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    # Programs of some twenty runs fill the table of memory maps of a process, and LLVM ends it.
    jax.clear_caches()


def table(options: Options) -> str:
    """Markdown: mean over the seeds, and lowest to highest where there are several."""
    records = [json.loads(path.read_text("utf-8")) for path in Path(options.workdir).glob("*.json")]
    columns = [(column, figure) for column in COLUMNS for figure in FIGURES[options.protocol]]
    head = ["row", "seeds", *(f"{figure}, {column}" for column, figure in columns)]
    lines = [head, ["---"] * len(head)]
    for row in ROWS:
        found = [record for record in records if record["row"] == row]
        if not found:
            continue
        cells = [row, str(len(found))]
        for column, figure in columns:
            values = [record["figures"][column][figure] for record in found]
            spread = f" ({min(values):.2g} to {max(values):.2g})" if len(values) > 1 else ""
            cells.append(f"{sum(values) / len(values):.3g}{spread}")
        lines.append(cells)
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    """Make the runs that are missing, print the table."""
    options = tyro.cli(Options, description=__doc__)
    enable_compilation_cache()
    root = data_root(options.data_root, CONFIGS / "any.toml")
    if not options.table_only:
        for seed in range(options.seeds):
            for row in options.rows:
                run(row, seed, options, root)
    print(table(options))


if __name__ == "__main__":
    main()
