"""Programs in files: against the functions that they were made of, and from a file made long ago."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg import exported
from jaxreg.cli import main
from jaxreg.data.procedural.shapes import sample_shape
from jaxreg.geometry import rigid
from jaxreg.weights import released

pytestmark = [pytest.mark.float32, pytest.mark.untyped]

MADE_BEFORE = Path(__file__).parent / "exported" / "register_global_v1.jaxreg"
"""Written on 2026-11-29 by JAX 0.10.2: jaxreg export register_global --points 128 128 --platform cpu
cuda tpu -o FILE. Keep it as long as its version can be read."""


def turned_pair(seed, points=120):
    """Two samplings of a shape, the source turned and moved; and the true transform."""
    cloud = sample_shape(seed % 50, 3, points=2 * points)
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    turn = (turn * np.sign(np.linalg.det(turn))).astype(np.float32)
    return (cloud[:points] - 0.3) @ turn, cloud[points:] - 0.3, turn


def test_a_file_made_before_still_registers(seed):
    program = exported.load_exported(MADE_BEFORE)
    assert program.platforms == ("cpu", "cuda", "tpu")
    source, reference, turn = turned_pair(0)
    found = program(source, reference)
    assert found.correspondences.shape == (120, 3)
    assert rigid.rotation_angle_deg(np.asarray(found.rotation), turn) < 8


def test_rows_beyond_a_mask_count_for_nothing():
    program = exported.load_exported(MADE_BEFORE)
    source, reference, _ = turned_pair(0)
    padded = np.concatenate([source, np.full((8, 3), np.nan, np.float32)])
    found = program(padded, reference, source_mask=np.arange(128) < 120)
    want = program(source, reference)
    np.testing.assert_array_equal(found.rotation, want.rotation)
    assert (np.asarray(found.confidence)[120:] == 0).all()


def test_loading_and_running_needs_no_network():
    code = f"""
import sys
import numpy as np
from jaxreg import load_exported

