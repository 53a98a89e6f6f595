"""Pairs that share no point: recall of any method over the protocols, and curves over hardness.

    python -m benchmarks.scans.protocols --data-root DATA --methods dense open3d_ransac_icp [--pairs 256]
    python -m benchmarks.scans.protocols --data-root DATA --curve overlap --picture overlap.png

A protocol is the `test_pairs` section of a file in configs/. Where dense clouds of ModelNet40 are
found (modelnet40_normal_10k, 10,000 points a shape) each of its clouds is a draw of 1024 points
before the crop; else the 1024 points of the usual files are halved. By default the source is turned
by a uniformly random rotation after the crop, so that crops and overlap stay those of the protocol.
Categories with a rotational symmetry are reported apart: there, the true pose is not in the data.
"""

import dataclasses
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tyro
from jax.scipy.spatial.transform import Rotation

from jaxreg import _xla
from jaxreg.config import PairConfig, load_config
from jaxreg.data import data_root, hdf5, make_pair, modelnet
from jaxreg.evaluation import baselines
from jaxreg.evaluation.metrics import pair_errors
from jaxreg.geometry import rigid
from jaxreg.network.model import register_pair
from jaxreg.scans.pair import register
from jaxreg.search import load_features, register_global
from jaxreg.types import Pair, RigidTransform
from jaxreg.weights.released import load_pretrained

SYMMETRIC = ("bottle", "bowl", "cone", "cup", "flower_pot", "lamp", "tent", "vase")
CONFIGS = Path(__file__).resolve().parents[2] / "configs"
PROTOCOLS = (
    "resampled",
    "jitter",
    "resampled_jitter",
    "crops70",
    "crops70_jitter",
    "crops50",
)
CURVES = {
    "overlap": (0.95, 0.85, 0.75, 0.65, 0.55, 0.45),
    "jitter": (0.0, 0.01, 0.02, 0.03, 0.04),
    "outliers": (0.0, 0.1, 0.2, 0.3, 0.4, 0.5),
}


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    methods: tuple[str, ...] = ("dense",)
    """`dense` (without learning), `dense_learned`, `register`, released weights (`weights:modelnet40`), or a baseline such as open3d_ransac_icp."""
    protocols: tuple[str, ...] = PROTOCOLS
    """Files configs/modelnet40_NAME.toml."""
    curve: Literal["none", *CURVES] = "none"
    """In place of the protocols: resampled pairs, ever harder in one way."""
    rotation: Literal["full", "protocol"] = "full"
    """Any rotation, or the angles of the protocol alone."""
    pairs: int = 256
    seed: int = 0
    per_category: int = 6
    """Most shapes of a category: the dense clouds hold 65 airplanes and 41 bathtubs of 178."""
    data_root: str | None = None
    json: str = ""
    picture: str = ""


Shapes = tuple[np.ndarray, np.ndarray]
Solve = Callable[[Pair], RigidTransform]


def load_shapes(root: Path, per_category: int) -> Shapes:
    """Clouds (s, p, 3) and the name of each one's category, at most so many of a category."""
    dense = root / "modelnet40_normal_10k" / "modelnet40_normal_10k.h5"
    if dense.is_file():
        clouds, labels = hdf5.read_clouds(dense, "data"), hdf5.read(dense, "label").reshape(-1)
    else:
        clouds, labels = modelnet.load(root, "test")
    kept = np.concatenate([np.flatnonzero(labels == x)[:per_category] for x in np.unique(labels)])
    return clouds[kept], np.array(modelnet.category_names(root))[labels[kept]]


