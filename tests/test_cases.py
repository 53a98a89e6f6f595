"""The runner of case scripts."""

import pytest

from tests import cases

FORMER = """
import subprocess
import sys

assert "jaxreg" not in sys.modules and "numpy" not in sys.modules  # a name costs nothing unasked

import dataclasses

import numpy as np

import jaxreg
from jaxreg import compilation, evaluation, model, scoring
from jaxreg.config import Config, DataConfig, PairConfig, RegisterConfig
from jaxreg.data.shapes import sample_shape
from jaxreg.dense import register_dense
from jaxreg.judge.evidence import Evidence
from jaxreg.refine.gicp import gicp
from jaxreg.refine.host import refine
from jaxreg.refine.icp import icp

assert register_dense is jaxreg.register_global
assert model.iterate.__module__ == "jaxreg.network.model"
few = dataclasses.replace(RegisterConfig().refine, iterations=3)
assert RegisterConfig(refine_iterations=3, refine_points=99) == jaxreg.RegisterConfig(
    refine=few, refine_points=99
)
cloud = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
for former, method in ((icp, jaxreg.icp), (gicp, jaxreg.gicp)):
    found = former(cloud, cloud + np.float32(0.05), iterations=2, trim=0.9)
    told = method(
        cloud, cloud + np.float32(0.05), config=jaxreg.RefineConfig(iterations=2, trim=0.9)
    )
    assert (np.asarray(found.rotation) == np.asarray(told.rotation)).all()
data = DataConfig(name="shapes", test_shapes=2)
config = Config(test_pairs=PairConfig(points=64, kept=48), data=data)
count, batches = scoring.pair_stream(config, root=None)
assert evaluation.true_transforms(batches).rotation.shape == (count, 3, 3)
found = jaxreg.register(cloud, cloud, initial=np.eye(4), refine="icp")
assert found.converged and 0 < found.seconds < 60
assert Evidence(*range(13)).gap == Evidence(*range(13)).distance
assert subprocess.run([sys.executable, "-c", "from jaxreg.dense import register_dense"]).returncode == 0
try:
    from jaxreg.config import register_dense
except ImportError as error:
    assert "register_dense" in str(error)
else:
    raise SystemExit("a name that never was is found")
"""


def test_runner_prints_how_every_script_ends(tmp_path, capsys):
    (tmp_path / "common.py").write_text("WELL = 'fine'\n")
    (tmp_path / "01_good.py").write_text("from common import WELL\nprint(WELL)\n")
    (tmp_path / "02_bad.py").write_text("raise SystemExit('FAULT: it is broken')\n")
    assert cases.main([str(tmp_path)]) == 1
    told = capsys.readouterr().out
    assert "/01_good.py: 0 (" in told
    assert "/02_bad.py: 1: FAULT: it is broken (" in told


def test_a_missing_folder_is_skipped(tmp_path, capsys):
    assert cases.main([str(tmp_path / "absent")]) == 0
    assert "skipped" in capsys.readouterr().out


@pytest.mark.slow
def test_scripts_may_use_the_names_of_when_they_were_written(tmp_path, capsys):
    (tmp_path / "01_names.py").write_text(FORMER)
    assert cases.main([str(tmp_path)]) == 0, capsys.readouterr().out


def test_former_names_are_of_no_use_to_others():
    with pytest.raises(ImportError, match="RegisterConfig"):
        from jaxreg.config import RegisterConfig  # noqa: F401
