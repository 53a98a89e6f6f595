"""Weights as files: what is saved is what is loaded, without pickle, wherever it lies."""

import dataclasses
import io
import json
import os
import zipfile

import chex
import jax
import numpy as np
import pytest
from flax.traverse_util import unflatten_dict

from jaxreg.config import Config, from_dict
from jaxreg.evaluation import methods
from jaxreg.network.model import init_variables
from jaxreg.peers import by_name
from jaxreg.training import create_train_state, started_from
from jaxreg.weights import released

pytestmark = pytest.mark.float32

SHIPPED = {path.stem: path for path in sorted(released._SHIPPED.glob("*.npz"))}


def save(directory, name, **config):
    """Weights of a small network, saved; the variables and their configuration."""
    config = from_dict({"model": {"channels": [4], "width": 4} | config})
    variables = jax.tree.map(np.asarray, init_variables(jax.random.key(3), config.model))
    released.save_weights(directory, name, variables, config, {"command": "c", "data": "d"})
    return variables, config


def test_saved_weights_load_bit_for_bit_by_their_path(tmp_path):
    variables, config = save(tmp_path / "weights", "mine", alpha=0.6)
    loaded, loaded_config = released.load_pretrained(str(tmp_path / "weights" / "mine"))
    jax.tree.map(np.testing.assert_array_equal, loaded, variables)
    assert loaded_config == config
    assert released.load_card(str(tmp_path / "weights" / "mine"))["data"] == "d"


def test_directories_of_the_environment_are_searched_by_name(tmp_path, monkeypatch):
    one, two = tmp_path / "one", tmp_path / "two"
    save(one, "first", alpha=0.1)
    save(two, "second", alpha=0.2)
    monkeypatch.setenv("JAXREG_WEIGHTS", f"{one}{os.pathsep}{two}{os.pathsep}{tmp_path / 'none'}")
    assert {"first", "second", "modelnet40"} <= set(released.available_weights())
    assert released.load_pretrained("first")[1].model.alpha == 0.1
    assert released.load_pretrained("second")[1].model.alpha == 0.2
    monkeypatch.delenv("JAXREG_WEIGHTS")
    with pytest.raises(ValueError, match=r"no released weights 'first': .*modelnet40.*JAXREG_WEIG"):
        released.load_pretrained("first")


def test_equal_weights_give_equal_files(tmp_path, monkeypatch):
    variables = {"params": {"a": np.arange(3.0), "b": {"c": np.ones(2)}}}
    for name in ("one", "two"):
        monkeypatch.setattr("time.time", lambda name=name: 1e9 * len(name))
        released.save_weights(tmp_path / name, "w", variables, Config(), {})
        variables = {"params": dict(reversed(variables["params"].items()))}
    assert (tmp_path / "one" / "w.npz").read_bytes() == (tmp_path / "two" / "w.npz").read_bytes()
    with zipfile.ZipFile(tmp_path / "one" / "w.npz") as archive:
        assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_the_tree_is_that_of_flax(tmp_path):
    variables, _ = save(tmp_path, "mine")
    flat, _ = released.load_arrays(str(tmp_path / "mine"))
    tree = unflatten_dict(flat, sep="/")
    jax.tree.map(np.testing.assert_array_equal, tree, variables)


def test_an_unknown_name_lists_the_known_ones(tmp_path):
    with pytest.raises(
        ValueError, match="no released weights 'nothing': choose from fmr, idam, modelnet40"
    ):
        released.load_pretrained("nothing")
    with pytest.raises(ValueError, match=r"nothing.npz and .*nothing.json not found: give"):
        released.load_pretrained(str(tmp_path / "nothing"))


def test_the_features_of_the_search_are_not_a_network():
    assert "features" not in released.available_weights()
    with pytest.raises(
        ValueError, match="'features' are not those of a network: choose from fmr, idam, mod"
    ):
        released.load_pretrained("features")
    arrays, card = released.load_arrays("features")
    assert {array.dtype for array in arrays.values()} == {np.dtype(np.float32)}
    assert "radii" in card["config"]


@pytest.mark.parametrize(
    ("suffix", "content", "message"),
    [
        (".npz", b"PK rubbish", r"mine.npz is not an .npz of arrays .*copy it again"),
        (".json", b"{", r"mine.json cannot be read .*copy it again"),
        (".json", b"[1]", r"mine.json is not a card of weights.*copy it again"),
        (".json", b'{"config": {"model": {"kk": 1}}}', "mine.json: .*unknown key 'kk'"),
    ],
)
def test_damaged_files_are_named(tmp_path, suffix, content, message):
    save(tmp_path, "mine")
    (tmp_path / f"mine{suffix}").write_bytes(content)
    with pytest.raises(ValueError, match=message):
        released.load_pretrained(str(tmp_path / "mine"))