program = load_exported({str(MADE_BEFORE)!r})
found = program(*np.random.default_rng(0).normal(size=(2, 100, 3)).astype(np.float32))
assert found.valid
loaded = [name for name in ("flax", "jaxreg.network", "jaxreg.search") if name in sys.modules]
assert not loaded, loaded
"""
    environment = os.environ | {"XLA_FLAGS": "--xla_backend_optimization_level=0"}
    subprocess.run([sys.executable, "-c", code], check=True, timeout=600, env=environment)


@pytest.mark.slow
@pytest.mark.parametrize("symbolic", [False, True])
def test_the_network_gives_what_it_gave_before_it_was_saved(tmp_path, seed, symbolic):
    from jaxreg import load_pretrained, register_pair

    path = exported.export_program(
        tmp_path / "p", "modelnet40", points=(300, 300), symbolic=symbolic
    )
    program = exported.load_exported(path)
    variables, config = load_pretrained("modelnet40")
    one = jax.jit(lambda x, y: register_pair(variables, x, y, config=config))
    # A pair that the network can register: a pose that it leaves open follows from rounding.
    reference = sample_shape(seed % 50, 3, points=300) - np.float32(0.3)
    turn = Rotation.from_euler("xyz", [20, -15, 25], degrees=True).as_matrix()
    source = reference @ turn.astype(np.float32)
    for count in (300, 280):
        found, want = program(source[:count], reference), one(source[:count], reference)
        np.testing.assert_allclose(found.rotation, want.rotation, atol=1e-5)
        np.testing.assert_allclose(found.rotation, turn, atol=0.05)
        assert found.confidence.shape == (count,)


def test_another_network_gives_what_its_register_gives(tmp_path, seed):
    from jaxreg import load_pretrained
    from jaxreg.peers import fmr

    program = exported.load_exported(
        exported.export_program(tmp_path / "p", "fmr", points=(64, 64))
    )
    variables, config = load_pretrained("fmr")
    source, reference, _ = turned_pair(seed, 64)
    found = program(source[:60], reference)
    want = jax.jit(lambda x, y: fmr.register(variables, x, y, config=config))(
        source[:60], reference
    )
    np.testing.assert_allclose(found.rotation, want.rotation, atol=1e-3)
    assert found.confidence.shape == (60,)


def test_a_program_is_not_written_over_the_weights_that_it_is_made_of(tmp_path):
    for path in released.weight_files("fmr"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    weights = tmp_path / "fmr.npz"
    before = weights.read_bytes()
    assert main(["export", str(tmp_path / "fmr"), "-o", str(weights)]) == 2
    assert weights.read_bytes() == before


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"symbolic": True}, "no program for any size.*--points"),
        ({"platforms": ("gpu",)}, "'gpu'.*choose from cpu, cuda"),
        ({"platforms": ()}, "no platform is given: choose from cpu, cuda"),
        ({"points": (4, 100)}, "16 points or more"),
        ({"name": "modelnet40", "points": (128, 300)}, "modelnet40 keeps 256 correspondences"),
        ({"name": "no_such_weights"}, "no_such_weights"),
    ],
)
def test_what_cannot_be_exported_is_named(tmp_path, options, told):
    with pytest.raises(ValueError, match=told):
        exported.export_program(tmp_path / "p", **options)


@pytest.mark.parametrize(
    ("source", "told"),
    [
        (np.zeros((200, 3)), "source has 200 points and this program takes 1 to 128"),
        (np.zeros((100, 2)), r"source has shape \(100, 2\)"),
    ],
)
def test_clouds_that_do_not_fit_are_named(source, told):
    with pytest.raises(ValueError, match=told):
        exported.load_exported(MADE_BEFORE)(source, jnp.zeros((100, 3)))


def packed(path, card, program):
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("card.json", card if isinstance(card, bytes) else json.dumps(card))
        file.writestr("program.bin", program)
    return path


def test_other_files_are_named(tmp_path):
    with zipfile.ZipFile(MADE_BEFORE) as file:
        card, program = json.loads(file.read("card.json")), file.read("program.bin")
    for name, version, content, told in (
        ("newer", 99, program, "has version 99"),
        ("cut", 1, program[:100], "cannot be read by JAX"),
    ):
        packed(tmp_path / name, card | {"version": version}, content)
        with pytest.raises(ValueError, match=told):
            exported.load_exported(tmp_path / name)


def without(card, name):
    return {key: value for key, value in card.items() if key != name}


NO_CARDS = {
    "a list": lambda card: [1],
    "bytes": lambda card: b"\xff",
    "cut off": lambda card: json.dumps(card).encode()[:-5],
    "no version": lambda card: without(card, "version"),
    "a version in words": lambda card: card | {"version": "one"},
    "no name": lambda card: without(card, "name"),
    "no points": lambda card: without(card, "points"),
    "three sizes": lambda card: card | {"points": [1, 2, 3]},
    "sizes in words": lambda card: card | {"points": ["a", "b"]},
    "no platforms": lambda card: without(card, "platforms"),
    "platforms that are none": lambda card: card | {"platforms": 3},
}


@pytest.mark.parametrize("kind", NO_CARDS)
def test_a_zip_of_something_else_is_named(tmp_path, kind):
    with zipfile.ZipFile(MADE_BEFORE) as file:
        card, program = json.loads(file.read("card.json")), file.read("program.bin")
    path = packed(tmp_path / "p", NO_CARDS[kind](card), program)
    with pytest.raises(ValueError, match=f"^{path} is no program of jaxreg: write one by jaxreg"):
        exported.load_exported(path)


def test_a_file_that_is_no_zip_or_a_damaged_one_is_named(tmp_path):
    (tmp_path / "text").write_text("no program")
    with zipfile.ZipFile(tmp_path / "other", "w") as file:
        file.writestr("data.csv", "1,2")
    whole = bytearray(MADE_BEFORE.read_bytes())
    whole[200:230] = bytes(30)
    (tmp_path / "damaged").write_bytes(whole)
    for name in ("text", "other", "damaged"):
        with pytest.raises(
            ValueError, match=f"{name} is no program of jaxreg: write one by jaxreg"
        ):
            exported.load_exported(tmp_path / name)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"nothing: no such file; check the path\.$"):
        exported.load_exported(tmp_path / "nothing")
    with pytest.raises(ValueError, match=r"cannot be read \(Is a directory\): name a file"):
        exported.load_exported(tmp_path)
