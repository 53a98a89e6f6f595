import h5py
import numpy as np
import pytest

from jaxreg.config import DataConfig
from jaxreg.data import data_root as find_root
from jaxreg.data import dataset_label, load_shapes, load_training, modelnet


def write_modelnet(root, count=40, points=8):
    folder = root / "modelnet40_ply_hdf5_2048"
    folder.mkdir()
    (folder / "shape_names.txt").write_text("\n".join(f"c{i}" for i in range(40)))
    clouds = np.arange(count * points * 3, dtype=np.float32).reshape(count, points, 3)
    for split in ("train", "test"):
        (folder / f"{split}_files.txt").write_text(f"data/x/ply_data_{split}0.h5\n")
        with h5py.File(folder / f"ply_data_{split}0.h5", "w") as file:
            file["data"] = clouds
            file["label"] = (np.arange(count) % 40).astype(np.uint8)[:, None]
    return clouds


def rows(clouds, written):
    return [int(np.flatnonzero((written == cloud).all(axis=(1, 2)))[0]) for cloud in clouds]


@pytest.mark.parametrize("share", [0.05, 0.3, 0.001])
def test_validation_is_a_held_out_share_of_the_training_shapes(share, tmp_path):
    written = write_modelnet(tmp_path)
    config = DataConfig(validation_share=share)

    def load(split, seed=0):
        clouds, labels = load_shapes(config, split, root=tmp_path, points=8, seed=seed)
        found = rows(clouds, written)
        np.testing.assert_array_equal(labels, found)
        return found

    train, validation = load("train"), load("validation")
    assert train == sorted(train)
    assert sorted(train + validation) == list(range(40))
    assert len(validation) == max(1, round(40 * share))
    assert load("validation") == validation
    assert len({tuple(load("validation", seed)) for seed in range(5)}) > 1
    assert load("test") == list(range(40))


def test_categories_of_training_and_test(tmp_path):
    write_modelnet(tmp_path)
    config = DataConfig(train_categories="first20", test_categories="last20")
    labels = {
        split: set(load_shapes(config, split, root=tmp_path, points=8)[1].tolist())
        for split in ("train", "validation", "test")
    }
    assert labels["train"] | labels["validation"] == set(range(20))
    assert labels["test"] == set(range(20, 40))


def test_procedural_shapes_need_no_root_and_share_nothing():
    config = DataConfig(name="shapes", train_shapes=40, test_shapes=7, validation_share=0.1)
    loads = {s: load_shapes(config, s, points=16)[0] for s in ("train", "validation", "test")}
    assert [len(loads[s]) for s in ("train", "validation", "test")] == [40, 4, 7]
    assert len({tuple(c.ravel()) for clouds in loads.values() for c in clouds}) == 51
    other = load_shapes(config, "train", points=16, seed=1)[0]
    assert (other != loads["train"]).any()


@pytest.mark.parametrize(
    ("config", "validation_points", "reads"),
    [
        (DataConfig(), 8, 1),
        (DataConfig(), 4, 1),  # of these files every shape has as many points as it has
        (DataConfig(name="shapes", train_shapes=6), 4, 0),
    ],
)
def test_training_and_validation_come_from_one_reading(
    config, validation_points, reads, tmp_path, monkeypatch
):
    write_modelnet(tmp_path)
    sizes = {"train": 8, "validation": validation_points}
    apart = [
        load_shapes(config, split, root=tmp_path, points=number, seed=3)[0]
        for split, number in sizes.items()
    ]
    read, load = [], modelnet.load
    monkeypatch.setattr(modelnet, "load", lambda *a, **k: read.append(a) or load(*a, **k))
    together = load_training(
        config, root=tmp_path, points=8, validation_points=validation_points, seed=3
    )
    assert len(read) == reads
    for one, other in zip(apart, together, strict=True):
        np.testing.assert_array_equal(one, other)


def test_clouds_of_another_size_are_drawn_for_validation(tmp_path, seed):
    rng = np.random.default_rng(seed)
    for i in range(4):
        np.save(tmp_path / f"{i}.npy", rng.normal(size=(40, 3)))
    config = DataConfig(name="folder", folder=str(tmp_path), validation_share=0.4)
    for validation_points in (10, 20):
        clouds = load_training(config, points=20, validation_points=validation_points, seed=seed)
        assert [x.shape[1] for x in clouds] == [20, validation_points]
        apart = load_shapes(config, "validation", points=validation_points, seed=seed)[0]
        np.testing.assert_array_equal(clouds[1], apart)


@pytest.mark.parametrize("share", [0.0, 1.0, 0.999, -0.1])
def test_a_share_that_leaves_nothing(share, tmp_path):
    write_modelnet(tmp_path)
    with pytest.raises(ValueError, match="validation_share = .* leaves none on one side"):
        load_shapes(DataConfig(validation_share=share), "train", root=tmp_path, points=8)


