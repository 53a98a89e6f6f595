"""Your own files: which belong to a split, what becomes of them, and clear errors."""

import gzip

import numpy as np
import pytest

from jaxreg import io
from jaxreg.config import DataConfig
from jaxreg.data import folder, load_shapes


@pytest.fixture
def scans(tmp_path, seed):
    """Twelve clouds in metres far from the origin, in several formats; notes beside them."""
    rng = np.random.default_rng(seed)
    suffixes = (".ply", ".xyz", ".npy", ".pcd")
    for i in range(12):
        cloud = rng.normal(size=(60, 3)) * [30, 20, 5] + [5e5 + i, 0, 100]
        io.write_cloud(tmp_path / f"scan_{i}{suffixes[i % 4]}", cloud)
    (tmp_path / "notes.md").write_text("not a cloud")
    return tmp_path


def test_the_last_files_by_number_are_for_the_test(scans):
    train = folder.split_files(scans, "train", test_share=0.25)
    test = folder.split_files(scans, "test", test_share=0.25)
    assert [path.stem for path in test] == ["scan_9", "scan_10", "scan_11"]
    assert [path.stem for path in train] == [f"scan_{i}" for i in range(9)]


def test_packed_clouds_are_files_and_folders_are_none(tmp_path):
    for i in range(3):
        io.write_cloud(tmp_path / f"{i}.xyz", np.random.default_rng(i).normal(size=(9, 3)))
    (tmp_path / "3.XYZ.GZ").write_bytes(gzip.compress((tmp_path / "2.xyz").read_bytes()))
    (tmp_path / "notes.md.gz").write_bytes(gzip.compress(b"not a cloud"))
    (tmp_path / "4.ply").mkdir()
    io.write_cloud(tmp_path / "4.ply" / "inside.npy", np.random.default_rng(4).normal(size=(9, 3)))
    train, test = (folder.split_files(tmp_path, s, test_share=0.5) for s in ("train", "test"))
    names = [str(path.relative_to(tmp_path)) for path in (*train, *test)]
    assert names == ["0.xyz", "1.xyz", "2.xyz", "3.XYZ.GZ", "4.ply/inside.npy"]
    clouds, _ = folder.load(tmp_path, "test", points=9, test_share=0.5)
    assert clouds.shape == (2, 9, 3)


def test_raised_digits_in_names_are_no_numbers(tmp_path):
    for name in ("m2²_9.xyz", "m2²_10.xyz"):
        io.write_cloud(tmp_path / name, np.eye(3))
    (held,) = folder.split_files(tmp_path, "test", test_share=0.5)
    assert held.name == "m2²_10.xyz"


def test_folders_train_and_test_are_the_split(scans):
    for name, numbers in (("train", range(8)), ("test", range(8, 12))):
        (scans / name / "deeper").mkdir(parents=True)
        for i in numbers:
            path = next(scans.glob(f"scan_{i}.*"))
            path.rename(scans / name / "deeper" / path.name)
    io.write_cloud(scans / "beside.ply", np.eye(3))
    found = {
        split: [path.stem for path in folder.split_files(scans, split, test_share=0.2)]
        for split in ("train", "test")
    }
    assert found == {
        "train": [f"scan_{i}" for i in range(8)],
        "test": [f"scan_{i}" for i in range(8, 12)],
    }


def test_clouds_fill_the_unit_sphere_with_points_of_the_file(scans):
    clouds, labels = folder.load(scans, "test", points=40, test_share=0.1, seed=3)
    assert clouds.shape == (1, 40, 3)
    assert clouds.dtype == np.float32
    np.testing.assert_array_equal(labels, [0])
    assert np.linalg.norm(clouds[0], axis=1).max() == pytest.approx(1, abs=1e-6)
    original = io.read_cloud(scans / "scan_11.pcd")
    # Similar: the rows drawn are those of the file, moved and scaled and nothing else.
    shift, size = original.mean(axis=0), np.linalg.norm(original - original.mean(axis=0), axis=1)
    candidates = [(original - shift) / radius for radius in size]
    errors = [
        np.linalg.norm(clouds[0][:, None] - scaled[None], axis=2).min(axis=1).max()
        for scaled in candidates
    ]
    assert min(errors) < 1e-5
    assert len(np.unique(clouds[0], axis=0)) == 40, "without replacement"


def test_the_same_seed_draws_the_same_points(scans):
    one, two, other = (
        folder.load(scans, "train", points=20, test_share=0.2, seed=seed)[0] for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, two)
    assert not np.array_equal(one, other)


def test_repeated_and_non_finite_points_are_left_out(tmp_path):
    points = np.random.default_rng(0).normal(size=(30, 3))
    io.write_cloud(tmp_path / "a.npy", np.concatenate([points, points, [[np.nan, 0, 0]]]))
    io.write_cloud(tmp_path / "b.npy", points)
    clouds, _ = folder.load(tmp_path, "train", points=30, test_share=0.5)
    assert len(np.unique(clouds[0], axis=0)) == 30
    with pytest.raises(
        ValueError, match=r"a.npy has 30 distinct points, but pairs need 31: set --pairs"
    ):
        folder.load(tmp_path, "train", points=31, test_share=0.5)


def test_validation_is_part_of_the_training_files(scans):
    config = DataConfig(name="folder", folder=str(scans), test_share=0.25, validation_share=0.2)
    sizes = {
        split: len(load_shapes(config, split, points=16)[0])
        for split in ("train", "validation", "test")
    }
    assert sizes == {"train": 7, "validation": 2, "test": 3}


def test_what_is_missing_is_named(tmp_path, scans):
    with pytest.raises(
        ValueError, match="there is no folder .*nowhere: name yours with --data.folder"
    ):
        folder.load(tmp_path / "nowhere", "train", points=4, test_share=0.2)
    (tmp_path / "void").mkdir()
    with pytest.raises(ValueError, match=r"no cloud in .*void: expected files .ply"):
        folder.load(tmp_path / "void", "train", points=4, test_share=0.2)
    for share in (0.0, 1.0, 0.99):
        with pytest.raises(ValueError, match=r"12 file\(s\).* leaves none on one side"):
            folder.load(scans, "test", points=4, test_share=share)
    with pytest.raises(ValueError, match=r"no folder given: name yours with --data.folder"):
        load_shapes(DataConfig(name="folder"), "train", points=4)
    (scans / "scan_3.pcd").write_bytes(b"broken")
    with pytest.raises(ValueError, match="scan_3.pcd"):
        folder.load(scans, "train", points=4, test_share=0.2)
