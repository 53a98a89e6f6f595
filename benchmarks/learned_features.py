"""Do learned features find more true matches than the moments of the dense search?

    python -m benchmarks.learned_features --data-root DATA

The whole search stays as it is, only the similarity of the points changes:

`moments`  what the library compares, without learning
`linear`   the same moments under a learned matrix, the control: learning without a network
`network`  the moments passed along the edges of two neighbourhood graphs, with invariants of distance
           and normals on every edge (no coordinates, so any rotation gives the same)
`both`     the mean of the cosines of moments and network

Linear and network are trained by the same contrastive loss (InfoNCE in both directions) on the same
pairs: procedural shapes, crops of 70 % with and without jitter and of 50 %, whose poses are known.
Nothing of ModelNet40 is trained on; the dense clouds of its shapes are what is tested on.
"""

import dataclasses
import functools
import time

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

from benchmarks import protocols
from jaxreg import compilation, rigid
from jaxreg.config import DenseConfig, PairConfig, load_config
from jaxreg.data import data_root, shapes
from jaxreg.dense.moments import moment_descriptors, openness, standardized
from jaxreg.dense.register import search_dense
from jaxreg.metrics import pair_errors
from jaxreg.neighbors import knn, squared_distances
from jaxreg.numerics import safe_norm

