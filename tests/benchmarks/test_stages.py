"""What the benchmarks compute themselves: the counted arithmetic, exponents, peaks, taking turns."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.speed import processes, scaling, stages, timing, workload
from jaxreg.network import matching, model
from jaxreg.types import PointCloud

pytestmark = [pytest.mark.float32, pytest.mark.loose]

POINTS = 272  # N_c of the released weights is 256.


def counted(function, *inputs) -> float:
    """Operations of a function by XLA's own count, before anything is optimised."""
    return jax.jit(function).lower(*inputs).cost_analysis()["flops"]


def test_arithmetic_counted_by_hand_is_what_xla_counts():
    variables, config = workload.released()
    by_hand = stages.operations(POINTS, POINTS, config.model)
    cloud, mask = jnp.zeros((POINTS, 3)), jnp.ones(POINTS, bool)
    graph = jax.eval_shape(
        lambda x: model.neighborhood_graph(PointCloud(x, mask), config.model), cloud
    )
    features = jax.ShapeDtypeStruct((POINTS, config.model.width), jnp.float32)

    def point_features(points, graph):
        return model.point_features(variables, points, graph, mask, config=config.model)[0]

    # XLA also counts BatchNorm and maxima, which the hand leaves out.
    assert counted(point_features, cloud, graph) == pytest.approx(by_hand["features"], rel=0.1)
    distance = counted(matching.feature_distance, features, features)
    assert distance == pytest.approx(by_hand["feature distance"], rel=0.1)


def test_every_stage_that_is_timed_is_counted_and_ends_in_a_pose():
    found = stages.stages(POINTS, 2)
    assert list(found) == list(stages.operations(POINTS, POINTS, workload.released()[1].model))
    assert found["Procrustes"].run().rotation.shape == (2, 3, 3)


def test_the_exponent_of_a_power_law():
    points = [1024, 2048, 4096]
    assert scaling.exponent(points, [3e-9 * n**1.7 for n in points]) == pytest.approx(1.7)


def test_a_size_that_does_not_fit_is_a_line_and_no_failure():
    found = {"points": 16384, "needs_mb": 9000.0}
    assert "needs 9000 MB" in scaling.line(found)
    assert "no such" in scaling.line({"points": 8, "failure": "no such thing"})


def test_memory_that_was_in_use_shows_in_the_peak():
    program = (
        "from benchmarks.speed.processes import peak_mb; before = peak_mb(); "
        "block = b'x' * 100_000_000; "
        "print(peak_mb() - before)"
    )
    text = subprocess.check_output([sys.executable, "-c", program], cwd=processes.ROOT, text=True)
    assert 95 < float(text) < 130


def test_candidates_take_turns_and_the_first_run_is_not_timed(monkeypatch):
    calls, clock = [], iter(np.arange(0.0, 1000.0))
    monkeypatch.setattr(timing.time, "perf_counter", lambda: next(clock))
    taken = timing.alternate(
        {name: lambda number, name=name: calls.append((name, number)) for name in "ab"},
        rounds=4,
        seconds=1.5,
    )
    expected = [(name, number) for number in range(3) for name in "ab"]
    assert calls == expected, "two runs have used up the time"
    assert taken == {name: timing.Timing(1.0, 1.0, 2) for name in "ab"}
