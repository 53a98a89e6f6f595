"""Training on many devices and in many processes: against one device, and as processes that are ended.

Each test starts processes of its own and gives them a time limit.
"""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jaxreg import devices

pytestmark = pytest.mark.float32

SMALL = """
network = "paper"
[model]
channels = [4, 8]
width = 8
n_inliers = 12
iterations = 2
k = 3
[pairs]
points = 32
kept = 24
[test_pairs]
points = 32
kept = 24
[data]
name = "shapes"
train_shapes = 8
test_shapes = 4
validation_share = 0.5
[train]
steps = 6
batch = 4
validate_every = 3
validation_pairs = 2
warmup = 1
"""
LIMIT = 400


def started(folder: Path, workdir: str, *options: str, processes: int = 1, devices: int = 1):
    """`train.py` in so many processes of so many emulated devices each."""
    (folder / "c.toml").write_text(SMALL)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    flags = f"--xla_force_host_platform_device_count={devices} --xla_backend_optimization_level=0"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    many = ["--coordinator", f"127.0.0.1:{port}", "--processes", f"{processes}", "--process-id"]
    return [
        subprocess.Popen(
            [
                *[
                    sys.executable,
                    "-c",
                    "from jaxreg.cli.train import main; raise SystemExit(main())",
                ],
                *[str(folder / "c.toml"), "--workdir", str(folder / workdir), *options],
                *([*many, f"{number}"] if processes > 1 else []),
            ],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for number in range(processes)
    ]


def ended(processes) -> list[str]:
    """What they printed; fails if one of them fails or takes too long."""
    told = [process.communicate(timeout=LIMIT)[0] for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), told
    return told


def log(workdir: Path) -> dict[str, np.ndarray]:
    rows = [json.loads(line) for line in (workdir / "metrics.jsonl").read_text().splitlines()]
    return {name: np.array([row[name] for row in rows]) for name in ("step", "loss")}


def same_log(one: Path, other: Path) -> None:
    np.testing.assert_array_equal(log(one)["step"], log(other)["step"])
    np.testing.assert_allclose(log(one)["loss"], log(other)["loss"], rtol=2e-3)


@pytest.mark.slow
def test_two_devices_and_two_processes_train_as_one_device_does(tmp_path):
    ended(started(tmp_path, "one"))
    ended(started(tmp_path, "devices", devices=2))
    same_log(tmp_path / "one", tmp_path / "devices")
    ended(started(tmp_path, "processes", processes=2))
    same_log(tmp_path / "one", tmp_path / "processes")


@pytest.mark.slow
def test_a_run_of_two_processes_goes_on_in_one_and_in_four(tmp_path):
    ended(started(tmp_path, "run", processes=2))
    for processes in (1, 4):
        workdir = tmp_path / f"run{processes}"
        subprocess.run(["cp", "-r", tmp_path / "run", workdir], check=True)
        # The same command, of which two steps are left to do.
        text = (workdir / "metrics.jsonl").read_text().splitlines()
        assert json.loads(text[-1])["step"] == 6
        told = ended(started(tmp_path, workdir.name, processes=processes))
        assert "best checkpoint" in told[0]
    same_log(tmp_path / "run", tmp_path / "run4")


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_sigterm_saves_where_the_run_is(tmp_path, processes):
    long = ("--train.steps", "4000", "--train.validate_every", "4000")
    running = started(tmp_path, "run", *long, processes=processes)
    wait_for(tmp_path / "run", step=3)
    for process in running:
        process.send_signal(signal.SIGTERM)
    told = [process.communicate(timeout=LIMIT)[0] for process in running]
    assert "SIGTERM: saved step" in told[0], told
    assert all(process.returncode == -signal.SIGTERM for process in running)
    last = log(tmp_path / "run")["step"][-1]
    assert f"saved step {last};" in told[0]
    again = started(tmp_path, "run", *long, processes=processes)
    wait_for(tmp_path / "run", step=last + 2)
    for process in again:
        process.kill()
        process.communicate()
    steps = log(tmp_path / "run")["step"]
    np.testing.assert_array_equal(steps, np.arange(1, len(steps) + 1))


@pytest.mark.slow
def test_a_process_that_is_killed_ends_the_others_with_a_message(tmp_path):
    long = ("--train.steps", "4000", "--train.validate_every", "4000")
    first, second = started(tmp_path, "run", *long, processes=2)
    wait_for(tmp_path / "run", step=3)
    second.kill()
    second.communicate()
    told = first.communicate(timeout=LIMIT)[0]
    assert first.returncode == 2, told
    assert "error: process 0 of 2 lost process 1: start all of them again" in told


def wait_for(workdir: Path, *, step: int) -> None:
    begin = time.monotonic()
    while time.monotonic() - begin < LIMIT:
        path = workdir / "metrics.jsonl"
        if path.exists() and len(path.read_text().splitlines()) >= step:
            return
        time.sleep(0.2)
    pytest.fail(f"no step {step} in {LIMIT} s")


@pytest.mark.untyped
def test_a_batch_that_cannot_be_shared_is_named():
    class Three:
        size = 3

    with pytest.raises(ValueError, match="4 pairs cannot be shared by 3 devices.*multiple of 3"):
        devices.check_shares(4, Three())
    devices.check_shares(4, None)


def test_half_an_address_is_named(monkeypatch):
    monkeypatch.setenv("JAX_NUM_PROCESSES", "2")
    with pytest.raises(ValueError, match="--process-id is missing: give all of"):
        devices.join_processes("127.0.0.1:1")


@pytest.fixture
def environment(monkeypatch):
    """Sets variables of the environment, among those that say which process this is."""

    def set_to(**variables):
        for name in ("PROCID", "NTASKS"):
            monkeypatch.delenv(f"SLURM_{name}", raising=False)
        for name in ("PROCESS_ID", "NUM_PROCESSES", "COORDINATOR_ADDRESS"):
            monkeypatch.delenv(f"JAX_{name}", raising=False)
        for name, value in variables.items():
            monkeypatch.setenv(name, value)

    return set_to


@pytest.mark.parametrize(
    ("variables", "given", "place"),
    [
        ({}, (None, None), (0, 1)),
        ({"SLURM_NTASKS": "4"}, (None, None), (0, 1)),
        ({"SLURM_NTASKS": "4", "SLURM_PROCID": "2"}, (None, None), (2, 4)),
        ({"SLURM_NTASKS": "4", "SLURM_PROCID": "2"}, (1, 3), (1, 3)),
        ({"SLURM_NTASKS": "4"}, (1, None), (1, 4)),
        ({"JAX_NUM_PROCESSES": "3", "JAX_PROCESS_ID": "1"}, (None, None), (1, 3)),
    ],
)
def test_the_place_of_a_process_is_the_one_that_is_known(environment, variables, given, place):
    environment(**variables)
    assert devices.place_of(*given) == place


@pytest.mark.parametrize(
    ("variables", "given"),
    [
        ({"JAX_NUM_PROCESSES": "3"}, (None, None)),
        ({"SLURM_NTASKS": "4"}, (None, 4)),
        ({}, (1, None)),
    ],
)
def test_half_a_place_is_named(environment, variables, given):
    environment(**variables)
    with pytest.raises(ValueError, match="--processes N and --process-id K is missing"):
        devices.place_of(*given)


def test_a_training_in_the_shell_of_an_allocation_is_alone(environment, monkeypatch):
    joined = []
    monkeypatch.setattr(devices, "_initialize", lambda *given: joined.append(given))
    environment(SLURM_NTASKS="4")
    devices.join_processes()
    assert joined == []
    environment(SLURM_NTASKS="4", SLURM_PROCID="2")
    devices.join_processes()
    assert joined == [()]
