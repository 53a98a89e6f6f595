"""From evidence to probabilities: which of several poses is right, if any.

Of distinct poses at most one is right. With ``s_k`` the log odds that the evidence gives pose k,

    P(pose k is right) = exp(s_k) / (1 + sum_j exp(s_j)),

and the one in the denominator stands for "none of them". So one number ranks the poses, settles
close calls and is the probability that the user sees: two poses that agree equally well share it.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import softmax

from jaxreg.judge.evidence import Evidence

INTERCEPT = -2.351
WEIGHTS = Evidence(
    smaller=2.842, larger=-1.044, distance=-7.531, rough_distance=-2.125, rough_facing=0.0,
    disagreement=-8.215, beside=7.263, unseen=-13.293, rough=0.133, ends=10.925, held=5.5,
    same=30.0, sparse=-7.0,
)  # fmt: skip
"""What one unit of every feature adds to the log odds.

Fitted on 2026-11-28 to 287 virtual pairs of procedural rooms and shapes and 204 real pairs of five
sensors (research/fit_judge.py); the table of the sensors left out is in docs/notes/0040. The last
two are set by hand: where points coincide nothing else tells more, and the doubt about sparse clouds
is the one whose probabilities come true best on clouds of 400 to 2,000 points (docs/notes/0046)."""


def features(evidence: Evidence) -> Evidence:
    """The evidence as the log odds take it: shares and lengths by their logarithm."""
    return evidence._replace(
        smaller=jnp.log(evidence.smaller + 0.003),
        larger=jnp.log(evidence.larger + 0.003),
        distance=jnp.log(evidence.distance),
        rough_distance=jnp.log(evidence.rough_distance),
        held=jnp.log10(jnp.maximum(evidence.held, 1e-6)),
        # Half of the points are proof; of a grid, which coincides with itself, more is chance.
        same=jnp.minimum(evidence.same, 0.5),
    )


def log_odds(evidence: Evidence) -> Float[Array, "*k"]:
    """``s = w_0 + sum_i w_i f_i``: the larger, the more speaks for the pose.

    Fitted by research/fit_judge.py; the head of that file says on what.
    """
    terms = jax.tree.map(jnp.multiply, WEIGHTS, features(evidence))
    return INTERCEPT + jnp.sum(jnp.stack(terms), axis=0)


def chances(score: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """`probabilities` on the host, where every number of poses would be a program of its own."""
    return np.asarray(softmax(np.append(np.asarray(score, np.float64), 0.0))[:-1])


def probabilities(
    score: Float[Array | np.ndarray, "k"], counted: Bool[Array, "k"] | None = None
) -> Float[Array, "k"]:
    """The chance of every pose to be the right one; 0 where a pose is not `counted`.

    Count of poses that are the same but for noise only one, or they share its chance.
    """
    score = jnp.asarray(score)
    if counted is not None:
        score = jnp.where(counted, score, -jnp.inf)
    none = jnp.zeros(1, score.dtype)
    return jax.nn.softmax(jnp.concatenate([score, none]))[:-1]
