"""Poses of many scans as a file: JSON, 4x4 text, TUM, KITTI and g2o; and 3DMatch's logs."""

import json
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxreg.io.decoding import decoded
from jaxreg.io.matrix import words
from jaxreg.io.places import reading

FORMATS = (".json", ".txt", ".tum", ".kitti", ".g2o")
_SWAP = [3, 4, 5, 0, 1, 2]
_REMEDY = "export the poses again"
_Poses = Mapping[Any, np.ndarray | None]
"""By names, or by numbers (int) in a file without names; None is a scan without a pose."""


class Edges(NamedTuple):
    """The edges of a g2o file: ``transform[e]`` maps scan ``source[e]`` to scan ``reference[e]``.

    `information` is that of a motion ``Z exp(xi)`` of the source's frame, rotation vector (radians)
    before translation.
    """

    source: Int[np.ndarray, "e"]
    reference: Int[np.ndarray, "e"]
    transform: Float[np.ndarray, "e 4 4"]
    information: Float[np.ndarray, "e 6 6"]


def check_poses_output(path: Path) -> None:
    """Raise ValueError unless the suffix is that of a format that `write_poses` writes."""
    if path.suffix.lower() not in FORMATS:
        raise ValueError(
            f"{path}: poses cannot be written as '{path.suffix}': choose one of {', '.join(FORMATS)}."
        )


def write_poses(
    path: str | Path,
    poses: Float[np.ndarray, "n 4 4"],
    *,
    names: Sequence[str] = (),
    edges: Edges | None = None,
    groups: Sequence[Sequence[int]] = (),
) -> None:
    """Write poses (scan to common frame) in the format of the suffix; NaN marks a scan without one.

    `.json`: ``{"poses": {name: 4x4 or null}}``, and ``"groups"``, lists of names, where there are
    several `groups` (the numbers of their scans), each in a frame of its own. `.txt`: four lines a scan
    below ``# name``. `.tum`: number, translation and quaternion (x, y, z, w), scans without a pose left
    out. `.kitti`: the first three rows in one line a scan, NaN where there is none. `.g2o`: vertices,
    and `edges`.

    Raises:
      ValueError: the suffix is none of these.
    """
    path = Path(path)
    check_poses_output(path)
    names = list(names) or [str(k) for k in range(len(poses))]
    write: Callable[[], str] = {
        ".json": lambda: _json_text(poses, names, groups),
        ".txt": lambda: _matrix_text(poses, names),
        ".tum": lambda: _tum_text(poses),
        ".kitti": lambda: "".join(_row(pose[:3].ravel().tolist()) for pose in poses),
        ".g2o": lambda: _g2o_text(poses, edges),
    }[path.suffix.lower()]
    path.write_text(write(), "utf-8")


