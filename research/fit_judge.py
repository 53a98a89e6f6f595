"""How the constants of `jaxreg/judge/odds.py` were fitted, and how they do on a sensor left out.

    python -m research.fit_judge collect --folder runs/judge [--data-root DATA] [--part 0 --parts 2]
    python -m research.fit_judge fit --folder runs/judge

`collect` keeps what `jaxreg.register` reads from the poses of both of its searches, for pairs with a
known truth: virtual scans of procedural shapes and rooms (`research/judge_pairs.py`), pairs that
share nothing, and, where they are found, real scans of several sensors (`benchmarks/scans/sensors.py`).
It goes on where it stopped. `fit` maximises the likelihood that `jaxreg.judge.odds` gives to the
right pose of every pair, or to "none of them", with a weak penalty; every set of pairs counts about
alike, whatever its size. Then it fits again without each of the sensors and judges the one left out.
"""

import dataclasses
import functools
import pickle
from pathlib import Path

import numpy as np
import tyro
from scipy.optimize import minimize

from benchmarks.scans import sensors
from jaxreg.cli import process
from jaxreg.data import data_root
from jaxreg.judge.evidence import Evidence
from jaxreg.judge.odds import WEIGHTS, features, probabilities
from jaxreg.scans import candidates, prepare, surfaces
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.verdict import TRUSTED
from jaxreg.types import RigidTransform
from research.judge_pairs import KINDS, made_pairs

_PENALTY = 1.0
_ALIKE = ("redkitchen", "redkitchen_lomatch", "redkitchen_frames")
"""Sets of one sensor and one room: they are left out together."""
_MORE, _LESS, _ANY = (0, None), (None, 0), (None, None)
_BOUNDS = {
    "smaller": _MORE, "larger": _ANY, "distance": _LESS, "rough_distance": _LESS,
    "rough_facing": _MORE, "disagreement": _LESS, "beside": _ANY, "unseen": _LESS, "rough": _MORE,
    "ends": _ANY, "held": _MORE, "same": (WEIGHTS.same,) * 2, "sparse": (WEIGHTS.sparse,) * 2,
}  # fmt: skip
"""Bounds of the weights. Few sensors must not turn around what speaks for a pose and what against it;
the two that are set by hand (`odds.py`) stay as they are."""
_WEIGHT = {"ends": 0.2, "unrelated": 0.5, "crops": 2.0}
"""Weight of a pair, 1 for the others: the ends of many shapes are congruent, and no evidence tells
that they are two; crops stand for all pairs of `register_global`."""
_NEAR = 2.0
"""Poses within so many times the tolerance count as right: refinement still draws them in."""


