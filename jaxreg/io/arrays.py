"""NumPy's own files: NPY with an array (n, 3), NPZ with such an array in it. Never unpickled."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxreg.io.contents import TWO_COLUMNS, Scan
from jaxreg.io.places import reading


def read(path: Path) -> Scan:
    """The points (n, 3), float64; (n, 2) gets z = 0. Raises what `jaxreg.io.read_cloud` raises.

    More columns than three (colours, intensity) are not read. In an NPZ file the array is `points`,
    or the only one that could be a cloud.
    """
    try:
        content = _loaded(path)
    except Exception as error:  # noqa: BLE001 - numpy, zipfile and zlib raise types of their own
        hint = "save numbers, not objects" if "pickle" in str(error) else "save it again"
        told = " ".join(str(error).split())[:200]
        raise ValueError(f"{path} cannot be read as {path.suffix} ({told}): {hint}.") from None
    if isinstance(content, dict):
        return _chosen(content, path)
    return _scan(content, str(path))


def read_arrays(
    path: str | Path, names: Sequence[str] = (), *, remedy: str
) -> dict[str, np.ndarray]:
    """Every array of an ``.npz`` file, by its name, of any kind.

    Raises:
      ValueError: the file is missing, a directory, not an ``.npz`` or only a part of one, or lacks
        an array of `names`; the message names the file and ends with `remedy`.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path} is a directory, not a file: {remedy}.")
    if not path.exists():
        raise ValueError(f"{path}: no such file; {remedy}.")
    try:
        arrays = _loaded(path)
        if isinstance(arrays, np.ndarray):
            raise ValueError("it contains one array, without a name")
    except Exception as error:  # noqa: BLE001 - numpy, zipfile and zlib raise types of their own
        raise ValueError(f"{path} is not an .npz of arrays ({error}): {remedy}.") from None
    for name in names:
        if name not in arrays:
            raise ValueError(f"{path} has no array '{name}': {remedy}.")
    return arrays


def read_numbers(path: Path, count: int, *, what: str = "point") -> np.ndarray:
    """One number a point, or whatever `what` says: text with one a line, or NPY.

    Raises:
      ValueError: there is no such file, it is a directory, it may not be read, it holds no numbers,
        or not `count` of them.
    """
    with reading(path):
        if not path.is_fifo():
            path.open("rb").close()  # numpy would call a file that may not be read missing
        try:
            loaded = _loaded(path) if path.suffix.lower() == ".npy" else np.loadtxt(path, ndmin=1)
        except OSError:
            raise
        except Exception as error:  # noqa: BLE001 - numpy raises types of its own
            told = " ".join(str(error).split())[:200]
            raise ValueError(
                f"{path} holds no numbers ({told}): write one for each {what}."
            ) from None
    numbers = np.asarray(loaded)
    if numbers.shape != (count,) or numbers.dtype.kind not in "bfiu":
        raise ValueError(
            f"{path} is {numbers.dtype} {numbers.shape}: write {count:,} numbers, one for each {what}."
        )
    return numbers


def _loaded(path: Path) -> np.ndarray | dict[str, np.ndarray]:
    with path.open("rb") as file:
        content = np.load(file, allow_pickle=False)
        if isinstance(content, np.ndarray):
            return content
        return {name: content[name] for name in content.files}


def _chosen(named: dict[str, np.ndarray], path: Path) -> Scan:
    if "points" in named:
        return _scan(named["points"], f"{path}['points']")
    clouds = [name for name, array in named.items() if array.ndim == 2 and array.shape[1] >= 3]
    if len(clouds) != 1:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in named.items())
        raise ValueError(
            f"{path} contains {shapes or 'nothing'}: save the cloud (n, 3) under the name 'points'."
        )
    return _scan(named[clouds[0]], f"{path}['{clouds[0]}']")


def _scan(array: np.ndarray, where: str) -> Scan:
    planar = array.dtype.names is None and array.ndim == 2 and array.shape[1] == 2
    return Scan(_points(array, where), (TWO_COLUMNS,) if planar else ())


def _points(array: np.ndarray, where: str) -> np.ndarray:
    if array.dtype.names and set("xyz") <= set(array.dtype.names):
        array = np.stack([array[axis] for axis in "xyz"], axis=-1).reshape(-1, 3)
    columns = array.dtype.kind in "fiu" and array.ndim == 2 and array.shape[0] == 4 < array.shape[1]
    if columns and np.all(array[3] == 1):
        raise ValueError(
            f"{where} is {array.dtype} {array.shape}, one homogeneous point per column: save the "
            "transpose of its first three rows (n, 3)."
        )
    if array.dtype.kind in "fiu" and array.ndim == 2 and array.shape[0] == 3 < array.shape[1]:
        raise ValueError(
            f"{where} is {array.dtype} {array.shape}, one point per column: save its transpose (n, 3)."
        )
    if array.dtype.kind in "fiu" and array.ndim == 3 and array.shape[2] == 3:
        return array.reshape(-1, 3).astype(np.float64)  # an organised cloud, (height, width, 3)
    if array.dtype.kind in "fiu" and array.ndim == 2 and array.shape[1] == 2:
        return np.column_stack([array, np.zeros(len(array))]).astype(np.float64)
    if array.dtype.kind not in "fiu" or array.ndim != 2 or array.shape[1] < 3:
        raise ValueError(
            f"{where} is {array.dtype} {array.shape}, not numbers of shape (n, 3): "
            "save one point per row."
        )
    return array[:, :3].astype(np.float64)


def more(path: Path) -> tuple[str, ...]:
    """What the file holds besides x, y, z."""
    loaded = _loaded(path)
    if isinstance(loaded, dict):
        return tuple(name for name in loaded if name != "points") if "points" in loaded else ()
    if loaded.dtype.names:
        return tuple(name for name in loaded.dtype.names if name not in "xyz")
    further = loaded.shape[1] - 3 if loaded.ndim == 2 else 0
    return (f"{further} further columns",) if further > 0 else ()


def write(path: Path, points: np.ndarray) -> None:
    """The array itself, or an archive with the array `points`."""
    with path.open("wb") as file:  # To a name, numpy would append its own suffix to ".NPY".
        if path.suffix.lower() == ".npz":
            np.savez_compressed(file, points=points)
        else:
            np.save(file, points)
