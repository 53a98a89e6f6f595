"""The equations of the paper as one would first write them in JAX: yardstick and oracle.

Nothing of jaxreg is imported, and nothing is done for speed: neighbours by sorting every row, a
module for every cloud in every iteration, iterations in a Python loop, neighbourhood sums by
indexing. Compiled by `jax.jit` as it stands
this is what a first port costs (`benchmarks/speed/speed.py`), and since it shares no code with the
library it is what the library's results and gradients are held to
(`tests/benchmarks/test_transcription.py`).

The readings are those of the released weights: `gather` for the 1-NN patch, edge vectors, the top N_c in
the Procrustes, angles to the next edge or to all. So are the parameters.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

LEAK = 0.2


class Result(NamedTuple):
    """Transform from source to reference, confidence (n,) and copy (n, 3) of the last iteration."""

    rotation: jax.Array
    translation: jax.Array
    confidence: jax.Array
    copy: jax.Array


class Parts(NamedTuple):
    """What the losses of one iteration read."""

    source: jax.Array
    copy: jax.Array
    dual: jax.Array
    neighbors: jax.Array
    inliers: jax.Array
    rotation: jax.Array
    translation: jax.Array


def root(x):
    """sqrt(max(x, 0)); without the inner `where` its derivative at 0 would be NaN."""
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1)), 0)


def norm(x):
    """Euclidean norm along the last axis."""
    return root(jnp.sum(x**2, axis=-1))


def squared_distances(a, b):
    """|a_i - b_j|^2 of points."""
    return jnp.sum((a[:, None] - b[None]) ** 2, axis=-1)


def neighborhoods(points, k):
    """N_o: the k nearest other points (n, k), nearest first."""
    distance = squared_distances(points, points)
    distance = jnp.where(jnp.eye(points.shape[0], dtype=bool), jnp.inf, distance)
    return jnp.argsort(distance, axis=1)[:, :k]


def batch_norm(params, statistics, x, train):
    """Normalise channels: by running statistics, or by those of the batch (`vmap` axis "batch")."""
    params, statistics = params["BatchNorm_0"], statistics["BatchNorm_0"]
    axes = tuple(range(x.ndim - 1))
    mean, variance, scale, bias = (
        jnp.expand_dims(value, axes)
        for value in (statistics["mean"], statistics["var"], params["scale"], params["bias"])
    )
    if train:
        mean = jax.lax.pmean(jnp.mean(x, axis=axes, keepdims=True), "batch")
        variance = jax.lax.pmean(jnp.mean((x - mean) ** 2, axis=axes, keepdims=True), "batch")
    return (x - mean) / jnp.sqrt(variance + 1e-5) * scale + bias


def dense(params, x):
    """A linear map of the last axis."""
    y = x @ params["kernel"]
    return y + jnp.broadcast_to(params["bias"], y.shape) if "bias" in params else y


def features(variables, points, neighbors, train):
    """F_P: DGCNN over the edges of every neighbourhood."""
    params, statistics = (variables[kind]["features"] for kind in ("params", "batch_stats"))
    last = sum(name.startswith("Dense") for name in params) - 1

    def layer(number, x):
        y, name = dense(params[f"Dense_{number}"], x), f"BatchNorm_{number}"
        return jax.nn.relu(batch_norm(params[name], statistics[name], y, train))

    x, pooled = points[neighbors] - points[:, None], []
    for number in range(last):
        x = layer(number, x)
        pooled.append(jnp.max(x, axis=1))
    return layer(last, jnp.concatenate(pooled, axis=-1))


def feature_distance(a, b):
    """D_ij = |a_i - b_j| of features, by the usual product form."""
    squares = jnp.sum(a**2, axis=1)[:, None] + jnp.sum(b**2, axis=1)[None]
    return root(squares - 2 * a @ b.T)


def neighborhood_sum(scores, source_neighbors, reference_neighbors):
    """Sum of the scores over N(p_i) x N(q_j): an (n, k, m) array, then an (n, m, k) array."""
    rows = jnp.sum(scores[source_neighbors], axis=1)
    return jnp.sum(rows[:, reference_neighbors], axis=2)


def matching(source_features, reference_features, source_neighbors, reference_neighbors, config):
    """The maps G and F (Eq. 3-5)."""
    nearest_p, nearest_q = source_neighbors[:, 0], reference_neighbors[:, 0]
    near_p, near_q = source_neighbors[:, : config.k_matching], reference_neighbors
    near_q = near_q[:, : config.k_matching]
    distance = feature_distance(source_features, reference_features)
    nearest = feature_distance(source_features[nearest_p], reference_features[nearest_q])
    scores, nearest_scores = (jax.nn.softmax(-d, axis=1) for d in (distance, nearest))
    dual = neighborhood_sum(scores, near_p, near_q) / config.k_matching
    dual += neighborhood_sum(nearest_scores, near_p, near_q) / config.k_matching
    final = jnp.exp(config.alpha - dual) * (distance + nearest)
    return dual, jax.nn.softmax(-final, axis=1)


def structure(points, neighbors, angles):
    """Edges (n, k, 3) and angles (n, k, 1 or k) of every neighbourhood (Eq. 7-8)."""
    edges = points[:, None] - points[neighbors]
    following = jnp.roll(edges, -1, axis=1)[:, :, None]
    one, other = edges[:, :, None], edges[:, None] if angles == "all" else following
    cross = jnp.cross(*jnp.broadcast_arrays(one, other))
    return edges, jnp.arctan2(norm(cross), jnp.sum(one * other, axis=-1))


def confidence(variables, source, copy, neighbors, config, train):
    """w_i (Eq. 9-11)."""
    params, statistics = (variables[kind]["inliers"] for kind in ("params", "batch_stats"))

    def layer(number, name, x):
        y = batch_norm(params[name], statistics[name], dense(params[f"Dense_{number}"], x), train)
        return jax.nn.leaky_relu(y, LEAK)

    shapes = [structure(p, neighbors, config.angles) for p in (source, copy)]
    x = jnp.stack([jnp.concatenate(shape, axis=-1) for shape in shapes])
    fused = layer(1, "BatchNorm_1", layer(0, "BatchNorm_0", x))
    difference = fused[0] - fused[1]
    attention = dense(params["Dense_2"], layer(3, "BatchNorm_2", difference))
    pooled = jnp.sum(jax.nn.softmax(attention, axis=1) * difference, axis=1)
    return 1 - jnp.tanh(jnp.abs(dense(params["Dense_4"], pooled)[:, 0]))


def procrustes(source, reference, weights):
    """R, t of Eq. 13 by a singular value decomposition."""
    share = weights / jnp.sum(weights)
    p, q = share @ source, share @ reference
    u, _, vt = jnp.linalg.svd((share[:, None] * (source - p[None])).T @ (reference - q[None]))
    sign = jnp.linalg.det(vt.T @ u.T)
    rotation = (vt.T * jnp.stack([jnp.ones_like(sign), jnp.ones_like(sign), sign])[None]) @ u.T
    return rotation, q - rotation @ p


def step(variables, source, reference, config, train):
    """One registration step: the confidence, and what the losses read."""
    k = max(config.k, config.k_matching)
    source_neighbors, reference_neighbors = (neighborhoods(x, k) for x in (source, reference))
    near = source_neighbors[:, : config.k]
    source_features = features(variables, source, near, train)
    reference_features = features(variables, reference, reference_neighbors[:, : config.k], train)
    dual, final = matching(
        source_features, reference_features, source_neighbors, reference_neighbors, config
    )
    copy = final @ reference
    weights = confidence(variables, source, copy, near, config, train)
    inliers = jnp.argsort(-weights)[: config.n_inliers]
    motion = procrustes(source[inliers], copy[inliers], weights[inliers])
    return weights, Parts(source, copy, dual, near, inliers, *motion)


def register(variables: Any, source, reference, *, config) -> Result:
    """Register one pair, (n, 3) and (m, 3); `config` is a `ModelConfig` with the default readings."""
    rotation, translation = jnp.eye(3, dtype=source.dtype), jnp.zeros(3, source.dtype)
    for _ in range(config.iterations):
        weights, parts = step(variables, source, reference, config, train=False)
        source = source @ parts.rotation.T + parts.translation[None]
        rotation = parts.rotation @ rotation
        translation = parts.rotation @ translation + parts.translation
    return Result(rotation, translation, weights, parts.copy)


def losses(parts, reference, config, angles):
    """L_gc + gamma L_in + rho L_gs + lambda L_sc of one iteration (Eq. 14-17)."""
    moved = parts.source @ parts.rotation.T + parts.translation[None]
    distance = squared_distances(moved, reference)
    nearest = jnp.concatenate([jnp.min(distance, axis=1), jnp.min(distance, axis=0)])
    beta = config.beta
    huber = jnp.where(nearest < beta, nearest**2 / 2, beta * nearest - beta**2 / 2)
    near = parts.neighbors[parts.inliers]
    within = norm(moved[near] - parts.copy[near])
    shapes = [structure(x, parts.neighbors, angles) for x in (parts.source, parts.copy)]
    edges, included = (norm((a - b)[parts.inliers]) for a, b in zip(*shapes, strict=True))
    peak = jnp.max(parts.dual[parts.inliers], axis=1)
    return (
        config.global_consistency * jnp.sum(huber)
        + config.gamma * jnp.sum(within)
        + config.rho * (jnp.sum(edges) + jnp.sum(included))
        - config.lambda_ * jnp.mean(jnp.log(peak))
    )


def batch_loss(params: Any, statistics: Any, sources, references, *, config) -> jax.Array:
    """Mean over pairs of the loss of Eq. 18, in training mode; clouds (b, n, 3) and (b, m, 3)."""
    variables = {"params": params, "batch_stats": statistics}

    def pair_loss(source, reference):
        total = jnp.zeros((), source.dtype)
        for _ in range(config.model.iterations):
            _, parts = step(variables, source, reference, config.model, train=True)
            total += losses(parts, reference, config.loss, config.model.angles)
            source = source @ parts.rotation.T + parts.translation[None]
        return total

    return jnp.mean(jax.vmap(pair_loss, axis_name="batch")(sources, references))
