"""The command `jaxreg`: seven programs; only the one that is called is loaded.

Exit status: 0 success; 2 bad input; 3 finished, but do not trust the result; 130 interrupted.
"""

import dataclasses
import gc
import importlib
import sys
from typing import Any

import tyro

from jaxreg import __version__
from jaxreg.cli import process
from jaxreg.cli.align import Align
from jaxreg.cli.export import Export
from jaxreg.cli.info import Info
from jaxreg.cli.options import SUCCESS, say, status_of
from jaxreg.cli.register import Register
from jaxreg.cli.view import View

__all__ = ["main"]


@dataclasses.dataclass(frozen=True)
class _Train:
    """Train a network as a configuration says: jaxreg train CONFIG.toml ..."""


@dataclasses.dataclass(frozen=True)
class _Evaluate:
    """Evaluate a network, or another method, on the same pairs: jaxreg evaluate CONFIG.toml ..."""


_WITH_CONFIGURATION = ("train", "evaluate")
"""These parse their own command lines, because their options depend on the file that follows."""


def main(arguments: list[str] | None = None) -> int:
    """The console script `jaxreg`; returns the exit status."""
    given = sys.argv[1:] if arguments is None else arguments
    if given == ["--version"]:
        say(f"jaxreg {__version__}")
        return SUCCESS
    if given[:1] == ["train"] and arguments is None:
        process.restart_with_huge_pages()
    if given and given[0] in _WITH_CONFIGURATION:
        return importlib.import_module(f"jaxreg.cli.{given[0]}").main(given[1:])
    command: Any = tyro.extras.subcommand_cli_from_dict(
        {
            "register": Register,
            "align": Align,
            "info": Info,
            "view": View,
            "train": _Train,
            "evaluate": _Evaluate,
            "export": Export,
        },
        prog="jaxreg",
        description="Rigid registration of point clouds (jaxreg --version prints the version).",
        args=given,
    )
    # Tracing makes a million small objects and little garbage: collecting is a tenth of a short run.
    gc.disable()
    try:
        return status_of(command.run)
    finally:
        gc.enable()
