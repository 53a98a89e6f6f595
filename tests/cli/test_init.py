"""The command itself: versions, usage, and that the one script is declared."""

import importlib
import tomllib
from pathlib import Path

import pytest

import jaxreg
from jaxreg.cli import main
from jaxreg.cli.options import SUCCESS

pytestmark = pytest.mark.float32

SOURCE_ROOT = Path(__file__).parents[2]


def test_version(run):
    assert run("--version")[:2] == (SUCCESS, f"jaxreg {jaxreg.__version__}\n")


@pytest.mark.parametrize(
    "arguments", [[], ["register", "a.ply"], ["fly"], ["info", "a.ply", "--x"]]
)
def test_usage_mistakes_end_with_status_2(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert capsys.readouterr().err


def test_console_script_is_declared():
    project = tomllib.loads((SOURCE_ROOT / "pyproject.toml").read_text())["project"]
    module, _, function = project["scripts"]["jaxreg"].partition(":")
    assert getattr(importlib.import_module(module), function) is main


@pytest.mark.parametrize("command", ["register", "align", "info", "view", "train", "evaluate"])
def test_every_command_has_help_and_takes_its_settings_as_options(command, capsys):
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert end.value.code == 0
    out = capsys.readouterr().out
    assert out.startswith(f"usage: jaxreg {command}")
    assert "subcommands" not in out


def test_the_list_of_commands_is_complete(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    out = capsys.readouterr().out
    for path in (SOURCE_ROOT / "jaxreg" / "cli").glob("[a-z]*.py"):
        assert path.stem in out or path.stem in ("options", "process")
