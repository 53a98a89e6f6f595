"""What a benchmark measured, in one file a question: benchmarks/results/NAME.json.

Every number of RESULTS.md is read from these files (`python -m benchmarks.render`).
"""

import datetime
import importlib.metadata
import json
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

FOLDER = Path(__file__).parent / "results"
FIELDS = ("question", "command", "commit", "date", "machine", "columns", "rows")
"""What every file has. `setting` (numbers that the text names), `note` and `transcribed` may be missing."""

Value = str | int | float | None


def write(
    name: str,
    *,
    question: str,
    command: str,
    columns: Mapping[str, str],
    rows: Mapping[str, Mapping[str, Value]],
    setting: Mapping[str, Value] | None = None,
    note: str | None = None,
    folder: Path = FOLDER,
) -> Path:
    """Writes NAME.json with today's date, the commit and the machine, and returns its path.

    Args:
      name: the file's name and its name in the template, `two_scans`.
      question: what the table answers, as one sentence.
      command: what makes it again, `python -m benchmarks.scans.red_kitchen --rotation full`.
      columns: the heading of each column by its key, `{"right": "right"}`.
      rows: the values of each row by its key, `{"jaxreg": {"label": "jaxreg.register", "right": 20}}`;
        None is a cell that was not measured. Without a `label` the key is shown.
      setting: numbers that a sentence needs, such as how many pairs were asked for.
      note: one sentence that a reader must know, such as what differs in one row.
      folder: where the file goes.

    Raises:
      ValueError: for a key that a template cannot name, or a value without a column.
    """
    for key in (name, *columns, *rows, *(setting or {})):
        if not key.isidentifier() or hasattr(dict, key) or key == "setting":
            raise ValueError(f"{name}: {key!r} cannot be named in the template: use another word")
    for key, row in rows.items():
        if strange := set(row) - {"label", *columns}:
            raise ValueError(f"{name}: row {key!r} has values without a column: {sorted(strange)}")
    record = {
        "question": question,
        "command": command,
        "commit": commit(),
        "date": datetime.date.today().isoformat(),
        "machine": machine(),
        "note": note,
        "setting": dict(setting or {}),
        "columns": dict(columns),
        "rows": {key: dict(row) for key, row in rows.items()},
    }
    path = folder / f"{name}.json"
    text = json.dumps(record, indent=1, ensure_ascii=False, allow_nan=False, default=_plain)
    path.write_text(text + "\n", encoding="utf-8")
    return path


def read(name: str) -> dict | None:
    """NAME.json as it stands; None if there is none."""
    path = FOLDER / f"{name}.json"
    return json.loads(path.read_text("utf-8")) if path.is_file() else None


def kept(old: dict, rows: Sequence[str]) -> str | None:
    """A note on the rows that a run did not make and keeps from the record as it stood; none if none."""
    if not rows:
        return None
    told, note = f"figures of {', '.join(rows)}.", old.get("note") or ""
    if told in note:  # The run before did not make them either, and says which one did.
        return note
    return f"Not made in this run, but at commit {old['commit']}: {told} {note}".strip()


def command(module: str) -> str:
    """The command line of this process as one that makes the record again, elsewhere.

    `--data-root` is left out, and of other absolute paths all but the name.
    """
    given = iter(sys.argv[1:])
    kept = []
    for word in given:
        if word == "--data-root":
            next(given, None)
        elif not word.startswith("--data-root="):
            kept.append(Path(word).name if word.startswith("/") else word)
    return shlex.join(["python", "-m", module, *kept])


def key(name: str) -> str:
    """A name as a template can say it: `open3d_ransac_icp@0.05` is `open3d_ransac_icp_0_05`."""
    return re.sub(r"\W", "_", name)


def commit() -> str:
    """The commit that is checked out, with a "+" where the code differs from it."""
    try:
        name = _git("rev-parse", "--short", "HEAD")
        changed = _git("status", "--porcelain", "-uno", "--", ".", ":!RESULTS.md", f":!{FOLDER}")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return name + ("+" if changed else "")


def machine() -> str:
    """The processor, how many of its cores this process has, and the versions that matter."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return (
        f"{_processor()}, {cores} cores, {platform.system()}, "
        f"Python {platform.python_version()}, JAX {importlib.metadata.version('jax')}"
    )


def _git(*arguments: str) -> str:
    finished = subprocess.run(
        ["git", *arguments], cwd=FOLDER.parents[1], check=True, capture_output=True, text=True
    )
    return finished.stdout.strip()


def _processor() -> str:
    """`platform.processor()` is empty or the architecture on Linux."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _plain(value):
    """A Python number for a scalar of numpy or JAX, which `json` does not know."""
    if getattr(value, "shape", None) == ():
        return value.item()
    raise TypeError(f"not a number, a string or None: {value!r}")
