"""Poses of many scans as a file: JSON, 4x4 text, TUM, KITTI and g2o; and 3DMatch's logs."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

FORMATS = (".json", ".txt", ".tum", ".kitti", ".g2o")
_SWAP = [3, 4, 5, 0, 1, 2]
_REMEDY = "export the poses again"


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
) -> None:
    """Write poses (scan to common frame) in the format of the suffix; NaN marks a scan without one.

    `.json`: ``{"poses": {name: 4x4 or null}}``. `.txt`: four lines a scan below ``# name``. `.tum`: number,
    translation and quaternion (x, y, z, w), scans without a pose left out. `.kitti`: the first three rows in
    one line a scan, NaN where there is none. `.g2o`: vertices, and `edges`.

    Raises:
      ValueError: the suffix is none of these.
    """
    path = Path(path)
    check_poses_output(path)
    names = list(names) or [str(k) for k in range(len(poses))]
    write: Callable[[], str] = {
        ".json": lambda: _json_text(poses, names),
        ".txt": lambda: _matrix_text(poses, names),
        ".tum": lambda: _tum_text(poses),
        ".kitti": lambda: "".join(_row(pose[:3].ravel()) for pose in poses),
        ".g2o": lambda: _g2o_text(poses, edges),
    }[path.suffix.lower()]
    path.write_text(write(), "utf-8")


def read_poses(path: str | Path, names: Sequence[str] = ()) -> dict[str, Float[np.ndarray, "4 4"]]:
    """Poses by name: of JSON and 4x4 text the names there, of other files the numbers of the scans.

    With `names` (paths or names of scans in their order) the result has one entry a scan that has a pose:
    a name is found by itself, by its file name or by its stem, and numbers count the scans from 0.

    Raises:
      ValueError: there is no such file, it is malformed, or none of the names has a pose in it.
    """
    path = Path(path)
    try:
        found = _read(path)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; check the path.") from None
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise ValueError(f"{path} does not contain poses ({error}): {_REMEDY}.") from None
    return _named(path, found, names) if names else found


def read_g2o(path: str | Path) -> tuple[dict[int, Float[np.ndarray, "4 4"]], Edges]:
    """The vertices (by number) and edges of a g2o file of 3-D poses (``SE3:QUAT``).

    Raises:
      ValueError: there is no such file, or a line is malformed.
    """
    path = Path(path)
    vertices: dict[int, np.ndarray] = {}
    ends, transforms, information = [], [], []
    try:
        lines = path.read_text("utf-8").splitlines()
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; check the path.") from None
    for number, line in enumerate(lines, start=1):
        words = line.split()
        try:
            if words[:1] in (["VERTEX_SE3:QUAT"],):
                vertices[int(words[1])] = _from_quaternion(_floats(words[2:9], 7))
            elif words[:1] == ["EDGE_SE3:QUAT"]:
                ends.append((int(words[1]), int(words[2])))
                transforms.append(_from_quaternion(_floats(words[3:10], 7)))
                information.append(_rotation_first(_symmetric(_floats(words[10:31], 21))))
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
      ValueError: there is no such file, or it is not made of blocks of five lines.
    """
    path = Path(path)
    try:
        rows = [line.split() for line in path.read_text("utf-8").splitlines() if line.strip()]
        if len(rows) % 5:
            raise ValueError(f"{len(rows)} lines, no multiple of 5")
        ends = np.array([[int(word) for word in row[:2]] for row in rows[::5]], np.int64)
        values = [[float(word) for word in row] for k, row in enumerate(rows) if k % 5]
        return ends.reshape(-1, 2), np.array(values, np.float64).reshape(-1, 4, 4)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; check the path.") from None
    except ValueError as error:
        raise ValueError(f"{path} is no log of pairs ({error}): download it again.") from None


def _read(path: Path) -> dict[str, np.ndarray]:
    kind = path.suffix.lower()
    if kind == ".json":
        content = json.loads(path.read_text("utf-8"))
        poses = content.get("poses", content) if isinstance(content, dict) else content
        items = poses.items() if isinstance(poses, dict) else enumerate(poses)
        return {str(name): _checked(pose) for name, pose in items if pose is not None}
    if kind == ".g2o":
        return {str(number): pose for number, pose in read_g2o(path)[0].items()}
    lines = path.read_text("utf-8").splitlines()
    rows = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
    numbers = [_floats(re.split(r"[\s,]+", row.strip())) for row in rows]
    widths = {len(row) for row in numbers}
    if widths == {12}:
        last = [0.0, 0.0, 0.0, 1.0]
        poses = {str(k): _checked([*row, *last]) for k, row in enumerate(numbers) if _finite(row)}
    elif widths == {8}:
        # The time of a row counts the scans, whatever its unit: rows are in their order.
        whole = all(row[0] == int(row[0]) and row[0] < 1e6 for row in numbers)
        poses = {
            str(int(row[0]) if whole else k): _from_quaternion(row[1:])
            for k, row in enumerate(numbers)
        }
    else:
        poses = _from_matrix_text(lines)
    return poses


def _from_matrix_text(lines: list[str]) -> dict[str, np.ndarray]:
    """Blocks of four lines of four numbers, each below a comment with its name, or numbered."""
    poses, name, rows = {}, None, []
    for line in lines:
        if line.lstrip().startswith("#"):
            name = line.lstrip("# \t").strip() or None
        elif line.strip():
            rows.append(_floats(re.split(r"[\s,]+", line.strip("[] \t;")), 4))
        if len(rows) == 4:
            matrix = np.array(rows)
            if np.isfinite(matrix).all():
                poses[name or str(len(poses))] = _checked(matrix)
            name, rows = None, []
    if rows or not poses:
        raise ValueError("it is not made of blocks of four lines of four numbers")
    return poses


def _named(path: Path, found: Mapping[str, np.ndarray], names: Sequence[str]) -> dict:
    by_stem = {Path(name).name: pose for name, pose in found.items()}
    by_stem |= {Path(name).stem: pose for name, pose in found.items()}
    chosen = {}
    for k, name in enumerate(names):
        for key in (name, Path(name).name, Path(name).stem, str(k)):
            pose = found.get(key, by_stem.get(key))
            if pose is not None:
                chosen[name] = pose
                break
    if not chosen:
        raise ValueError(
            f"{path} has poses of {', '.join(list(found)[:4])}, and none of these scans: name them as "
            "the files, or number them from 0."
        )
    return chosen


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
    """From translation before rotation. The latter counts as a rotation vector, as GTSAM and Ceres have
    it; g2o itself takes the vector part of a quaternion, which is half of it.
    """
    return information[np.ix_(_SWAP, _SWAP)]


def _row(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values) + "\n"


def _json_text(poses: np.ndarray, names: list[str]) -> str:
    known = {
        name: pose.tolist() if np.isfinite(pose).all() else None
        for name, pose in zip(names, poses, strict=True)
    }
    return json.dumps({"poses": known}, indent=1) + "\n"


def _matrix_text(poses: np.ndarray, names: list[str]) -> str:
    blocks = zip(names, poses, strict=True)
    return "".join(f"# {name}\n" + "".join(map(_row, pose)) for name, pose in blocks)


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