def read_poses(path: str | Path, names: Sequence[str] = ()) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Poses by name: of JSON and 4x4 text the names there, of other files the numbers of the scans.

    Of a JSON file with several groups the poses of the first, since each has a frame of its own.
    With `names` (of the scans, in their order) the result has an entry for every scan that has a pose.
    In files with names it is found by its path, or by as much of its end as tells it from all others:
    the file name or the stem, and the folders before it. In files without names, or with none of
    these but numbers, it is found by its number, from 0.

    Raises:
      ValueError: there is no such file, it is a directory, it may not be read, it is malformed, none of
        the scans has a pose in it, or a scan could have several.
    """
    path = Path(path)
    found = _read(path)
    if names:
        return _of_scans(path, found, names)
    return {str(key): pose for key, pose in found.items() if pose is not None}


def read_g2o(path: str | Path) -> tuple[dict[int, Float[np.ndarray, "4 4"]], Edges]:
    """The vertices (by number) and edges of a g2o file of 3-D poses (``SE3:QUAT``).

    Raises:
      ValueError: there is no such file, it is a directory, it may not be read, or a line is malformed.
    """
    path = Path(path)
    vertices: dict[int, np.ndarray] = {}
    ends, transforms, information = [], [], []
    with reading(path):
        lines = decoded(path, path.read_bytes()).splitlines()
    for number, line in enumerate(lines, start=1):
        row = line.split()
        try:
            if row[:1] == ["VERTEX_SE3:QUAT"]:
                vertices[int(row[1])] = _from_quaternion(_floats(row[2:9], 7))
            elif row[:1] == ["EDGE_SE3:QUAT"]:
                ends.append((int(row[1]), int(row[2])))
                transforms.append(_from_quaternion(_floats(row[3:10], 7)))
                information.append(_rotation_first(_symmetric(_floats(row[10:31], 21))))
        except (ValueError, IndexError) as error:
            raise ValueError(f"{path}, line {number} is malformed ({error}): {_REMEDY}.") from None
    both = np.array(ends, np.int64).reshape(-1, 2)
    # An edge i j holds X_i^-1 X_j, which maps j to i.
    return vertices, Edges(
        both[:, 1], both[:, 0], np.array(transforms).reshape(-1, 4, 4),
        np.array(information).reshape(-1, 6, 6),
    )  # fmt: skip


def read_pairs_log(
    path: str | Path,
) -> tuple[Int[np.ndarray, "p 2"], Float[np.ndarray, "p 4 4"]]:
    """(i, j) and T of a log of 3DMatch: T maps fragment j to the frame of fragment i.

    Raises:
      ValueError: there is no such file, it is a directory, it may not be read, or it is not made of
        blocks of five lines.
    """
    path = Path(path)
    with reading(path):
        text = decoded(path, path.read_bytes())
    try:
        rows = [line.split() for line in text.splitlines() if line.strip()]
        if len(rows) % 5:
            raise ValueError(f"{len(rows)} lines, no multiple of 5")
        ends = np.array([[int(word) for word in row[:2]] for row in rows[::5]], np.int64)
        values = [[float(word) for word in row] for k, row in enumerate(rows) if k % 5]
        return ends.reshape(-1, 2), np.array(values, np.float64).reshape(-1, 4, 4)
    except ValueError as error:
        raise ValueError(f"{path} is no log of pairs ({error}): download it again.") from None


def _read(path: Path) -> _Poses:
    """All that a file has: a scan without a pose counts, since its name is that of no other scan."""
    if path.suffix.lower() == ".g2o":
        return read_g2o(path)[0]
    with reading(path):
        try:
            text = decoded(path, path.read_bytes())
            return _from_json(text) if path.suffix.lower() == ".json" else _from_text(text)
        except (ValueError, KeyError, TypeError, IndexError) as error:
            raise ValueError(f"{path} does not contain poses ({error}): {_REMEDY}.") from None


def _from_json(text: str) -> _Poses:
    content = json.loads(text)
    poses = content.get("poses", content) if isinstance(content, dict) else content
    items = poses.items() if isinstance(poses, dict) else enumerate(poses)
    found = {key: None if pose is None else _checked(pose) for key, pose in items}
    groups = content.get("groups", []) if isinstance(content, dict) else []
    elsewhere = {name for group in groups[1:] for name in group}
    return {key: None if key in elsewhere else pose for key, pose in found.items()}


def _from_text(text: str) -> _Poses:
    lines = text.splitlines()
    rows = [_floats(row) for row in map(words, lines) if row]
    widths = {len(row) for row in rows}
    if widths == {12}:
        last = [0.0, 0.0, 0.0, 1.0]
        return {k: _checked([*row, *last]) if _finite(row) else None for k, row in enumerate(rows)}
    if widths == {8}:
        times = [row[0] for row in rows]
        # Numbers of scans as `write_poses` has them, or times: these count the rows in their order.
        numbers = all(0 <= t < 1e6 and t == int(t) for t in times) and len(set(times)) == len(rows)
        return {
            int(row[0]) if numbers else k: _from_quaternion(row[1:]) if _finite(row[1:]) else None
            for k, row in enumerate(rows)
        }
    return _from_matrix_text(lines)


def _from_matrix_text(lines: list[str]) -> _Poses:
    """Blocks of four lines of four numbers, each below a comment with its name, or numbered."""
    names: list[str | None] = []
    poses: list[np.ndarray | None] = []
    name, rows = None, []
    for line in lines:
        if line.lstrip().startswith("#"):
            name = line.lstrip("# \t").strip() or None
        elif row := words(line):
            rows.append(_floats(row, 4))
        if len(rows) == 4:
            names.append(name)
            poses.append(_checked(rows) if np.isfinite(rows).all() else None)
            name, rows = None, []
    if rows or not poses:
        raise ValueError("it is not made of blocks of four lines of four numbers")
    if not any(names[1:]) and (len(names) > 1 or names[0] is None):
        return dict(enumerate(poses))  # A comment above the first of many is a title.
    known = [name for name in names if name is not None]
    if len(known) < len(names):
        raise ValueError(f"block {names.index(None) + 1} has no name above it, and others have one")
    if len(set(known)) < len(known):
        twice = next(name for k, name in enumerate(known) if name in known[:k])
        raise ValueError(f"two blocks have the name {twice}")
    return dict(zip(known, poses, strict=True))


def _of_scans(path: Path, found: _Poses, names: Sequence[str]) -> dict[str, np.ndarray]:
    keys = [key for key in found if isinstance(key, str)]
    by_name = _by_path(path, keys, list(dict.fromkeys(names)))
    _check_numbers(path, keys, by_name, names)
    by_number = {name: found.get(k, found.get(str(k))) for k, name in enumerate(names)}
    given = {name: found[key] for name, key in by_name.items()} if by_name else by_number
    chosen = {name: pose for name in names if (pose := given.get(name)) is not None}
    if not chosen:
        known = [str(key) for key, pose in found.items() if pose is not None]
        raise ValueError(
            f"{path} has poses of {', '.join(known[:4]) or 'nothing'}, and none of these scans: name "
            "them as the files, or number them from 0."
        )
    return chosen


def _by_path(path: Path, keys: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Which key each scan has: the one with the longest end in common, if no other has it, too.

    Raises:
      ValueError: there are several.
    """
    scans, poses = _by_end(names), _by_end(keys)
    chosen: dict[str, str] = {}
    taken: set[str] = set()
    # Longest ends first, and of a file its whole name before its stem.
    for end in sorted(scans.keys() & poses.keys(), key=lambda e: (-len(e), -len(e[-1]))):
        if len(scans[end]) == len(poses[end]) == 1:
            (name,), (key,) = scans[end], poses[end]
            if name not in chosen and key not in taken:
                chosen[name] = key
                taken.add(key)
    for name in (name for name in names if name not in chosen):
        alike = [key for form in _forms(name) for key in poses.get((form,), ()) if key not in taken]
        if alike:
            raise ValueError(
                f"{path}: whether {name} has the pose of {' or '.join(dict.fromkeys(alike[:9]))} is "
                "open, since several files have this name: name the poses by paths that differ."
            )
    return chosen


