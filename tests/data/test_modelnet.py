import h5py
import numpy as np
import pytest

from jaxreg.data import modelnet

NAMES = [f"category_{i}" for i in range(40)]


def write_published(root, *, points=64, counts=(5, 4), name="modelnet40_ply_hdf5_2048"):
    """The published layout; the lists name the files under a path of another machine."""
    folder = root / name
    folder.mkdir()
    (folder / "shape_names.txt").write_text("\n".join(NAMES) + "\n")
    rng = np.random.default_rng(0)
    written = {}
    for split in ("train", "test"):
        # Listed in an order that is neither that of the numbers nor of the folder.
        order = list(reversed(range(len(counts))))
        lines = [f"data/{name}/ply_data_{split}{i}.h5" for i in order]
        (folder / f"{split}_files.txt").write_text("\r\n".join(lines) + "\r\n\r\n")
        for i, count in enumerate(counts):
            data = rng.normal(size=(count, points, 3)).astype(np.float32)
            label = rng.integers(0, 40, (count, 1)).astype(np.uint8)
            with h5py.File(folder / f"ply_data_{split}{i}.h5", "w") as file:
                file["data"], file["label"] = data, label
            written[split, i] = data, label[:, 0]
    return folder, written


def replace(path, key, value):
    with h5py.File(path, "a") as file:
        del file[key]
        if value is not None:
            file[key] = value


@pytest.mark.parametrize("points", [32, 64])
@pytest.mark.parametrize("split", ["train", "test"])
def test_shapes_in_the_order_of_the_list(points, split, tmp_path):
    folder, written = write_published(tmp_path, points=points)
    for root in (tmp_path, folder):
        clouds, labels = modelnet.load(root, split)
        assert (clouds.dtype, labels.dtype) == (np.float32, np.int32)
        np.testing.assert_array_equal(clouds[:4], written[split, 1][0])
        np.testing.assert_array_equal(clouds[4:], written[split, 0][0])
        np.testing.assert_array_equal(labels, np.r_[written[split, 1][1], written[split, 0][1]])
    assert modelnet.category_names(tmp_path) == tuple(NAMES)


def test_category_halves(tmp_path):
    write_published(tmp_path, counts=(30, 30))
    clouds, labels = modelnet.load(tmp_path, "train")
    first = modelnet.load(tmp_path, "train", categories="first20")
    last = modelnet.load(tmp_path, "train", categories="last20")
    np.testing.assert_array_equal(first[1], [label for label in labels if label <= 19])
    np.testing.assert_array_equal(last[1], [label for label in labels if label >= 20])
    np.testing.assert_array_equal(first[0], clouds[labels < 20])
    np.testing.assert_array_equal(last[0], clouds[labels >= 20])


def test_the_2048_point_set_is_preferred(tmp_path):
    write_published(tmp_path, name="modelnet40_ply_hdf5_1024")
    assert modelnet.find_folder(tmp_path).name == "modelnet40_ply_hdf5_1024"
    write_published(tmp_path)
    assert modelnet.find_folder(tmp_path).name == "modelnet40_ply_hdf5_2048"


@pytest.mark.untyped
def test_unknown_split_and_categories(tmp_path):
    write_published(tmp_path)
    with pytest.raises(ValueError, match="splits 'train' and 'test', got 'val'"):
        modelnet.load(tmp_path, "val")
    with pytest.raises(ValueError, match="'last20', got 'odd'"):
        modelnet.load(tmp_path, "train", categories="odd")


def test_missing_data_names_layout_and_source(tmp_path):
    with pytest.raises(
        ValueError, match="expected modelnet40_ply_hdf5_2048/.*train_files.txt"
    ) as e:
        modelnet.load(tmp_path, "train")
    assert "https://shapenet.cs.stanford.edu/media/modelnet40_ply_hdf5_2048.zip" in str(e.value)
    assert "--data-root" in str(e.value)


@pytest.mark.parametrize("name", ["train_files.txt", "shape_names.txt"])
def test_missing_or_empty_list(name, tmp_path):
    folder, _ = write_published(tmp_path)
    (folder / name).write_text("\n")
    with pytest.raises(ValueError, match=rf"{name} is empty: expected"):
        modelnet.load(tmp_path, "train")
    (folder / name).unlink()
    with pytest.raises(ValueError, match=rf"{name} is missing: expected"):
        modelnet.load(tmp_path, "train")


def test_listed_file_is_missing(tmp_path):
    folder, _ = write_published(tmp_path)
    (folder / "ply_data_test1.h5").unlink()
    with pytest.raises(ValueError, match=r"ply_data_test1\.h5 is missing"):
        modelnet.load(tmp_path, "test")
    assert len(modelnet.load(tmp_path, "train")[0]) == 9


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("data", None, "no array 'data'"),
        ("label", None, "no array 'label'"),
        ("data", np.zeros((4, 64), np.float32), r"'data' must be float \(n, P, 3\)"),
        ("label", np.zeros((3, 1), np.uint8), r"'label' must be integer \(4, 1\).*uint8 \(3, 1\)"),
        ("label", np.zeros((4, 2), np.uint8), r"'label' must be integer \(4, 1\)"),
        ("label", np.zeros((4, 1)), "'label' must be integer .* got float64"),
        ("label", np.array([[1], [2], [40], [3]], np.uint8), "'label' is 40 in row 2"),
        ("data", np.zeros((4, 32, 3), np.float32), r"the train files have shapes of \[32, 64\]"),
    ],
)
def test_malformed_file(key, value, message, tmp_path):
    folder, _ = write_published(tmp_path)
    replace(folder / "ply_data_train1.h5", key, value)
    with pytest.raises(ValueError, match=message) as error:
        modelnet.load(tmp_path, "train")
    assert "download" in str(error.value) or "is it a file from" in str(error.value)


def test_labels_without_second_axis(tmp_path):
    folder, written = write_published(tmp_path)
    replace(folder / "ply_data_train1.h5", "label", written["train", 1][1])
    np.testing.assert_array_equal(modelnet.load(tmp_path, "train")[1][:4], written["train", 1][1])


@pytest.mark.modelnet
@pytest.mark.parametrize("split", ["train", "test"])
def test_real_files(split, data_root):
    clouds, labels = modelnet.load(data_root, split)
    assert 9840 <= len(clouds) <= 9843 if split == "train" else len(clouds) == 2468
    assert set(labels) == set(range(40))
    assert len(modelnet.category_names(data_root)) == 40
    np.testing.assert_allclose(clouds.mean(axis=1), 0, atol=1e-3)
    assert np.linalg.norm(clouds, axis=2).max(axis=1) == pytest.approx(1, abs=1e-3)
