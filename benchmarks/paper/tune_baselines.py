"""The spacing that each Open3D baseline does best with, on pairs of held-out *training* shapes.

    python -m benchmarks.paper.tune_baselines [--outliers 200] [--pairs 48] [--data-root DATA]

All lengths of a baseline derive from `spacing` (see jaxreg/evaluation/baselines/open3d.py), so that
this one number is what there is to tune. Prints MAE(R), median and recall of every method and spacing.
"""

import dataclasses
from pathlib import Path

import numpy as np
import tyro

from benchmarks import record
from jaxreg.config import DataConfig, PairConfig
from jaxreg.data import data_root, load_shapes
from jaxreg.data.batches import pair_batches, validation_key
from jaxreg.evaluation import methods, metrics, run

METHODS = {
    "open3d_icp": ("icp", "ICP"),
    "open3d_icp_coarse_to_fine": ("icp_coarse_to_fine", "ICP, coarse to fine"),
    "open3d_fgr": ("fgr", "FGR"),
    "open3d_fgr_gicp": ("fgr_gicp", "FGR + GICP"),
    "open3d_fpfh_ransac": ("ransac", "FPFH + RANSAC"),
    "open3d_ransac_gicp": ("ransac_gicp", "RANSAC + GICP"),
}
"""Methods, with the names of their rows in the record and what a reader sees."""
DEFAULT = 0.05


@dataclasses.dataclass(frozen=True)
class Options:
    """What to try."""

    methods: tuple[str, ...] = tuple(METHODS)
    spacings: tuple[float, ...] = (0.02, 0.035, DEFAULT, 0.07, 0.1)
    outliers: int = 0
    pairs: int = 48
    data_root: str = ""
    record: bool = True
    """Write the table to benchmarks/results/."""


def evaluate(name: str, spacing: float, shapes: np.ndarray, outliers: int) -> dict:
    """The figures of a method with a spacing, on the same pairs for all."""
    config = PairConfig(outliers=outliers)
    batches = pair_batches(shapes, validation_key(0), config=config, batch=8)
    method = methods.choose(f"{name}@{spacing:g}").batch
    predicted, truth, seconds = run.evaluate_method(method, batches)
    found = metrics.evaluate_transforms(predicted, truth)
    print(
        f"{name}, spacing {spacing:g}: MAE(R) {found['mae_r_deg']:.3g}, median "
        f"{found['median_rre_deg']:.3g}, recall 1 deg {found['recall_1deg']:.3f}, "
        f"{1e3 * seconds:.0f} ms",
        flush=True,
    )
    return found


def write(found: dict[tuple[str, float], dict], options: Options) -> Path:
    """The record `tune_baselines`: a row a method, two columns a spacing."""
    decimals = {spacing: f"{spacing:.3f}".partition(".")[2] for spacing in options.spacings}
    keys = {x: f"s{text[:2] if text.endswith('0') else text}" for x, text in decimals.items()}
    rows: dict[str, dict] = {}
    for (name, spacing), figures in found.items():
        key, label = METHODS.get(name, (record.key(name), name))
        row = rows.setdefault(key, {"label": label})
        row[f"{keys[spacing]}_mae_r"] = figures["mae_r_deg"]
        row[f"{keys[spacing]}_recall"] = figures["recall_1deg"]
    heads = {"mae_r": "MAE(R)", "recall": "recall 1 deg"}
    names = {x: f"{x:g}{' (default)' if x == DEFAULT else ''}" for x in options.spacings}
    return record.write(
        "tune_baselines",
        question="Which spacing suits Open3D's methods on training shapes?",
        command=record.command("benchmarks.paper.tune_baselines"),
        columns={
            f"{keys[spacing]}_{k}": f"{names[spacing]}: {head}"
            for spacing in options.spacings
            for k, head in heads.items()
        },
        rows=rows,
        setting={"pairs": options.pairs, "outliers": options.outliers},
    )


def main(options: Options) -> None:
    """Print a line for every method and spacing, and write the table."""
    root = data_root(options.data_root, Path(__file__).parents[2] / "configs" / "any.toml")
    shapes, _ = load_shapes(DataConfig(), "validation", root=root, points=1024)
    shapes = shapes[: options.pairs]
    found = {
        (name, spacing): evaluate(name, spacing, shapes, options.outliers)
        for name in options.methods
        for spacing in options.spacings
    }
    if options.record:
        print(write(found, options))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