def test_a_pickle_is_never_opened(tmp_path):
    save(tmp_path, "mine")
    np.savez(tmp_path / "mine.npz", a=np.array([{}], object))
    with pytest.raises(ValueError, match=r"mine.npz .*allow_pickle=False"):
        released.load_pretrained(str(tmp_path / "mine"))


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_weights_are_small_and_say_where_they_come_from(name):
    content = SHIPPED[name].read_bytes()
    assert len(content) < 4e6
    card = json.loads(SHIPPED[name].with_suffix(".json").read_text("utf-8"))
    assert {"command", "data", "config"} <= set(card)
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        assert all(np.isfinite(arrays[key]).all() for key in arrays.files)


@pytest.mark.parametrize("name", released.available_weights())
def test_shipped_networks_fit_the_network_of_their_configuration(name):
    assert {"seed", "step", "validation"} <= set(released.load_card(name))
    variables, config = released.load_pretrained(name)
    fresh = by_name.init_variables(jax.random.key(0), config)
    # A file has no empty parts, such as the statistics of a network without BatchNorm.
    shapes, expected = (
        {jax.tree_util.keystr(path): np.shape(leaf) for path, leaf in leaves}
        for leaves in map(
            jax.tree_util.tree_leaves_with_path,
            (variables, by_name.for_registration(fresh, config)),
        )
    )
    assert shapes == expected


@pytest.mark.parametrize("name", ["rpmnet", "fmr"])
def test_training_starts_from_weights_whose_file_lacks_parts(name):
    variables, config = released.load_pretrained(name)
    state = create_train_state(config)
    started = started_from(name, state)
    assert jax.tree.structure(started.variables) == jax.tree.structure(state.variables)
    for part, tree in variables["params"].items():
        chex.assert_trees_all_equal(started.variables["params"][part], tree)


@pytest.mark.parametrize("name", ["", "a/b", "../modelnet40", "a b", "a.b", "möbel", "a\n"])
def test_a_name_that_is_not_plain_is_refused(name, tmp_path):
    with pytest.raises(ValueError, match="use letters, digits, _ and - only"):
        released.check_new_name(name, tmp_path)


def test_a_name_that_is_taken_is_refused_until_its_files_are_deleted(tmp_path):
    released.check_new_name("my_scans-2", tmp_path / "weights")
    save(tmp_path / "weights", "my_scans-2")
    with pytest.raises(ValueError, match=r"delete my_scans-2.npz and my_scans-2.json in .*weights"):
        released.check_new_name("my_scans-2", tmp_path / "weights")
    (tmp_path / "weights" / "my_scans-2.npz").unlink()
    released.check_new_name("my_scans-2", tmp_path / "weights")
    with pytest.raises(ValueError, match="weights 'modelnet40' already exist"):
        released.check_new_name("modelnet40", tmp_path)


def test_a_card_holds_the_configuration_that_was_given(tmp_path):
    config = from_dict({"model": {"channels": [4], "width": 4}, "train": {"steps": 7}})
    path = released.save_weights(tmp_path, "a", {"x": np.zeros(1)}, config, {"command": "c"})
    card = json.loads(path.read_text("utf-8"))
    assert card["command"] == "c"
    assert card["config"] == json.loads(json.dumps(dataclasses.asdict(config)))


def test_other_files_beside_weights_are_passed_over(tmp_path, monkeypatch):
    """A folder of weights may hold other JSON, cards whose weights are gone, and what is cut off."""
    one, two = tmp_path / "one", tmp_path / "two"
    save(one, "gone")
    (one / "gone.npz").unlink()
    save(one, "cut")
    (one / "cut.json").write_text('{"config": {"mo')
    for name, content in (("list", b"[1]"), ("settings", b'{"a": 1}'), ("bytes", b"\xff")):
        (one / f"{name}.json").write_bytes(content)
    (one / "folder.json").mkdir()
    save(one, "mine", alpha=0.1)
    save(two, "settings", alpha=0.2)
    shipped = set(released.available_weights())
    monkeypatch.setenv("JAXREG_WEIGHTS", f"{one}{os.pathsep}{two}")
    assert set(released.available_weights()) == shipped | {"mine", "settings"}
    assert released.load_pretrained("settings")[1].model.alpha == 0.2
    assert "weights:mine" in methods.names()
    with pytest.raises(ValueError, match="weights 'nothing': choose from .*idam, mine, modelnet40"):
        released.load_pretrained("nothing")
    with pytest.raises(ValueError, match="no released weights 'gone': choose from"):
        released.load_card("gone")
