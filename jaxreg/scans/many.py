"""Register many scans: every one in the frame of its group, from registrations of pairs."""

import collections
import concurrent.futures
import contextlib
import dataclasses
import multiprocessing
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxreg.geometry.clouds import check_points, check_pose, pose_parts
from jaxreg.scans import apart, placing, prepare, proposals, stored
from jaxreg.scans.config import RegisterConfig, checked
from jaxreg.scans.joint import JointRefinement, refine_jointly
from jaxreg.scans.placing import Placement, Sizes
from jaxreg.scans.prepare import Prepared, voxel_reduced
from jaxreg.scans.relation import How, Relation, Task, WorkFolder, register_files, register_task
from jaxreg.scans.result import matrix_of
from jaxreg.types import RigidTransform

_ALL_PAIRS = 8
"""Up to so many scans every pair is tried."""
_NEAREST = 4
"""Of more scans each is tried with so many that look most alike, and later with more."""
_STIFF = 6
"""Pairs that hold a placed scan; with fewer, it is also registered from where it lies."""
_WIDER = 4
"""How often scans outside the largest group are looked for more widely."""
_RETRIES = 2
"""How often a pair is tried again whose worker died."""
_OVERLAP = 0.1
"""Placed scans that should share more than this of their points are registered from where they lie."""

Progress = Callable[[int, int, str], None]
"""Called with the pairs done, those known to be wanted, and what is being done."""


@dataclasses.dataclass(frozen=True, eq=False)
class AlignedPair:
    """A pair of scans that was registered: `relation`, and what became of it.

    `probability` is that of the pair in view of all others. `used` says whether the poses come from it
    too, and `reason` why not.
    """

    relation: Relation
    probability: float
    used: bool
    reason: str


@dataclasses.dataclass(frozen=True, eq=False)
class Alignment:
    """What `register_many` returns: where every scan lies, and how far to trust that.

    float64, in the unit of the input. `rotation[k]`, `translation[k]` map scan k to the frame of its
    group, ``y = R x + t``, which is that of the group's first scan; NaN for a scan that could not be
    placed. `groups` are the scans that hang together, the largest group first; between groups nothing
    is known. `probability[k]` is the chance that the pose is right in its group (0 if not placed),
    `covariance[k]` that of a small rotation vector (rad) and translation about the scan's centre, in
    the axes of the group, relative to the group's first scan; `centres` are these centres. `pairs` are
    the registrations that were
    made, used ones and refused ones, `reasons[k]` says why a scan is not placed (empty if it is).
    `steps` tell what the joint refinement gained. `success` is True if all scans are in one group.
    """

    rotation: Float[np.ndarray, "n 3 3"]
    translation: Float[np.ndarray, "n 3"]
    groups: tuple[tuple[int, ...], ...]
    probability: Float[np.ndarray, "n"]
    covariance: Float[np.ndarray, "n 6 6"]
    centres: Float[np.ndarray, "n 3"]
    pairs: tuple[AlignedPair, ...]
    reasons: tuple[str, ...]
    steps: tuple[JointRefinement, ...]
    notes: tuple[str, ...]

    @property
    def transform(self) -> RigidTransform:
        """Rotations and translations, from scan to group, with a leading axis."""
        return RigidTransform(self.rotation, self.translation)

    @property
    def transformation(self) -> Float[np.ndarray, "n 4 4"]:
        """The same as 4x4 matrices."""
        return matrix_of(self.transform)

    @property
    def success(self) -> bool:
        """Whether all scans are placed, in one group."""
        return len(self.groups) == 1 and len(self.groups[0]) == len(self.translation)

    @property
    def unplaced(self) -> tuple[int, ...]:
        """The scans that are in no group."""
        return tuple(np.flatnonzero(np.isnan(self.translation[:, 0])).tolist())

    def merged(
        self, clouds: Sequence[object], *, group: int = 0, voxel: float | None = None
    ) -> tuple[Float[np.ndarray, "p 3"], np.ndarray]:
        """The points of a group in its frame, and of each the number of its scan.

        `clouds` are those that were registered, arrays or prepared ones; rows that are not finite are
        left out. With `voxel`, points of one scan in one cube of this edge become their mean.

        Raises:
          ValueError: there is no such group, `clouds` are not as many as the scans, one of them is no
            cloud, or `voxel` is not positive.
        """
        if not 0 <= group < len(self.groups):
            raise ValueError(f"there is no group {group}: there are {len(self.groups)}.")
        if voxel is not None and not voxel > 0:
            raise ValueError(f"voxel must be positive, got {voxel}.")
        if len(clouds) != len(self.translation):
            raise ValueError(f"{len(clouds)} clouds for {len(self.translation)} scans: give all.")
        parts = [
            _points_of(clouds[k], f"scan {k}") @ self.rotation[k].T + self.translation[k]
            for k in self.groups[group]
        ]
        if voxel is not None:
            parts = [voxel_reduced(part, voxel) for part in parts]
        return np.concatenate(parts), np.repeat(self.groups[group], [len(p) for p in parts])


