"""How the constants of `jaxreg/scans/verdict.py` were fitted, and how well they judge.

    python -m research.fit_verdict [--data-root DATA] [--pairs 200]
    python -m research.fit_verdict --split test --seed 1

The second judges the library's constants on shapes that took no part, and on real fragments.

Registers pairs whose truth is known, from procedural shapes and, where they are found, ModelNet40
and (to judge only) fragments of 7Scenes: independent samplings of one shape, with noise and with own
half-space crops (overlap 0.5 to 1), pairs of unrelated shapes, and the two ends of one shape, which
share no surface. A pose is right within 5 degrees and 0.1 of the shape's radius. Ends that lie on
each other everywhere, to within the sampling, are counted apart: those of a box are congruent, and
nothing in the two clouds tells that they are two.
"""

import dataclasses
import json
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from jaxreg.cli import process
from jaxreg.data import data_root, modelnet
from jaxreg.data.procedural import shapes
from jaxreg.data.seven_scenes import read_fragment
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.scans import verdict
from jaxreg.scans.pair import register
from research import verdict_records

KINDS = ("full", "noisy", "crops", "unrelated", "apart")


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    data_root: str | None = None
    split: Literal["train", "test"] = "train"
    """Fit on training shapes, or judge on test shapes."""
    pairs: int = 200
    """Pairs of each source of shapes."""
    seed: int = 0
    save: Path | None = None
    """Write the evidence of every pair here (JSON)."""
    record: bool = True
    """With `--split test`, write the tables to benchmarks/results/."""


def sources(options: Options) -> dict:
    """Functions from an index to a cloud (2048, 3) or so."""
    first = 0 if options.split == "train" else 100_000
    found = {"procedural": lambda i: shapes.sample_shape(77, first + i, points=2048)}
    root = data_root(options.data_root)
    if root is not None:
        clouds, _ = modelnet.load(root, options.split)
        order = np.random.default_rng(options.seed).permutation(len(clouds))
        found["ModelNet40"] = lambda i: clouds[order[i]]
        fragments = sorted(root.glob("7scene/*/cloud_bin_*.ply"))
        if fragments and options.split == "test":
            found["7Scenes"] = lambda i: fragment(fragments[i % len(fragments)], i)
    return found


def fragment(path: Path, seed: int, points: int = 4096) -> np.ndarray:
    """Some points of a real scan, in the unit sphere."""
    cloud = np.random.default_rng(seed).permutation(read_fragment(path))[:points]
    cloud = cloud - cloud.mean(axis=0)
    return cloud / np.linalg.norm(cloud, axis=1).max()


def make_pair(shape, index: int, rng: np.random.Generator, kinds: tuple[str, ...] = KINDS):
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


def run(options: Options) -> list[dict]:
    """Register every pair; one record each."""
    records = []
    for name, shape in sources(options).items():
        # Two fragments of one room are not unrelated.
        kinds = tuple(k for k in KINDS if k != "unrelated") if name == "7Scenes" else KINDS
        for index in range(options.pairs):
            rng = np.random.default_rng((options.seed, index))
            source, reference, truth, kind = make_pair(shape, index, rng, kinds)
            result = register(source, reference)
            right = False
            if truth is not None:
                angle = rotation_angle_deg(result.rotation[None], truth[None, :3, :3])[0]
                centre = source.mean(axis=0)
                change = (result.transformation - truth)[:3]
                right = angle < 5 and np.linalg.norm(change[:, :3] @ centre + change[:, 3]) < 0.1
            records.append(
                {"source": name, "kind": kind, "right": bool(right)} | result.evidence._asdict()
            )
            print(f"\r{name} {index + 1}/{options.pairs}", end="", flush=True)
        print()
    return records


def without_search(records: list[dict]) -> list[dict]:
    """The same pairs as if their poses had been given: nothing is known of a rival."""
    return [record | {"rival": verdict.NOT_SEARCHED} for record in records]


def design(records: list[dict]) -> tuple[np.ndarray, np.ndarray]:
    """Inputs of the regression, and which poses are right."""
    found = [verdict.Evidence(*(r[n] for n in verdict.Evidence._fields)) for r in records]
    inputs = np.array([verdict.features(evidence) for evidence in found])
    return inputs, np.array([r["right"] for r in records])


def fit(inputs: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Intercept and coefficients of a logistic regression with a weak penalty."""
    design = np.concatenate([np.ones((len(inputs), 1)), inputs], axis=1)

    def loss(weights):
        score = design @ weights * np.where(right, 1, -1)
        return np.sum(np.logaddexp(0, -score)) + 0.02 * np.sum(weights[1:] ** 2)

    return minimize(loss, np.zeros(design.shape[1])).x


def report(records: list[dict], weights: np.ndarray | None, title: str) -> None:
    """The shares of wrong verdicts, by kind; `weights` None uses those of the library."""
    print(title)
    for name in dict.fromkeys(r["source"] for r in records):
        for kind in KINDS:
            chosen = [r for r in records if (r["source"], r["kind"]) == (name, kind)]
            if not chosen:
                continue
            right = np.array([r["right"] for r in chosen])
            trusted = np.array([probability(r, weights) for r in chosen]) >= verdict.TRUSTED
            false = [r for r, t in zip(chosen, trusted & ~right, strict=True) if t]
            everywhere = sum(r["overlap"] > 0.9 and r["gap"] < 1.25 for r in false)
            print(
                f"  {name:10s} {kind:10s} {len(chosen):4d} pairs, right {right.sum():4d}  "
                f"right but called failure {(right & ~trusted).sum():3d}  wrong but called success "
                f"{len(false):3d} (of these on each other everywhere {everywhere})"
            )
    chance = np.array([probability(r, weights) for r in records])
    right = np.array([r["right"] for r in records])
    for low, high in ((0, 0.1), (0.1, 0.5), (0.5, 0.9), (0.9, 1.01)):
        inside = (chance >= low) & (chance < high)
        if inside.any():
            share = right[inside].mean()
            print(
                f"  said {low:.1f} to {min(high, 1):.1f}: {inside.sum()} pairs, right {share:.2f}"
            )


def probability(record: dict, weights: np.ndarray | None) -> float:
    """Of the library, or by the given weights."""
    found = verdict.Evidence(*(record[name] for name in verdict.Evidence._fields))
    if weights is None:
        return verdict.probability(found)
    return float(1 / (1 + np.exp(-(weights[0] + verdict.features(found) @ weights[1:]))))


def main(options: Options) -> None:
    """Judge the library's constants; on training shapes also fit and print new ones."""
    process.enable_compilation_cache()
    records = run(options)
    if options.save:
        options.save.write_text(json.dumps(records))
    for name, known in (("_SEARCHED", records), ("_UNSEARCHED", without_search(records))):
        report(known, None, f"the library's constants, {name}")
        if options.split == "train":
            weights = fit(*design(known))
            report(known, weights, f"fitted on these pairs, {name}")
            print(f"{name} = np.array([{', '.join(f'{w:.2f}' for w in weights)}])")
    if options.record and options.split == "test":
        for path in verdict_records.write(records):
            print(path)


if __name__ == "__main__":
    main(tyro.cli(Options))