def test_no_folder_is_known():
    with pytest.raises(
        ValueError, match=r"their folder is not known: give --data-root, set \$JAXREG_DATA"
    ):
        load_shapes(DataConfig(), "train", points=8)


@pytest.mark.parametrize("name", ["modelnet40", "seven_scenes", "icl_nuim"])
def test_missing_data_names_the_layout(name, tmp_path):
    with pytest.raises(ValueError, match="expected .*http|expected .*From"):
        load_shapes(DataConfig(name=name), "train", root=tmp_path, points=8)


@pytest.mark.untyped
def test_unknown_name_and_split(tmp_path):
    with pytest.raises(ValueError, match="data.name must be .* got 'scannet'"):
        load_shapes(DataConfig(name="scannet"), "train", root=tmp_path, points=8)
    with pytest.raises(ValueError, match="split must be .* got 'dev'"):
        load_shapes(DataConfig(), "dev", root=tmp_path, points=8)


def test_icl_nuim_and_the_stand_in_of_seven_scenes(tmp_path):
    (tmp_path / "train").mkdir()
    with h5py.File(tmp_path / "train" / "icl_nuim.h5", "w") as file:
        file["points"] = np.zeros((20, 8, 3), np.float32)
    assert load_shapes(DataConfig(name="icl_nuim"), "train", root=tmp_path, points=8)[0].shape == (
        19,
        8,
        3,
    )
    folder = tmp_path / "7scene" / "7-scenes-chess"
    folder.mkdir(parents=True)
    head = "ply\nformat ascii 1.0\nelement vertex 2\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    for i in range(10):
        (folder / f"cloud_bin_{i}.ply").write_text(f"{head}0 0 0\n1 2 {3 + i}\n")
    config = DataConfig(name="seven_scenes", train_draws=3, test_draws=2)
    for split, count in (("train", 3 * 7), ("validation", 3 * 1), ("test", 2 * 2)):
        assert len(load_shapes(config, split, root=tmp_path, points=8)[0]) == count


def test_no_fragment_is_both_trained_on_and_validated(tmp_path):
    folder = tmp_path / "7scene" / "7-scenes-chess"
    folder.mkdir(parents=True)
    head = "ply\nformat ascii 1.0\nelement vertex 2\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    for i in range(10):
        (folder / f"cloud_bin_{i}.ply").write_text(f"{head}0 0 0\n1 {2 + i} {30 + i}\n")
    (tmp_path / "7scene" / "7-scenes-office").mkdir()
    (tmp_path / "7scene" / "7-scenes-office" / "cloud_bin_0.ply").write_text(
        f"{head}0 0 0\n1 2 3\n"
    )
    config = DataConfig(name="seven_scenes", train_draws=4, validation_share=0.3)
    extents = {
        split: {
            round(float(np.ptp(cloud[:, 1])), 6)
            for cloud in load_shapes(config, split, root=tmp_path, points=2)[0]
        }
        for split in ("train", "validation")
    }
    assert (len(extents["train"]), len(extents["validation"])) == (7, 3)
    assert not extents["train"] & extents["validation"]


def test_the_label_of_the_test_data(tmp_path):
    (tmp_path / "stand_in" / "test").mkdir(parents=True)
    (tmp_path / "stand_in" / "test" / "icl_nuim.h5").touch()
    assert dataset_label(DataConfig(name="icl_nuim"), tmp_path) == "stand_in"
    assert dataset_label(DataConfig(name="icl_nuim", label="rooms"), tmp_path) == "rooms"
    assert dataset_label(DataConfig(name="shapes"), None) == "shapes"
    assert dataset_label(DataConfig(), tmp_path) == "modelnet40"


def test_root_by_argument_then_environment_then_beside_the_config(tmp_path, monkeypatch):
    folders = {name: tmp_path / name for name in ("argument", "environment", "data")}
    for folder in folders.values():
        folder.mkdir()
    config = tmp_path / "config.toml"
    monkeypatch.setenv("JAXREG_DATA", str(folders["environment"]))
    assert find_root(str(folders["argument"]), config) == folders["argument"]
    assert find_root(None, config) == folders["environment"]
    monkeypatch.delenv("JAXREG_DATA")
    assert find_root(None, config) == folders["data"]
    assert find_root(None, tmp_path / "elsewhere" / "config.toml") is None
    assert find_root() is None


def test_a_named_root_that_does_not_exist(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="--data-root is .*none, which is not a folder"):
        find_root(tmp_path / "none")
    monkeypatch.setenv("JAXREG_DATA", str(tmp_path / "none"))
    with pytest.raises(ValueError, match=r"\$JAXREG_DATA is .*none"):
        find_root()
