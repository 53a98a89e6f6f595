"""The records of `research.fit_verdict --split test`: what the verdict of `jaxreg.register` is worth."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from benchmarks import record
from jaxreg.scans import verdict

SOURCES = {"procedural": "procedural", "ModelNet40": "modelnet", "7Scenes": "scenes"}
KINDS = {
    "full": ("samplings", "two samplings"),
    "noisy": ("noise", "noise up to 0.015"),
    "crops": ("crops", "own crops of 60 to 90 %"),
    "unrelated": ("unrelated", "unrelated shapes"),
    "apart": ("ends", "two ends of one {thing}"),
}
GOOD = ("full", "noisy", "crops")
"""Kinds of pairs that have a right pose."""
BINS = {
    "p90": ("0.9 or more", 0.9, 1.01),
    "p50": ("0.5 to 0.9", 0.5, 0.9),
    "p10": ("0.1 to 0.5", 0.1, 0.5),
    "p00": ("below 0.1", 0.0, 0.1),
}
COLUMNS = {
    "pairs": "pairs",
    "right": "right",
    "right_called_failure": "right, called a failure",
    "wrong_called_success": "wrong, called a success",
}


def evidence(entry: dict) -> verdict.Evidence:
    """The evidence of a pair that `research.fit_verdict` has registered."""
    return verdict.Evidence(*(entry[name] for name in verdict.Evidence._fields))


def counts(entries: list[dict], judge: Callable[[dict], float]) -> dict[str, int | None]:
    """How many pairs there are, how many poses are right, and how many verdicts are wrong."""
    right = np.array([entry["right"] for entry in entries], bool)
    trusted = np.array([judge(entry) for entry in entries]) >= verdict.TRUSTED
    without = all(entry["kind"] not in GOOD for entry in entries)
    return {
        "pairs": len(entries),
        "right": int(right.sum()),
        "right_called_failure": None if without else int(np.sum(right & ~trusted)),
        "wrong_called_success": int(np.sum(trusted & ~right)),
    }


def as_judged(entry: dict) -> float:
    """The probability that `jaxreg.register` gives."""
    return verdict.probability(evidence(entry))


def without_search(entry: dict) -> float:
    """That of the same pose, had it been given."""
    return verdict.probability(evidence(entry | {"rival": verdict.NOT_SEARCHED}))


def without_rival(entry: dict) -> float:
    """That of the same pose, were it known that no other agrees."""
    return verdict.probability(evidence(entry | {"rival": verdict.NO_RIVAL}))


def write(entries: list[dict]) -> Iterator[Path]:
    """The records `verdict`, `verdict_initial` and `verdict_probability` of registered pairs."""
    yield write_verdict(entries)
    yield write_initial(entries)
    yield write_probability(entries)


def chosen(entries: list[dict], *, sources=tuple(SOURCES), kinds=tuple(KINDS)) -> list[dict]:
    """The pairs of some sources and kinds."""
    return [x for x in entries if x["source"] in sources and x["kind"] in kinds]


def write_verdict(entries: list[dict]) -> Path:
    """A row a source and kind, then sums."""
    rows = {}
    for kind, (key, text) in KINDS.items():
        for source, name in SOURCES.items():
            if found := chosen(entries, sources=(source,), kinds=(kind,)):
                label = text.format(thing="scan" if source == "7Scenes" else "shape")
                rows[f"{name}_{key}"] = {"label": f"{source}: {label}"} | counts(found, as_judged)
    for source, name in SOURCES.items():
        if found := chosen(entries, sources=(source,), kinds=GOOD):
            label = f"{source}: samplings, noise, own crops"
            rows[name] = {"label": label} | counts(found, as_judged)
    shapes = ("procedural", "ModelNet40")
    if found := chosen(entries, sources=shapes, kinds=("unrelated",)):
        label = "procedural and ModelNet40: unrelated shapes"
        rows["unrelated"] = {"label": label} | counts(found, as_judged)
    return _write(
        "verdict", "What is the verdict of `jaxreg.register` worth?", COLUMNS, rows, entries
    )


def write_initial(entries: list[dict]) -> Path:
    """The same poses as if they had been given, by other constants than those that a search needs."""
    wrong = {"unrelated": ("unrelated",), "ends": ("apart",)}
    rows = {}
    for key, label, judge in (
        ("no_rival", "judged as if there were no rival", without_rival),
        ("own_constants", "constants of its own", without_search),
    ):
        called = {
            name: counts(chosen(entries, kinds=kinds), judge)["wrong_called_success"]
            for name, kinds in wrong.items()
        }
        failed = counts(chosen(entries, kinds=GOOD), judge)["right_called_failure"]
        rows[key] = {"label": label} | called | {"good": failed}
    columns = {
        "unrelated": "unrelated pairs called a success",
        "ends": "ends called a success",
        "good": "good pairs called a failure",
    }
    question = "What is the verdict worth for a pose that was given (`initial=`)?"
    return _write("verdict_initial", question, columns, rows, entries)


def write_probability(entries: list[dict]) -> Path:
    """How many of the poses of about one probability are right."""
    chance = np.array([as_judged(entry) for entry in entries])
    right = np.array([entry["right"] for entry in entries], bool)
    rows = {}
    for key, (label, low, high) in BINS.items():
        inside = (chance >= low) & (chance < high)
        share = float(right[inside].mean()) if inside.any() else None
        rows[key] = {"label": label, "pairs": int(inside.sum()), "right": share}
    question = "How often is a pose of a given probability right?"
    columns = {"pairs": "pairs", "right": "share right"}
    return _write("verdict_probability", question, columns, rows, entries)


def setting(entries: list[dict]) -> dict[str, float]:
    """The counts that the text names."""
    good = counts(chosen(entries, kinds=GOOD), as_judged)
    found = {"pairs": len(entries), "good": good["right"]}
    found["good_called_failure"] = good["right_called_failure"]
    found["share_called_failure"] = round(good["right_called_failure"] / max(good["right"], 1), 3)
    shapes = ("procedural", "ModelNet40")
    for key, sources, kind in (
        ("unrelated", shapes, "unrelated"),
        ("ends_of_shapes", shapes, "apart"),
        ("ends_of_scans", ("7Scenes",), "apart"),
    ):
        part = counts(chosen(entries, sources=sources, kinds=(kind,)), as_judged)
        found[key], found[f"{key}_called_success"] = part["pairs"], part["wrong_called_success"]
    found["ends"] = found["ends_of_shapes"] + found["ends_of_scans"]
    return found


def _write(name: str, question: str, columns: dict, rows: dict, entries: list[dict]) -> Path:
    return record.write(
        name,
        question=question,
        command=record.command("research.fit_verdict"),
        columns=columns,
        rows=rows,
        setting=setting(entries),
    )
