"""Blocks of code in a Markdown page: run them, and compare what they print with what the page says."""

import contextlib
import io as streams
import re
import shlex

import jax
import numpy as np

from jaxreg.cli import main

BLOCK = re.compile(r"```(python|sh)\n(.*?)```\n(?:\n```\n(.*?)```\n)?", re.DOTALL)


def run_python(code: str, names: dict) -> str:
    # Readers write `points + translation`, as the field does.
    with (
        contextlib.redirect_stdout(streams.StringIO()) as printed,
        jax.numpy_rank_promotion("allow"),
    ):
        exec(compile(code, "example", "exec"), names)  # noqa: S102
    return printed.getvalue()


def run_shell(code: str) -> str | None:
    """What lines `jaxreg ...` and `echo $?` print.

    None for other programs, and for training and evaluation of all pairs, which take minutes: they are
    not run.
    """
    if not re.match(r"jaxreg (register|align|info|view|evaluate \w+ --pairs) ", code):
        return None
    status = 0
    with (
        contextlib.redirect_stdout(streams.StringIO()) as printed,
        contextlib.redirect_stderr(printed),
    ):
        for line in code.splitlines():
            if line == "echo $?":
                print(status)
            else:
                status = main(shlex.split(line)[1:])
    return printed.getvalue()


def run_blocks(text: str):
    """The match, and what was printed (None where nothing was run), of every block of a page."""
    names = {}
    for match in BLOCK.finditer(text):
        kind, code, _ = match.groups()
        yield match, run_python(code, names) if kind == "python" else run_shell(code)


def comparable(text: str) -> tuple[list[str], np.ndarray]:
    """The words, and the numbers, of lines that do not tell a time."""
    lines = [line for line in text.splitlines() if not re.search(r"^time|seconds|\bs$", line)]
    numbers = re.findall(r"(?<![\w.])-?\d[\d,]*\.?\d*(?:e[-+]?\d+)?", "\n".join(lines))
    return words_of("\n".join(lines)), np.array(
        [float(number.replace(",", "")) for number in numbers]
    )


def compare(promised: str, printed: str) -> None:
    """Equal words; numbers that differ by no more than another machine's rounding may cause.

    A line "..." of a page stands for lines that it leaves out.
    """
    if "..." in promised.splitlines():
        promised, printed = shown_lines(promised, printed)
    (words, numbers), (other_words, others) = comparable(promised), comparable(printed)
    assert words == other_words, printed
    assert numbers.shape == others.shape, printed
    np.testing.assert_allclose(others, numbers, rtol=0.1, atol=0.05, err_msg=printed)


def shown_lines(promised: str, printed: str) -> tuple[str, str]:
    """The promised lines without "...", and those lines of the output that have the same words."""
    kept = [line for line in promised.splitlines() if line != "..."]
    rest, found = iter(printed.splitlines()), []
    for line in kept:
        found += [next((other for other in rest if words_of(other) == words_of(line)), "")]
    return "\n".join(kept), "\n".join(found)


def refreshed(promised: str, printed: str) -> str:
    """The output for a page that leaves out lines, where `promised` says which."""
    if "..." not in promised.splitlines():
        return printed
    lines = iter(shown_lines(promised, printed)[1].splitlines())
    return "".join(f"{line if line == '...' else next(lines)}\n" for line in promised.splitlines())


def words_of(text: str) -> list[str]:
    return re.findall(r"[A-Za-z]{3,}", text)
