"""The registration as a teacher: features fine-tuned on real scans whose poses nobody gave.

    python -m research.teacher [--steps 300] [--seeds 3] [--data-root DATA]

`jaxreg.register` labels the pairs of some sensors: its pose, where its probability is above .99. The
features of the search go on learning from these pairs, by the loss that they were trained with
(`research/train_features.py`), and are tested on pairs of *other* sensors that overlap by less than .3:
how many best matches are right, and on how many pairs a right pose is among those of the wider search.
Beside them stand the released features as they are, and the control: as many further steps on the
procedural shapes that they were trained on.
"""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jaxtyping import Float

from benchmarks.scans.sensors import LOW, TruePair, true_pairs
from jaxreg.cli import process
from jaxreg.data import data_root
from jaxreg.data.procedural import shapes
from jaxreg.geometry import frame
from jaxreg.geometry.neighbors import squared_distances
from jaxreg.scans import prepare
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.pair import register_prepared
from jaxreg.scans.surfaces import pose_problem
from jaxreg.search.description import Described, compare
from jaxreg.search.learned import Network, load_features
from jaxreg.search.stages import search_described
from jaxreg.types import RigidTransform
from research.train_features import contrastive_loss

FOLDS = {
    "taught by a lidar, a car and a turntable": (
        ("balm", "kitti00", "bunny_turntable"),
        ("redkitchen_frames", "redkitchen_lomatch"),
    ),
    "taught by a room": (
        ("redkitchen_frames", "redkitchen"),
        ("balm", "bunny_turntable"),
    ),
}
"""Sensors that teach, and those that are tested."""
_SURE = 0.99
_ROWS = 1024
_CONFIG = RegisterConfig()


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    steps: int = 300
    batch: int = 2
    rate: float = 3e-4
    seeds: int = 3
    shapes: int = 200
    """Procedural shapes of the control."""
    data_root: str | None = None
    json: str = ""
    """Write the figures to this file."""


class Lesson(NamedTuple):
    """A pair as the search compares it, and a pose (in its units) to learn from, or to be tested with."""

    source: Described
    reference: Described
    pose: RigidTransform


class Tested(NamedTuple):
    """A lesson by the true pose, and what tells which poses are right."""

    lesson: Lesson
    pair: TruePair
    where: frame.Frame


class Taught(NamedTuple):
    """Lessons, and how many of the poses are right, of those that are known."""

    lessons: list[Lesson]
    right: int


def lesson(problem, pose: RigidTransform) -> tuple[Lesson, frame.Frame]:
    """A pair of prepared clouds; `pose` is of the clouds as given."""
    where = problem.where._replace(length=problem.unit)
    sides = zip(problem.levels, (problem.source, problem.reference), strict=True)
    described = (
        level.described(problem.unit / cloud.radius, _ROWS, _CONFIG.search.radii)
        for level, cloud in sides
    )
    inner = frame.transform_in(where, pose)
    inner = RigidTransform(*(np.asarray(part, np.float32) for part in inner))
    return Lesson(*described, inner), where


def taught(root: Path, sensors: tuple[str, ...]) -> Taught:
    """The pairs of which the teacher is sure, with the poses that it finds."""
    lessons, right = [], 0
    for sensor in sensors:
        for pair in true_pairs(root, sensor):
            clouds = (prepare.prepare(pair.source), prepare.prepare(pair.reference))
            found = register_prepared(*clouds, _CONFIG)
            if found.success and found.probability > _SURE:
                lessons.append(lesson(pose_problem(*clouds, _CONFIG), found.transform)[0])
                right += pair.is_right(found.transform)
    return Taught(lessons, right)


def tested(root: Path, sensors: tuple[str, ...]) -> Iterator[Tested]:
    """The pairs of low overlap."""
    for sensor in sensors:
        for pair in true_pairs(root, sensor):
            if pair.overlap < LOW and pair.truth is not None:
                problem = pose_problem(
                    prepare.prepare(pair.source), prepare.prepare(pair.reference), _CONFIG
                )
                truth = RigidTransform(pair.truth[:3, :3], pair.truth[:3, 3])
                made, where = lesson(problem, truth)
                yield Tested(made, pair, where)


def drawn(options: Options, seed: int) -> list[Lesson]:
    """The control: crops of procedural shapes, described as the scans are."""
    rng, lessons = np.random.default_rng(seed), []
    for number in range(options.shapes):
        cloud = shapes.sample_shape(seed + 90, number, points=2048).astype(np.float64)
        halves = cloud[rng.permutation(2048)].reshape(2, 1024, 3)
        kept = []
        for half in halves:
            along = half @ rng.normal(size=3)
            kept.append(half[along < np.quantile(along, rng.uniform(0.5, 0.8))])
        source, reference = kept
        problem = pose_problem(prepare.prepare(source), prepare.prepare(reference), _CONFIG)
        lessons.append(lesson(problem, RigidTransform(np.eye(3), np.zeros(3)))[0])
    return lessons


