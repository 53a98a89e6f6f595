"""Does learning rank the poses of the dense search better? A network against fitted terms.

    python -m research.learned_ranking --data-root DATA

Both choose among the same poses (the `--aligned` best of the search, each aligned) from the same facts
about every point: the distance to the nearest point of the other cloud, its parts along both normals,
their cosine, the likeness of the local moments, the openness of both. The *terms* are the library's
four means over the points (`jaxreg.search.ranking`), with the library's weights and refitted; the
*means* are more of them, in a linear score; the *network* lifts every point by two layers, takes the
mean and scores it. All are fitted by the cross entropy of the right poses (5 degrees and 0.1).

Trains on independent crops (70 %, with and without jitter, and 50 %) of ModelNet40's training shapes
and of procedural shapes, the symmetric categories left out; an eighth is held out. Tests on the dense
clouds of test shapes.
"""

import dataclasses
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

from benchmarks.scans import protocols
from jaxreg.cli import process
from jaxreg.config import load_config
from jaxreg.data import data_root, modelnet
from jaxreg.data.procedural import shapes
from jaxreg.evaluation.metrics import pair_errors
from jaxreg.search.config import SearchConfig
from jaxreg.search.description import compare, describe
from jaxreg.search.nearest import nearest_packed
from jaxreg.search.pipeline import search_poses
from jaxreg.search.ranking import move, score_terms
from jaxreg.search.surface import Surface
from jaxreg.types import Pair, RigidTransform

KINDS = ("crops70", "crops70_jitter", "crops50")
_POINTS, _HIDDEN, _BATCH = 256, 32, 8


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    pairs: int = 1600
    """Pairs of ModelNet40 and half as many of procedural shapes."""
    test_pairs: int = 64
    """Pairs of each protocol."""
    aligned: int = 32
    steps: int = 2000
    seed: int = 0
    data_root: str | None = None


class Choice(NamedTuple):
    """The poses of a pair: what is known of every point, of every pose, and which are right."""

    there: np.ndarray
    back: np.ndarray
    terms: np.ndarray
    score: np.ndarray
    right: np.ndarray


def facts(moved: Surface, other: Surface) -> jax.Array:
    """Seventeen numbers of every point, from where it lies to the nearest point of the other."""
    nearest = nearest_packed(moved.points, other.points, other.mask)
    residual = moved.points - other.points[nearest]
    distance = jnp.sqrt(jnp.sum(residual**2, axis=1))
    across = jnp.sum(residual * other.normals[nearest], axis=1)
    own_across = jnp.sum(residual * moved.normals, axis=1)
    facing = jnp.abs(jnp.sum(moved.normals * other.normals[nearest], axis=1))
    alike = jnp.sum(moved.local * other.local[nearest], axis=1)
    near = lambda x, width: jnp.exp(-(x**2) / (2 * width**2))  # noqa: E731
    close = near(distance, 0.05)
    opened = (moved.openness, other.openness[nearest])
    columns = [near(distance, w) for w in (0.02, 0.05, 0.1, 0.2)]
    columns += [near(across, w) for w in (0.01, 0.02, 0.05)] + [near(own_across, 0.02)]
    columns += [facing, alike, *(jnp.maximum(0, 1 - x / 0.25) for x in opened), *opened]
    columns += [close * near(across, 0.02) * facing**2, close * alike, distance]
    return jnp.stack(columns, axis=1)


def choices(options: Options):
    """A compiled function of a pair: the poses of the search and everything known about them."""
    config = dataclasses.replace(SearchConfig(), unit=1.0, aligned=options.aligned)

    def found(x: jax.Array, y: jax.Array):
        search = search_poses(x, y, config=config)
        described = (describe(points, unit=1.0) for points in (x, y))
        source, reference, _ = compare(*described)

        def judge(pose: RigidTransform):
            moved = move(pose, source)
            terms = score_terms(pose, source, reference)
            weighed = jnp.stack(terms[:4])  # What `score_of` weighs: all but `plane`.
            return facts(moved, reference), facts(reference, moved), weighed

        return search, jax.lax.map(judge, search.poses)

    return jax.jit(found)


