"""The command line of the scripts: a configuration file first, then deviations from it."""

import sys
from pathlib import Path
from typing import Any, NoReturn

import tyro

from jaxreg.config import Config, load_config


def parse(
    options: type, *, description: str, arguments: list[str] | None = None
) -> tuple[Path, Any]:
    """``CONFIG.toml [--option value ...] [--section.field value ...]`` as (path, `options`).

    `options` is a dataclass with a field `config: Config` and defaults for the rest. A mistake ends
    the program with status 2 and one message.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    asks_help = not arguments or arguments[0] in ("-h", "--help")
    if asks_help:
        path, config, rest = Path(), Config(), ["--help"]
    else:
        path, rest = Path(arguments[0]), arguments[1:]
        try:
            config = load_config(path)
        except ValueError as error:
            stop(str(error))
    program = f"{Path(sys.argv[0]).name} CONFIG.toml"
    parsed = tyro.cli(
        options, default=options(config=config), args=rest, prog=program, description=description
    )
    return path, parsed


def stop(message: str, *, status: int = 2) -> NoReturn:
    """End the program with one message: status 2 for bad input, as `jaxreg` does."""
    print(f"error: {message}" if status == 2 else message, file=sys.stderr)  # noqa: T201
    raise SystemExit(status)


def told(error: Exception) -> str:
    """What an error says: of a file that could not be read or written, which one and why."""
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return str(error)
