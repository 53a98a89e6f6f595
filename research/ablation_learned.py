"""The paper's 1-NN strategy and inlier module on pairs that share no point, on features that match there.

    python -m research.ablation_learned [--seeds 3] [--data-root DATA]

The paper's network does not learn on such pairs at a small budget (`ablation.py --protocol posed`),
which says nothing about its parts. Here the features are given: those of `jaxreg.search.learned`, which
no rotation changes, frozen. `none`, `self` and `gather` are the single neighbourhood, the control that
counts it twice, and the 1-NN strategy (`ModelConfig.one_nn`); weights are equal, the row maxima of the
final map, or the confidence of the paper's inlier network (lengths and angles, with the N_c most
confident points or all). What is left to train are the sharpness of the distances and the inlier
network, by the distance to the true pose. Ideas of the peers stand beside them: the matches of RPM-Net
(Sinkhorn's iterations with a slack entry for each row and column, which takes what has no counterpart;
its threshold is trained, the mass of a row is its weight), and a predicted overlap as IDAM and others
have it (a network of 16 units over how well a point and its neighbours match at best). Every row has the same budget: procedural shapes,
resampled, any rotation. The control without all of this is the search of `register_global` with the
same features. Tested on pairs that were not trained on, one step, no refinement.
"""

import dataclasses
import json
from pathlib import Path
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

from benchmarks.scans import protocols
from jaxreg.cli import process
from jaxreg.config import ModelConfig
from jaxreg.data.procedural import shapes
from jaxreg.evaluation.metrics import pair_errors
from jaxreg.geometry import frame, rigid
from jaxreg.geometry.neighbors import knn
from jaxreg.geometry.procrustes import weighted_procrustes
from jaxreg.network.features import BATCH_AXIS
from jaxreg.network.inliers import InlierNetwork, select_inliers
from jaxreg.network.invariants import geometric_structure
from jaxreg.network.matching import match, matching_maps, neighborhood_sum
from jaxreg.network.model import neighborhood_graph
from jaxreg.peers.rpmnet import sinkhorn
from jaxreg.search import description
from jaxreg.search.learned import load_features
from jaxreg.search.pipeline import enter, search_poses
from jaxreg.types import Pair, PointCloud, RigidTransform
from research import train_features as learned_features

_MODEL = ModelConfig()
_ROUNDS = 5
"""Of Sinkhorn's iterations, as in RPM-Net."""
TESTED = ("resampled", "resampled_jitter", "crops70")


class Row(NamedTuple):
    """Which neighbourhoods are matched, and what weighs the correspondences."""

    one_nn: Literal["none", "self", "gather"]
    weights: Literal["equal", "peaks", "inliers", "all inliers", "overlap"]
    slack: bool = False
    """Matches by Sinkhorn's iterations with slack, in place of the paper's maps; the mass of a row is
    its peak."""


ROWS = {
    "single neighbourhood, equal weights": Row("none", "equal"),
    "single neighbourhood, peaks": Row("none", "peaks"),
    "single neighbourhood, inlier module": Row("none", "inliers"),
    "self (control), equal weights": Row("self", "equal"),
    "self (control), inlier module": Row("self", "inliers"),
    "1-NN, equal weights": Row("gather", "equal"),
    "1-NN, peaks": Row("gather", "peaks"),
    "1-NN, inlier module (the paper)": Row("gather", "inliers"),
    "1-NN, inlier module, all points": Row("gather", "all inliers"),
    "single neighbourhood, predicted overlap": Row("none", "overlap"),
    "Sinkhorn with slack, mass": Row("none", "peaks", slack=True),
    "Sinkhorn with slack, inlier module": Row("none", "inliers", slack=True),
    "Sinkhorn with slack, predicted overlap": Row("none", "overlap", slack=True),
}


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    rows: tuple[str, ...] = tuple(ROWS)
    seeds: int = 3
    steps: int = 200
    batch: int = 4
    rate: float = 5e-3
    shapes: int = 400
    """Procedural shapes to train on."""
    pairs: int = 64
    """Test pairs of each protocol."""
    test_seed: int = 5
    data_root: str | None = None
    json: str = ""
    """Write the figures to this file."""


class Described(NamedTuple):
    """A pair in the units of the search, the cosines of its features, and where it came from."""

    x: jax.Array
    y: jax.Array
    cosines: jax.Array
    where: frame.Frame


def describe(network, source, reference) -> Described:
    """What is the same for all rows."""
    where, x, y = enter(source, reference)
    both = (description.describe(points, unit=1.0) for points in (x, y))
    return Described(x, y, description.compare(*both, network=network).similarity, where)


