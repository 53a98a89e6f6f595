"""Train the features of the dense search, and compare them with what it does without learning.

    python -m research.train_features --save jaxreg/weights --data-root DATA

The whole search stays as it is, only the features that points are matched by change:

`moments`  without learning
`linear`   the moments under a learned matrix, the control: learning without a network
`network`  `jaxreg.search.learned`: the moments passed along the surface
`network, 1-NN`  the same, with the paper's 1-NN strategy: nearest neighbours should match too

Linear and network are trained by the same contrastive loss (InfoNCE in both directions) on the same
pairs: procedural shapes whose pose is known, crops of 70 % with and without jitter and of 50 %, any
rotation, half to all of the points. Nothing of ModelNet40 is trained on; its dense clouds are what is
tested on.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

from benchmarks.scans import protocols
from jaxreg.cli import process
from jaxreg.config import PairConfig, load_config
from jaxreg.data import data_root
from jaxreg.data.procedural import shapes
from jaxreg.evaluation.metrics import pair_errors
from jaxreg.geometry import rigid
from jaxreg.geometry.neighbors import nearest_neighbor, squared_distances
from jaxreg.geometry.numerics import safe_norm
from jaxreg.search.description import compare, describe
from jaxreg.search.descriptors import standardized
from jaxreg.search.learned import feature_config, init_network, load_features
from jaxreg.search.pipeline import enter, search_poses
from jaxreg.weights.released import save_weights

KINDS = ("crops70", "crops70_jitter", "crops50")
_SAME, _APART = 0.06, 0.12
"""A match is right within the first distance (unit sphere); up to the second it is neither."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    shapes: int = 2000
    """Procedural shapes to train on."""
    steps: int = 1800
    batch: int = 4
    rate: float = 2e-3
    features: tuple[str, ...] = ("linear", "network")
    """What to train; the moments are always compared."""
    released: bool = False
    """Take the released network in place of training one."""
    save: str = ""
    """Write the weights and the card of a network that was trained to this folder."""
    test_pairs: int = 64
    """Of each kind, from each of procedural and ModelNet40 shapes."""
    test_seed: int = 5
    seed: int = 0
    data_root: str | None = None


def linear_cosines(matrix, x, y, x_mask, y_mask) -> jax.Array:
    """Cosines of the moments under a matrix."""
    found = [describe(p, mask, unit=1.0).features for p, mask in ((x, x_mask), (y, y_mask))]
    mapped = [f @ matrix for f in standardized(*found, x_mask, y_mask)]
    one, other = (f / jnp.maximum(safe_norm(f), 1e-6)[:, None] for f in mapped)
    return one @ other.T


def network_cosines(network, x, y, x_mask, y_mask) -> jax.Array:
    """Cosines of the features of the library; of the moments, where `network` is None."""
    described = (describe(p, mask, unit=1.0) for p, mask in ((x, x_mask), (y, y_mask)))
    return compare(*described, network=network).similarity


def one_nn_cosines(network, x, y, x_mask, y_mask) -> jax.Array:
    """The mean of the cosines of two points and of their nearest neighbours, as the paper's Eq. 5."""
    found = network_cosines(network, x, y, x_mask, y_mask)
    return (found + found[nearest_neighbor(x, x_mask)][:, nearest_neighbor(y, y_mask)]) / 2


COSINES: dict[str, Callable] = {
    "moments": network_cosines,
    "linear": linear_cosines,
    "network": network_cosines,
    "network, 1-NN": one_nn_cosines,
}


def init_weights(name: str, seed: int) -> Any:
    """The weights before the first step; the linear control starts as the moments are."""
    return jnp.eye(48) if name == "linear" else init_network(jax.random.key(seed))


def contrastive_loss(
    cosines: jax.Array,
    sharpness: jax.Array,
    squared: jax.Array,
    x_mask: jax.Array,
    y_mask: jax.Array,
) -> jax.Array:
    """InfoNCE over the rows and columns that have a right match."""
    both = x_mask[:, None] & y_mask[None, :]
    right = (squared < _SAME**2) & both
    unclear = (squared >= _SAME**2) & (squared < _APART**2)
    logits = jnp.where(unclear | ~both, -1e9, cosines * sharpness)

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


