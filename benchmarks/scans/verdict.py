"""What the verdict of `jaxreg.register` is worth: pairs whose truth is known, and the counts.

    python -m benchmarks.scans.verdict [--data-root DATA] [--pairs 200] [--seed 1]

The pairs come from procedural shapes and, where they are found, ModelNet40's test shapes and
fragments of 7Scenes: independent samplings of one shape, with noise and with own half-space crops
(overlap 0.5 to 1), pairs of unrelated shapes, and the two ends of one shape, which share no surface.
A pose is right within 5 degrees and 0.1 of the shape's radius. Ends are often congruent, and nothing
in two congruent clouds tells that they are two; several poses then agree alike, so successes without
an alternative of comparable probability are counted apart.
"""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from benchmarks import record
from jaxreg.cli import process
from jaxreg.data import data_root, modelnet
from jaxreg.data.procedural import shapes
from jaxreg.data.seven_scenes import read_fragment
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.scans.pair import register
from jaxreg.scans.result import ScanRegistration

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
COMPARABLE = 0.5
"""An alternative is comparable from this many times the probability of the pose."""
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
    "wrong_without_rival": "of these, no alternative is comparable",
}


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    data_root: str | None = None
    pairs: int = 200
    """Pairs of each source of shapes."""
    seed: int = 1
    save: Path | None = None
    """Write the outcome of every pair here (JSON)."""
    record: bool = True
    """Write benchmarks/results/verdict.json and verdict_probability.json."""


def sources(options: Options) -> dict:
    """Functions from an index to a cloud (2048, 3) or so."""
    found = {"procedural": lambda i: shapes.sample_shape(77, 100_000 + i, points=2048)}
    root = data_root(options.data_root)
    if root is not None:
        clouds, _ = modelnet.load(root, "test")
        order = np.random.default_rng(options.seed).permutation(len(clouds))
        found["ModelNet40"] = lambda i: clouds[order[i]]
        fragments = sorted(root.glob("7scene/*/cloud_bin_*.ply"))
        if fragments:
            found["7Scenes"] = lambda i: fragment(fragments[i % len(fragments)], i)
    return found


def fragment(path: Path, seed: int, points: int = 4096) -> np.ndarray:
    """Some points of a real scan, in the unit sphere."""
    cloud = np.random.default_rng(seed).permutation(read_fragment(path))[:points]
    cloud = cloud - cloud.mean(axis=0)
    return cloud / np.linalg.norm(cloud, axis=1).max()


def make_pair(shape, index: int, rng: np.random.Generator, kinds: tuple[str, ...] = tuple(KINDS)):
    """Source, reference, the true 4x4 transform (None where there is none) and the kind."""
    kind = kinds[index % len(kinds)]
    cloud = np.asarray(shape(index), np.float64)
    cloud = cloud[rng.permutation(len(cloud))]
    half = len(cloud) // 2
    source, reference = cloud[:half], cloud[half:]
    if kind == "noisy":
        source, reference = (
            x + np.clip(rng.normal(size=x.shape) * rng.uniform(0, 0.015), -0.05, 0.05)
            for x in (source, reference)
        )
    if kind == "crops":
        source, reference = (crop(x, rng, rng.uniform(0.6, 0.9)) for x in (source, reference))
    if kind == "unrelated":
        reference = np.asarray(shape(index + 7), np.float64)[half:]
    if kind == "apart":
        along = cloud @ rng.normal(size=3)
        low, high = np.quantile(along, (0.45, 0.55))
        source, reference = cloud[along < low], cloud[along > high]
    turn, shift = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1, 1, 3)
    truth = np.block([[turn, shift[:, None]], [0, 0, 0, 1]])
    moved = (source - shift) @ turn
    return moved, reference, None if kind in ("unrelated", "apart") else truth, kind


def crop(points: np.ndarray, rng: np.random.Generator, share: float) -> np.ndarray:
    """The points on one side of a random plane."""
    along = points @ rng.normal(size=3)
    return points[along >= np.quantile(along, 1 - share)]


def is_right(result: ScanRegistration, truth: np.ndarray, centre: np.ndarray) -> bool:
    """Within 5 degrees, and 0.1 at the `centre` of the source."""
    angle = rotation_angle_deg(result.rotation, truth[:3, :3])
    change = (result.transformation - truth)[:3]
    return bool(angle < 5 and np.linalg.norm(change[:, :3] @ centre + change[:, 3]) < 0.1)