def _points_of(cloud: object, name: str) -> Float[np.ndarray, "n 3"]:
    """The finite points of a cloud as `register_many` takes it, in the unit of the input."""
    if isinstance(cloud, Prepared):
        return cloud.points[cloud.row] * cloud.radius + cloud.centre
    points, finite = check_points(cloud, name, nonfinite="drop", planar=True)
    return points[finite]


def register_many(
    clouds: Sequence[object],
    *,
    order: Literal["unknown", "sequence"] | Sequence[float] = "unknown",
    initial: Sequence[object] | Float[np.ndarray, "n 4 4"] | Alignment | None = None,
    viewpoints: Sequence[object] | None = None,
    nonfinite: Literal["raise", "drop"] = "raise",
    strays: Literal["drop", "keep", "raise"] = "drop",
    names: Sequence[str] | None = None,
    joint: bool = True,
    work: str | Path | None = None,
    executor: concurrent.futures.Executor | None = None,
    workers: int = 0,
    config: RegisterConfig | None = None,
    progress: Progress | None = None,
) -> Alignment:
    """Place many scans in one frame, and say which could not be placed.

    `clouds` are array-likes (n, 3) in one unit, or results of `jaxreg.prepare`, two at least. With
    `order` "sequence" neighbours in the list overlap, and only these and closures of loops are
    looked for; an `order` of numbers, one a scan, are the times at which the scans were taken (any
    unit): neighbours are then those in time, unless ten times the usual step lies between them.
    `initial` are poses to start from, one a scan (4x4, a `RigidTransform` or None; NaN is None), all in
    one frame, or an earlier `Alignment`, of which the first group counts. `viewpoints` say where the
    scanner of each scan stood (3,), in the coordinates of the scan, None where unknown: see
    `jaxreg.prepare`. `joint` refines all poses together at the end.
    With `work`, a folder, prepared scans and finished pairs are kept there, and a run with the same
    scans and settings goes on where the last one ended. Pairs run on `executor` (any of
    `concurrent.futures`, Dask's, Ray's or mpi4py's; `work` must then be a folder that its workers
    see), on `workers` processes of this machine, or in turn; the result has the same bits. `names`
    are how messages refer to the scans.

    Raises:
      ValueError: fewer than two clouds, a cloud that `jaxreg.prepare` refuses, or an option that is
        wrong.
    """
    config = checked(config)
    names = _checked_names(clouds, names)
    starts = _checked_starts(initial, len(clouds))
    times = _checked_times(order, len(clouds))
    if viewpoints is not None and len(viewpoints) != len(clouds):
        raise ValueError(
            f"{len(viewpoints)} viewpoints for {len(clouds)} scans: give one each, or None."
        )
    report = progress or (lambda done, wanted, text: None)
    prepared = []
    for k, cloud in enumerate(clouds):
        report(0, 0, f"preparing {names[k]}")
        place = None if viewpoints is None else viewpoints[k]
        prepared.append(
            prepare.prepared(
                cloud, viewpoint=place, nonfinite=nonfinite, strays=strays, config=config,
                name=names[k], caller="jaxreg.register_many",
            )
        )  # fmt: skip
    with _runner(prepared, config, work, executor, workers) as runner:
        run = _Run(prepared, names, runner, report, [])
        _find_pairs(run, times, starts)
        placement = run.placed()
        steps: tuple[JointRefinement, ...] = ()
        if joint and placement.group.max(initial=-1) >= 0:
            report(len(run.relations), len(run.relations), "joint refinement")
            placement, steps = refine_jointly(placement, run.relations, prepared)
    return _alignment(placement, run, steps)


def _checked_names(clouds: Sequence[object], names: Sequence[str] | None) -> list[str]:
    if len(clouds) < 2:
        raise ValueError(f"{len(clouds)} scan given: an alignment needs two at least.")
    if names is None:
        return [f"scan {k}" for k in range(len(clouds))]
    if len(names) != len(clouds):
        raise ValueError(f"{len(names)} names for {len(clouds)} scans: give one each.")
    return list(names)


