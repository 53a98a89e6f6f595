"""Every picture of the documentation, from procedural shapes and the released weights.

    python -m benchmarks.figures [--folder docs/images] [--only pairs noise ... reliability pair_choice]
    python -m benchmarks.figures --only drift --runs runs/drift_default runs/drift_batch4 ...

`pairs` and `noise`: pairs before and after, with the inlier confidence as colour. `matches`: the
best match of points at the first step with the 1-NN cloud, with every point in the place of its own
1-NN, and with a single neighbourhood, all with the same weights. `arccos`: the published form of
MIE(R) beside the true angle. `search`: the stages of the search. `reliability`: how often poses of a
given probability are right, as benchmarks/results/reliability.json says. `pair_choice`: what trying the
likeliest pairs alone costs and finds, of pair_choice.json there. `drift`: validation errors of runs of train.py.
"""

import dataclasses
import json
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from benchmarks import record
from benchmarks.search_figure import draw_search
from jaxreg.cli.process import enable_compilation_cache
from jaxreg.config import ModelConfig, PairConfig
from jaxreg.data.batches import key_of_tests, pair_batches
from jaxreg.data.pairs import make_pair
from jaxreg.data.procedural import shapes
from jaxreg.evaluation import methods, metrics, run
from jaxreg.geometry import rigid
from jaxreg.io.log import read_metrics
from jaxreg.network.matching import feature_distance, matching_maps, neighborhood_sum
from jaxreg.network.model import iterate, neighborhood_graph, point_features
from jaxreg.types import Pair
from jaxreg.view import pictures
from jaxreg.weights.released import load_pretrained

CLEAN = PairConfig(points=1024, kept=768)
NOISY = dataclasses.replace(CLEAN, outliers=200)
VIEW = (20.0, -60.0)
FAMILIES = shapes.families()
FIRST = 1000 * len(FAMILIES)  # Of the shapes drawn: index FIRST + i is of family i.
GREEN, RED = "#1f9d55", "#d23c3c"


@dataclasses.dataclass(frozen=True)
class Options:
    """Which pictures, and where to."""

    folder: str = "docs/images"
    only: tuple[str, ...] = (
        "pairs",
        "noise",
        "matches",
        "arccos",
        "search",
        "reliability",
        "pair_choice",
    )
    weights: str = "modelnet40"
    seed: int = 0
    runs: tuple[str, ...] = ()


class Registered(NamedTuple):
    """A pair (numpy), and what the network makes of it."""

    pair: Pair
    aligned: np.ndarray
    confidence: np.ndarray
    error_deg: float


def sample_pair(index: int, config: PairConfig, seed: int) -> Pair:
    shape = shapes.sample_shape(seed, FIRST + index, points=config.points)
    return make_pair(jax.random.fold_in(jax.random.key(seed), index), jnp.asarray(shape), config)


def register(pairs: list[Pair], weights: str, model: ModelConfig | None = None) -> list[Registered]:
    variables, config = load_pretrained(weights)
    one = jax.jit(
        lambda s, r: iterate(
            variables, s, r, config=model or config.model, observe=lambda step, _: step.confidence
        )[:2]
    )
    done = []
    for pair in pairs:
        (rotation, translation), confidence = jax.tree.map(
            np.asarray, one(pair.source, pair.reference)
        )
        pair = jax.tree.map(np.asarray, pair)
        error = rigid.rotation_angle_deg(rotation[None], pair.transform.rotation[None])[0]
        aligned = pair.source.points @ rotation.T + translation
        done.append(Registered(pair, aligned, confidence[-1], float(error)))
    return done


def draw_pairs(registered: list[Registered], names: list[str], path: Path, title: str) -> None:
    """A row a pair: before, after, and the aligned source with its confidence as colour."""
    figure = Figure(figsize=(10.5, 3.3 * len(registered)), layout="constrained")
    grid = figure.subplots(len(registered), 3, squeeze=False)
    for row, item, name in zip(grid, registered, names, strict=True):
        reference = (item.pair.reference.points, to_rgb(pictures.REFERENCE))
        colors = colormaps["viridis"](item.confidence)[:, :3]
        panels = (
            [reference, (item.pair.source.points, to_rgb(pictures.SOURCE))],
            [reference, (item.aligned, to_rgb(pictures.ALIGNED))],
            [(item.aligned, colors)],
        )
        everything = np.concatenate(
            [item.pair.source.points, item.pair.reference.points, item.aligned]
        )
        for axes, clouds in zip(row, panels, strict=True):
            pictures.draw_clouds(axes, clouds, VIEW, pictures.project(everything, VIEW))
        row[0].set_title(f"{name}: before", fontsize=10)
        row[1].set_title(f"after: {item.error_deg:.1e} deg", fontsize=10)
        row[2].set_title("inlier confidence", fontsize=10)
    bar = figure.colorbar(ScalarMappable(cmap="viridis"), ax=grid[:, 2], shrink=0.5)
    bar.set_label("confidence w")
    figure.suptitle(title, fontsize=11)
    figure.savefig(path, dpi=90, facecolor="white")


