"""Pairs that share no point: recall of any method over the protocols.

    python -m benchmarks.scans.protocols --data-root DATA [--methods register_global icp] [--seeds 11]

A protocol is the `test_pairs` section of a file in configs/. Where dense clouds of ModelNet40 are
found (modelnet40_normal_10k, 10,000 points a shape) each of its clouds is a draw of 1024 points
before the crop; else the 1024 points of the usual files are halved. By default the source is turned
by a uniformly random rotation after the crop, so that crops and overlap stay those of the protocol.
Recall leaves out the categories with a rotational symmetry, where the true pose is not in the data,
unless it says "all". Milliseconds are those of the processor.
"""

import dataclasses
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax.scipy.spatial.transform import Rotation

from benchmarks import record
from jaxreg.cli.process import enable_compilation_cache
from jaxreg.config import PairConfig, load_config
from jaxreg.data import data_root, hdf5, make_pair, modelnet
from jaxreg.evaluation import methods
from jaxreg.evaluation.metrics import PairErrors, pair_errors
from jaxreg.geometry import rigid
from jaxreg.types import Pair, RigidTransform

SYMMETRIC = ("bottle", "bowl", "cone", "cup", "flower_pot", "lamp", "tent", "vase")
CONFIGS = Path(__file__).resolve().parents[2] / "configs"
PROTOCOLS = {
    "resampled": "resampled",
    "jitter": "jitter 0.01",
    "resampled_jitter": "resampled, jitter 0.01",
    "crops70": "crops of 70 %",
    "crops70_jitter": "crops of 70 %, jitter 0.01",
    "crops50": "crops of 50 %",
}
KEYS = {
    "register_global": "jaxreg",
    "register_global_learned": "learned",
    "open3d_ransac_icp": "ransac",
    "open3d_fgr_gicp": "fgr",
}
"""Methods as the columns of the records call them."""
LABELS = {
    "register_global": "`register_global`",
    "register_global_learned": "learned features",
    "open3d_ransac_icp": "Open3D RANSAC + ICP",
    "open3d_fgr_gicp": "Open3D FGR + GICP",
}


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    methods: tuple[str, ...] = ("register_global", "register_global_learned")
    """Names as of `jaxreg.evaluation.methods.choose`. The first meets all seeds, the others the first."""
    protocols: tuple[str, ...] = tuple(PROTOCOLS)
    """Files configs/modelnet40_NAME.toml."""
    rotation: Literal["full", "protocol"] = "full"
    """Any rotation, or the angles of the protocol alone."""
    pairs: int = 256
    seeds: tuple[int, ...] = (11, 17, 19)
    per_category: int = 6
    """Most shapes of a category: the dense clouds hold 65 airplanes and 41 bathtubs of 178."""
    data_root: str | None = None
    record: bool = True
    """Write the table to benchmarks/results/."""


class Shapes(NamedTuple):
    """Clouds (s, p, 3) and the name of each one's category."""

    clouds: np.ndarray
    categories: np.ndarray


class Found(NamedTuple):
    """How a method did on every pair: errors, which are of a symmetric category, milliseconds."""

    errors: PairErrors
    symmetric: np.ndarray
    milliseconds: np.ndarray
    points: int

    def recall(self, degrees: int, *, symmetric: bool = False) -> float:
        """Within 1 degree and 0.01, or 5 degrees and 0.1; `symmetric`: over all categories."""
        right = (self.errors.rre_deg < degrees) & (self.errors.rte < {1: 0.01, 5: 0.1}[degrees])
        return float(right[symmetric | ~self.symmetric].mean())


def load_shapes(root: Path, per_category: int) -> Shapes:
    """Test shapes, at most so many of a category."""
    dense = root / "modelnet40_normal_10k" / "modelnet40_normal_10k.h5"
    if dense.is_file():
        clouds, labels = hdf5.read_clouds(dense, "data"), hdf5.read(dense, "label").reshape(-1)
    else:
        clouds, labels = modelnet.load(root, "test")
    kept = np.concatenate([np.flatnonzero(labels == x)[:per_category] for x in np.unique(labels)])
    return Shapes(clouds[kept], np.array(modelnet.category_names(root))[labels[kept]])


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


def drawn_from(shapes: Shapes, *, pairs: int, seed: int) -> Iterator[tuple[int, jax.Array]]:
    """The index of the shape of every pair, and the key that it is drawn with."""
    order = np.random.default_rng(seed).permutation(len(shapes.clouds))
    for number, shape in enumerate(np.resize(order, pairs)):
        yield shape, jax.random.fold_in(jax.random.key(seed), number)


def draw_pairs(config: PairConfig, shapes: Shapes, *, pairs: int, seed: int, turned: bool):
    """The index of a shape and its pair, the same ones for every method."""
    config = at_size(config, shapes.clouds.shape[1])
    for shape, key in drawn_from(shapes, pairs=pairs, seed=seed):
        yield shape, draw(key, shapes.clouds[shape], config=config, turned=turned)


def run(method: methods.Method, drawn, categories: np.ndarray) -> Found:
    """The method on every pair that `draw_pairs` gives."""
    predicted, truth, symmetric, milliseconds = [], [], [], []
    for shape, pair in drawn:
        batch = jax.tree.map(lambda x: x[None], pair)
        if not predicted:
            jax.block_until_ready(method.batch(batch))  # Compiles.
        begin = time.process_time()
        found = jax.block_until_ready(method.batch(batch))
        milliseconds.append(1e3 * (time.process_time() - begin))
        predicted.append(jax.tree.map(lambda x: np.asarray(x)[0], found))
        truth.append(jax.tree.map(np.asarray, pair.transform))
        symmetric.append(categories[shape] in SYMMETRIC)
    stacked = (jax.tree.map(lambda *x: np.stack(x), *parts) for parts in (predicted, truth))
    points = len(pair.source.points)
    return Found(pair_errors(*stacked), np.array(symmetric), np.array(milliseconds), points)


