"""A prepared scan as a file: what a worker in another process, or on another machine, reads."""

import dataclasses
import hashlib
import zipfile
from pathlib import Path

import numpy as np

from jaxreg.io.places import whole
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.prepare import Level, Prepared

_ARRAYS = ("points", "centre", "kept", "row")


def fingerprint(cloud: Prepared) -> str:
    """32 hexadecimal digits that stand for the points of a cloud and how it was prepared."""
    found = hashlib.sha256(settings_text(cloud.config).encode())
    for array in (
        cloud.points,
        cloud.centre,
        np.float64(cloud.radius),
        cloud.normals,
        cloud.viewpoint,
    ):
        found.update(b"-" if array is None else np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:32]


def settings_text(config: RegisterConfig) -> str:
    """The settings that change a result, as text."""
    return repr(dataclasses.asdict(config))


def save(cloud: Prepared, path: Path) -> None:
    """Write a prepared cloud as NPZ: complete, or not at all."""
    arrays = {name: getattr(cloud, name) for name in _ARRAYS} | {"radius": np.float64(cloud.radius)}
    arrays |= {"notes": np.array(cloud.notes, dtype=np.str_)}
    for name in ("fine", "coarse"):
        level: Level = getattr(cloud, name)
        arrays |= {name: level.points, f"{name}_k": np.int64(level.k)}
        if level.normals is not None:
            arrays[f"{name}_normals"] = level.normals
    for name in ("normals", "viewpoint"):
        if (array := getattr(cloud, name)) is not None:
            arrays[name] = array
    with whole(path) as part, part.open("wb") as file:
        np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]


def load(path: str | Path, config: RegisterConfig) -> Prepared:
    """A cloud that `save` wrote, prepared with `config`; nothing is unpickled.

    Raises:
      ValueError: it is no such file.
    """
    try:
        with open(path, "rb") as handle, np.load(handle, allow_pickle=False) as file:
            arrays = dict(file)
        fine, coarse = (
            Level(arrays[name], arrays.get(f"{name}_normals"), int(arrays[f"{name}_k"]))
            for name in ("fine", "coarse")
        )
        return Prepared(
            arrays["points"], arrays.get("normals"), arrays["centre"], float(arrays["radius"]),
            arrays["kept"], arrays["row"], tuple(arrays["notes"].tolist()), fine, coarse, config,
            arrays.get("viewpoint"),
        )  # fmt: skip
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{path} holds no prepared scan ({error}): delete it, and it is made again."
        ) from None
