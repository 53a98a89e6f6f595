"""Of pairs that the search registers wrongly: how many of the poses does the whole shape not tell apart?

    python -m benchmarks.scans.symmetries [--pairs 256] [--seeds 11 17 19]

The pairs of `benchmarks.scans.protocols`, without the rotation-symmetric categories. A wrong pose lays the
whole shape, of which the pair shows two crops, somewhere in the frame of the reference. Where that is
where the shape lies anyway, up to the spacing of the crops, no evidence in the pair tells the pose from
the right one (a table turned by half), and no ranking can be asked to.
"""

import dataclasses
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Float
from scipy.spatial import cKDTree

from benchmarks import record
from benchmarks.scans import protocols
from jaxreg.cli.process import enable_compilation_cache
from jaxreg.config import PairConfig
from jaxreg.data import make_pair
from jaxreg.evaluation import methods
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.types import RigidTransform

_SHARE = 0.95
"""So many of the points of the whole shape must lie on it again, both ways."""
WITHIN = {"fine": 0.03, "coarse": 0.05}
"""Distances that count as on it; points of a crop lie .03 to .05 apart."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run."""

    method: str = "register_global"
    """Its name as of `jaxreg.evaluation.methods.choose`."""
    protocols: tuple[str, ...] = ("crops70", "crops70_jitter", "crops50")
    pairs: int = 256
    seeds: tuple[int, ...] = (11, 17, 19)
    per_category: int = 6
    data_root: str | None = None
    record: bool = True
    """Write the table to benchmarks/results/."""


class Case(NamedTuple):
    """A pair, and the whole shape in the frame of its reference."""

    pair: protocols.Pair
    whole: Float[np.ndarray, "p 3"]


@partial(jax.jit, static_argnames="config")
def _undrawn(key: jax.Array, shape: jax.Array, *, config: PairConfig) -> RigidTransform:
    """Where `protocols.draw` lays the shape of a pair: the pose before the source is turned."""
    return make_pair(jax.random.split(key)[0], shape, config).transform


def cases(protocol: str, shapes: protocols.Shapes, seed: int, options: Options) -> Iterator[Case]:
    """The pairs of `protocols.draw_pairs` that are not of a rotation-symmetric category."""
    config = protocols.at_size(protocols.pairs_of(protocol), shapes.clouds.shape[1])
    for row, key in protocols.drawn_from(shapes, pairs=options.pairs, seed=seed):
        if shapes.categories[row] in protocols.SYMMETRIC:
            continue
        shape = shapes.clouds[row]
        pair = protocols.draw(key, shape, config=config, turned=True)
        yield Case(pair, _moved(shape, _undrawn(key, shape, config=config)))


def _moved(points: np.ndarray, pose: RigidTransform) -> Float[np.ndarray, "p 3"]:
    rotation, translation = (np.asarray(part, np.float64) for part in pose)
    return np.asarray(points, np.float64) @ rotation.T + translation


def apart(whole: Float[np.ndarray, "p 3"], found: RigidTransform, truth: RigidTransform) -> float:
    """Within which distance most of the shape lies on itself after ``found truth^-1``, both ways."""
    rotation, translation = (np.asarray(part, np.float64) for part in truth)
    again = _moved((whole - translation) @ rotation, found)
    there, back = cKDTree(whole).query(again)[0], cKDTree(again).query(whole)[0]
    return float(max(np.quantile(there, _SHARE), np.quantile(back, _SHARE)))


def measure(protocol: str, shapes: protocols.Shapes, options: Options) -> dict[str, float | int]:
    """How many pairs there are, how many are right, and how many of the others are symmetries."""
    method = methods.choose(options.method)
    row = {"pairs": 0, "right": 0, **dict.fromkeys(WITHIN, 0)}
    for seed in options.seeds:
        for case in cases(protocol, shapes, seed, options):
            batch = jax.tree.map(lambda x: x[None], case.pair)
            found = jax.tree.map(lambda x: np.asarray(x)[0], method.batch(batch))
            truth = case.pair.transform
            angle = rotation_angle_deg(
                *(np.asarray(pose.rotation, np.float64)[None] for pose in (found, truth))
            )[0]
            shift = np.linalg.norm(np.asarray(found.translation) - np.asarray(truth.translation))
            row["pairs"] += 1
            if angle < 5 and shift < 0.1:
                row["right"] += 1
                continue
            distance = apart(case.whole, found, truth)
            for name, within in WITHIN.items():
                row[name] += int(distance < within)
    wrong = row["pairs"] - row["right"]
    return row | {"recall": row["right"] / row["pairs"], "wrong": wrong}


def main(options: Options) -> None:
    """Print a line for every protocol, and write the table."""
    enable_compilation_cache()
    shapes = protocols.read_shapes(options.data_root, options.per_category)
    rows = {}
    for protocol in options.protocols:
        rows[record.key(protocol)] = {"label": protocols.PROTOCOLS[protocol]} | measure(
            protocol, shapes, options
        )
        print(rows[record.key(protocol)], flush=True)
    if options.record:
        record.write(
            "symmetries",
            question="How many wrong poses does the whole shape not tell from the right one?",
            command=record.command("benchmarks.scans.symmetries"),
            columns={
                "pairs": "pairs",
                "right": "right",
                "recall": "recall",
                "wrong": "wrong",
                **{
                    key: f"wrong, and the shape lies on itself within {x}"
                    for key, x in WITHIN.items()
                },
            },
            rows=rows,
            setting={"share": _SHARE, **WITHIN},
        )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
