"""Run scripts that each show one situation: `python tests/cases.py FOLDER ...` prints how they end.

Each script runs in a process of its own, with this interpreter, and ends with 0 where all is well. A
folder that is not there is skipped. Exit status: 0 if every script did, else 1. Names that the library
had when the scripts were written are those of today for them (tests/former).
"""

import os
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIMIT = 600
"""Seconds after which a script is ended: some faults are waits without end."""


def run(script: Path) -> str:
    """The exit status of a script, or that it did not end."""
    former = str(ROOT / "tests" / "former")
    places = [former, str(ROOT), str(script.parent), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, places)),
        "JAXREG_CLONE": str(ROOT),
    }
    try:
        done = subprocess.run(
            [sys.executable, str(script)],
            cwd=ROOT, env=environment, capture_output=True, text=True, timeout=LIMIT, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"no end in {LIMIT} s"
    last = (done.stdout + done.stderr).strip().splitlines()[-1:]
    return str(done.returncode) if done.returncode == 0 else f"{done.returncode}: {' '.join(last)}"


def main(folders: list[str]) -> int:
    """Run every numbered script of the folders; returns the exit status."""
    failed = 0
    for folder in map(Path, folders):
        scripts = sorted(folder.glob("[0-9]*.py"))
        if not scripts:
            print(f"{folder}: skipped, there are no cases")
        for script in scripts:
            begin = time.perf_counter()
            told = run(script)
            failed += told != "0"
            print(
                f"{folder.name}/{script.name}: {told} ({time.perf_counter() - begin:.0f} s)",
                flush=True,
            )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
