"""The command `jaxreg`."""

from jaxreg.cli.commands import main

__all__ = ["main"]
