import h5py
import numpy as np
import pytest

from jaxreg.data import hdf5


def write(path, **arrays):
    with h5py.File(path, "w") as file:
        for key, value in arrays.items():
            file[key] = value
    return path


def test_clouds_come_back_in_float32(tmp_path, seed):
    clouds = np.random.default_rng(seed).normal(size=(4, 7, 3))
    read = hdf5.read_clouds(write(tmp_path / "a.h5", data=clouds), "data")
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, clouds.astype(np.float32))


def test_missing_file(tmp_path):
    with pytest.raises(ValueError, match=r"none\.h5 is missing: download"):
        hdf5.read(tmp_path / "none.h5", "data")


def test_missing_key_and_group_in_its_place(tmp_path):
    path = write(tmp_path / "a.h5", points=np.zeros(3))
    with h5py.File(path, "a") as file:
        file.create_group("data")
    for key in ("data", "label"):
        with pytest.raises(ValueError, match=rf"a\.h5 has no array '{key}' among .*'points'"):
            hdf5.read(path, key)


@pytest.mark.parametrize("kept", [0.0, 0.01, 0.5, 0.95])
def test_truncated_file(kept, tmp_path):
    path = write(tmp_path / "a.h5", data=np.zeros((20, 100, 3), np.float32))
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(ValueError, match=r"a\.h5 cannot be read as HDF5 .*download it again"):
        hdf5.read(path, "data")


def test_damaged_chunk(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        data = np.random.default_rng(0).normal(size=(20, 100, 3))
        file.create_dataset("data", data=data, compression="gzip", chunks=data.shape)
        chunk = file["data"].id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    middle = chunk.byte_offset + chunk.size // 2
    content[middle : middle + 200] = bytes(200)
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.h5 cannot be read as HDF5"):
        hdf5.read(path, "data")


@pytest.mark.parametrize(
    "value",
    [
        np.zeros((4, 3)),
        np.zeros((4, 7, 2)),
        np.zeros((0, 7, 3)),
        np.zeros((4, 0, 3)),
        np.zeros((4, 7, 3), int),
    ],
)
def test_wrong_shape_or_dtype(value, tmp_path):
    path = write(tmp_path / "a.h5", data=value)
    with pytest.raises(ValueError, match=r"a\.h5: 'data' must be float \(n, P, 3\) with n, P > 0"):
        hdf5.read_clouds(path, "data")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_non_finite_point_is_named(bad, tmp_path):
    clouds = np.zeros((4, 7, 3), np.float32)
    clouds[2, 5, 1] = bad
    path = write(tmp_path / "a.h5", data=clouds)
    with pytest.raises(ValueError, match="non-finite number in row 2, point 5"):
        hdf5.read_clouds(path, "data")
