"""What is known of two scans of many: the result of one registration, small enough to keep and send."""

import dataclasses
import functools
import hashlib
import json
import math
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxreg.io.places import whole
from jaxreg.scans import stored
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.pair import register_prepared
from jaxreg.scans.prepare import Prepared
from jaxreg.types import RigidTransform

How = Literal["search", "wide search", "start"]
_KEPT_IN_MEMORY = 64
"""Prepared scans that a worker keeps."""
_FORMAT = 2
_HOPELESS = 0.05
"""A pose of a smaller probability is not refined: it would take as long as the search."""


class Task(NamedTuple):
    """Two scans to register: by the first search, by both, or from a start pose (4x4)."""

    source: int
    reference: int
    how: How
    start: Float[np.ndarray, "4 4"] | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Relation:
    """The registration of scan `source` to scan `reference` (numbers of scans), of `ScanRegistration`.

    `how` tells what found it. `covariance` is about the centroid of the reference. `rivals` is the
    probability that another pose that was found is right.
    """

    source: int
    reference: int
    how: How
    transformation: Float[np.ndarray, "4 4"]
    probability: float
    success: bool
    reason: str
    overlap: float
    max_correspondence_distance: float
    covariance: Float[np.ndarray, "6 6"]
    rivals: float = 0.0

    @property
    def transform(self) -> RigidTransform:
        """Rotation and translation, from source to reference."""
        return RigidTransform(self.transformation[:3, :3], self.transformation[:3, 3])


def register_task(
    task: Task, source: Prepared, reference: Prepared, config: RegisterConfig
) -> Relation:
    """Register two scans as a task says."""
    if task.how == "search":
        config = dataclasses.replace(config, wide=None)
    start = task.start
    found = register_prepared(
        source,
        reference,
        config,
        start=None if start is None else RigidTransform(start[:3, :3], start[:3, 3]),
        least=_HOPELESS,
        thorough=False,
    )
    return Relation(
        task.source, task.reference, task.how, found.transformation, found.probability,
        found.success, found.reason, found.overlap, found.max_correspondence_distance,
        found.covariance, sum(other.probability for other in found.alternatives),
    )  # fmt: skip


def register_files(task: Task, source: str, reference: str, config: RegisterConfig) -> Relation:
    """The same of two files of `stored.save`: what a worker runs."""
    return register_task(task, _loaded(source, config), _loaded(reference, config), config)


@functools.lru_cache(_KEPT_IN_MEMORY)
def _loaded(path: str, config: RegisterConfig) -> Prepared:
    return stored.load(path, config)


class WorkFolder(NamedTuple):
    """A folder that keeps prepared scans and finished pairs, by their content.

    The same scans and settings find them again, in any order; others may lie beside them.
    """

    path: Path
    config: RegisterConfig

    def make(self) -> None:
        """Make the folder and its two parts."""
        for part in ("scans", "pairs"):
            (self.path / part).mkdir(parents=True, exist_ok=True)

    def keep_scan(self, cloud: Prepared, fingerprint: str) -> str:
        """Write a prepared scan unless it is there; its path."""
        path = self.path / "scans" / f"{fingerprint}.npz"
        if not path.is_file():
            stored.save(cloud, path)
        return str(path)

    def pair_path(self, task: Task, source: str, reference: str) -> Path:
        """Where the result of a task on scans with these fingerprints is kept."""
        from jaxreg import __version__

        start = b"" if task.start is None else np.ascontiguousarray(task.start).tobytes()
        parts = [__version__, str(_FORMAT), source, reference, task.how]
        text = "\n".join([*parts, stored.settings_text(self.config)])
        name = hashlib.sha256(text.encode() + start).hexdigest()[:32]
        return self.path / "pairs" / f"{name}.json"

    def read(self, path: Path, task: Task) -> Relation | None:
        """A kept result; None if there is none, or it was cut off."""
        try:
            content = json.loads(path.read_text("utf-8"))
            return _from_record(content, task)
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def write(self, path: Path, relation: Relation) -> None:
        """Keep a result: complete, or not at all."""
        with whole(path) as part:
            part.write_text(json.dumps(record(relation), allow_nan=False) + "\n", "utf-8")


def record(relation: Relation) -> dict[str, Any]:
    """A relation as plain values for JSON; a covariance that is not known is None."""
    values = {field.name: getattr(relation, field.name) for field in dataclasses.fields(relation)}
    values["transformation"] = relation.transformation.tolist()
    known = bool(np.isfinite(relation.covariance).all())
    return values | {"covariance": relation.covariance.tolist() if known else None}


def _from_record(values: dict[str, Any], task: Task) -> Relation:
    covariance = values["covariance"]
    found = Relation(
        task.source, task.reference, task.how,
        np.array(values["transformation"], np.float64), float(values["probability"]),
        bool(values["success"]), str(values["reason"]), float(values["overlap"]),
        float(values["max_correspondence_distance"]),
        np.full((6, 6), np.nan) if covariance is None else np.array(covariance, np.float64),
        float(values["rivals"]),
    )  # fmt: skip
    if found.transformation.shape != (4, 4) or not math.isfinite(found.probability):
        raise ValueError
    return found