def _checked_times(order: object, count: int) -> Float[np.ndarray, "n"] | None:
    """The times of the scans, their numbers for a sequence, None where nothing is known."""
    if isinstance(order, str):
        if order not in ("unknown", "sequence"):
            raise ValueError(
                f"order must be 'unknown', 'sequence' or the times of the scans, got {order!r}."
            )
        return np.arange(count, dtype=np.float64) if order == "sequence" else None
    times = np.asarray(order)
    if times.shape != (count,) or times.dtype.kind not in "iuf" or not np.isfinite(times).all():
        raise ValueError(
            f"order is {times.dtype} {times.shape}: give one finite time for each of the {count} scans."
        )
    return times.astype(np.float64)


def _checked_starts(
    initial: Sequence[object] | Float[np.ndarray, "n 4 4"] | Alignment | None, count: int
) -> list[np.ndarray | None]:
    if initial is None:
        return [None] * count
    if isinstance(initial, Alignment):
        first = initial.groups[0] if initial.groups else ()
        poses = [x if k in first else None for k, x in enumerate(initial.transformation)]
    else:
        poses = initial
    if len(poses) != count:
        raise ValueError(f"{len(poses)} initial poses for {count} scans: give one each, or None.")
    starts: list[np.ndarray | None] = []
    for k, pose in enumerate(poses):
        given = None if pose is None else pose_parts(pose, f"initial[{k}]")
        # As `Alignment.transformation` has it for a scan that was not placed.
        if given is None or all(np.isnan(part).all() for part in given):
            starts.append(None)
        else:
            starts.append(matrix_of(check_pose(RigidTransform(*given), f"initial[{k}]")))
    return starts


_Runner = Callable[[list[Task]], Iterator[Relation]]
"""Runs tasks and yields their results as they come."""


class _Run(NamedTuple):
    """A registration of many scans while it goes on."""

    prepared: list[Prepared]
    names: list[str]
    runner: _Runner
    report: Progress
    relations: list[Relation]

    @property
    def sizes(self) -> Sizes:
        return Sizes(
            np.array([p.centre for p in self.prepared]), np.array([p.radius for p in self.prepared])
        )

    def do(self, tasks: list[Task], text: str) -> None:
        """Register these pairs; of a pair that was registered before one result stays.

        That is the later one if its probability is higher, or if the earlier one is of the first search
        alone: what is looked for again was in doubt.
        """
        done, wanted = len(self.relations), len(self.relations) + len(tasks)
        found = []
        for k, relation in enumerate(self.runner(tasks)):
            found.append(relation)
            self.report(done + k + 1, wanted, text)
        # Workers finish in any order, and the order of the pairs must not change a bit.
        for relation in sorted(found, key=lambda r: (r.reference, r.source)):
            self._keep(relation)

    def _keep(self, relation: Relation) -> None:
        for k, other in enumerate(self.relations):
            if (other.source, other.reference) == (relation.source, relation.reference):
                if relation.probability > other.probability or other.how == "search":
                    # A pose that is given has no rival, which is not the same as having none.
                    rivals = max(relation.rivals, other.rivals)
                    self.relations[k] = dataclasses.replace(relation, rivals=rivals)
                return
        self.relations.append(relation)

    def placed(self) -> Placement:
        """Where the pairs so far lay the scans; parts that free space keeps apart are not joined."""
        refused = np.zeros(len(self.relations), bool)
        while True:
            placement = placing.place(self.relations, self.sizes, refused)
            if all(cloud.viewpoint is None for cloud in self.prepared):
                return placement
            seen = apart.looks(self.prepared, placement)
            torn = apart.kept_apart(self.relations, placement, seen)
            if not torn.any():
                return placement
            refused |= torn

    def tried(self) -> dict[tuple[int, int], How]:
        return {(r.reference, r.source): r.how for r in self.relations}


def _find_pairs(run: _Run, times: np.ndarray | None, starts: list[np.ndarray | None]) -> None:
    """Register pairs until every scan is held by several, or no promising pair is left."""
    run.report(0, 0, "comparing the scans")
    likeness = proposals.likeness(run.prepared)
    if any(start is not None for start in starts):
        run.do(_from_starts(run, starts), "registering pairs from their start")
    run.do(_first_pairs(run, likeness, times), "registering pairs")
    for _ in range(_WIDER):
        placement = run.placed()
        run.do(_nearby(run, placement), "registering neighbours")
        placement = run.placed()
        if (placement.group == 0).all():
            return
        tasks = _wider(run, placement, likeness)
        if not tasks:
            break
        run.do(tasks, "searching more widely")
    run.do(_nearby(run, run.placed()), "registering neighbours")


