"""The spacing that each Open3D baseline does best with, on pairs of held-out *training* shapes.

    python -m benchmarks.paper.tune_baselines [--outliers 200] [--pairs 64] [--data-root DATA]

All lengths of a baseline derive from `spacing` (see jaxreg/classical/open3d.py), so that
this one number is what there is to tune. Prints MAE(R), median and recall of every method and spacing.
"""

import dataclasses
import functools
from pathlib import Path

import tyro

from jaxreg.config import DataConfig, PairConfig
from jaxreg.data import data_root, load_shapes
from jaxreg.data.batches import pair_batches, validation_key
from jaxreg.evaluation import methods, metrics, run
from jaxreg.evaluation.baselines import open3d

METHODS = ("icp", "icp_coarse_to_fine", "fgr", "fgr_gicp", "fpfh_ransac", "ransac_gicp")


@dataclasses.dataclass(frozen=True)
class Options:
    """What to try."""

    methods: tuple[str, ...] = METHODS
    spacings: tuple[float, ...] = (0.02, 0.035, 0.05, 0.07, 0.1)
    outliers: int = 0
    pairs: int = 64
    data_root: str = ""


def main() -> None:
    """Print a line for every method and spacing."""
    options = tyro.cli(Options, description=__doc__)
    root = data_root(options.data_root, Path(__file__).parents[2] / "configs" / "any.toml")
    shapes, _ = load_shapes(DataConfig(), "validation", root=root, points=1024)
    config = PairConfig(outliers=options.outliers)
    for name in options.methods:
        for spacing in options.spacings:
            function = functools.partial(getattr(open3d, name), spacing=spacing)
            batches = pair_batches(
                shapes[: options.pairs], validation_key(0), config=config, batch=8
            )
            method = methods.host_method(function)
            predicted, truth, seconds = run.evaluate_method(method, batches)
            found = metrics.evaluate_transforms(predicted, truth)
            print(
                f"{name}, spacing {spacing:g}: MAE(R) {found['mae_r_deg']:.3g}, median "
                f"{found['median_rre_deg']:.3g}, recall 1 deg {found['recall_1deg']:.3f}, "
                f"{1e3 * seconds:.0f} ms",
                flush=True,
            )


if __name__ == "__main__":
    main()