def best_matches(pair: Pair, weights: str, one_nn: str) -> tuple[np.ndarray, np.ndarray]:
    """The column of the largest entry of F for every source point, and whether it is its copy."""
    variables, config = load_pretrained(weights)
    graphs = [neighborhood_graph(cloud, config.model) for cloud in (pair.source, pair.reference)]
    features = [
        point_features(variables, cloud.points, graph, cloud.mask, config=config.model)[0]
        for cloud, graph in zip((pair.source, pair.reference), graphs, strict=True)
    ]
    distance = feature_distance(*features)
    nearest = {
        "gather": lambda: neighborhood_sum(distance, graphs[0].nearest, graphs[1].nearest),
        "self": lambda: distance,
        "none": lambda: None,
    }[one_nn]()
    maps = matching_maps(
        distance, nearest, graphs[0].matching, graphs[1].matching, alpha=config.model.alpha
    )
    column = np.asarray(maps.final).argmax(axis=1)
    moved = np.asarray(pair.source.points) @ np.asarray(pair.transform.rotation).T
    moved = moved + np.asarray(pair.transform.translation)
    error = np.linalg.norm(moved - np.asarray(pair.reference.points)[column], axis=1)
    return column, error < 1e-4


def draw_matches(options: Options, path: Path) -> None:
    """Lines from source points to their best matches: green is the copy of the point, red is not."""
    pair = sample_pair(FAMILIES.index("chair"), NOISY, options.seed)
    source, reference = (np.asarray(c.points)[:768] for c in (pair.source, pair.reference))
    labels = {
        "gather": "1-NN cloud (i != m)",
        "self": "control: each point its own 1-NN",
        "none": "single neighbourhood",
    }
    truth = jax.tree.map(np.asarray, pair.transform)
    moved = source @ truth.rotation.T + truth.translation
    copied = np.mean(cKDTree(reference).query(moved)[0] < 1e-4)
    figure = Figure(figsize=(13.5, 4.4), layout="constrained")
    chosen = np.random.default_rng(options.seed).choice(768, 150, replace=False)
    left, right, every = (
        pictures.project(np.asarray(points), VIEW)[:, :2]
        for points in (source, reference, pair.reference.points)
    )
    apart = [np.ptp(left[:, 0]) / 2 + np.ptp(right[:, 0]) / 2 + 0.3, 0]
    apart += left.mean(axis=0) - right.mean(axis=0)
    right, every = right + apart, every + apart
    for axes, (one_nn, label) in zip(figure.subplots(1, 3), labels.items(), strict=True):
        column, good = best_matches(pair, options.weights, one_nn)
        ends = np.stack([left, every[column[:768]]], axis=1)
        for right_ones, color, width in ((True, GREEN, 0.3), (False, RED, 0.7)):
            mine = chosen[good[chosen] == right_ones]
            axes.add_collection(LineCollection(ends[mine], colors=color, linewidths=width))
        axes.scatter(*left.T, s=2, color=pictures.SOURCE)
        axes.scatter(*right.T, s=2, color=pictures.REFERENCE)
        axes.set(xticks=[], yticks=[], aspect="equal")
        axes.set_title(
            f"{label}\n{good[:768].mean():.1%} of 768 points find their copy", fontsize=10
        )
        axes.spines[:].set_visible(False)
    figure.suptitle(
        "Best matches at the first step, 200 outliers in each cloud (150 points drawn). "
        f"{copied:.1%} of the points have a copy.",
        fontsize=11,
    )
    figure.savefig(path, dpi=90, facecolor="white")


def draw_arccos(options: Options, path: Path, count: int = 128) -> None:
    """The published MIE(R) of single pairs over their true angle."""
    variables, config = load_pretrained(options.weights)
    clouds = np.stack(
        [shapes.sample_shape(options.seed, FIRST + i, points=1024) for i in range(count)]
    )
    batches = pair_batches(clouds, key_of_tests(options.seed), config=CLEAN, batch=8)
    method = methods.network_method(variables, config.model)
    predicted, truth, _ = run.evaluate_method(method, batches)
    errors = metrics.pair_errors(predicted, truth)
    figure = Figure(figsize=(7.5, 4.6), layout="constrained")
    axes = figure.subplots()
    line = np.geomspace(1e-6, 1, 200)
    axes.plot(line, line, color="black", lw=0.8, label="what an exact metric would print")
    axes.plot(
        errors.rre_deg, errors.rre_deg_float32_acos, ".", color=pictures.SOURCE, label="pairs"
    )
    cosine = 1 - 2.0**-23 * np.arange(1, 19)  # Half the spacing of float32 traces next to 3.
    for angle in np.degrees(np.arccos(cosine)):
        axes.axhline(angle, color="0.85", lw=0.8, zorder=0)
    true, printed = errors.rre_deg.mean(), errors.rre_deg_float32_acos.mean()
    axes.set(
        xscale="log",
        xlim=(1e-6, 1),
        ylim=(-0.005, 0.12),
        xlabel="true angle: 2 asin(|R1 - R2| / (2 sqrt 2)) in float64, degrees",
        ylabel="printed: arccos((trace - 1) / 2) in float32, degrees",
        title=f"{count} pairs: true mean {true:.1e} deg, printed mean {printed:.1e} deg\n"
        "grey: the angles that a float32 trace next to 3 can say",
    )
    axes.legend(frameon=False, loc="upper left")
    figure.savefig(path, dpi=90, facecolor="white")