def _pair(i: int, j: int) -> tuple[int, int]:
    """(reference, source): the earlier scan is the reference."""
    return (min(i, j), max(i, j))


def _tasks(pairs: set[tuple[int, int]], how: How) -> list[Task]:
    return [Task(source, reference, how) for reference, source in sorted(pairs)]


def _first_pairs(run: _Run, likeness: np.ndarray, times: np.ndarray | None) -> list[Task]:
    count = len(run.prepared)
    if times is not None:
        pairs = proposals.successive(times) | proposals.most_alike(likeness, 2)
    elif count <= _ALL_PAIRS:
        pairs = {(i, j) for j in range(count) for i in range(j)}
    else:
        pairs = proposals.most_alike(likeness, _NEAREST)
    return _tasks(pairs - set(run.tried()), "search")


def _from_starts(run: _Run, starts: list[np.ndarray | None]) -> list[Task]:
    matrices = {k: start for k, start in enumerate(starts) if start is not None}
    tasks = []
    for (reference, source), share in proposals.overlaps(run.prepared, matrices).items():
        if share < _OVERLAP:
            continue
        start = np.linalg.inv(matrices[reference]) @ matrices[source]
        tasks.append(Task(source, reference, "start", start))
    return tasks


def _nearby(run: _Run, placement: Placement) -> list[Task]:
    """Placed scans that should overlap, whose pair is not used: from where they lie.

    Those that share most first, until each scan is held by several, and so is every two parts.
    """
    held = np.zeros(len(run.prepared), int)
    between: collections.Counter[tuple[int, int]] = collections.Counter()
    done, part = set(), placement.part.tolist()
    for relation, used in zip(run.relations, placement.used, strict=True):
        held[[relation.source, relation.reference]] += used
        between[_pair(part[relation.source], part[relation.reference])] += used
        if used or relation.how == "start":
            done.add((relation.reference, relation.source))
    matrices = matrix_of(placement.poses)
    tasks = []
    for members in placement.members():
        found = proposals.overlaps(run.prepared, {k: matrices[k] for k in members})
        for pair in sorted(found, key=lambda pair: (-found[pair], pair)):
            parts = _pair(part[pair[0]], part[pair[1]])
            stiff = held[list(pair)].min() if parts[0] == parts[1] else between[parts]
            if found[pair] < _OVERLAP or pair in done or stiff >= _STIFF:
                continue
            held[list(pair)] += 1
            between[parts] += 1
            start = np.linalg.inv(matrices[pair[0]]) @ matrices[pair[1]]
            tasks.append(Task(pair[1], pair[0], "start", start))
    return tasks


def _wider(run: _Run, placement: Placement, likeness: np.ndarray) -> list[Task]:
    """The wider search for scans outside the largest group, with the likeliest ones of other groups."""
    tried, group = run.tried(), placement.group
    chance = {(r.reference, r.source): r.probability for r in run.relations}
    count = len(group)
    most = count if count <= _ALL_PAIRS else 2 * _NEAREST
    pairs: set[tuple[int, int]] = set()
    for k in np.flatnonzero(group != 0).tolist():
        others = np.flatnonzero((group != group[k]) | (group < 0)).tolist()
        fresh = [j for j in others if j != k and tried.get(_pair(j, k)) != "wide search"]
        fresh.sort(key=lambda j: (-chance.get(_pair(j, k), 0.0) - likeness[j, k], j))
        pairs |= {_pair(j, k) for j in fresh[:most]}
    return _tasks(pairs, "wide search")


@contextlib.contextmanager
def _runner(
    prepared: list[Prepared], config: RegisterConfig, work, executor, workers: int
) -> Iterator[_Runner]:
    if executor is not None and workers:
        raise ValueError("give an executor or a number of workers, not both.")
    if workers < 0:
        raise ValueError(f"workers must be 0 or more, got {workers}.")
    with contextlib.ExitStack() as stack:
        folder = None if work is None else WorkFolder(Path(work), config)
        if folder is None and (executor is not None or workers):
            path = stack.enter_context(tempfile.TemporaryDirectory(prefix="jaxreg-"))
            folder = WorkFolder(Path(path), config)
        if folder is None:
            yield lambda tasks: (_in_turn(task, prepared, config) for task in tasks)
            return
        folder.make()
        prints = [stored.fingerprint(cloud) for cloud in prepared]
        if executor is None and not workers:
            yield lambda tasks: _kept_or_made(tasks, prepared, folder, prints, config)
            return
        paths = [folder.keep_scan(*scan) for scan in zip(prepared, prints, strict=True)]
        pool = _Pool(executor, workers)
        stack.callback(pool.close)
        yield lambda tasks: _on_workers(tasks, pool, folder, prints, paths, config)


