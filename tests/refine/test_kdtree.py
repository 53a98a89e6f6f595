"""Padded sizes and the pairs of the trees against brute force."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.geometry import rigid
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.correspondences import closest_pairs
from jaxreg.refine.kdtree import index_cloud, iterate, tree_pairs
from jaxreg.refine.robust import Weighting
from jaxreg.types import RigidTransform


def test_the_last_width_is_used_where_a_wider_one_stands_still():
    cloud = index_cloud(np.random.default_rng(0).normal(size=(70, 3)), k=5)
    start = RigidTransform(np.eye(3), np.zeros(3))  # the right pose: no width moves it
    weighting = Weighting("geman_mcclure", None, np.inf, 1.0)
    for widest, iterations, steps in ((8.0, 2, 2), (8.0, 4, 3), (1.0, 2, 1)):
        config = RefineConfig(iterations=iterations, kernel_annealing=widest, epsilon=0.01)
        _, taken, converged, _ = iterate(start, cloud, cloud, weighting, config=config)
        assert (taken, converged) == (steps, True)


@pytest.mark.parametrize("both_directions", [False, True])
def test_pairs_equal_brute_force(both_directions, seed):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(70, 3)), rng.normal(size=(90, 3))
    pose = RigidTransform(Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3))
    clouds = [index_cloud(points, k=5) for points in (x, y)]
    pairs = tree_pairs(pose, *clouds, 1, both_directions=both_directions)
    moved = rigid.apply(RigidTransform(*map(jnp.asarray, pose)), jnp.asarray(x))
    expected = closest_pairs(moved, jnp.asarray(y), None, None, both_directions=both_directions)
    count = len(expected.mask)
    np.testing.assert_array_equal(pairs.source_index[:count], expected.source_index)
    np.testing.assert_array_equal(pairs.reference_index[:count], expected.reference_index)
    assert pairs.mask[:count].all()
    assert not pairs.mask[count:].any()
