"""The peers that are trained here go through the same training, checkpoints and evaluation."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.config import Config
from jaxreg.evaluation import methods
from jaxreg.peers import by_name, fmr
from jaxreg.training import create_train_state, release, started_from, train
from jaxreg.types import Pair, PointCloud, RigidTransform
from jaxreg.weights.checkpoint import load_checkpoint
from jaxreg.weights.released import load_pretrained
from tests.peers.small import SMALL, short_training

pytestmark = [pytest.mark.float32, pytest.mark.loose]


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in by_name.TRAINED if n != "paper"])
def test_two_steps_a_checkpoint_and_a_method(name, tmp_path):
    config = short_training(name)
    train(config, tmp_path)
    variables, saved = load_checkpoint(tmp_path)
    assert saved == config
    fresh = by_name.init_variables(jax.random.key(0), config)
    assert jax.tree.structure(variables) == jax.tree.structure(fresh)
    points = np.random.default_rng(0).uniform(-1, 1, (1, 24, 3)).astype(np.float32)
    cloud = PointCloud(points, np.ones((1, 24), bool))
    still = RigidTransform(np.eye(3)[None], np.zeros((1, 3)))
    found = methods.choose(f"checkpoint:{tmp_path}").batch(Pair(cloud, cloud, still))
    np.testing.assert_allclose(found.rotation[0] @ found.rotation[0].T, np.eye(3), atol=1e-5)


def test_weights_are_released_without_what_only_the_training_uses(tmp_path):
    config = short_training("fmr")
    trained = train(config, tmp_path / "run")
    place = release("own", tmp_path / "run", "command", directory=tmp_path).with_suffix("")
    released, _ = load_pretrained(str(place))
    assert set(trained["params"]) - set(released["params"]) == {"decoder"}
    points = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (2, 24, 3)), jnp.float32)
    for both in zip(
        *(jax.tree.leaves(fmr.register(x, *points, config=config)) for x in (trained, released)),
        strict=True,
    ):
        np.testing.assert_array_equal(*both)
    state = create_train_state(config)
    started = started_from(str(place), state).variables["params"]
    for name, expected in (("encoder", trained), ("steps", trained), ("decoder", state.variables)):
        chex.assert_trees_all_equal(started[name], expected["params"][name])
    with pytest.raises(ValueError, match="do not fit the network of the configuration"):
        started_from(str(place), create_train_state(Config(network="idam", idam=SMALL["idam"])))


def test_a_network_that_is_not_trained_here_says_so(tmp_path):
    with pytest.raises(
        ValueError, match="'dcp' is not trained here: .* one of paper, idam, rpmnet, fmr"
    ):
        train(Config(network="dcp"), tmp_path)