def draw_drift(options: Options, path: Path) -> None:
    """Training loss and validation error over the steps, a line a run."""
    figure = Figure(figsize=(12, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for folder in options.runs:
        columns = read_metrics(Path(folder) / "metrics.jsonl")
        label, error = Path(folder).name, columns["val_mie_r_deg"]
        smooth = np.convolve(columns["loss"], np.ones(25) / 25, mode="valid")
        left.plot(columns["step"][12 : 12 + len(smooth)], smooth, label=label, lw=1)
        known = np.isfinite(error)
        right.plot(columns["step"][known], error[known], ".-", label=label, lw=1)
    left.set(title="training loss (mean of 25 steps)", xlabel="step", yscale="log")
    right.set(title="validation MIE(R), degrees", xlabel="step", yscale="log")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    right.legend(frameon=False)
    figure.savefig(path, dpi=90, facecolor="white")


def draw_reliability(path: Path) -> None:
    """Share of right poses over their probability, a point a bin, its area by the pairs in it."""
    found = json.loads((record.FOLDER / "reliability.json").read_text("utf-8"))
    rows = [row for row in found["rows"].values() if row["pairs"]]
    chance, right, pairs = (
        np.array([row[key] for row in rows]) for key in ("probability", "right", "pairs")
    )
    deviation = np.sqrt(np.maximum(chance * (1 - chance), 1e-4) / pairs)
    figure = Figure(figsize=(5.6, 5.2), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="black", lw=0.8, label="what was promised")
    axes.errorbar(chance, right, deviation, fmt="none", color="0.6", lw=1, label="one deviation")
    axes.scatter(chance, right, s=8 + 2 * pairs, color=pictures.SOURCE, alpha=0.8, zorder=3)
    for x, y, count in zip(chance, right, pairs, strict=True):
        axes.annotate(f"{count}", (x, y), (0, 11), textcoords="offset points", ha="center", size=8)
    axes.set(
        xlim=(-0.05, 1.05),
        ylim=(-0.05, 1.1),
        aspect="equal",
        xlabel="probability given by jaxreg.register",
        ylabel="share of these poses that are right",
        title=f"{found['setting']['pairs']} pairs of real scans (number of pairs at each point)",
    )
    axes.title.set_size(10)
    axes.legend(frameon=False, loc="upper left")
    figure.savefig(path, dpi=90, facecolor="white")


def draw_pair_choice(path: Path) -> None:
    """Share of the overlapping pairs that are tried over the share of all pairs that are tried."""
    found = json.loads((record.FOLDER / "pair_choice.json").read_text("utf-8"))
    figure = Figure(figsize=(6.4, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="black", lw=0.8, label="chosen at random")
    for key, heading in found["columns"].items():
        if key.endswith("_cost"):
            name, rows = key.removesuffix("_cost"), found["rows"].values()
            cost, recall = ([row[f"{name}_{what}"] for row in rows] for what in ("cost", "recall"))
            axes.plot(cost, recall, "o-", ms=4, label=heading.removesuffix(": cost"))
    axes.set(
        xlim=(0, 1), ylim=(0, 1),
        xlabel="share of all pairs that are registered",
        ylabel="share of the overlapping pairs among them",
        title=f"{', '.join(row['label'] for row in found['rows'].values())} partners for each scan",
    )  # fmt: skip
    axes.title.set_size(10)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, loc="lower right")
    figure.savefig(path, dpi=90, facecolor="white")


def draw(name: str, options: Options) -> None:
    path = Path(options.folder) / f"{name}.png"
    if name == "pairs":
        labels = ["chair", "airplane", "mug", "helix"]
        pairs = [sample_pair(FAMILIES.index(label), CLEAN, options.seed) for label in labels]
        title = "Source blue, reference yellow, aligned source green; 768 of 1024 points"
        draw_pairs(register(pairs, options.weights), labels, path, title)
    elif name == "noise":
        labels = ["airplane", "mug"]
        pairs = [sample_pair(FAMILIES.index(label), NOISY, options.seed) for label in labels]
        robust = dataclasses.replace(load_pretrained(options.weights)[1].model, robust_rounds=3)
        title = '"Gaussian noise": 200 outliers appended to each cloud'
        draw_pairs(register(pairs, options.weights, robust), labels, path, title)
    elif name == "search":
        draw_search(path)
    elif name == "reliability":
        draw_reliability(path)
    elif name == "pair_choice":
        draw_pair_choice(path)
    else:
        {"matches": draw_matches, "arccos": draw_arccos, "drift": draw_drift}[name](options, path)
    print(path, flush=True)


def main() -> None:
    """Draw what is asked for."""
    options = tyro.cli(Options, description=__doc__)
    enable_compilation_cache()
    Path(options.folder).mkdir(parents=True, exist_ok=True)
    for name in options.only:
        draw(name, options)


if __name__ == "__main__":
    main()
