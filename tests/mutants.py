"""Breaks each kernel on purpose, in a copy: the tests must notice. Run by `make mutants`.

A mutant that survives is a hole in the tests; one whose text is gone must be written anew.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent


class Mutant(NamedTuple):
    """`text` of `module` becomes `mutated`; the tests of that module must fail."""

    module: str
    text: str
    mutated: str
    tests: str = ""


MUTANTS = [
    Mutant("procrustes", "(share * (source -", "(share * share * (source -"),
    Mutant("procrustes", "jnp.sign(sign)]", "jnp.ones_like(sign)]"),
    Mutant("procrustes", "skew = skew.T - skew", "skew = skew - skew.T"),
    Mutant("neighbors", "order[None, :] == jnp.arange(n)[:, None]", "jnp.zeros((n, n), bool)"),
    Mutant("neighbors", "order = jnp.lexsort(points.T)", "order = jnp.arange(n)"),
    Mutant("numerics", "jnp.sqrt(jnp.where(zero, 1, x))", "jnp.sqrt(x)"),
    Mutant("numerics", "jnp.where(degenerate, 1, dot)", "dot"),
    Mutant(
        "rigid", "RigidTransform(rotation, -translation)", "RigidTransform(rotation, translation)"
    ),
    Mutant("rigid", "jnp.matmul(second.rotation, first", "jnp.matmul(first.rotation, second"),
    Mutant("matching", "jax.nn.softmax(-distance, axis=1)", "jax.nn.softmax(-distance, axis=0)"),
    Mutant("matching", "jnp.exp(alpha - dual)", "jnp.exp(dual - alpha)"),
    Mutant("invariants", "jnp.roll(vectors, -1, axis=1)", "vectors"),
    Mutant("inliers", "jnp.where(mask, confidence, -1)", "jnp.where(mask, confidence, 2)"),
    Mutant("metrics", "chord / np.sqrt(8)", "chord / np.sqrt(2)"),
    Mutant("metrics", "errors.rte < 0.01)", "errors.rte < 0.1)"),
]


def check(mutant: Mutant) -> None:
    """Raises ValueError when the module does not hold the text exactly once."""
    count = (ROOT / "jaxreg" / f"{mutant.module}.py").read_text("utf-8").count(mutant.text)
    if count != 1:
        raise ValueError(f"{mutant.module}.py holds {mutant.text!r} {count} times: write it anew.")


def survives(mutant: Mutant) -> bool:
    """Whether the tests pass all the same."""
    with tempfile.TemporaryDirectory() as directory:
        copy = Path(directory)
        for name in ("jaxreg", "tests"):
            shutil.copytree(ROOT / name, copy / name)
        shutil.copy(ROOT / "pyproject.toml", copy)
        path = copy / "jaxreg" / f"{mutant.module}.py"
        source = path.read_text(encoding="utf-8")
        path.write_text(source.replace(mutant.text, mutant.mutated), encoding="utf-8")
        tests = mutant.tests or f"tests/test_{mutant.module}.py"
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", tests]
        result = subprocess.run(command, cwd=copy, capture_output=True, text=True, check=False)
        if result.returncode not in (0, 1):
            raise ValueError(f"{tests} did not run: {result.stdout[-2000:]}{result.stderr[-2000:]}")
        return result.returncode == 0


def main() -> None:
    """Run every mutant; exit 1 when one survives."""
    survivors = 0
    for mutant in MUTANTS:
        check(mutant)
    for mutant in MUTANTS:
        alive = survives(mutant)
        survivors += alive
        outcome = "SURVIVED" if alive else "killed"
        print(f"{outcome:9}{mutant.module}: {mutant.text}  ->  {mutant.mutated}", flush=True)
    sys.exit(f"{survivors} mutants survived" if survivors else 0)


if __name__ == "__main__":
    main()
