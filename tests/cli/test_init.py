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
