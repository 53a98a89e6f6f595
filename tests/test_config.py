"""Configurations: one home for each default, and a clear answer to every slip."""

import dataclasses
import json
from pathlib import Path

import pytest

from jaxreg.config import Config, ModelConfig, from_dict, load_config, to_dict
from jaxreg.data import pair_sizes
from jaxreg.weights.released import available_weights

CONFIGS = Path(__file__).resolve().parents[1] / "configs"


@pytest.fixture
def write(tmp_path):
    def write(text, name="config.toml"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def test_an_empty_file_gives_the_defaults(write):
    assert load_config(write("")) == Config()
    assert from_dict({}) == Config()


def test_a_file_states_deviations_only(write):
    path = write('weights = "modelnet40"\n[model]\nk = 8\nalpha = 1\nchannels = [4, 8]\n')
    expected = Config(weights="modelnet40", model=ModelConfig(k=8, alpha=1.0, channels=(4, 8)))
    assert load_config(path) == expected
    assert type(load_config(path).model.alpha) is float


def test_test_pairs_start_from_the_training_pairs(write):
    config = load_config(write("[pairs]\nkept = 100\n[test_pairs]\noutliers = 200\n"))
    assert (config.pairs.kept, config.pairs.outliers) == (100, 0)
    assert (config.test_pairs.kept, config.test_pairs.outliers) == (100, 200)
    assert load_config(write("[pairs]\nkept = 100\n")).test_pairs.kept == 100


def test_there_and_back_through_json():
    config = from_dict(
        {"model": {"k": 9, "channels": [1, 2]}, "pairs": {"jitter": 0.5}, "weights": "x"}
    )
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config


def test_configurations_are_hashable_and_frozen():
    assert hash(Config()) == hash(Config())
    with pytest.raises(dataclasses.FrozenInstanceError):
        Config().model.k = 3


def test_every_field_is_documented():
    # The paper's symbols stand there; a dataclass keeps no such strings, so the source is read.
    import ast
    import inspect

    from jaxreg import config

    for node in ast.parse(inspect.getsource(config)).body:
        if not isinstance(node, ast.ClassDef) or node.name == "Config":
            continue
        for field, below in zip(node.body, [*node.body[1:], None], strict=True):
            if isinstance(field, ast.AnnAssign):
                documented = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
                assert documented, f"{node.name}.{field.target.id} says nothing"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[modle]\nk = 3\n", "unknown key 'modle'; did you mean 'model'"),
        ("[model]\nalhpa = 0.5\n", "unknown key 'alhpa'; did you mean 'alpha'"),
        ('[model]\nk = "three"\n', "'k' must be int, got 'three'"),
        ("[model]\nk = 3.0\n", "'k' must be int, got 3.0"),
        ("[model]\nk = true\n", "'k' must be int, got True"),
        ("[model]\nalpha = true\n", "'alpha' must be float, got True"),
        ('[model]\nalpha = "1e-3"\n', "'alpha' must be float, got '1e-3'"),
        ("[model]\ninclude_self = 1\n", "'include_self' must be bool, got 1"),
        ('[model]\nedge = "vectors"\n', "'edge' must be one of 'vector', 'length', 'coordinates'"),
        ("[model]\nedge = []\n", "'edge' must be one of"),
        ("[model]\nchannels = 4\n", "'channels' must be a list, got 4"),
        ('[model]\nchannels = "48"\n', "'channels' must be a list, got '48'"),
        ("[model]\nchannels = [4, 8.5]\n", "'channels' must be int, got 8.5"),
        ("model = 3\n", r"'model' is a section: write \['?model'?\]"),
        ("pairs = 3\n", r"'pairs' is a section"),
        ('pairs = "3"\n', r"'pairs' is a section"),
        ("test_pairs = [1]\n", r"'test_pairs' is a section"),
        ("[pairs]\nkeep = 3\n", "unknown key 'keep'; did you mean 'kept'"),
        ("[model\n", "is not valid TOML"),
        (b"\xff\xfe\x00", "is not valid TOML"),
    ],
)
def test_slips_are_named(write, text, message):
    with pytest.raises(ValueError, match=message) as caught:
        load_config(write(text))
    assert "config.toml" in str(caught.value)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"no configuration file at .*none\.toml"):
        load_config(tmp_path / "none.toml")
    with pytest.raises(ValueError, match="cannot be read"):
        load_config(tmp_path)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.toml")), ids=lambda path: path.stem)
def test_every_given_configuration_reads_and_names_weights_that_are_there(path):
    config = load_config(path)
    assert config.weights in ("", *available_weights())
    assert f"configs/{path.name}" in path.read_text("utf-8"), "says how it is run"
    assert pair_sizes(config.test_pairs, 2 * config.test_pairs.points)[0] >= config.model.n_inliers
