"""What the commands share: configurations as arguments, exit statuses, and terminal output."""

import dataclasses
import sys
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import tyro
from rich.console import Console

from jaxreg.config import Config, load_config

SUCCESS, BAD_INPUT, NOT_TRUSTED, INTERRUPTED = 0, 2, 3, 130


def parse(
    options: type,
    *,
    description: str | None,
    arguments: list[str] | None = None,
    program: str = "",
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
    parsed = tyro.cli(
        options,
        default=options(config=config),
        args=rest,
        prog=f"{program or Path(sys.argv[0]).name} CONFIG.toml",
        description=description,
    )
    return path, parsed


def given_fields(options: type, arguments: list[str]) -> frozenset[str]:
    """The fields of the configuration that a command line sets after its file, as in `model.k`.

    Parsed twice, from configurations that differ in every field: where the results agree, the
    command line has set the field. The arguments must be ones that `parse` has accepted.
    """
    defaults = load_config(arguments[0])
    first, second = (
        _leaves(tyro.cli(options, default=options(config=config), args=arguments[1:]).config)
        for config in (defaults, _different(defaults))
    )
    return frozenset(name for name, value in first.items() if value == second[name])


_SOMETHING = {int: 1, float: 1.0, str: "1", tuple: (1,)}


def _leaves(config: Any) -> dict[str, Any]:
    leaves = {}
    for name, value in vars(config).items():
        if dataclasses.is_dataclass(value):
            leaves |= {f"{name}.{field}": leaf for field, leaf in _leaves(value).items()}
        else:
            leaves[name] = value
    return leaves


def _different(config: Any) -> Any:
    """The same configuration with another value of the same type in every field."""
    values = {}
    for name, hint in typing.get_type_hints(type(config)).items():
        value = getattr(config, name)
        if dataclasses.is_dataclass(value):
            values[name] = _different(value)
        elif typing.get_origin(hint) is typing.Literal:
            values[name] = next(x for x in typing.get_args(hint) if x != value)
        elif isinstance(value, bool):
            values[name] = not value
        else:
            # Doubling zero or infinity changes nothing.
            values[name] = next(x for x in (value * 2, _SOMETHING[type(value)]) if x != value)
    return type(config)(**values)


def status_of(run: Callable[[], int], *, interrupted: str = "interrupted") -> int:
    """The exit status of a command; its mistakes become one line instead of a traceback."""
    try:
        return run()
    except KeyboardInterrupt:
        complain(interrupted)
        return INTERRUPTED
    except (ValueError, OSError, FloatingPointError, ImportError) as error:
        complain(f"error: {told(error)}")
        return BAD_INPUT


def told(error: Exception) -> str:
    """The text of an error; for a file that could not be read or written, which one and why."""
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def stop(message: str, *, status: int = BAD_INPUT) -> NoReturn:
    """End the program with one message: status 2 for bad input."""
    complain(f"error: {message}" if status == BAD_INPUT else message)
    raise SystemExit(status)


def complain(message: str) -> None:
    """One message on standard error, as it is."""
    console = Console(stderr=True, highlight=False, soft_wrap=True, emoji=False)
    console.print(message, markup=False)


def say(text: str) -> None:
    """A line of the output, as it is: never wrapped, coloured or read as markup."""
    Console(highlight=False, soft_wrap=True, emoji=False).print(text, markup=False)


def line(name: str, value: str) -> None:
    """A line of the output that begins with a name."""
    say(f"{name:<16} {value}")


def finite(points: np.ndarray, path: Path) -> np.ndarray:
    """The finite points of the file at `path`.

    Raises:
      ValueError: there are none.
    """
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        raise ValueError(f"{path} contains no finite point: export the file again.")
    return points
