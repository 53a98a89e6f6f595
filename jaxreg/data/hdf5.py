"""One data set of an HDF5 file, read whole and checked: every fault is a `ValueError`."""

from pathlib import Path

import numpy as np

from jaxreg._extras import extra


def read(path: Path, key: str) -> np.ndarray:
    """The array under `key`.

    Raises:
      ValueError: the file is missing, not HDF5 or truncated, or has no array under `key`.
    """
    with extra("train", f"{path}: HDF5"):
        import h5py
    if not path.is_file():
        raise ValueError(f"{path} is missing: download the data set again, or correct the list.")
    try:
        with h5py.File(path, "r") as file:
            item = file.get(key)
            if not isinstance(item, h5py.Dataset):
                raise ValueError(
                    f"{path} has no array '{key}' among its keys {sorted(file)}: is it a file from "
                    "this data set?"
                )
            return np.asarray(item[()])
    except OSError as error:
        raise ValueError(
            f"{path} cannot be read as HDF5 ({error}): it is truncated or not HDF5; "
            "download it again."
        ) from None


def read_clouds(path: Path, key: str) -> np.ndarray:
    """The clouds (n, P, 3) under `key` as float32.

    Raises:
      ValueError: as `read`, or the array is not (n, P, 3) of finite numbers with n, P > 0.
    """
    clouds = read(path, key)
    if clouds.ndim != 3 or clouds.shape[2] != 3 or clouds.size == 0 or clouds.dtype.kind != "f":
        raise ValueError(
            f"{path}: '{key}' must be float (n, P, 3) with n, P > 0, got {clouds.dtype} "
            f"{clouds.shape}: download the file again."
        )
    finite = np.isfinite(clouds)
    if not finite.all():
        row, point = np.argwhere(~finite)[0][:2]
        raise ValueError(
            f"{path}: '{key}' has a non-finite number in row {row}, point {point}: "
            "download the file again, or leave that row out."
        )
    return clouds.astype(np.float32)