def pairs_of(protocol: str) -> PairConfig:
    return load_config(CONFIGS / f"modelnet40_{protocol}.toml").test_pairs


def cells(found: dict[tuple[str, int], Found], options: Options) -> dict[str, float]:
    """The row of one protocol, from what was found by method and seed."""
    first, *others = options.methods
    row = {}
    for degrees in (1, 5):
        of_seeds = {seed: found[first, seed].recall(degrees) for seed in options.seeds}
        weights = [np.sum(~found[first, seed].symmetric) for seed in options.seeds]
        row[f"mean_{degrees}deg"] = float(np.average(list(of_seeds.values()), weights=weights))
        row |= {f"seed{seed}_{degrees}deg": value for seed, value in of_seeds.items()}
        everything = found[first, options.seeds[0]].recall(degrees, symmetric=True)
        row[f"all_{degrees}deg"] = everything
        for name in others:
            recall = found[name, options.seeds[0]].recall(degrees)
            row[f"{column_key(name)}_{degrees}deg"] = recall
    for name in options.methods:
        row[f"{column_key(name)}_ms"] = float(np.median(found[name, options.seeds[0]].milliseconds))
    return row


def column_key(name: str) -> str:
    return KEYS.get(name, record.key(name))


def columns(options: Options) -> dict[str, str]:
    """Heads of the columns that `cells` fills."""
    first, seed = options.methods[0], options.seeds[0]
    heads = {"mean": "mean"} | {f"seed{x}": f"seed {x}" for x in options.seeds}
    heads["all"] = f"all categories, seed {seed}"
    heads |= {
        column_key(x): f"{LABELS.get(x, x)}, seed {seed}" for x in options.methods if x != first
    }
    recall = {f"{k}_{d}deg": f"{text}: {d} deg" for k, text in heads.items() for d in (1, 5)}
    return recall | {f"{column_key(x)}_ms": f"{LABELS.get(x, x)}: ms" for x in options.methods}


def write(found: dict[str, dict[tuple[str, int], Found]], shapes: int, options: Options) -> Path:
    """The record `protocols`: a row a protocol."""
    first = options.methods[0]
    of_first = next(iter(found.values()))
    kept = int(sum(np.sum(~of_first[first, seed].symmetric) for seed in options.seeds))
    setting = {
        "pairs": options.pairs,
        "runs": len(options.seeds),
        "shapes": shapes,
        "kept": kept,
        "points": of_first[first, options.seeds[0]].points,
    }
    if "crops50" in found:
        setting["points_crops50"] = found["crops50"][first, options.seeds[0]].points
    for percent in (98, 87, 50):
        share = percent / 100
        setting[f"error_at_{percent}"] = round(float(np.sqrt(share * (1 - share) / kept)), 3)
    rows = {record.key(name): cells(x, options) for name, x in found.items()}
    if {"jaxreg_ms", "learned_ms"} <= set(columns(options)):
        ratio = np.mean([row["learned_ms"] / row["jaxreg_ms"] for row in rows.values()])
        setting["learned_more_time_percent"] = round(100 * (float(ratio) - 1))
    return record.write(
        "protocols",
        question="How often are two samplings of a shape registered?",
        command=record.command("benchmarks.scans.protocols"),
        columns=columns(options),
        rows={k: {"label": PROTOCOLS.get(k, k)} | row for k, row in rows.items()},
        setting=setting,
        note="Recall within 1 degree and 0.01, and within 5 degrees and 0.1, without the "
        "rotation-symmetric categories unless it says otherwise.",
    )


def report(name: str, where: str, found: Found) -> None:
    """A line for a method and a protocol."""
    one, five = (found.recall(degrees) for degrees in (1, 5))
    all_one, all_five = (found.recall(degrees, symmetric=True) for degrees in (1, 5))
    print(
        f"{name}, {where}: {one:.2f} / {five:.2f} (all {all_one:.2f} / {all_five:.2f}), "
        f"{np.median(found.milliseconds):.0f} ms",
        flush=True,
    )


def measure(shapes: Shapes, options: Options) -> dict[str, dict[tuple[str, int], Found]]:
    """What every method and seed finds, by protocol."""
    print("method, protocol: recall 1 deg / 5 deg (all categories), median processor time")
    result = {protocol: {} for protocol in options.protocols}
    for name in options.methods:
        method = methods.choose(name)
        for seed in options.seeds if name == options.methods[0] else options.seeds[:1]:
            how = {"pairs": options.pairs, "seed": seed, "turned": options.rotation == "full"}
            for protocol in options.protocols:
                drawn = draw_pairs(pairs_of(protocol), shapes, **how)
                found = run(method, drawn, shapes.categories)
                report(name, f"{protocol}, seed {seed}", found)
                result[protocol][name, seed] = found
    return result


def read_shapes(argument: str | None, per_category: int) -> Shapes:
    """The test shapes of --data-root, or the end of the program with what is missing."""
    root = data_root(argument, CONFIGS / "any.toml")
    if root is None:
        raise SystemExit("no data: give --data-root or set $JAXREG_DATA")
    return load_shapes(root, per_category)


def main(options: Options) -> None:
    """Print a line for every method and protocol, and write the table."""
    enable_compilation_cache()
    shapes = read_shapes(options.data_root, options.per_category)
    found = measure(shapes, options)
    if options.record:
        print(write(found, len(shapes.clouds), options))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
