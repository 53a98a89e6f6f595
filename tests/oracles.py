"""Independent references: slow float64 loops in numpy and scipy, from the equations of the paper.

Nothing here imports jaxreg, except that the oracles of the networks read a tree of parameters.
"""

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

LEAK = 0.2
"""Slope of the inlier networks' LeakyReLU below zero."""


def neighbor_distances(points, k, mask=None):
    """(n, k) sorted distances of every valid point to its k nearest other valid points."""
    points = np.asarray(points, float)
    valid = np.arange(len(points)) if mask is None else np.flatnonzero(mask)
    result = np.full((len(points), k), np.nan)
    for i in valid:
        others = points[[j for j in valid if j != i]]
        result[i] = (
            cKDTree(others).query(points[i], k)[0]
            if k > 1
            else (np.min(np.linalg.norm(others - points[i], axis=1)))
        )
    return result


def angle(u, v):
    """Angle in radians by Kahan's formula of the half angle; 0 when either vector is zero."""
    a, b = np.linalg.norm(u), np.linalg.norm(v)
    if a == 0 or b == 0:
        return 0.0
    u, v = u / a, v / b
    return 2 * np.arctan2(np.linalg.norm(u - v), np.linalg.norm(u + v))


def softmax_rows(x):
    """Softmax along the last axis."""
    e = np.exp(x - x.max(axis=-1, keepdims=True))
    return e / e.sum(axis=-1, keepdims=True)


def feature_distance(source, reference):
    """D of Eq. 3, entry by entry."""
    return np.array([[np.linalg.norm(a - b) for b in reference] for a in source])


def neighborhood_sum(scores, source_idx, reference_idx):
    """The double sum of Eq. 4, entry by entry."""
    n, m = len(source_idx), len(reference_idx)
    total = np.zeros((n, m))
    for i in range(n):
        for j in range(m):
            for a in source_idx[i]:
                for b in reference_idx[j]:
                    total[i, j] += scores[a, b]
    return total


def maps(distance, nearest_distance, source_idx, reference_idx, alpha, nearest_idx=None):
    """M, G and F of Eq. 3-5."""
    k = len(source_idx[0])
    scores, total = softmax_rows(-distance), distance
    dual = neighborhood_sum(scores, source_idx, reference_idx) / k
    if nearest_distance is not None:
        total = distance + nearest_distance
        nearest = softmax_rows(-nearest_distance)
        graphs = nearest_idx or (source_idx, reference_idx)
        dual = dual + neighborhood_sum(nearest, *graphs) / k
    return scores, dual, softmax_rows(-np.exp(alpha - dual) * total)


def geometric_structure(points, neighbors, edge, angles):
    """The input of f_theta of Eq. 9: what Eq. 7-8 say, neighbour by neighbour."""
    rows = []
    for i, near in enumerate(neighbors):
        vectors = [points[i] - points[j] for j in near]
        row = []
        for r, j in enumerate(near):
            features = {
                "vector": list(vectors[r]),
                "length": [np.linalg.norm(vectors[r])],
                "coordinates": list(points[j]),
            }[edge]
            if angles == "all":
                features += [0.0 if s == r else angle(vectors[r], v) for s, v in enumerate(vectors)]
            elif angles == "next":
                features.append(angle(vectors[r], vectors[(r + 1) % len(near)]))
            row.append(features)
        rows.append(row)
    return np.array(rows)


def dense(layer, x):
    """A linear map with the parameters of a Flax Dense layer."""
    return x @ np.asarray(layer["kernel"]) + np.asarray(layer.get("bias", 0.0))


def batch_norm(params, statistics, name, x):
    """Batch normalisation with running statistics and epsilon 1e-5."""
    p, s = params[name]["BatchNorm_0"], statistics[name]["BatchNorm_0"]
    normal = (x - np.asarray(s["mean"])) / np.sqrt(np.asarray(s["var"]) + 1e-5)
    return normal * np.asarray(p["scale"]) + np.asarray(p["bias"])


def dgcnn(params, statistics, points, neighbors):
    """Features of a cloud, point by point and edge by edge."""
    edges = [[points[j] - points[i] for j in near] for i, near in enumerate(neighbors)]
    return np.array([dgcnn_of_edges(params, statistics, x) for x in edges])


