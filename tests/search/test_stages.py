import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.search.config import SearchConfig
from jaxreg.search.description import compare, describe
from jaxreg.search.learned import init_network
from jaxreg.search.pipeline import enter, search_poses
from jaxreg.search.stages import search_described
from jaxreg.types import RigidTransform
from tests.search.clouds import angle_deg, box, make_pair, padded

pytestmark = [pytest.mark.float32]
CONFIG = SearchConfig(candidates=256, screened=24, aligned=8)


@functools.partial(jax.jit, static_argnames="config")
def search_of(x, y, a, b, alike, also, max_angle, config=CONFIG):
    """All searches with a similarity share one program."""
    return search_poses(
        x,
        y,
        source_mask=a,
        reference_mask=b,
        similarity=alike,
        also=also,
        max_angle=max_angle,
        config=config,
    )


@pytest.fixture
def boxes(seed):
    """Two samplings of a box, padded, and which pose lays the first on the other."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(np.radians(50) * np.array([0.6, 0.0, 0.8])).as_matrix()
    source, reference = box(rng, 380), box(rng, 340)
    return padded(source @ turn, 400, np.nan), padded(reference, 400, np.nan), source, turn


def likeness(source, reference):
    """Cosines that make points alike that are near each other; NaN for padding."""
    gap = np.linalg.norm(source[:, None] - reference[None], axis=2)
    alike = np.full((400, 400), np.nan, np.float32)
    alike[: len(source), : len(reference)] = 2 * np.exp(-((gap / 0.2) ** 2)) - 1
    return jnp.asarray(alike)


FAR = RigidTransform(jnp.eye(3, dtype=jnp.float32), jnp.full(3, 9, jnp.float32))
"""A pose that leads nowhere."""
SYMMETRIES = ([1, 1, 1], [1, -1, -1], [-1, -1, 1], [-1, 1, -1])


def test_matches_come_from_the_similarity_that_is_given(boxes):
    """Of the four poses of a box, which fit alike, the one whose matches look alike."""
    (x, mask), (y, other), source, turn = boxes
    for symmetry in SYMMETRIES:
        alike = likeness(source * symmetry, np.asarray(y)[:340])
        found = search_of(x, y, mask, other, alike, FAR, np.float32(np.pi))
        assert angle_deg(found.poses.rotation[0], np.diag(symmetry) @ turn) < 5
        assert np.all(found.allowed)


def test_poses_beyond_the_largest_angle_come_last(boxes):
    """The matches say half a turn and 50 degrees, but only 80 are allowed."""
    (x, mask), (y, other), source, turn = boxes
    for symmetry in SYMMETRIES[1:]:
        alike = likeness(source * symmetry, np.asarray(y)[:340])
        alike = jnp.maximum(alike, likeness(source, np.asarray(y)[:340]) - 0.1)
        found = search_of(x, y, mask, other, alike, FAR, np.float32(np.radians(80)))
        turned = Rotation.from_matrix(found.poses.rotation).magnitude()
        allowed, score = np.asarray(found.allowed), np.asarray(found.score)
        np.testing.assert_array_equal(allowed, turned <= np.radians(80))
        assert angle_deg(found.poses.rotation[0], turn) < 5
        assert not np.any(np.diff(allowed.astype(int)) > 0)
        for part in (score[allowed], score[~allowed]):
            assert np.all(np.diff(part) <= 0)


def test_a_pose_that_no_match_leads_to_can_be_given(boxes):
    (x, mask), (y, other), source, turn = boxes
    alike = likeness(source * [1, -1, -1], np.asarray(y)[:340])
    near = Rotation.from_matrix(turn) * Rotation.from_rotvec([0.05, 0, 0.03])
    also = RigidTransform(jnp.float32(near.as_matrix()), jnp.zeros(3, jnp.float32))
    found = search_of(x, y, mask, other, alike, also, np.float32(np.pi))
    assert min(angle_deg(rotation, turn) for rotation in found.poses.rotation) < 5


@pytest.mark.slow
def test_a_network_matches_points_by_its_features(seed):
    """The search is that of the cosines of its features, and not that of the moments."""
    source, reference, _ = make_pair(seed)
    network = init_network(jax.random.key(seed))
    (x, mask), (y, other) = (padded(p, 400, np.nan) for p in (source, reference))

    @jax.jit
    def both(x, y):
        _, a, b = enter(x, y, mask, other)
        described = [describe(p, m, unit=1.0, config=CONFIG) for p, m in ((a, mask), (b, other))]
        cosines = [compare(*described, network=n).similarity for n in (network, None)]
        return search_described(*described, network=network, config=CONFIG), cosines

    of_network, cosines = both(x, y)
    of_its_cosines, of_moments = (
        search_of(x, y, mask, other, c, None, np.float32(np.pi)) for c in cosines
    )
    np.testing.assert_allclose(of_network.score, of_its_cosines.score, atol=1e-3)
    assert np.abs(of_network.score - of_moments.score).max() > 0.01
