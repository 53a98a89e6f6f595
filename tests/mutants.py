"""Breaks each kernel on purpose, in a copy: a named test must notice. Run by `make mutants`.

A mutant that survives is a hole in the tests; one whose text is gone must be written again. Words
after the command choose the mutants of these modules: `python tests/mutants.py matching losses`.
"""

import concurrent.futures
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent


class Mutant(NamedTuple):
    """Where `text` of `module` becomes `mutated`, `test` must fail.

    It stands in that module's tests, or in the file of their folder that it names (`file.py::test`).
    """

    module: str
    text: str
    mutated: str
    test: str


MUTANTS = [
    Mutant(module, **entry)
    for module, entries in tomllib.loads((ROOT / "tests/mutants.toml").read_text("utf-8")).items()
    for entry in entries
]


def killer(mutant: Mutant, cache: str) -> str | None:
    """Name of the test that fails for a mutant; None when it survives.

    Raises:
      ValueError: the module does not hold the text exactly once, or the test did not run.
    """

    def mutate(copy: Path) -> None:
        path = copy / file_of(mutant)
        source = path.read_text(encoding="utf-8")
        if source.count(mutant.text) != 1:
            count = source.count(mutant.text)
            raise ValueError(f"{mutant.module}.py holds {mutant.text!r} {count} times, not once")
        path.write_text(source.replace(mutant.text, mutant.mutated), encoding="utf-8")

    return first_failure([test_of(mutant)], cache, mutate)


def test_of(mutant: Mutant) -> str:
    package, _, name = mutant.module.rpartition(".")
    file, _, test = mutant.test.rpartition("::")
    return str(Path("tests", *package.split("."), file or f"test_{name}.py")) + f"::{test}"


def file_of(mutant: Mutant) -> Path:
    return Path("jaxreg", *mutant.module.split(".")).with_suffix(".py")


def first_failure(
    tests: list[str], cache: str, change: Callable[[Path], None] = lambda copy: None
) -> str | None:
    """The first of the tests that fails in a changed copy; None when all pass.

    What the change does not concern was compiled for another copy, and is found in `cache`.
    """
    with tempfile.TemporaryDirectory() as directory:
        copy = Path(directory)
        ignored = shutil.ignore_patterns("__pycache__")
        for name in ("jaxreg", "tests", "configs"):
            shutil.copytree(ROOT / name, copy / name, ignore=ignored)
        shutil.copy(ROOT / "pyproject.toml", copy)
        change(copy)
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
        environment = os.environ | {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
        result = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True, check=False
        )
    if result.returncode not in (0, 1):
        raise ValueError(f"{tests} did not run: {result.stdout[-2000:]}{result.stderr[-2000:]}")
    failed = re.search(r"^FAILED \S+::(\S+)", result.stdout, re.MULTILINE)
    return failed.group(1) if failed else None


def main() -> None:
    """Run the mutants, two at a time; exit 1 when one survives, or a test fails without any."""
    chosen = [m for m in MUTANTS if not sys.argv[1:] or m.module in sys.argv[1:]]
    with (
        tempfile.TemporaryDirectory() as cache,
        concurrent.futures.ThreadPoolExecutor(min(2, os.cpu_count() or 1)) as pool,
    ):
        survivors = 0
        if broken := first_failure(sorted({test_of(mutant) for mutant in chosen}), cache):
            sys.exit(f"{broken} fails without a mutant: fix that first.")
        for mutant, test in zip(
            chosen, pool.map(killer, chosen, [cache] * len(chosen)), strict=True
        ):
            survivors += test is None
            print(f"{mutant.module}: {mutant.text}  ->  {mutant.mutated}")
            print(f"    {'SURVIVED ' + mutant.test if test is None else 'killed by ' + test}")
            sys.stdout.flush()
    print(f"{len(chosen) - survivors} of {len(chosen)} mutants killed")
    sys.exit(1 if survivors else 0)


if __name__ == "__main__":
    main()