def dgcnn_of_edges(params, statistics, x):
    """The feature of a point from its edges."""
    layers = sum(name.startswith("Dense") for name in params)
    pooled = []
    for layer in range(layers - 1):
        x = [
            np.maximum(
                batch_norm(
                    params, statistics, f"BatchNorm_{layer}", dense(params[f"Dense_{layer}"], e)
                ),
                0,
            )
            for e in x
        ]
        pooled.append(np.max(x, axis=0))
    last = dense(params[f"Dense_{layers - 1}"], np.concatenate(pooled))
    return np.maximum(batch_norm(params, statistics, f"BatchNorm_{layers - 1}", last), 0)


def inlier_confidence(params, statistics, source, copy):
    """w of Eq. 9-11, point by point; `source` and `copy` are geometric structures (n, k, d)."""

    def layer(number, norm, x):
        y = batch_norm(params, statistics, f"BatchNorm_{norm}", dense(params[f"Dense_{number}"], x))
        return np.where(y > 0, y, LEAK * y)

    # The order in which the network makes its layers: f_theta 0 and 1, then f_mu.
    confidence = []
    for e_source, e_copy in zip(source, copy, strict=True):
        f_theta = [[layer(1, 1, layer(0, 0, x)) for x in e] for e in (e_source, e_copy)]
        d = np.array(f_theta[0]) - np.array(f_theta[1])
        # The outer linear map of f_mu is made before the inner layer that it is applied to.
        f_mu = np.array([dense(params["Dense_2"], layer(3, 2, x)) for x in d])
        delta = softmax_rows(f_mu.T).T
        pooled = (delta * d).sum(axis=0)
        # 1 - tanh|x|; as a difference it would be rounding noise where |x| is above 15 or so.
        confidence.append(2 / (np.exp(2 * np.abs(dense(params["Dense_4"], pooled)[0])) + 1))
    return np.array(confidence)


def procrustes(source, reference, weights):
    """R, t of Eq. 13 by scipy."""
    weights = np.asarray(weights, float)
    share = weights / weights.sum()
    p, q = share @ source, share @ reference
    rotation = Rotation.align_vectors(reference - q, source - p, weights=weights)[0].as_matrix()
    return rotation, q - rotation @ p


def weighted_cost(rotation, translation, source, reference, weights):
    """The objective of Eq. 13."""
    return sum(
        w * np.sum((rotation @ x + translation - y) ** 2)
        for x, y, w in zip(source, reference, weights, strict=True)
    )


def huber(x, beta):
    """The Huber function of L_gc."""
    return x * x / 2 if x < beta else beta * x - beta * beta / 2


def global_consistency(moved, reference, beta):
    """L_gc (Eq. 14)."""
    to, back = cKDTree(reference).query(moved)[0], cKDTree(moved).query(reference)[0]
    return sum(huber(d * d, beta) for d in (*to, *back))


def neighborhood_consistency(source, copy, rotation, translation, neighbors, inliers, squared):
    """L_in (Eq. 15)."""
    total = 0.0
    for i in inliers:
        moved = {j: rotation @ source[j] + translation for j in (i, *neighbors[i])}
        if squared:
            total += np.sum((moved[i] - copy[i]) ** 2)
            for j in neighbors[i]:
                edge = (moved[i] - moved[j]) - (copy[i] - copy[j])
                total += np.sum(edge**2) / len(neighbors[i])
        else:
            total += sum(np.linalg.norm(moved[j] - copy[j]) for j in neighbors[i])
    return total


def geometric_consistency(source, copy, neighbors, inliers, edge, angles):
    """L_gs (Eq. 16): edges, then angles."""
    total = 0.0
    size = 1 if edge == "length" else 3
    kind = "length" if edge == "length" else "vector"
    structures = [geometric_structure(x, neighbors, kind, angles) for x in (source, copy)]
    for i in inliers:
        for a, b in zip(structures[0][i], structures[1][i], strict=True):
            total += np.linalg.norm(a[:size] - b[:size]) + np.linalg.norm(a[size:] - b[size:])
    return total


def spatial_consistency(scores, inliers):
    """L_sc (Eq. 17) of a map (n, m)."""
    total = 0.0
    for i in inliers:
        j = np.argmax(scores[i])
        total -= np.log(scores[i, j])
    return total / len(inliers)


def directional_difference(function, inputs, direction, step=1e-5):
    """Central difference of `function` (a list of arrays to a list of arrays) along `direction`."""
    ahead = function([x + step * d for x, d in zip(inputs, direction, strict=True)])
    behind = function([x - step * d for x, d in zip(inputs, direction, strict=True)])
    return [
        (np.asarray(a) - np.asarray(b)) / (2 * step) for a, b in zip(ahead, behind, strict=True)
    ]
