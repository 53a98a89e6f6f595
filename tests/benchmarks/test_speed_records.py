"""What speed and scaling write: rows of the candidates, ratios, exponents, one file a part."""

import os
import subprocess
import sys

import pytest

from benchmarks.paper import accuracy
from benchmarks.speed import candidates, many_pairs, parallel, scaling, sends, speed, stages
from benchmarks.speed import records as of_speed

OPTIONS = speed.Options(points=(768, 1434), batch=8)


def forward(points, seconds):
    names = [name.format(batch=8) for name, _ in of_speed.CANDIDATES.values()]
    return [
        {"candidate": name, "points": points, "minimum": x, "median_error_deg": 0.1}
        for name, x in zip(names, seconds, strict=True)
    ]


def test_the_names_of_the_records_are_those_of_what_is_measured():
    own = {name for name, _ in of_speed.CANDIDATES.values() if "batch" not in name}
    assert own <= set(candidates.PEERS)
    assert list(of_speed.VARIANTS.values()) == list(accuracy.variants(1))
    measured = stages.operations(300, 300, of_speed_config())
    assert [x for names in of_speed.STAGES.values() for x in names] == list(measured)


def of_speed_config():
    from benchmarks.speed import workload

    return workload.released()[1].model


def test_forward_training_and_first_results(records):
    small = forward(768, (0.03, 0.027, 0.3, 0.04, 0.09, 0.005))
    large = forward(1434, (0.12, 0.13, 1.5, 0.1, 0.15, 0.02))
    first = [
        {"first result": f"jaxreg.{task}", "cache": cache, "process, s": seconds}
        for task, cache, seconds in (("register_pair", "empty", 4.04), ("register", "warm", 3.2))
        + (("register_pair", "warm", 2.2), ("register", "empty", 10.8))
    ]
    training = [
        {"candidate": "jaxreg, step", "minimum": 0.2},
        {"candidate": "transcription, gradient", "minimum": 0.7},
    ]
    results = {"forward": [small, large], "training": training, "first": first}
    assert len(list(of_speed.write(results, OPTIONS))) == 2
    rows, setting = (records.read("speed")[key] for key in ("rows", "setting"))
    assert rows["forward"]["ms"] == pytest.approx(30)
    assert rows["forward"]["faster"] == pytest.approx(10)
    assert rows["forward_one"]["faster"] == pytest.approx(0.3 / 0.027)
    assert rows["step"]["faster"] == pytest.approx(3.5)
    assert rows["ransac_icp"]["faster"] is None
    assert (setting["register_pair_cold_s"], setting["register_warm_s"]) == (4.0, 3.2)
    sizes = records.read("sizes")
    assert sizes["setting"] == {"as_written_ratio": 10.0, "slower_from": 1434}
    assert sizes["rows"]["small_gicp"]["ms_1434"] == pytest.approx(20)
    # The page names four sizes.
    four = speed.Options(points=(768, 1434, 2048, 4096))
    of_speed.sizes([small, large, large, large], four)
    assert records.fits("speed", "sizes")


def test_one_core_has_a_file_of_its_own(records):
    options = speed.Options(points=(768,), cores=1)
    results = {"forward": [forward(768, (0.04, 0.05, 0.4, 0.06, 0.1, 0.01))]}
    assert [path.stem for path in of_speed.write(results, options)] == ["speed_one_core"]
    assert records.read("speed_one_core")["rows"]["ransac_icp"]["ratio"] == pytest.approx(1.5)
    assert records.fits("speed_one_core")


def test_stages_programs_and_accuracy(records):
    parts = [
        {"stage": name, "calls": 3, "operations": 2e6, "seconds": 0.001, "rate": 1e11}
        for names in of_speed.STAGES.values()
        for name in names
    ]
    whole = {"stage": "whole registration", "calls": 1, "operations": 1, "seconds": 0.01}
    programs = [
        {"program": name, "trace, s": 1.0, "compile, s": 2.0, "peak, MB": 500, "before": 1}
        | {"arrays": 18, "peak, warm": 400}
        for name in of_speed.PROGRAMS.values()
    ]
    variants = [
        {"variant": name, "dtype": dtype, "mae_r_deg": 1.0, "worst_deg": 2.0}
        | {"difference_deg": 0.0, "apart_deg": apart}
        for dtype, apart in (("float32", 1e-5), ("float64", 1e-12))
        for name in of_speed.VARIANTS.values()
    ]
    results = {
        "stages": [*parts, whole | {"rate": 1e11}],
        "programs": programs,
        "accuracy": variants,
    }
    written = [path.stem for path in of_speed.write(results, OPTIONS)]
    assert written == ["stages", "processes", "accuracy"]
    assert records.fits(*written)
    rows = records.read("stages")["rows"]
    assert rows["inliers"]["ms"] == pytest.approx(2), "inliers and Procrustes together"
    assert rows["features"]["share"] == pytest.approx(2e6 / 1e-3 / 1e11)
    assert records.read("accuracy")["setting"]["float64_apart"] == 1e-12


