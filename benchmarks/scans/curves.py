"""Pairs that share no point, ever harder in one way: recall of any method, and pictures.

    python -m benchmarks.scans.curves --data-root DATA [--curves overlap] [--pictures docs/images]

Resampled clouds of 1024 points before the crop, in any rotation: with crops of their own that keep
less and less, with more and more jitter, or with a growing share of outliers. Everything else is as in
`benchmarks.scans.protocols`.
"""

import dataclasses
from pathlib import Path
from typing import Literal

import matplotlib.pyplot as plt
import numpy as np
import tyro

from benchmarks import record
from benchmarks.scans import protocols
from benchmarks.scans.protocols import LABELS, Found, Shapes, column_key
from jaxreg.cli.process import enable_compilation_cache
from jaxreg.config import PairConfig
from jaxreg.evaluation import methods

Curve = Literal["overlap", "jitter", "outliers"]

CURVES: dict[Curve, tuple[float, ...]] = {
    "overlap": (0.95, 0.85, 0.75, 0.65, 0.55, 0.45),
    "jitter": (0.0, 0.01, 0.02, 0.03, 0.04),
    "outliers": (0.0, 0.1, 0.2, 0.3, 0.4, 0.5),
}
AXES: dict[Curve, str] = {
    "overlap": "share of each cloud that its own crop keeps",
    "jitter": "standard deviation of the jitter (unit sphere)",
    "outliers": "share of outliers in each cloud",
}
BASE = PairConfig(points=1024, kept=768, sampling="disjoint")


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    methods: tuple[str, ...] = ("register_global", "open3d_ransac_icp", "open3d_fgr_gicp")
    """Names as of `jaxreg.evaluation.methods.choose`."""
    curves: tuple[Curve, ...] = tuple(CURVES)
    pairs: int = 64
    seed: int = 13
    per_category: int = 6
    pictures: str = ""
    """Draw every curve to CURVE.png in this folder."""
    data_root: str | None = None
    record: bool = True
    """Write the table to benchmarks/results/."""


def pairs_of(curve: Curve, hardness: float) -> PairConfig:
    """The pairs of one step of a curve."""
    match curve:
        case "overlap":
            kept = round(BASE.points * hardness)
            crop = {"crop": "half-space", "independent_crops": True}
            return dataclasses.replace(BASE, kept=kept, **crop)
        case "jitter":
            return dataclasses.replace(BASE, jitter=hardness, jitter_clip=5 * hardness)
        case "outliers":
            outliers = round(BASE.kept * hardness / (1 - hardness))
            return dataclasses.replace(BASE, outliers=outliers)


def key_and_label(curve: Curve, hardness: float) -> tuple[str, str]:
    """What the record calls a step, and what a reader sees."""
    percent = round(100 * hardness)
    match curve:
        case "overlap":
            return f"crops_{percent}", f"crops of {percent} %"
        case "outliers":
            return f"outliers_{percent:02d}", f"{percent} % outliers"
    return (
        ("full_overlap", "nearly full overlap")
        if percent == 0
        else (
            f"jitter_{percent:02d}",
            f"jitter {hardness:g}",
        )
    )


Steps = dict[tuple[str, Curve, float], Found]


def measure(shapes: Shapes, options: Options) -> Steps:
    """What every method finds at every step."""
    print("method, curve step: recall 1 deg / 5 deg (all categories), median processor time")
    result = {}
    for name in options.methods:
        method = methods.choose(name)
        for curve in options.curves:
            for hardness in CURVES[curve]:
                drawn = protocols.draw_pairs(
                    pairs_of(curve, hardness),
                    shapes,
                    pairs=options.pairs,
                    seed=options.seed,
                    turned=True,
                )
                found = protocols.run(method, drawn, shapes.categories)
                protocols.report(name, f"{curve} {hardness:g}", found)
                result[name, curve, hardness] = found
    return result


def write(steps: Steps, options: Options) -> Path:
    """The record `curves`: a row a step."""
    rows: dict[str, dict] = {}
    for (name, curve, hardness), found in steps.items():
        key, label = key_and_label(curve, hardness)
        rows.setdefault(key, {"label": label})
        rows[key] |= {f"{column_key(name)}_{d}deg": found.recall(d) for d in (5, 1)}
        rows[key][f"{column_key(name)}_ms"] = float(np.median(found.milliseconds))
    kept = int(np.sum(~next(iter(steps.values())).symmetric))
    return record.write(
        "curves",
        question="And as they become harder, beside the classical pipelines?",
        command=record.command("benchmarks.scans.curves"),
        columns={
            f"{column_key(name)}_{figure}": f"{LABELS.get(name, name)}: {head}"
            for name in options.methods
            for figure, head in (("5deg", "5 deg"), ("1deg", "1 deg"), ("ms", "processor ms"))
        },
        rows=rows,
        setting={"pairs": options.pairs, "kept": kept},
        note="Recall without the rotation-symmetric categories.",
    )


def draw(steps: Steps, curve: Curve, path: Path) -> None:
    """Recall at 5 degrees over the hardness, a line for every method."""
    figure, axes = plt.subplots(figsize=(5, 3.5), layout="constrained")
    for name in dict.fromkeys(name for name, _, _ in steps):
        recall = [steps[name, curve, hardness].recall(5) for hardness in CURVES[curve]]
        axes.plot(CURVES[curve], recall, marker="o", label=LABELS.get(name, name).strip("`"))
    axes.set(xlabel=AXES[curve], ylabel="recall (5°, 0.1)", ylim=(0, 1.02))
    if curve == "overlap":
        axes.invert_xaxis()
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(options: Options) -> None:
    """Print a line for every method and step; write the table, and the pictures if asked."""
    enable_compilation_cache()
    shapes = protocols.read_shapes(options.data_root, options.per_category)
    steps = measure(shapes, options)
    for curve in options.curves if options.pictures else ():
        draw(steps, curve, Path(options.pictures) / f"{curve}.png")
    if options.record:
        print(write(steps, options))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