def _in_turn(task: Task, prepared: list[Prepared], config: RegisterConfig) -> Relation:
    return register_task(task, prepared[task.source], prepared[task.reference], config)


def _kept_or_made(
    tasks: list[Task], prepared, folder: WorkFolder, prints: list[str], config: RegisterConfig
) -> Iterator[Relation]:
    for task in tasks:
        path = _pair_path(folder, task, prints)
        found = folder.read(path, task)
        if found is None:
            found = _in_turn(task, prepared, config)
            folder.write(path, found)
        yield found


class _Pool:
    """The caller's executor, or processes of this machine, which are started anew if one dies."""

    def __init__(self, given: concurrent.futures.Executor | None, workers: int) -> None:
        self._given, self._workers = given, workers
        self._own: concurrent.futures.ProcessPoolExecutor | None = None

    def submit(self, *arguments: Any) -> concurrent.futures.Future:
        if self._given is not None:
            return self._given.submit(*arguments)
        if self._own is None:
            # Forked, a process would inherit locks of JAX's threads.
            context = multiprocessing.get_context("spawn")
            self._own = concurrent.futures.ProcessPoolExecutor(self._workers, mp_context=context)
        try:
            return self._own.submit(*arguments)
        except concurrent.futures.BrokenExecutor:
            self._own = None
            return self.submit(*arguments)

    def close(self) -> None:
        if self._own is not None:
            self._own.shutdown(cancel_futures=True)


def _on_workers(
    tasks: list[Task], pool: _Pool, folder: WorkFolder, prints: list[str], paths: list[str], config
) -> Iterator[Relation]:
    waiting: dict[concurrent.futures.Future, tuple[Task, int]] = {}

    def submit(task: Task, tries: int) -> None:
        ends = paths[task.source], paths[task.reference]
        waiting[pool.submit(register_files, task, *ends, config)] = (task, tries)

    for task in tasks:
        found = folder.read(_pair_path(folder, task, prints), task)
        if found is not None:
            yield found
        else:
            submit(task, 0)
    while waiting:
        future = _first_done(waiting)
        task, tries = waiting.pop(future)
        try:
            found = future.result()
        except ValueError:
            raise
        except Exception:
            # A worker died, with this pair or with another: the pair is tried again.
            if tries >= _RETRIES:
                raise
            submit(task, tries + 1)
            continue
        folder.write(_pair_path(folder, task, prints), found)
        yield found


def _first_done(waiting) -> concurrent.futures.Future:
    done, _ = concurrent.futures.wait(waiting, return_when=concurrent.futures.FIRST_COMPLETED)
    return next(iter(done))


def _pair_path(folder: WorkFolder, task: Task, prints: list[str]) -> Path:
    return folder.pair_path(task, prints[task.source], prints[task.reference])


def _alignment(placement: Placement, run: _Run, steps) -> Alignment:
    pairs = tuple(
        AlignedPair(relation, float(chance), bool(used), reason)
        for relation, chance, used, reason in zip(
            run.relations, placement.posterior, placement.used, placement.refusal, strict=True
        )
    )
    reasons = tuple(
        "" if placement.group[k] >= 0 else _why_alone(k, pairs, run.names)
        for k in range(len(run.prepared))
    )
    notes = tuple(note for cloud in run.prepared for note in cloud.notes)
    return Alignment(
        placement.poses.rotation, placement.poses.translation, placement.members(),
        placement.probability, placement.covariance, run.sizes.centre, pairs, reasons, steps, notes,
    )  # fmt: skip


def _why_alone(scan: int, pairs: tuple[AlignedPair, ...], names: list[str]) -> str:
    """The reason of the most probable of its pairs."""
    own = [p for p in pairs if scan in (p.relation.source, p.relation.reference)]
    if not own:
        return "It was compared with no other scan."
    best = max(own, key=lambda p: p.relation.probability)
    other = best.relation.source + best.relation.reference - scan
    return f"No pair of it is sure; the likeliest, with {names[other]}: {best.reason}"
