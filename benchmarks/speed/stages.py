"""The stages of a registration: the time each takes, and the arithmetic that it needs.

Arithmetic is counted by hand, per call and pair of n x m points with K neighbours; an exponential,
a root or an arctangent counts as one operation:

    graphs               8 n^2                      squared distances, for each cloud
    features             2 n K sum(c_l c_l+1) + 2 n (sum c_l) C          one cloud
    feature distance     2 n m C + 4 n m
    1-NN distance        n m                        rows and columns, then the root
    maps M, M-hat, G     8 n m + n m + (2 K - 2) n m + n m        two softmaxes, sum, division by K
    final map, copy      4 n m + 4 n m + 6 n m + 2 n m     D', softmax, copy, peaks
    inliers              2 n [30 K (K - 1) / 2 + 2 K (d w + 2 w^2)] + 16 n K w^2 + 8 n K w
    Procrustes           40 N_c

The reference's features and both graphs are computed once, the rest once per iteration.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from benchmarks.speed import timing, workload
from jaxreg.batching import map_pairs
from jaxreg.config import ModelConfig
from jaxreg.geometry.numerics import safe_sqrt
from jaxreg.geometry.procrustes import weighted_procrustes
from jaxreg.network import matching, model
from jaxreg.network.inliers import InlierNetwork, select_inliers
from jaxreg.network.invariants import geometric_structure
from jaxreg.types import PointCloud


class Stage(NamedTuple):
    """A compiled function of one batch, its calls in a registration, and its operations per call."""

    run: Callable[[], object]
    calls: int
    operations: float


def operations(n: int, m: int, config: ModelConfig) -> dict[str, float]:
    """Operations of one call of every stage, for one pair (see above)."""
    k, c, w = config.k, config.width, config.inlier_width
    lift = sum(a * b for a, b in zip((3, *config.channels[:-1]), config.channels, strict=True))
    angles, structure = (k, 4) if config.angles == "next" else (k * (k - 1) / 2, 3 + k)
    return {
        "graphs": 8 * n * n,
        "features": 2 * n * k * lift + 2 * n * sum(config.channels) * c,
        "feature distance": 2 * n * m * c + 4 * n * m,
        "1-NN distance": n * m,
        "maps M, M-hat, G": (10 + 2 * (config.k_matching - 1)) * n * m,
        "final map, copy": 16 * n * m,
        "inliers": 2 * n * (30 * angles + 2 * k * (structure * w + 2 * w * w))
        + 16 * n * k * w * w
        + 8 * n * k * w,
        "Procrustes": 40 * config.n_inliers,
    }


def stages(points: int, batch: int) -> dict[str, Stage]:
    """Every stage on the intermediate results of a real batch, in the order of the method."""
    variables, whole = workload.released()
    config, drawn = whole.model, workload.draw(points, batch)
    sources, references = (jnp.asarray(x) for x in drawn[:2])
    mask = jnp.ones(points, bool)
    of_cloud = jax.jit(map_pairs(lambda x: model.neighborhood_graph(PointCloud(x, mask), config)))
    of_points = jax.jit(
        map_pairs(lambda x, g: model.point_features(variables, x, g, mask, config=config)[0])
    )
    distances, of_nearest, to_maps, to_copy = map(
        jax.jit, map(map_pairs, _matching_programs(config))
    )
    trust, solve = _inlier_programs(variables, config)
    graphs = of_cloud(sources), of_cloud(references)
    features = [of_points(x, g) for x, g in zip((sources, references), graphs, strict=True)]
    squared, distance = distances(*features)
    nearest = of_nearest(squared, *graphs)
    dual = to_maps(distance, nearest, *graphs)
    copy = to_copy(distance, nearest, dual, references)[0]
    confidence = trust(sources, copy, graphs[0].neighbors)
    programs = {
        "graphs": (of_cloud, sources),
        "features": (of_points, sources, graphs[0]),
        "feature distance": (distances, *features),
        "1-NN distance": (of_nearest, squared, *graphs),
        "maps M, M-hat, G": (to_maps, distance, nearest, *graphs),
        "final map, copy": (to_copy, distance, nearest, dual, references),
        "inliers": (trust, sources, copy, graphs[0].neighbors),
        "Procrustes": (solve, sources, copy, confidence),
    }
    calls = {"graphs": 2, "features": config.iterations + 1}
    needed = operations(points, points, config)
    return {
        name: Stage(functools.partial(*call), calls.get(name, config.iterations), needed[name])
        for name, call in programs.items()
    }


def _matching_programs(config: ModelConfig) -> tuple[Callable, ...]:
    """What `jaxreg.network.model` does between the features and the copy, in four parts."""

    def distances(source, reference):
        squared = matching.squared_feature_distance(source, reference)
        return squared, safe_sqrt(squared)

    def of_nearest(squared, p, q):
        return safe_sqrt(matching.neighborhood_sum(squared, p.nearest, q.nearest))

    def to_maps(distance, nearest, p, q):
        scores = matching.matching_scores(distance) + matching.matching_scores(nearest)
        return matching.neighborhood_sum(scores, p.matching, q.matching) / config.k_matching

    def to_copy(distance, nearest, dual, reference):
        final = matching.final_distance(distance + nearest, dual, alpha=config.alpha)
        return matching.match(dual, matching.matching_scores(final), reference)

    return distances, of_nearest, to_maps, to_copy


def _inlier_programs(variables, config: ModelConfig) -> tuple[Callable, Callable]:
    network = InlierNetwork(config.inlier_width, config.bn_momentum)
    own = {kind: tree["inliers"] for kind, tree in variables.items()}

    def trust(source, copy, neighbors):
        reading = {"edge": config.edge, "angles": config.angles}
        structures = [geometric_structure(x, neighbors, **reading) for x in (source, copy)]
        return network.apply(own, *structures, jnp.ones(source.shape[0], bool), train=False)

    def solve(source, copy, confidence):
        chosen = select_inliers(confidence, config.n_inliers)
        return weighted_procrustes(source[chosen], copy[chosen], confidence[chosen])

    return jax.jit(map_pairs(trust)), jax.jit(map_pairs(solve))


def measure(points: int, batch: int, *, rounds: int) -> tuple[list[dict], dict, float]:
    """Rows of every stage and of the whole, per pair and registration, and the matrix rate (FLOP/s)."""
    found = stages(points, batch)
    variables, config = workload.released()
    drawn = workload.draw(points, batch)
    clouds = [jnp.asarray(x) for x in drawn[:2]]
    whole = workload.registration("jaxreg", batched=True)
    product, of_product = timing.matrix_product()
    tasks = {name: lambda _, run=stage.run: run() for name, stage in found.items()}
    tasks |= {"whole": lambda _: whole(variables, *clouds), "product": product}
    taken = timing.alternate(tasks, rounds=rounds)
    rows = [
        {
            "stage": name,
            "calls": stage.calls,
            "operations": stage.calls * stage.operations,
            "seconds": stage.calls * taken[name].minimum / batch,
        }
        for name, stage in found.items()
    ]
    total = {
        "stage": "whole registration",
        "calls": 1,
        "operations": sum(row["operations"] for row in rows),
        "seconds": taken["whole"].minimum / batch,
    }
    return rows, total, of_product / taken["product"].minimum
