"""`jaxreg train`: what it says of a mistake, and where it writes. Training itself is replaced."""

import errno
import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from jaxreg import training
from jaxreg.cli import train as command
from jaxreg.config import load_config

pytestmark = pytest.mark.float32

ROOT = Path(__file__).parents[2]


@pytest.fixture
def toml(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text('[data]\nname = "shapes"\n')
    return path


@pytest.fixture
def train(run, toml, monkeypatch):
    """`jaxreg train c.toml ARGUMENTS`: status and error output."""
    monkeypatch.chdir(toml.parent)

    def train(*arguments, work=None):
        monkeypatch.setattr(command, "train", work)
        status, _, error = run("train", toml, *arguments)
        return status, error

    return train


def one_step(config, workdir, *, root):
    Path(workdir).mkdir(exist_ok=True, parents=True)
    (Path(workdir) / "metrics.jsonl").write_text('{"step": 1, "loss": 1.0}\n')


def test_weights_get_the_command_as_it_was_typed_and_go_where_it_says(
    train, toml, tmp_path, monkeypatch
):
    released = []

    def release(name, workdir, command, *, root, directory):
        released.append((name, workdir, command, directory))
        return Path(directory) / f"{name}.json"

    monkeypatch.setattr(command, "release", release)
    workdir = str(tmp_path / "a run")
    typed = ["--workdir", workdir, "--train.steps", "7", "--release", "mine"]
    assert train(*typed, work=one_step) == (0, "")
    assert train(*typed, "--release-to", "weights", work=one_step) == (0, "")
    (name, run, line, place), (*_, other) = released
    assert (name, run, place, other) == ("mine", workdir, workdir, "weights")
    assert shlex.split(line) == ["jaxreg", "train", str(toml), *typed]


def test_weights_are_not_replaced_and_that_is_said_before_the_training(train, tmp_path):
    status, message = train("--release", "modelnet40")
    assert status == 2
    assert message.startswith("error: weights 'modelnet40' already exist")
    (tmp_path / "w").mkdir()
    (tmp_path / "w" / "mine.npz").touch()
    status, message = train("--release", "mine", "--release-to", "w")
    assert status == 2
    assert message.endswith("delete mine.npz and mine.json in w to replace them.\n")


def test_after_the_training_an_error_is_one_line_and_loses_nothing(train, tmp_path):
    (tmp_path / "curves.png").mkdir()
    status, message = train("--workdir", tmp_path, work=one_step)
    assert status == 2
    assert message.startswith(f"error: {tmp_path}/curves.png: Is a directory")
    assert f"({tmp_path} has the whole run: run the same command again to do the rest)" in message
    assert len(message.splitlines()) == 1


def test_without_matplotlib_a_run_is_complete_and_says_what_was_not_drawn(
    run, train, tmp_path, monkeypatch
):
    monkeypatch.setattr(command, "train", one_step)
    monkeypatch.delitem(sys.modules, "jaxreg.view.pictures", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    status, out, error = run("train", tmp_path / "c.toml", "--workdir", tmp_path / "r")
    assert (status, error) == (0, "")
    assert "curves.png is not drawn: a picture needs matplotlib" in out
    assert out.splitlines()[-1] == f"best checkpoint, metrics.jsonl: {tmp_path / 'r'}"


def test_errors_of_the_file_system_and_of_the_numbers_are_one_line_and_status_2(train):
    def full(config, workdir, *, root):
        raise OSError(errno.ENOSPC, "No space left on device", "runs/c/latest")

    def diverged(config, workdir, *, root):
        raise FloatingPointError("the loss is not finite at step 3")

    assert train(work=full) == (2, "error: runs/c/latest: No space left on device\n")
    assert train(work=diverged) == (2, "error: the loss is not finite at step 3\n")


def test_a_workdir_that_is_a_file_is_one_line_and_status_2(train, tmp_path):
    status, message = train("--workdir", tmp_path / "c.toml", work=training.train)
    assert (status, len(message.splitlines())) == (2, 1)
    assert message.startswith(f"error: {tmp_path}/c.toml is a file")


def test_an_interrupted_run_says_how_it_goes_on(train):
    def interrupted(config, workdir, *, root):
        raise KeyboardInterrupt

    message = "interrupted: run the same command to go on from the last validation\n"
    assert train(work=interrupted) == (130, message)


@pytest.mark.parametrize("name", ["synthetic_cpu", "synthetic_cpu.toml"])
def test_a_configuration_of_the_package_is_found_by_its_name(run, tmp_path, monkeypatch, name):
    seen = []
    monkeypatch.chdir(tmp_path)

    def look(config, workdir, *, root):
        seen.append((config, workdir))
        one_step(config, workdir, root=root)

    monkeypatch.setattr(command, "train", look)
    assert run("train", name)[0] == 0
    assert seen == [(load_config(ROOT / "configs" / "synthetic_cpu.toml"), "runs/synthetic_cpu")]


def test_a_wrong_name_lists_the_configurations_of_the_package(capsys):
    with pytest.raises(SystemExit) as end:
        command.main(["synthetic_gpu"])
    assert end.value.code == 2
    error = capsys.readouterr().err
    for path in (ROOT / "configs").glob("*.toml"):
        assert path.stem in error


def test_the_script_is_the_same_program(tmp_path):
    (tmp_path / "sitecustomize.py").write_text(
        "import json, sys, jaxreg.cli.train as t\n"
        "t.main = lambda: print(json.dumps(sys.argv[1:])) or 3\n"
    )
    done = subprocess.run(
        [sys.executable, ROOT / "train.py", "c.toml", "--workdir", "a b"],
        env=os.environ | {"PYTHONPATH": f"{tmp_path}:{ROOT}"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, json.loads(done.stdout)) == (3, ["c.toml", "--workdir", "a b"])
