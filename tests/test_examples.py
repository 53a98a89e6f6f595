"""The examples run and do what they say."""

import runpy
from pathlib import Path

import jax
import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(autouse=True)
def _as_users_have_it():
    with jax.numpy_rank_promotion("allow"):
        yield


@pytest.mark.float32
def test_calibrate_sensor_learns_the_offset_through_registration(capsys):
    example = runpy.run_path(str(EXAMPLES / "calibrate_sensor.py"))
    learned = example["calibrate"]()
    assert learned == pytest.approx(example["TRUE_OFFSET"], abs=0.004)
    assert f"step {example['STEPS']}: offset" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.float32
def test_calibrate_mount_learns_the_mount_through_a_pose_graph(capsys):
    example = runpy.run_path(str(EXAMPLES / "calibrate_mount.py"))
    np.testing.assert_allclose(example["calibrate"](), example["TRUE"], atol=0.004)
    assert "stations missed by 1.12" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.float32
def test_implicit_gradient_is_that_of_the_iterations(capsys):
    example = runpy.run_path(str(EXAMPLES / "implicit_gradient.py"))
    unrolled, implicit = (np.asarray(example["influence"](g)) for g in ("unrolled", "implicit"))
    np.testing.assert_allclose(implicit, unrolled, atol=1e-3 * unrolled.max())
    assert "implicit" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.loose
@pytest.mark.parametrize("x64", [False, True])
def test_fine_tune_keeps_the_weights_as_they_are_released(x64):
    """Names, shapes and float32, in a process with x64, too; nothing is compiled."""
    example = runpy.run_path(str(EXAMPLES / "fine_tune.py"))
    variables = example["variables"]
    state = example["optimizer"].init(variables["params"])
    with jax.enable_x64(x64):
        found = jax.eval_shape(example["step"], variables, state, jax.random.key(0))
    forms = [
        jax.tree.map(lambda x: (x.shape, str(x.dtype)), tree) for tree in (variables, found[0])
    ]
    assert forms[0] == forms[1]


@pytest.mark.slow
@pytest.mark.float32
@pytest.mark.loose
def test_fine_tune_changes_the_weights_a_little(capsys):
    example = runpy.run_path(str(EXAMPLES / "fine_tune.py"))
    released, tuned = example["variables"]["params"], example["fine_tune"](example["variables"])
    for old, new in zip(jax.tree.leaves(released), jax.tree.leaves(tuned["params"]), strict=True):
        moved = np.abs(np.asarray(new) - old)
        # Lion's steps are all of one size, the learning rate (and decay, which is smaller).
        assert 0 < moved.max() < 2 * example["STEPS"] * 1e-5
    assert "step 5: loss" in capsys.readouterr().out
