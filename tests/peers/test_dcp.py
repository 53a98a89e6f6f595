"""DCP against its equations in numpy, and its released weights where they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxreg.config import Config, DCPConfig
from jaxreg.peers import dcp
from jaxreg.types import PointCloud
from tests import oracles
from tests.peers.small import draw_variables

# Flax promotes with the float32 that it starts from.
pytestmark = pytest.mark.loose

SMALL = DCPConfig(k=4, channels=(5, 6), width=8)
register = jax.jit(dcp.register, static_argnames="config")


def expected_features(variables, points, k):
    params, statistics = (variables[kind]["features"] for kind in ("params", "batch_stats"))
    near = cKDTree(points).query(points, k)[1]
    edges = [np.hstack([points[j], np.tile(p, (k, 1))]) for p, j in zip(points, near, strict=True)]
    return np.array([oracles.dgcnn_of_edges(params, statistics, e) for e in edges])


def expected(variables, source, reference, k):
    features = [expected_features(variables, x, k) for x in (source, reference)]
    scores = oracles.softmax_rows(features[0] @ features[1].T / np.sqrt(features[0].shape[1]))
    copy = scores @ reference
    return copy, oracles.procrustes(source, copy, np.ones(len(source)))


def test_the_pose_is_that_of_the_equations(seed):
    rng = np.random.default_rng(seed)
    variables = draw_variables(dcp, SMALL, rng)
    source, reference = rng.normal(size=(20, 3)), rng.normal(size=(17, 3))
    found = register(variables, source, reference, config=SMALL)
    copy, (rotation, translation) = expected(variables, source, reference, SMALL.k)
    np.testing.assert_allclose(found.correspondences, copy, atol=1e-9)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-7)
    np.testing.assert_allclose(found.translation, translation, atol=1e-7)
    np.testing.assert_array_equal(found.confidence, np.ones(20))


@pytest.mark.untyped
def test_the_settings_may_be_those_of_a_whole_configuration(seed):
    rng = np.random.default_rng(seed)
    variables = draw_variables(dcp, SMALL, rng)
    clouds = rng.normal(size=(20, 3)), rng.normal(size=(17, 3))
    own = register(variables, *clouds, config=SMALL)
    whole = register(variables, *clouds, config=Config(network="dcp", dcp=SMALL))
    np.testing.assert_array_equal(own.rotation, whole.rotation)
    with pytest.raises(ValueError, match="config must be a jaxreg.DCPConfig, got ModelConfig"):
        dcp.register(variables, *clouds, config=Config().model)


@pytest.mark.peers
def test_the_released_weights_fill_the_network_and_embed_as_they_should(peers_root):
    variables, config = dcp.load_weights(peers_root / "dcp_v1.npz")
    fresh = jax.eval_shape(lambda: dcp.init_variables(jax.random.key(0), config.dcp))
    assert jax.tree.map(jnp.shape, variables) == jax.tree.map(jnp.shape, fresh)
    points = np.random.default_rng(3).uniform(-1, 1, size=(40, 3))
    doubles = jax.tree.map(lambda x: np.asarray(x, np.float64), variables)
    cloud = PointCloud(jnp.asarray(points), jnp.ones(40, bool))
    embed = jax.jit(lambda cloud: dcp.embedding(doubles, cloud, config=config.dcp))
    expected = expected_features(doubles, points, config.dcp.k)
    np.testing.assert_allclose(embed(cloud), expected, atol=1e-8)


@pytest.mark.peers
@pytest.mark.parametrize("extent", [0.05, 0.32394126, 0.36987798, 0.42232879, 3.0])
def test_the_gradient_at_a_line_through_the_origin_is_no_rounding(peers_root, extent):
    """The released weights let all points point to one: 1e24 and NaN came of what softmax left."""
    variables, config = dcp.load_weights(peers_root / "dcp_v1.npz")
    line = jnp.asarray(extent * np.outer(np.arange(24), [1, 2, 3]), jnp.float32)

    def of_pose(source, reference):
        found = dcp.register(variables, source, reference, config=config.dcp)
        return jnp.sum(found.rotation[0]) + jnp.sum(found.translation)

    for gradient in jax.jit(jax.grad(of_pose, argnums=(0, 1)))(line, line):
        assert np.abs(gradient).max() < 1e3


def test_what_is_no_weight_file_is_named(tmp_path):
    np.savez(tmp_path / "other.npz", weight=np.zeros(3))
    with pytest.raises(ValueError, match=r"missing\.npz: no such file"):
        dcp.load_weights(tmp_path / "missing.npz")
    with pytest.raises(ValueError, match=r"other\.npz has no array 'emb_nn.*DCP's whole"):
        dcp.load_weights(tmp_path / "other.npz")
