"""The second call: clouds of the size that is asked for, ratios by pair, and a process that times."""

import sys

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.speed import processes, second_call


@pytest.mark.parametrize("count", [20_000, 80_000])
def test_clouds_are_thinned_or_filled_along_their_surface(count, seed):
    rng = np.random.default_rng(seed)
    plane = np.c_[rng.uniform(size=(count, 2)), np.zeros(count)]
    found = second_call.filled(plane, rng)
    assert found.shape == (50_000, 3)
    assert (found[:, 2] == 0).all()
    assert len(np.unique(found, axis=0)) > 49_900
    kept = np.mean(cKDTree(plane).query(found)[0] == 0)
    assert kept == pytest.approx(min(count, 50_000) / 50_000, abs=0.01)


def test_ratios_are_of_the_pairs_of_one_round():
    """A machine that is half as fast in one round changes no ratio."""
    once = {"prepared": [0.1, 0.2, 0.9], "old": [0.2, 0.2, 0.3], "open3d": [1.0, 1.0, 1.0]}
    taken = {kind: [times, [2 * x for x in times]] for kind, times in once.items()}
    cells = second_call.rows(taken)
    assert cells["prepared"]["of_old"] == pytest.approx(1.0)
    assert cells["prepared"]["of_old_max"] == pytest.approx(3.0)
    assert cells["prepared"]["of_open3d"] == pytest.approx(0.2)
    assert cells["old"]["of_open3d_max"] == pytest.approx(0.3)
    assert "of_old" not in cells["old"]
    assert cells["prepared"]["s_max"] == pytest.approx(1.35)


@pytest.mark.slow
def test_a_fresh_process_times_every_pair(tmp_path, seed):
    rng = np.random.default_rng(seed)
    clouds = rng.uniform(size=(4, 400, 3)) * [1, 0.6, 0.3]
    np.savez(tmp_path / "clouds.npz", *clouds)
    for kind in ("prepared", "arrays"):
        taken = second_call.seconds(kind, tmp_path / "clouds.npz", processes.ROOT)
        assert len(taken) == 2
        assert all(0 < x < 60 for x in taken)
    with pytest.raises(RuntimeError, match="nothing of"):
        second_call.seconds("nothing", tmp_path / "clouds.npz", processes.ROOT)


def test_a_process_that_fails_says_what_it_wrote():
    """On either stream, as a command of the shell and a script of Python do."""
    code = "import sys; print('read', input()); sys.exit('no such cloud')"
    with pytest.raises(RuntimeError, match="failed with 7 points:\nread 7 points\nno such cloud"):
        processes.finished([sys.executable, "-c", code], environment={}, given="7 points")
