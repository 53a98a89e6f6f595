"""`jaxreg info`."""

import numpy as np
import pytest
import trimesh

from jaxreg import io
from jaxreg.cli.options import BAD_INPUT, SUCCESS

pytestmark = pytest.mark.float32


def test_info_describes_a_cloud(tmp_path, run):
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(7.0), [5e6]), axis=-1).reshape(-1, 3)
    io.write_cloud(tmp_path / "grid.npy", np.concatenate([grid, grid[:2], [[np.nan, 0, 0]]]))
    status, out, _ = run("info", tmp_path / "grid.npy")
    told = dict(line.split(maxsplit=1) for line in out.replace("not f", "not_f").splitlines())
    assert status == SUCCESS
    assert told["points"] == "66"
    assert told["not_finite"] == "1 points, the first is point 65"
    assert told["x"] == "0 to 8 (extent 8)"
    assert told["z"] == "5000000 to 5000000 (extent 0)"
    assert told["repeated"] == "2 points"
    assert told["spacing"] == "1"


def test_clouds_without_a_finite_point(tmp_path, run):
    io.write_cloud(tmp_path / "nan.npy", np.full((4, 3), np.nan))
    for command in ("info", "view"):
        status, _, err = run(command, tmp_path / "nan.npy")
        assert (status, "contains no finite point" in err) == (BAD_INPUT, True)


def test_info_says_what_is_odd_and_what_a_file_is(tmp_path, run):
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.ply")
    status, out, _ = run("info", tmp_path / "box.ply")
    assert status == SUCCESS
    assert "read as          a mesh of 12 triangles, sampled over its surface\n" in out
    assert "points           20,000\n" in out
    cloud = np.random.default_rng(0).normal(size=(2000, 3)) + [452000, 5411000, 250]
    io.write_cloud(tmp_path / "utm.npy", cloud.astype(np.float32).astype(float))
    _, out, _ = run("info", tmp_path / "utm.npy")
    assert "note             y comes in steps of 0.5 beside" in out