@dataclasses.dataclass(frozen=True)
class Collect:
    """Search and judge the poses of every pair, and keep the evidence."""

    folder: Path = Path("runs/judge")
    data_root: str | None = None
    made: int = 80
    """Virtual pairs of each kind."""
    most_high: int = 25
    """Pairs of each sensor that overlap by .3 or more; of the others all are taken."""
    part: int = 0
    parts: int = 1
    """Take every `parts`-th pair, from the `part`-th on."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """Fit the constants, and judge every sensor by constants fitted without it."""

    folder: Path = Path("runs/judge")


def collect(options: Collect) -> None:
    """Write one file per pair to the folder."""
    root = data_root(options.data_root)
    real = sensors.RIGHT if root is not None else ()
    process.enable_compilation_cache()
    for name in (*real, *KINDS):
        taken = 0
        source = made_pairs(name, options.made) if name in KINDS else sensors.true_pairs(root, name)
        for number, found in enumerate(source):
            if name not in KINDS and found.overlap >= sensors.LOW:
                taken += 1
                if taken > options.most_high:
                    continue
            path = options.folder / f"{found.name}.pkl"
            if number % options.parts != options.part or path.exists():
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            entry = judged_poses(found)
            path.write_bytes(pickle.dumps(entry))
            print(found.name, f"{found.overlap:.2f}", entry["right"].any(), flush=True)


def judged_poses(found: sensors.TruePair) -> dict:
    """The evidence of all poses that `register` may choose from, and which of them are right."""
    config = RegisterConfig()
    clouds = [prepare.prepare(cloud, config=config) for cloud in (found.source, found.reference)]
    problem = surfaces.pose_problem(*clouds, config)
    searches = [
        surfaces.searched_and_judged(problem, search) for search in (config.search, config.wide)
    ]
    if nearer := surfaces.closer(problem):
        searches.append(surfaces.searched_and_judged(nearer, config.wide))
    judged = functools.reduce(candidates.merged, searches)
    poses = [
        surfaces.frame.transform_out(problem.where, RigidTransform(*pose))
        for pose in zip(*judged.poses, strict=True)
    ]
    values = np.stack([np.asarray(leaf) for leaf in judged.evidence], axis=1)
    return {
        "name": found.name,
        "set": found.name.split("/")[0],
        "overlap": found.overlap,
        "evidence": values,
        "exact": np.array([found.is_right(pose) for pose in poses]),
        "right": np.array([found.is_right(pose, _NEAR) for pose in poses]),
    }


def load(folder: Path) -> list[dict]:
    """What `collect` kept."""
    return [pickle.loads(path.read_bytes()) for path in sorted(folder.glob("*/*.pkl"))]


def design(entry: dict) -> np.ndarray:
    """The features of every pose, as `log_odds` takes them."""
    known = features(Evidence(*entry["evidence"].T))
    return np.stack(np.broadcast_arrays(*known), axis=1)


def fitted(entries: list[dict]) -> np.ndarray:
    """Intercept and weights."""
    inputs = [design(entry) for entry in entries]
    every = np.concatenate(inputs)
    middle, spread = every.mean(axis=0), every.std(axis=0) + 1e-9
    inputs = [(x - middle) / spread for x in inputs]
    sets = [entry["set"] for entry in entries]
    weight = np.array([_WEIGHT.get(n, 1.0) * (60 / sets.count(n)) ** 0.5 for n in sets])

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        total, slope = _PENALTY / 2 * np.sum(w[1:] ** 2), np.append(0, _PENALTY * w[1:])
        for x, entry, share in zip(inputs, entries, weight, strict=True):
            score = np.append(w[0] + x @ w[1:], 0)
            chance = np.exp(score - score.max())
            chance /= chance.sum()
            right = np.append(entry["right"], not entry["right"].any())
            likely = max(chance[right].sum(), 1e-300)
            total -= share * np.log(likely)
            change = share * (chance - np.where(right, chance, 0) / likely)[:-1]
            slope += np.append(change.sum(), x.T @ change)
        return total, slope

    bounds = [(None, None)]
    for name, unit in zip(Evidence._fields, spread, strict=True):
        bounds.append(tuple(end if end is None else end * unit for end in _BOUNDS[name]))
    start = np.zeros(every.shape[1] + 1)
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds).x
    weights = found[1:] / spread
    return np.append(found[0] - weights @ middle, weights)


def likeliest(weights: np.ndarray, entry: dict) -> tuple[float, bool]:
    """The probability of the likeliest pose, and whether it is right."""
    chance = np.asarray(probabilities(weights[0] + design(entry) @ weights[1:]))
    best = int(np.argmax(chance))
    return float(chance[best]), bool(entry["right"][best])


def judge(entries: list[dict], best: list[tuple[float, bool]]) -> dict[str, int]:
    """How often the likeliest pose is right, and believed."""
    counts = {
        "pairs": len(entries), "right": 0, "believed": 0, "wrong": 0,
        "possible": sum(bool(entry["right"].any()) for entry in entries),
    }  # fmt: skip
    for chance, right in best:
        success = chance >= TRUSTED
        counts["right"] += right
        counts["believed"] += right and success
        counts["wrong"] += not right and success
    return counts


def calibration(pairs: list[tuple[float, bool]], bins: int = 10) -> float:
    """Expected calibration error of probabilities, in equally wide bins."""
    chance, right = (np.array(column, float) for column in zip(*pairs, strict=True))
    place = np.minimum((chance * bins).astype(int), bins - 1)
    gaps = [
        np.sum(place == k) * abs(chance[place == k].mean() - right[place == k].mean())
        for k in np.unique(place)
    ]
    return float(np.sum(gaps) / len(chance))


def report(entries: list[dict]) -> None:
    """The table of the sensors left out, and the constants of all."""
    for name in dict.fromkeys(entry["set"] for entry in entries):
        out = _ALIKE if name in _ALIKE else (name,)
        weights = fitted([entry for entry in entries if entry["set"] not in out])
        own = [entry for entry in entries if entry["set"] == name]
        for label, low in (("low", True), ("high", False)):
            if group := [e for e in own if (e["overlap"] < sensors.LOW) is low]:
                best = [likeliest(weights, entry) for entry in group]
                print(f"{name:20s} {label:5s}", judge(group, best), f"ECE {calibration(best):.3f}")
    weights = fitted(entries)
    print("all", judge(entries, [likeliest(weights, entry) for entry in entries]))
    print(f"INTERCEPT = {weights[0]:.3f}")
    print(Evidence(*(round(float(w), 3) for w in weights[1:])))


def main(options: Collect | Fit) -> None:
    """Collect, or fit and report."""
    if isinstance(options, Collect):
        collect(options)
    else:
        report(load(options.folder))


if __name__ == "__main__":
    main(tyro.cli(Collect | Fit, description=__doc__))  # pyright: ignore[reportArgumentType]
