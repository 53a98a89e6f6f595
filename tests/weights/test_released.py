"""Released weights: what is saved is what is loaded, without pickle."""

import json

import jax
import numpy as np
import pytest

from jaxreg.config import Config, from_dict
from jaxreg.network.model import init_variables
from jaxreg.weights import released

pytestmark = pytest.mark.float32


def test_saved_weights_load_bit_for_bit(tmp_path, monkeypatch, seed):
    config = from_dict({"model": {"channels": [4], "width": 4, "alpha": 0.6}})
    variables = jax.tree.map(np.asarray, init_variables(jax.random.key(seed), config.model))
    released.save_weights(tmp_path / "weights", "mine", variables, config, {"seed": seed})
    monkeypatch.setattr(released.resources, "files", lambda package: tmp_path)
    loaded, loaded_config = released.load_pretrained("mine")
    jax.tree.map(np.testing.assert_array_equal, loaded, variables)
    assert loaded_config == config
    assert released.load_card("mine")["seed"] == seed


def test_equal_weights_give_equal_files(tmp_path):
    variables = {"params": {"a": np.arange(3.0)}}
    for name in ("one", "two"):
        released.save_weights(tmp_path / name, "w", variables, Config(), {})
    assert (tmp_path / "one" / "w.npz").read_bytes() == (tmp_path / "two" / "w.npz").read_bytes()


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match="no released weights 'nothing': choose from"):
        released.load_pretrained("nothing")


@pytest.mark.parametrize("name", released.available_weights())
def test_released_weights_are_small_and_tell_where_they_come_from(name):
    folder = released.resources.files("jaxreg") / "weights"
    assert len((folder / f"{name}.npz").read_bytes()) < 3e6
    card = json.loads((folder / f"{name}.json").read_text("utf-8"))
    assert {"command", "data", "seed", "step", "validation", "config"} <= set(card)
    variables, config = released.load_pretrained(name)
    fresh = init_variables(jax.random.key(0), config.model)
    assert jax.tree.map(np.shape, fresh) == jax.tree.map(np.shape, variables)


@pytest.mark.parametrize("name", ["", "a/b", "../modelnet40", "a b", "a.b", "möbel", "a\n"])
def test_a_name_that_is_not_plain_is_refused(name):
    with pytest.raises(ValueError, match="use letters, digits, _ and - only"):
        released.check_new_name(name)


def test_a_name_that_is_taken_is_refused_until_its_files_are_deleted(tmp_path, monkeypatch):
    monkeypatch.setattr(released.resources, "files", lambda package: tmp_path)
    released.check_new_name("my_scans-2")
    released.save_weights(tmp_path / "weights", "my_scans-2", {"a": np.zeros(1)}, Config(), {})
    with pytest.raises(ValueError, match=r"delete my_scans-2.npz and my_scans-2.json in .*weights"):
        released.check_new_name("my_scans-2")
    (tmp_path / "weights" / "my_scans-2.npz").unlink()
    released.check_new_name("my_scans-2")