def test_scaling(records):
    rows = [
        {"points": n, "seconds": 1e-9 * n**2, "peak_mb": 500.4, "temporary_mb": n / 10}
        | {"trace_s": 1.0, "compile_s": 1.5}
        for n in (256, 768, 1024, 2048, 4096, 16384)
    ]
    scaling.write(rows)
    entry = records.read("scaling")
    assert records.fits("scaling")
    assert entry["setting"] == {
        "time_exponent": 2.0,
        "memory_exponent": 1.0,
        "from_points": 1024,
    }
    assert entry["rows"]["n2048"]["ms"] == pytest.approx(2048**2 * 1e-6)
    assert entry["rows"]["n256"]["compile"] == 2.5


def test_the_end_of_a_curve_of_memory(records):
    curve = [(1, 10.0, 400.0), (50, 11.0, 500.0), (100, 12.0, 501.0), (101, 12.0, 504.0)]
    found = many_pairs.summary(curve)
    assert found["ms"] == pytest.approx(20)
    assert (found["first"], found["half"], found["last"], found["grown"]) == (400, 501, 504, 3)
    told = {kind: {"curve": curve, "programs": 2} for kind in many_pairs.KINDS}
    many_pairs.write(told)
    assert records.read("many_pairs")["rows"]["executor"]["programs"] == 2
    assert records.fits("many_pairs")


def test_processes_that_train_together(records):
    turns = {
        "apart": [{"pairs": 10.0, "processor_ms": 200.0}, {"pairs": 8.0, "processor_ms": 210.0}],
        "together": [{"pairs": 9.0, "processor_ms": 220.0}, {"pairs": 8.0, "processor_ms": 205.0}],
    }
    sent = {"sends": 68, "kilobytes": 300, "sends_ms": 8.0, "as_one_ms": 0.5, "process_s": 1.0}
    parallel.write(turns, sent, parallel.Options(rounds=2))
    setting = records.read("parallel")["setting"]
    assert setting["ratio"] == pytest.approx(0.95)
    assert setting["least_ratio"] == pytest.approx(0.9)
    assert "process_s" not in setting
    assert records.fits("parallel")


def test_steps_are_counted_over_the_same_time(tmp_path):
    log = tmp_path / "metrics.jsonl"
    assert parallel.steps(log) == 0
    log.write_text("{}\n{}\n{")
    assert parallel.steps(log) == 2


def test_sums_in_a_loop_count_every_time():
    """Two emulated devices: a sum of 5 and of 2 x 3 numbers, then three rounds with one of 4."""
    program = """
import jax, jax.numpy as jnp
from jax.sharding import PartitionSpec
mesh = jax.make_mesh((2,), ("d",), axis_types=(jax.sharding.AxisType.Auto,))
def local(x, y, z):
    sums = jax.lax.psum(x, "d"), jax.lax.psum(y * x[0], "d")
    return *sums, jax.lax.fori_loop(0, 3, lambda i, z: jnp.sin(jax.lax.psum(z, "d")), z)
spec = PartitionSpec("d")
step = jax.shard_map(local, mesh=mesh, in_specs=(spec,) * 3, out_specs=spec, check_vma=False)
clouds = [jnp.ones((2 * n, m)) for n, m in ((5, 1), (2, 3), (4, 1))]
print(jax.jit(step).lower(*clouds).compile().as_text())
"""
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    text = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    ).stdout
    found = sends.sums_of(text)
    assert sum(found) == 5 + 6 + 3 * 4
    assert len(found) in (4, 5)  # XLA may send the first two as one