def fit(name: str, clouds: np.ndarray, options: Options) -> Any:
    """Weights that minimise the contrastive loss; a step takes pairs of one kind."""
    weights = {"features": init_weights(name, options.seed), "log_sharpness": jnp.log(10.0)}
    rate = optax.warmup_cosine_decay_schedule(0, options.rate, options.steps // 20, options.steps)
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(rate, weight_decay=1e-4))

    def pair_loss(weights, pair, share, key):
        x, y = pair.source.points, pair.reference.points
        masks = [
            jax.random.uniform(k, (len(p),)) < share
            for k, p in zip(jax.random.split(key), (x, y), strict=True)
        ]
        squared = squared_distances(rigid.apply(pair.transform, x), y)
        _, x, y = enter(x, y, *masks)
        cosines = COSINES[name](weights["features"], x, y, *masks)
        return contrastive_loss(cosines, jnp.exp(weights["log_sharpness"]), squared, *masks)

    @functools.partial(jax.jit, static_argnames="kind")
    def step(weights, state, key, chosen, kind: str):
        config = pair_config(kind)
        draw_key, mask_key, share_key = jax.random.split(key, 3)
        draw_keys, mask_keys = (jax.random.split(k, len(chosen)) for k in (draw_key, mask_key))
        pairs = jax.vmap(lambda k, c: protocols.draw(k, c, config=config, turned=True))(
            draw_keys, chosen
        )
        shares = jax.random.uniform(share_key, (len(chosen),), minval=0.5)

        def loss(weights):
            each = jax.vmap(pair_loss, in_axes=(None, 0, 0, 0))
            return jnp.mean(each(weights, pairs, shares, mask_keys))

        value, gradient = jax.value_and_grad(loss)(weights)
        updates, state = optimizer.update(gradient, state, weights)
        return optax.apply_updates(weights, updates), state, value

    rng, state = np.random.default_rng(options.seed), optimizer.init(weights)
    begin, seen, often = time.perf_counter(), [], max(options.steps // 10, 1)
    for number in range(options.steps):
        chosen = clouds[rng.integers(0, len(clouds), options.batch)]
        key = jax.random.fold_in(jax.random.key(options.seed + 1), number)
        weights, state, value = step(weights, state, key, chosen, KINDS[number % len(KINDS)])
        seen.append(float(value))
        if (number + 1) % often == 0:
            passed = time.perf_counter() - begin
            print(
                f"{name}, step {number + 1}: loss {np.mean(seen[-often:]):.3f}, {passed:.0f} s",
                flush=True,
            )
    return weights["features"]


def search(name: str, weights: Any):
    """A compiled search of a pair: the aligned poses, and the share of true best matches."""

    @jax.jit
    def found(x, y, truth):
        masks = [jnp.ones(len(p), bool) for p in (x, y)]
        _, a, b = enter(x, y, *masks)
        cosines = COSINES[name](weights, a, b, *masks)
        squared = squared_distances(rigid.apply(truth, x), y)
        has = jnp.min(squared, axis=1) < _SAME**2
        best = jnp.take_along_axis(squared, jnp.argmax(cosines, axis=1)[:, None], axis=1)[:, 0]
        share = jnp.sum((best < _SAME**2) & has) / jnp.maximum(jnp.sum(has), 1)
        return search_poses(x, y, similarity=cosines).poses, share

    return found


def test(found, clouds: list[np.ndarray], options: Options) -> dict[str, tuple[float, ...]]:
    """Of each kind: share of true best matches, of right poses, of pairs with one among eight."""
    results = {}
    for kind in KINDS:
        rows = []
        for number in range(options.test_pairs):
            key = jax.random.fold_in(jax.random.key(options.test_seed), number)
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


def clouds_to_test_on(options: Options) -> dict[str, list[np.ndarray]]:
    """Procedural shapes that were not trained on, and ModelNet40's where they are found."""
    fresh = [
        shapes.sample_shape(options.seed + 1, i, points=2048) for i in range(options.test_pairs)
    ]
    root = data_root(options.data_root, protocols.CONFIGS / "any.toml")
    if root is None:
        return {"procedural": fresh}
    dense, names = protocols.load_shapes(root, 6)
    plain = np.flatnonzero(~np.isin(names, protocols.SYMMETRIC))
    order = np.random.default_rng(options.test_seed).permutation(plain)
    return {"procedural": fresh, "ModelNet40": list(dense[order])}


def main() -> None:
    """Train, save, then print a line for every kind of features and set of shapes."""
    options = tyro.cli(Options, description=__doc__)
    process.enable_compilation_cache()
    trained = {"moments": None}
    if options.released and "network" in options.features:
        trained["network"] = load_features()
    to_fit = [name for name in options.features if name not in trained]
    if to_fit:
        clouds = np.stack(
            [shapes.sample_shape(options.seed, i, points=2048) for i in range(options.shapes)]
        )
        trained |= {name: fit(name, clouds, options) for name in to_fit}
    if options.save and "network" in to_fit:
        card = {
            "command": "python -m research.train_features --save jaxreg/weights",
            "data": f"{options.shapes} procedural shapes, seed {options.seed}",
            "steps": options.steps,
            "batch": options.batch,
        }
        save_weights(options.save, "features", trained["network"], feature_config(), card)
    if "network" in trained:
        trained["network, 1-NN"] = trained["network"]
    for label, chosen in clouds_to_test_on(options).items():
        for name, weights in trained.items():
            rows = test(search(name, weights), chosen, options)
            figures = (f"{k} {m:.3f} / {r:.3f} / {a:.3f}" for k, (m, r, a) in rows.items())
            print(f"{label}, {name}: {', '.join(figures)}", flush=True)


if __name__ == "__main__":
    main()