def _cosines(network: Network, made: Lesson) -> tuple[jax.Array, jax.Array]:
    """Of all features, and the squared distances of the points under the pose."""
    moved = (
        jnp.matmul(made.source.points, made.pose.rotation.T, precision=jax.lax.Precision.HIGHEST)
        + made.pose.translation[None]
    )
    squared = squared_distances(moved, made.reference.points)
    return compare(made.source, made.reference, network=network).similarity, squared


def fit(network: Network, lessons: list[Lesson], seed: int, options: Options) -> Network:
    """The features after some steps on these pairs."""
    rate = optax.cosine_decay_schedule(options.rate, options.steps)
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))

    def pair_loss(weights, made):
        cosines, squared = _cosines(weights["features"], made)
        masks = made.source.mask, made.reference.mask
        return contrastive_loss(cosines, jnp.exp(weights["log_sharpness"]), squared, *masks)

    @jax.jit
    def step(weights, state, pairs):
        def loss(weights):
            return jnp.mean(jnp.stack([pair_loss(weights, made) for made in pairs]))

        value, gradient = jax.value_and_grad(loss)(weights)
        updates, state = optimizer.update(gradient, state, weights)
        return optax.apply_updates(weights, updates), state, value

    weights = {"features": jax.tree.map(jnp.asarray, dict(network)), "log_sharpness": jnp.log(20.0)}
    state, rng, seen = optimizer.init(weights), np.random.default_rng(seed), []
    for _ in range(options.steps):
        chosen = tuple(lessons[i] for i in rng.integers(0, len(lessons), options.batch))
        weights, state, value = step(weights, state, chosen)
        seen.append(float(value))
    few = max(options.steps // 10, 1)
    print(f"  loss {np.mean(seen[:few]):.3f} to {np.mean(seen[-few:]):.3f}", flush=True)
    return weights["features"]


@jax.jit
def _searched(network: Network, made: Lesson):
    """Poses of the wider search, and the share of points whose best match is right."""
    cosines, squared = _cosines(network, made)
    squared = jnp.where(made.reference.mask[None], squared, jnp.inf)
    near = 2 * jnp.maximum(made.source.spacing, made.reference.spacing)
    has = (jnp.min(squared, axis=1) < near**2) & made.source.mask
    cosines = jnp.where(made.reference.mask[None], cosines, -jnp.inf)
    best = jnp.take_along_axis(squared, jnp.argmax(cosines, axis=1)[:, None], axis=1)[:, 0]
    share = jnp.sum((best < near**2) & has) / jnp.maximum(jnp.sum(has), 1)
    found = search_described(
        made.source, made.reference, network=network, config=_CONFIG.wide or _CONFIG.search
    )
    return found.poses, share


def test(network: Network, pairs: list[Tested]) -> dict[str, float]:
    """Share of right best matches, and pairs with a right pose first and among all."""
    rows: list[tuple[float, bool, bool]] = []
    for made, pair, where in pairs:
        poses, share = _searched(network, made)
        right = [
            pair.is_right(_out(where, poses.rotation[k], poses.translation[k]), times=2)
            for k in range(len(poses.rotation))
        ]
        rows.append((float(share), right[0], any(right)))
    matches, first, among = np.mean(np.array(rows, float), axis=0)
    return {"matches": float(matches), "first": float(first), "among": float(among)}


def _out(
    where: frame.Frame, rotation: Float[jax.Array, "3 3"], translation: Float[jax.Array, "3"]
) -> RigidTransform:
    pose = RigidTransform(np.asarray(rotation, np.float64), np.asarray(translation, np.float64))
    return frame.transform_out(where, pose)


def main() -> None:
    """Label, fine-tune, and print a line for every fold and row."""
    options = tyro.cli(Options, description=__doc__)
    process.enable_compilation_cache()
    found_root = data_root(options.data_root)
    if found_root is None:
        raise SystemExit("no data: set $JAXREG_DATA or give --data-root.")
    root, released, results = Path(found_root), load_features(), {}
    for label, (teachers, others) in FOLDS.items():
        lessons, pairs = taught(root, teachers), list(tested(root, others))
        print(
            f"{label}: {len(lessons.lessons)} pairs labelled, {lessons.right} of them right; "
            f"tested on {len(pairs)} of {', '.join(others)}",
            flush=True,
        )
        rows = {"released": [test(released, pairs)]}
        for seed in range(options.seeds):
            for name, taken in (
                ("taught", lessons.lessons),
                ("control", drawn(options, seed)),
            ):
                rows.setdefault(name, []).append(test(fit(released, taken, seed, options), pairs))
        for name, runs in rows.items():
            cells = {key: [round(run[key], 3) for run in runs] for key in runs[0]}
            print(f"  {name}: {cells}", flush=True)
        results[label] = {"labelled": len(lessons.lessons), "right": lessons.right, "rows": rows}
    if options.json:
        record = {"options": dataclasses.asdict(options), "results": results}
        Path(options.json).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