def at_size(config: PairConfig, shape_points: int) -> PairConfig:
    """The protocol with 1024 points a cloud, or half of the shape's: the crop keeps its share."""
    points = min(1024, shape_points // 2 if config.sampling == "disjoint" else shape_points)
    kept = round(config.kept / config.points * points)
    return dataclasses.replace(
        config, points=points, kept=kept, outliers=round(config.outliers * points / config.points)
    )


@partial(jax.jit, static_argnames=("config", "turned"))
def draw(key, shape, *, config: PairConfig, turned: bool) -> Pair:
    """A pair of the protocol whose source is then turned by any rotation about the origin."""
    pair_key, turn_key = jax.random.split(key)
    pair = make_pair(pair_key, shape, config)
    if not turned:
        return pair
    quaternion = jax.random.normal(turn_key, (4,))
    rotation = Rotation.from_quat(quaternion / jnp.linalg.norm(quaternion)).as_matrix()
    turn = RigidTransform(rotation, jnp.zeros(3))
    source = pair.source._replace(points=rigid.apply(turn, pair.source.points))
    return Pair(source, pair.reference, rigid.compose(pair.transform, rigid.inverse(turn)))


def choose(name: str) -> Solve:
    """One pair to a transform; errors as `jaxreg.classical.choose` and `load_pretrained`."""
    if name in ("dense", "dense_learned"):
        network = load_features() if name == "dense_learned" else None
        found = _xla.jit(lambda x, y: register_global(x, y, network=network))
    elif name == "register":
        return lambda p: RigidTransform(*register(p.source.points, p.reference.points)[:2])
    elif name.startswith("weights:"):
        variables, config = load_pretrained(name.removeprefix("weights:"))
        found = _xla.jit(lambda x, y: register_pair(variables, x, y, config=config.model))
    else:
        host = baselines.choose(name)
        return lambda p: host(np.asarray(p.source.points), np.asarray(p.reference.points))
    return lambda p: RigidTransform(*found(p.source.points, p.reference.points)[:2])


def evaluate(solve: Solve, config: PairConfig, shapes: Shapes, options: Options) -> dict:
    """Recall over all pairs and without the symmetric categories, and milliseconds a pair."""
    clouds, names = shapes
    config = at_size(config, clouds.shape[1])
    order = np.random.default_rng(options.seed).permutation(len(clouds))
    order = np.resize(order, options.pairs)
    predicted, truth, wall, processor = [], [], [], []
    for number, shape in enumerate(order):
        key = jax.random.fold_in(jax.random.key(options.seed), number)
        pair = draw(key, clouds[shape], config=config, turned=options.rotation == "full")
        if number == 0:
            jax.block_until_ready(solve(pair))  # Compiles.
        start, start_processor = time.perf_counter(), time.process_time()
        predicted.append(jax.tree.map(np.asarray, jax.block_until_ready(solve(pair))))
        wall.append(time.perf_counter() - start)
        processor.append(time.process_time() - start_processor)
        truth.append(jax.tree.map(np.asarray, pair.transform))
    errors = pair_errors(*(jax.tree.map(lambda *x: np.stack(x), *t) for t in (predicted, truth)))
    plain = ~np.isin(names[order], SYMMETRIC)
    tight = (errors.rre_deg < 1) & (errors.rte < 0.01)
    loose = (errors.rre_deg < 5) & (errors.rte < 0.1)
    return {
        "pairs": len(order),
        "points": int(pair.source.points.shape[0]),
        "recall_1deg": float(tight.mean()),
        "recall_5deg": float(loose.mean()),
        "recall_1deg_no_symmetric": float(tight[plain].mean()),
        "recall_5deg_no_symmetric": float(loose[plain].mean()),
        "median_rre_deg": float(np.median(errors.rre_deg)),
        "milliseconds": float(1e3 * np.median(wall)),
        "processor_milliseconds": float(1e3 * np.median(processor)),
    }


def runs(options: Options) -> dict[str, PairConfig]:
    """What to evaluate, by name: the protocols, or the steps of a curve."""
    if options.curve == "none":
        return {
            name: load_config(CONFIGS / f"modelnet40_{name}.toml").test_pairs
            for name in options.protocols
        }
    base = PairConfig(points=1024, kept=768, sampling="disjoint")
    crops = dataclasses.replace(base, crop="half-space", independent_crops=True)
    made = {
        "overlap": lambda x: dataclasses.replace(crops, kept=round(1024 * x)),
        "jitter": lambda x: dataclasses.replace(base, jitter=x, jitter_clip=5 * x),
        "outliers": lambda x: dataclasses.replace(base, outliers=round(768 * x / (1 - x))),
    }[options.curve]
    return {f"{x:g}": made(x) for x in CURVES[options.curve]}


def draw_curves(results: dict, options: Options) -> None:
    """Recall at 5 degrees over the hardness, a line for every method."""
    figure, axes = plt.subplots(figsize=(5, 3.5), layout="constrained")
    for method, rows in results.items():
        hardness = [float(x) for x in rows]
        recall = [row["recall_5deg_no_symmetric"] for row in rows.values()]
        axes.plot(hardness, recall, marker="o", label=method)
    labels = {
        "overlap": "share of each cloud that its own crop keeps",
        "jitter": "standard deviation of the jitter (unit sphere)",
        "outliers": "share of outliers in each cloud",
    }
    axes.set(xlabel=labels[options.curve], ylabel="recall (5°, 0.1)", ylim=(0, 1.02))
    if options.curve == "overlap":
        axes.invert_xaxis()
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(options.picture, dpi=150)


def main() -> None:
    """Print a line for every method and protocol; write the figures and the picture if asked."""
    options = tyro.cli(Options)
    root = data_root(options.data_root, CONFIGS / "any.toml")
    if root is None:
        raise SystemExit("no data: give --data-root or set $JAXREG_DATA")
    shapes, results = load_shapes(root, options.per_category), {}
    print(f"{len(shapes[0])} shapes of {shapes[0].shape[1]} points, seed {options.seed}")
    print(
        "method, protocol: recall 1 deg / 5 deg (without symmetric categories), ms (processor ms)"
    )
    for method in options.methods:
        solve, results[method] = choose(method), {}
        for name, config in runs(options).items():
            row = results[method][name] = evaluate(solve, config, shapes, options)
            print(
                f"{method}, {name}: {row['recall_1deg']:.2f} / {row['recall_5deg']:.2f} "
                f"({row['recall_1deg_no_symmetric']:.2f} / {row['recall_5deg_no_symmetric']:.2f}), "
                f"{row['milliseconds']:.0f} ({row['processor_milliseconds']:.0f})",
                flush=True,
            )
    if options.json:
        record = {"options": dataclasses.asdict(options), "results": results}
        Path(options.json).write_text(json.dumps(record, indent=2), encoding="utf-8")
    if options.picture:
        draw_curves(results, options)


if __name__ == "__main__":
    main()