def collect(find, pair: Pair) -> Choice:
    """The choice that a pair poses."""
    search, (there, back, terms) = jax.tree.map(
        np.asarray, find(pair.source.points, pair.reference.points)
    )
    truth = jax.tree.map(lambda x: np.broadcast_to(x, (len(terms), *x.shape)), pair.transform)
    errors = pair_errors(search.poses, jax.tree.map(np.asarray, truth))
    right = (errors.rre_deg < 5) & (errors.rte < 0.1)
    return Choice(np.float16(there), np.float16(back), terms, search.score, right)


def draw_pairs(clouds, options: Options, seed: int):
    """A name of KINDS and a pair of it for every cloud, each turned by any rotation."""
    for number, cloud in enumerate(clouds):
        kind = KINDS[number % len(KINDS)]
        config = load_config(protocols.CONFIGS / f"modelnet40_{kind}.toml").test_pairs
        key = jax.random.fold_in(jax.random.key(seed), number)
        yield (
            kind,
            protocols.draw(key, cloud, config=protocols.at_size(config, len(cloud)), turned=True),
        )


def clouds_to_learn_from(root: Path, options: Options):
    """ModelNet40's training shapes without the symmetric categories, then procedural shapes."""
    clouds, labels = modelnet.load(root, "train")
    names = np.array(modelnet.category_names(root))[labels]
    plain = np.flatnonzero(~np.isin(names, protocols.SYMMETRIC))
    order = np.random.default_rng(options.seed).permutation(plain)[: options.pairs]
    yield from (clouds[i] for i in order)
    for i in range(options.pairs // 2):
        yield shapes.sample_shape(options.seed, i, points=2048)


def clouds_to_test_on(root: Path, options: Options):
    """Each test shape of the dense clouds three times in a row: once for each kind."""
    clouds, names = protocols.load_shapes(root, 6)
    plain = np.flatnonzero(~np.isin(names, protocols.SYMMETRIC))
    order = np.random.default_rng(options.seed + 5).permutation(plain)
    for i in np.resize(order, options.test_pairs):
        yield from (clouds[i],) * len(KINDS)


def init_network(key: jax.Array, inputs: int) -> dict[str, jax.Array]:
    """Weights of `network_score`, by He's rule."""
    sizes = {"lift": (inputs, _HIDDEN), "mix": (_HIDDEN, _HIDDEN), "join": (2 * _HIDDEN, _HIDDEN)}
    keys = dict(zip((*sizes, "last"), jax.random.split(key, 4), strict=True))
    weights = {
        name: jax.random.normal(keys[name], size) * np.sqrt(2 / size[0])
        for name, size in sizes.items()
    }
    biases = {f"{name}_bias": jnp.zeros(size[1]) for name, size in sizes.items()}
    last = 0.3 * jax.random.normal(keys["last"], (_HIDDEN,)) * np.sqrt(2 / _HIDDEN)
    return weights | biases | {"last": last}


def network_score(weights: dict, there: jax.Array, back: jax.Array, _terms=None) -> jax.Array:
    """A score of every pose from the facts (poses, points, 17) of both clouds."""

    def layer(x, name):
        bias = weights[f"{name}_bias"]
        x = x @ weights[name] + jnp.broadcast_to(bias, (*x.shape[:-1], len(bias)))
        return jax.nn.gelu(x)

    def pooled(x):
        return jnp.mean(layer(layer(jnp.float32(x), "lift"), "mix"), axis=-2)

    one, other = pooled(there), pooled(back)
    joined = 4 * jnp.concatenate([one + other, jnp.abs(one - other)], axis=-1)
    return layer(joined, "join") @ weights["last"]


def terms_score(weights: jax.Array, _there, _back, terms: jax.Array) -> jax.Array:
    """The four terms of the library, weighted."""
    return terms @ weights


def means_score(weights: jax.Array, there: jax.Array, back: jax.Array, terms: jax.Array):
    """The terms and the means of all facts, weighted."""
    means = jnp.mean(jnp.float32(there), axis=-2) + jnp.mean(jnp.float32(back), axis=-2)
    return jnp.concatenate([terms, means], axis=-1) @ weights


def fit(score, weights, data: list[Choice], options: Options, rate: float):
    """Weights that minimise the cross entropy of the right poses; every step, other points."""
    rng = np.random.default_rng(options.seed)
    useful = [x for x in data if x.right.any() and not x.right.all()]

    def loss(weights, batch):
        found = jax.vmap(score, in_axes=(None, 0, 0, 0))(weights, *batch[:3])
        right = jnp.where(batch[3], found, -jnp.inf)
        return jnp.mean(jax.nn.logsumexp(found, axis=1) - jax.nn.logsumexp(right, axis=1))

    optimizer = optax.adamw(optax.cosine_decay_schedule(rate, options.steps), weight_decay=1e-3)

    @jax.jit
    def step(weights, state, batch):
        updates, state = optimizer.update(jax.grad(loss)(weights, batch), state, weights)
        return optax.apply_updates(weights, updates), state

    def draw(x: Choice):
        rows = [rng.integers(0, side.shape[1], _POINTS) for side in (x.there, x.back)]
        return x.there[:, rows[0]], x.back[:, rows[1]], x.terms, x.right

    state = optimizer.init(weights)
    for _ in range(options.steps):
        chosen = [draw(useful[i]) for i in rng.integers(0, len(useful), _BATCH)]
        batch = tuple(np.stack(x) for x in zip(*chosen, strict=True))
        weights, state = step(weights, state, batch)
    return weights


def show(name: str, choose, data: list[tuple[str, Choice]]) -> None:
    """The share of pairs whose chosen pose is right, of each kind and of all."""
    hits = {kind: [] for kind in KINDS}
    for kind, x in data:
        hits[kind].append(bool(x.right[choose(x)]))
    shares = ", ".join(f"{kind} {np.mean(values):.3f}" for kind, values in hits.items())
    print(f"{name}: {shares}, all {np.mean(sum(hits.values(), [])):.3f}", flush=True)


def main() -> None:
    """Collect the choices, fit, print who chooses right how often."""
    options = tyro.cli(Options, description=__doc__)
    process.enable_compilation_cache()
    root = data_root(options.data_root, protocols.CONFIGS / "any.toml")
    if root is None:
        raise SystemExit("no data: give --data-root or set $JAXREG_DATA")
    find, start = choices(options), time.perf_counter()
    learn, test = (
        [(kind, collect(find, pair)) for kind, pair in draw_pairs(clouds, options, seed)]
        for clouds, seed in (
            (clouds_to_learn_from(root, options), options.seed),
            (clouds_to_test_on(root, options), options.seed + 5),
        )
    )
    order = np.random.default_rng(options.seed).permutation(len(learn))
    held, learn = ([learn[i] for i in x] for x in np.split(order, [len(order) // 8]))
    print(f"{len(learn)} pairs, {time.perf_counter() - start:.0f} s")
    data = [x for _, x in learn]
    facts_of, terms_of = data[0].there.shape[-1], data[0].terms.shape[-1]
    network = fit(
        network_score, init_network(jax.random.key(options.seed), facts_of), data, options, 3e-3
    )
    terms = fit(terms_score, jnp.zeros(terms_of), data, options, 0.05)
    means = fit(means_score, jnp.zeros(terms_of + facts_of), data, options, 0.05)
    for name, pairs in (("held out", held), ("test", test)):
        show(f"{name}, a right pose is there", lambda x: int(np.argmax(x.right)), pairs)
        show(f"{name}, as in the library", lambda x: int(np.argmax(x.score)), pairs)
        for label, score, weights in (
            ("terms refitted", terms_score, terms),
            ("all means", means_score, means),
            ("network", network_score, network),
        ):
            run = jax.jit(score)
            best = lambda x, run=run, w=weights: int(np.argmax(run(w, *x[:3])))  # noqa: E731
            show(f"{name}, {label}", best, pairs)


if __name__ == "__main__":
    main()