def _by_end(names: Sequence[str]) -> dict[tuple[str, ...], list[str]]:
    """The names by the ends of their paths, of any number of folders; a whole path begins with ""."""
    ends = defaultdict(list)
    for name in names:
        folders = ("", *Path(name).parts[:-1])
        for form in _forms(name):
            ends[(form,)].append(name)
            for k in range(1, len(folders) + 1):
                ends[(*folders[-k:], form)].append(name)
    return ends


def _forms(name: str) -> list[str]:
    """The file name, without ``.gz``, and without the suffix; the ".17" of a time is none."""
    whole = Path(name).name
    plain = whole.removesuffix(".gz")
    stem = plain if plain.rpartition(".")[2].isdecimal() else Path(plain).stem
    return list(dict.fromkeys((whole, plain, stem)))


def _check_numbers(
    path: Path, keys: Sequence[str], by_name: Mapping[str, str], names: Sequence[str]
) -> None:
    """Raises ValueError where keys that are numbers may be names as well as positions."""
    places = {str(k) for k in range(len(names))}
    if by_name and set(keys) <= places and len(by_name) < len(keys):
        raise ValueError(
            f"{path} has numbers, {', '.join(keys[:4])}, which may be names of the scans or count them "
            "from 0: name the poses as the files."
        )


def _checked(pose: object) -> np.ndarray:
    matrix = np.asarray(pose, np.float64).reshape(4, 4)
    if not np.isfinite(matrix).all():
        raise ValueError("a pose has NaN")
    return matrix


def _finite(row: Sequence[float]) -> bool:
    return bool(np.isfinite(row).all())


def _floats(words: Sequence[str], count: int | None = None) -> list[float]:
    if count is not None and len(words) != count:
        raise ValueError(f"{len(words)} numbers where {count} belong")
    return [float(word) for word in words]


def _from_quaternion(values: Sequence[float]) -> np.ndarray:
    """A 4x4 pose from x, y, z and a quaternion x, y, z, w."""
    from scipy.spatial.transform import Rotation  # start-up of programs that only import this

    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    pose[:3, 3] = values[:3]
    return pose


def _quaternion(pose: np.ndarray) -> list[float]:
    from scipy.spatial.transform import Rotation  # start-up of programs that only import this

    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True).tolist()
    return [*pose[:3, 3].tolist(), x, y, z, w]


def _symmetric(values: Sequence[float]) -> np.ndarray:
    matrix = np.zeros((6, 6))
    matrix[np.triu_indices(6)] = values
    return matrix + np.triu(matrix, 1).T


def _rotation_first(information: np.ndarray) -> np.ndarray:
    """From translation before rotation.

    The latter counts as a rotation vector, as GTSAM and Ceres have it; g2o itself takes the vector part
    of a quaternion, which is half of it.
    """
    return information[np.ix_(_SWAP, _SWAP)]


def _row(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values) + "\n"


def _json_text(poses: np.ndarray, names: list[str], groups: Sequence[Sequence[int]]) -> str:
    known = {
        name: pose.tolist() if np.isfinite(pose).all() else None
        for name, pose in zip(names, poses, strict=True)
    }
    apart = {"groups": [[names[k] for k in group] for group in groups]} if len(groups) > 1 else {}
    return json.dumps({"poses": known} | apart, indent=1) + "\n"


def _matrix_text(poses: np.ndarray, names: list[str]) -> str:
    blocks = zip(names, poses, strict=True)
    return "".join(f"# {name}\n" + "".join(map(_row, pose.tolist())) for name, pose in blocks)


def _tum_text(poses: np.ndarray) -> str:
    placed = [(k, pose) for k, pose in enumerate(poses) if np.isfinite(pose).all()]
    return "".join(f"{k} {_row(_quaternion(pose))}" for k, pose in placed)


def _g2o_text(poses: np.ndarray, edges: Edges | None) -> str:
    lines = [
        f"VERTEX_SE3:QUAT {k} {_row(_quaternion(pose))}"
        for k, pose in enumerate(poses)
        if np.isfinite(pose).all()
    ]
    for source, reference, transform, information in zip(*(edges or ([],) * 4), strict=True):
        values = information[np.ix_(_SWAP, _SWAP)][np.triu_indices(6)]
        numbers = [*_quaternion(transform), *values.tolist()]
        lines.append(f"EDGE_SE3:QUAT {reference} {source} {_row(numbers)}")
    return "".join(lines)