def register_step(weights, described: Described, row: Row, *, train: bool):
    """One step of the paper's method on frozen features: the pose and the updated statistics."""
    x, y, cosines, _ = described
    distance = jnp.exp(weights["log_sharpness"]) * (1 - cosines)
    everywhere = [jnp.ones(len(p), bool) for p in (x, y)]
    graphs = [
        neighborhood_graph(PointCloud(*c), _MODEL) for c in zip((x, y), everywhere, strict=True)
    ]
    nearest = {
        "none": lambda: None,
        "self": lambda: distance,
        "gather": lambda: neighborhood_sum(distance, *(g.nearest for g in graphs)),
    }[row.one_nn]()
    if row.slack:
        copy, peak = assigned(weights["threshold"] - distance, y)
    else:
        maps = matching_maps(distance, nearest, *(g.matching for g in graphs), alpha=_MODEL.alpha)
        copy, _, peak = match(maps.dual, maps.final, y)
    statistics = weights["statistics"]
    if row.weights == "equal":
        trust = jnp.ones(len(x))
    elif row.weights == "peaks":
        trust = peak
    elif row.weights == "overlap":
        trust = overlap(weights["overlap"], cosines, graphs[0].neighbors)
    else:
        structures = (structure(p, graphs[0].neighbors) for p in (x, copy))
        inliers = {"params": weights["inliers"], "batch_stats": statistics}
        trust, updated = inlier_network().apply(
            inliers, *structures, everywhere[0], train=train, mutable=["batch_stats"]
        )
        statistics = updated["batch_stats"]
    source = x
    if row.weights == "inliers":
        chosen = select_inliers(trust, _MODEL.n_inliers)
        source, copy, trust = x[chosen], copy[chosen], trust[chosen]
    return weighted_procrustes(source, copy, trust), statistics


def assigned(affinity, points):
    """RPM-Net's copy of every source point, and the mass of its row."""
    scores = sinkhorn(affinity, jnp.ones(affinity.shape, bool), rounds=_ROUNDS)
    mass = jnp.sum(scores, axis=1)
    copy = jnp.matmul(scores, points, precision=jax.lax.Precision.HIGHEST)
    # Without any mass the copy does not matter, but its gradient must be finite.
    return copy / jnp.maximum(mass, 1e-6)[:, None], mass


def overlap(weights, cosines, neighbors):
    """The predicted share of overlap around each point, in (0, 1)."""
    best = jnp.max(cosines, axis=1)
    around = best[neighbors]
    mutual = best - jnp.max(cosines, axis=0)[jnp.argmax(cosines, axis=1)]
    given = jnp.stack([best, jnp.mean(around, axis=1), jnp.min(around, axis=1), mutual], axis=1)
    hidden = jnp.tanh(given @ weights["first"] + weights["bias"][None])
    return jax.nn.sigmoid(hidden @ weights["second"])


def inlier_network() -> InlierNetwork:
    """The paper's, as the library has it."""
    return InlierNetwork(_MODEL.inlier_width, _MODEL.bn_momentum)


def structure(points, neighbors):
    """Lengths of the edges and their angles, which no rotation changes."""
    return geometric_structure(points, neighbors, edge="length", angles="next")


def init_weights(key: jax.Array) -> dict:
    """Sharpness 20, where a match of cosine 0.9 outweighs one of 0.8 seven times, and the network."""
    cloud = jax.random.normal(key, (_MODEL.k + 1, 3))
    given = structure(cloud, knn(cloud, _MODEL.k))
    made = inlier_network().init(key, given, given, jnp.ones(len(cloud), bool), train=False)
    return {
        "log_sharpness": jnp.log(20.0),
        "threshold": jnp.asarray(2.0),
        "overlap": {
            "first": jax.random.normal(key, (4, 16)),
            "bias": jnp.zeros(16),
            "second": jnp.zeros(16),
        },
        "inliers": made["params"],
        "statistics": made["batch_stats"],
    }


@jax.jit
def training_pairs(network, keys, clouds):
    """Pairs of the protocol, described, and the points of each source at the true pose."""

    def one(key_and_cloud):
        config = learned_features.pair_config("resampled")
        pair = protocols.draw(*key_and_cloud, config=config, turned=True)
        described = describe(network, pair.source.points, pair.reference.points)
        where = described.where
        truth = rigid.apply(pair.transform, pair.source.points) - where.reference_centre[None]
        return described, truth / where.length

    return jax.lax.map(one, (keys, clouds))