def run(options: Options) -> list[dict]:
    """Register every pair; one entry each."""
    entries = []
    for name, shape in sources(options).items():
        # Two fragments of one room are not unrelated.
        kinds = tuple(k for k in KINDS if k != "unrelated" or name != "7Scenes")
        for index in range(options.pairs):
            rng = np.random.default_rng((options.seed, index))
            source, reference, truth, kind = make_pair(shape, index, rng, kinds)
            result = register(source, reference)
            entries.append(
                {
                    "source": name,
                    "kind": kind,
                    "right": truth is not None and is_right(result, truth, source.mean(axis=0)),
                    "success": result.success,
                    "probability": result.probability,
                    "rival": max((other.probability for other in result.alternatives), default=0.0),
                }
            )
            print(f"\r{name} {index + 1}/{options.pairs}", end="", flush=True)
        print()
    return entries


def chosen(entries: list[dict], *, sources=tuple(SOURCES), kinds=tuple(KINDS)) -> list[dict]:
    """The pairs of some sources and kinds."""
    return [x for x in entries if x["source"] in sources and x["kind"] in kinds]


def counts(entries: list[dict]) -> dict[str, int | None]:
    """How many pairs there are, how many poses are right, and how many verdicts are wrong."""
    right, success = (np.array([x[key] for x in entries], bool) for key in ("right", "success"))
    alone = np.array([x["rival"] < COMPARABLE * x["probability"] for x in entries], bool)
    without = all(x["kind"] not in GOOD for x in entries)
    return {
        "pairs": len(entries),
        "right": int(right.sum()),
        "right_called_failure": None if without else int(np.sum(right & ~success)),
        "wrong_called_success": int(np.sum(~right & success)),
        "wrong_without_rival": int(np.sum(~right & success & alone)),
    }


def verdict_rows(entries: list[dict]) -> dict[str, dict]:
    """A row a source and kind, then sums."""
    rows = {}
    for kind, (key, text) in KINDS.items():
        for source, name in SOURCES.items():
            if found := chosen(entries, sources=(source,), kinds=(kind,)):
                label = text.format(thing="scan" if source == "7Scenes" else "shape")
                rows[f"{name}_{key}"] = {"label": f"{source}: {label}"} | counts(found)
    for source, name in SOURCES.items():
        if found := chosen(entries, sources=(source,), kinds=GOOD):
            label = f"{source}: samplings, noise, own crops"
            rows[name] = {"label": label} | counts(found)
    if found := chosen(entries, kinds=("unrelated",)):
        rows["unrelated"] = {"label": "procedural and ModelNet40: unrelated shapes"} | counts(found)
    return rows


def probability_rows(entries: list[dict]) -> dict[str, dict]:
    """How many of the poses of about one probability are right."""
    chance = np.array([x["probability"] for x in entries])
    right = np.array([x["right"] for x in entries], bool)
    rows = {}
    for key, (label, low, high) in BINS.items():
        inside = (chance >= low) & (chance < high)
        share = float(right[inside].mean()) if inside.any() else None
        rows[key] = {"label": label, "pairs": int(inside.sum()), "right": share}
    return rows


def setting(entries: list[dict]) -> dict[str, float]:
    """The counts that the text names."""
    good = counts(chosen(entries, kinds=GOOD))
    found = {"pairs": len(entries), "good": good["right"]}
    found["good_called_failure"] = good["right_called_failure"] or 0
    shapes = ("procedural", "ModelNet40")
    for key, sources, kind in (
        ("unrelated", shapes, "unrelated"),
        ("ends_of_shapes", shapes, "apart"),
        ("ends_of_scans", ("7Scenes",), "apart"),
    ):
        part = counts(chosen(entries, sources=sources, kinds=(kind,)))
        found[key], found[f"{key}_called_success"] = part["pairs"], part["wrong_called_success"]
    return found


def write(entries: list[dict]) -> Iterator[Path]:
    """The records `verdict` and `verdict_probability` of registered pairs."""
    common = {
        "command": record.command("benchmarks.scans.verdict"),
        "setting": setting(entries),
    }
    yield record.write(
        "verdict",
        question="What is the verdict of `jaxreg.register` worth?",
        columns=COLUMNS,
        rows=verdict_rows(entries),
        **common,
    )
    yield record.write(
        "verdict_probability",
        question="How often is a pose of a given probability right?",
        columns={"pairs": "pairs", "right": "share right"},
        rows=probability_rows(entries),
        **common,
    )


def main(options: Options) -> None:
    """Register all pairs and print what the verdict is worth."""
    process.enable_compilation_cache()
    entries = run(options)
    if options.save:
        options.save.write_text(json.dumps(entries), encoding="utf-8")
    for row in (*verdict_rows(entries).values(), *probability_rows(entries).values()):
        print(row)
    if options.record:
        for path in write(entries):
            print(path)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
