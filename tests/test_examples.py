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


@pytest.mark.float32
def test_implicit_gradient_is_that_of_the_iterations(capsys):
    example = runpy.run_path(str(EXAMPLES / "implicit_gradient.py"))
    unrolled, implicit = (np.asarray(example["influence"](g)) for g in ("unrolled", "implicit"))
    np.testing.assert_allclose(implicit, unrolled, atol=1e-3 * unrolled.max())
    assert "implicit" in capsys.readouterr().out
