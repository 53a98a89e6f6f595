"""The log of a training run: `metrics.jsonl`, one JSON object per line."""

import json
from pathlib import Path

import numpy as np

from jaxreg.io.places import reading


def read_metrics(path: str | Path) -> dict[str, np.ndarray]:
    """The columns of a `metrics.jsonl`; NaN if a line has no such entry.

    Raises:
      ValueError: there is no such file, it may not be read, it is empty, or a line is not a JSON
        object.
    """
    path = Path(path)
    with reading(path):
        if not path.is_file():
            raise ValueError(f"no metrics at {path}: give the metrics.jsonl of a training run.")
        lines = path.read_text(encoding="utf-8").splitlines()
    entries = []
    for number, line in enumerate(lines, start=1):
        try:
            entries.append(dict(json.loads(line)))
        except (ValueError, TypeError):
            raise ValueError(f"{path}, line {number} is not a JSON object: remove it.") from None
    if not entries:
        raise ValueError(f"{path} is empty: the run has not finished a step yet.")
    names = dict.fromkeys(name for entry in entries for name in entry)
    return {name: np.array([entry.get(name, np.nan) for entry in entries], float) for name in names}
