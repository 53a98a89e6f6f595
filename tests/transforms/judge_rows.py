"""Rows of the judge: what a cloud shows, what a pose shows, and the odds of that."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxreg.judge import evidence, odds, surface
from tests.transforms.rows import N, Row, every, neighbor_graph, points, pose

RNG = np.random.default_rng(4)
ALL, NONE = np.ones(N, bool), np.zeros(N, bool)
PARTNERS = np.roll(np.arange(N, dtype=np.int32), 3)


def unit_vectors():
    vectors = points()
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def examined(cloud, spacing=1.0, mask=ALL):
    numbers = RNG.uniform(0, 1, (3, N)) * np.array([[0.06], [20.0], [1.0]])
    return surface.Examined(cloud, unit_vectors(), *numbers, mask, np.float64(spacing))


def shown(*shape):
    return evidence.Evidence(*RNG.uniform(0.1, 1, (len(evidence.Evidence._fields), *shape)))


def judge_rows() -> dict[str, Row]:
    def read(pose, source, reference):
        there = back = jnp.asarray(PARTNERS)
        return evidence.read_evidence(pose, source, reference, there, back)

    empty = (pose(), examined(points(), mask=NONE), examined(points()))
    nothing = jax.tree.map(np.zeros_like, shown(3))._replace(
        distance=np.full(3, 1.2), rough_distance=np.ones(3)
    )
    x = points()
    rows = {
        "evidence.read_evidence": Row(
            read,
            (pose(), examined(points()), examined(points(), 1.3)),
            (*every(lambda c: (pose(), examined(c), examined(c))), empty),
        ),
        "odds.features": Row(odds.features, (shown(4),), ((nothing,),)),
        "odds.log_odds": Row(odds.log_odds, (shown(4),), ((nothing,),)),
        "odds.probabilities": Row(
            odds.probabilities, (RNG.normal(size=5),), ((np.zeros(5),), (np.full(5, -1e9),))
        ),
        "surface.examine": Row(
            lambda c, n, m: surface.examine(c, n, jnp.asarray(neighbor_graph()), m),
            (x, unit_vectors(), ALL),
            (*every(lambda c: (c, unit_vectors(), ALL)), (x, unit_vectors(), NONE)),
        ),
        "surface.every": Row(lambda c: surface.every(c, 2), (examined(x),)),
    }
    return {f"judge.{name}": row for name, row in rows.items()}