def fit(row: Row, network, clouds: np.ndarray, seed: int, options: Options) -> dict:
    """Weights that lay the source where the true pose does, after one step."""
    rate = optax.cosine_decay_schedule(options.rate, options.steps)
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))

    def pair_loss(trained, statistics, described, truth):
        weights = trained | {"statistics": statistics}
        pose, statistics = register_step(weights, described, row, train=True)
        apart = rigid.apply(pose, described.x) - truth
        return jnp.mean(jnp.sum(jnp.abs(apart), axis=1)), statistics

    @jax.jit
    def step(trained, statistics, state, described, truth):
        def loss(trained):
            each = jax.vmap(pair_loss, in_axes=(None, None, 0, 0), axis_name=BATCH_AXIS)
            losses, new = each(trained, statistics, described, truth)
            return jnp.mean(losses), jax.tree.map(lambda s: s[0], new)

        (value, statistics), gradient = jax.value_and_grad(loss, has_aux=True)(trained)
        updates, state = optimizer.update(gradient, state, trained)
        return optax.apply_updates(trained, updates), statistics, state, value

    trained = init_weights(jax.random.key(seed))
    statistics = trained.pop("statistics")
    state, rng, seen = optimizer.init(trained), np.random.default_rng(seed), []
    for number in range(options.steps):
        chosen = clouds[rng.integers(0, len(clouds), options.batch)]
        key = jax.random.fold_in(jax.random.key(seed), number)
        made = training_pairs(network, jax.random.split(key, options.batch), chosen)
        trained, statistics, state, value = step(trained, statistics, state, *made)
        seen.append(float(value))
    few = max(options.steps // 10, 1)
    print(f"  loss {np.mean(seen[:few]):.3f} to {np.mean(seen[-few:]):.3f}", flush=True)
    return trained | {"statistics": statistics}


def draw_pairs(name: str, clouds: list[np.ndarray], options: Options) -> list[Pair]:
    """Pairs to test on, the same for every row."""
    config = learned_features.pair_config(name)
    key = jax.random.key(options.test_seed)
    return [
        protocols.draw(
            jax.random.fold_in(key, i), clouds[i % len(clouds)], config=config, turned=True
        )
        for i in range(options.pairs)
    ]


def test(solve, pairs: list[Pair]) -> tuple[float, float]:
    """Median rotation error in degrees, and recall at 5 degrees and 0.1."""
    found = [solve(pair.source.points, pair.reference.points) for pair in pairs]
    truth = [pair.transform for pair in pairs]
    errors = pair_errors(*(jax.tree.map(lambda *x: np.stack(x), *t) for t in (found, truth)))
    right = (errors.rre_deg < 5) & (errors.rte < 0.1)
    return float(np.median(errors.rre_deg)), float(np.mean(right))


def solver(row: Row, network, weights):
    """One pair to a pose, compiled."""

    @jax.jit
    def solve(described: Described) -> RigidTransform:
        pose, _ = register_step(weights, described, row, train=False)
        return frame.transform_out(described.where, pose)

    return lambda x, y: solve(describe_once(network, x, y))


describe_once = jax.jit(describe)


def main() -> None:
    """Train every row with every seed; print a line for each, and one for the control."""
    options = tyro.cli(Options, description=__doc__)
    process.enable_compilation_cache()
    network = load_features()
    asked = learned_features.Options(data_root=options.data_root, test_seed=options.test_seed)
    sets = learned_features.clouds_to_test_on(asked)
    name = "ModelNet40" if "ModelNet40" in sets else "procedural"
    pairs = {kind: draw_pairs(kind, sets[name], options) for kind in TESTED}
    print(f"{options.pairs} pairs of {name}: median degrees / recall at 5 degrees and 0.1")
    searched = jax.jit(
        lambda x, y: jax.tree.map(lambda p: p[0], search_poses(x, y, network=network).poses)
    )
    results = {"the search of register_global": [{k: test(searched, p) for k, p in pairs.items()}]}
    clouds = np.stack([shapes.sample_shape(0, i, points=2048) for i in range(options.shapes)])
    for label in options.rows:
        row, results[label] = ROWS[label], []
        for seed in range(options.seeds):
            weights = fit(row, network, clouds, seed, options)
            solve = solver(row, network, weights)
            results[label].append({kind: test(solve, p) for kind, p in pairs.items()})
    for label, runs in results.items():
        cells = []
        for kind in TESTED:
            degrees, recall = np.array([run[kind] for run in runs]).T
            cells.append(
                f"{kind} {degrees.mean():.2f} / {recall.mean():.2f} "
                f"({recall.min():.2f} to {recall.max():.2f})"
            )
        print(f"{label}: {', '.join(cells)}")
    if options.json:
        record = {"options": dataclasses.asdict(options), "results": results}
        Path(options.json).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