KINDS = ("crops70", "crops70_jitter", "crops50")
_DENSE = DenseConfig(unit=1.0)
_SAME, _APART = 0.06, 0.12
"""A match is right within the first distance; between the two it is neither right nor wrong."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    shapes: int = 1500
    """Procedural shapes to train on."""
    steps: int = 1500
    batch: int = 4
    rate: float = 2e-3
    width: int = 64
    test_pairs: int = 64
    """Of each kind, from each of procedural and ModelNet40 shapes."""
    seed: int = 0
    data_root: str | None = None


class Linear(nn.Module):
    """Features under a matrix."""

    width: int

    @nn.compact
    def __call__(self, features, points, normals):
        return _unit(nn.Dense(self.width, use_bias=False)(features))


class Network(nn.Module):
    """Messages along the edges to near points, then to points farther away."""

    width: int

    @nn.compact
    def __call__(self, features, points, normals):
        hidden = nn.gelu(nn.Dense(self.width)(features))
        graph = knn(points, 64)
        for neighbors, radius in ((graph[:, :16], 0.15), (graph[:, 3::4], 0.3)):
            edges = _edge_invariants(points, normals, neighbors, radius)
            messages = nn.Dense(self.width)(edges) + nn.Dense(self.width)(hidden)[neighbors]
            messages = nn.gelu(messages + nn.Dense(self.width)(hidden)[:, None])
            pooled = jnp.concatenate([jnp.max(messages, axis=1), jnp.mean(messages, axis=1)], -1)
            hidden = hidden + nn.Dense(self.width)(nn.gelu(nn.Dense(self.width)(pooled)))
        return _unit(nn.Dense(self.width)(nn.gelu(hidden)))


def _unit(x: jax.Array) -> jax.Array:
    return x / jnp.maximum(safe_norm(x), 1e-6)[:, None]


def _edge_invariants(points, normals, neighbors, radius: float) -> jax.Array:
    offset = points[neighbors] - points[:, None]
    length = safe_norm(offset)
    direction = offset / jnp.maximum(length, 1e-6)[..., None]
    own, other = normals[:, None], normals[neighbors]
    cosines = [jnp.sum(a * b, -1) for a, b in ((own, direction), (other, direction), (own, other))]
    return jnp.stack([length / radius, *(jnp.abs(c) for c in cosines)], axis=-1)


def inputs_of(x: jax.Array, y: jax.Array):
    """Of both clouds: features that a network reads, and normals; and the cosines of the moments."""
    found = [
        moment_descriptors(p, radii=_DENSE.radii, normal_radius=_DENSE.normal_radius)
        for p in (x, y)
    ]
    moments = standardized(*(f.features for f in found))
    rims = [
        openness(p, f.normals, jnp.ones(len(p), bool), radius=_DENSE.rim_radius)
        for p, f in zip((x, y), found, strict=True)
    ]
    features = [
        jnp.concatenate([m * np.sqrt(m.shape[1]), rim[:, None] * 4], axis=1)
        for m, rim in zip(moments, rims, strict=True)
    ]
    return features, [f.normals for f in found], moments[0] @ moments[1].T


def similarity(module, weights, x: jax.Array, y: jax.Array):
    """Cosines of the learned features, and of the moments."""
    features, normals, of_moments = inputs_of(x, y)
    one, other = (
        module.apply(weights, *parts) for parts in zip(features, (x, y), normals, strict=True)
    )
    return one @ other.T, of_moments


def contrastive_loss(cosines: jax.Array, sharpness: jax.Array, squared: jax.Array) -> jax.Array:
    """InfoNCE over rows and columns that have a right match."""
    right, unclear = squared < _SAME**2, (squared >= _SAME**2) & (squared < _APART**2)
    logits = jnp.where(unclear, -1e9, cosines * sharpness)

    def one_way(axis: int):
        chosen = jax.nn.logsumexp(jnp.where(right, logits, -1e9), axis=axis)
        lost = jax.nn.logsumexp(logits, axis=axis) - chosen
        has = jnp.any(right, axis=axis)
        return jnp.sum(jnp.where(has, lost, 0)) / jnp.maximum(jnp.sum(has), 1)

    return one_way(0) + one_way(1)


def pair_config(kind: str) -> PairConfig:
    """The protocol with 1024 points a cloud before the crop."""
    config = load_config(protocols.CONFIGS / f"modelnet40_{kind}.toml").test_pairs
    return protocols.at_size(config, 4096)


def fit(module: nn.Module, clouds: np.ndarray, options: Options):
    """Weights that minimise the contrastive loss; a step takes pairs of one kind."""
    start = module.init(
        jax.random.key(options.seed), jnp.zeros((80, 49)), jnp.zeros((80, 3)), jnp.zeros((80, 3))
    )
    weights = {"module": start, "log_sharpness": jnp.log(10.0)}
    rate = optax.warmup_cosine_decay_schedule(0, options.rate, options.steps // 20, options.steps)
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(rate, weight_decay=1e-4))

    @functools.partial(compilation.jit, static_argnames="kind")
    def step(weights, state, key, chosen, kind: str):
        config = pair_config(kind)
        pairs = jax.vmap(lambda k, c: protocols.draw(k, c, config=config, turned=True))(
            jax.random.split(key, len(chosen)), chosen
        )

        def loss(weights):
            def one(pair):
                x, y = pair.source.points, pair.reference.points
                cosines, _ = similarity(module, weights["module"], x, y)
                squared = squared_distances(rigid.apply(pair.transform, x), y)
                return contrastive_loss(cosines, jnp.exp(weights["log_sharpness"]), squared)

            return jnp.mean(jax.vmap(one)(pairs))

        value, gradient = jax.value_and_grad(loss)(weights)
        updates, state = optimizer.update(gradient, state, weights)
        return optax.apply_updates(weights, updates), state, value

    rng, state, begin, seen = (
        np.random.default_rng(options.seed),
        optimizer.init(weights),
        time.perf_counter(),
        [],
    )
    for number in range(options.steps):
        chosen = clouds[rng.integers(0, len(clouds), options.batch)]
        key = jax.random.fold_in(jax.random.key(options.seed + 1), number)
        weights, state, value = step(weights, state, key, chosen, KINDS[number % len(KINDS)])
        seen.append(float(value))
        if (number + 1) % (options.steps // 10) == 0:
            print(
                f"step {number + 1}: loss {np.mean(seen[-options.steps // 10 :]):.3f}, sharpness {np.exp(float(weights['log_sharpness'])):.1f}, {time.perf_counter() - begin:.0f} s",
                flush=True,
            )
    return weights["module"]


def searches(modules: dict):
    """A compiled search of a pair for every kind of features: first pose, and share of true matches."""

    def run(name: str):
        @compilation.jit
        def found(x, y, truth):
            if name == "moments":
                _, cosines = similarity(*modules["linear"], x, y)
            elif name == "both":
                learned, moments = similarity(*modules["network"], x, y)
                cosines = (learned + moments) / 2
            else:
                cosines, _ = similarity(*modules[name], x, y)
            squared = squared_distances(rigid.apply(truth, x), y)
            has = jnp.min(squared, axis=1) < _SAME**2
            best = jnp.take_along_axis(squared, jnp.argmax(cosines, axis=1)[:, None], axis=1)[:, 0]
            share = jnp.sum((best < _SAME**2) & has) / jnp.maximum(jnp.sum(has), 1)
            search = search_dense(x, y, similarity=cosines, config=_DENSE)
            return search.poses, share

        return found

    return {name: run(name) for name in ("moments", "linear", "network", "both")}


def test(
    found, clouds: list[np.ndarray], options: Options, seed: int
) -> dict[str, tuple[float, float, float]]:
    """Of each kind: share of true best matches, of right poses, and of pairs with one among eight."""
    results = {}
    for kind in KINDS:
        rows = []
        for number in range(options.test_pairs):
            key = jax.random.fold_in(jax.random.key(seed), number)
            pair = protocols.draw(
                key, clouds[number % len(clouds)], config=pair_config(kind), turned=True
            )
            poses, share = found(pair.source.points, pair.reference.points, pair.transform)
            truth = jax.tree.map(
                lambda x, p=poses: np.broadcast_to(x, (len(p.rotation), *x.shape)), pair.transform
            )
            errors = pair_errors(jax.tree.map(np.asarray, poses), jax.tree.map(np.asarray, truth))
            right = (errors.rre_deg < 5) & (errors.rte < 0.1)
            rows.append((float(share), right[0], right.any()))
        results[kind] = tuple(np.mean(rows, axis=0))
    return results


def main() -> None:
    """Train, then print a line for every kind of features and set of shapes."""
    options = tyro.cli(Options, description=__doc__)
    compilation.enable_compilation_cache()
    clouds = np.stack(
        [shapes.sample_shape(options.seed, i, points=2048) for i in range(options.shapes)]
    )
    modules = {}
    for name, module in (("linear", Linear(options.width)), ("network", Network(options.width))):
        print(name, flush=True)
        modules[name] = module, fit(module, clouds, options)
    sets = {
        "procedural": [
            shapes.sample_shape(options.seed + 1, i, points=2048) for i in range(options.test_pairs)
        ]
    }
    root = data_root(options.data_root, protocols.CONFIGS / "any.toml")
    if root is not None:
        dense, names = protocols.load_shapes(root, 6)
        plain = np.flatnonzero(~np.isin(names, protocols.SYMMETRIC))
        sets["ModelNet40"] = list(dense[np.random.default_rng(options.seed + 5).permutation(plain)])
    for label, chosen in sets.items():
        for name, found in searches(modules).items():
            rows = test(found, chosen, options, options.seed + 5)
            print(
                f"{label}, {name}: "
                + ", ".join(f"{k} {m:.3f} / {r:.3f} / {a:.3f}" for k, (m, r, a) in rows.items()),
                flush=True,
            )


if __name__ == "__main__":
    main()
