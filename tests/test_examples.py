"""The examples run and do what they say."""

import runpy
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.float32
def test_calibrate_sensor_learns_the_offset_through_registration(capsys):
    example = runpy.run_path(str(EXAMPLES / "calibrate_sensor.py"))
    learnt = example["calibrate"]()
    assert learnt == pytest.approx(example["TRUE_OFFSET"], abs=0.004)
    assert f"step {example['STEPS']}: offset" in capsys.readouterr().out


def test_examples_stay_short():
    for path in EXAMPLES.glob("*.py"):
        assert len(path.read_text(encoding="utf-8").splitlines()) < 60, path.name
