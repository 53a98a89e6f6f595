import h5py
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg.data import icl_nuim


def write_published(root, *, points=40, changes=()):
    rng = np.random.default_rng(0)
    source = rng.normal(size=(5, points, 3)).astype(np.float32)
    transform = np.tile(np.eye(4), (5, 1, 1))
    transform[:, :3, :3] = Rotation.random(5, rng=rng).as_matrix()
    transform[:, :3, 3] = rng.normal(size=(5, 3))
    target = np.einsum("nij,npj->npi", transform[:, :3, :3], source) + transform[:, None, :3, 3]
    arrays = {"source": source, "target": target.astype(np.float32), "transform": transform}
    for split in ("train", "test"):
        (root / split).mkdir(parents=True)
    with h5py.File(root / "train" / "icl_nuim.h5", "w") as file:
        file["points"] = rng.normal(size=(7, points, 3)).astype(np.float32)
    with h5py.File(root / "test" / "icl_nuim.h5", "w") as file:
        for key, value in (arrays | dict(changes)).items():
            if value is not None:
                file[key] = value
    return arrays


@pytest.mark.parametrize("folder", [".", "icl_nuim"])
@pytest.mark.parametrize("points", [40, 77])
def test_any_number_of_points_at_both_depths(folder, points, tmp_path):
    arrays = write_published(tmp_path / folder, points=points)
    train, labels = icl_nuim.load(tmp_path, "train")
    assert train.shape == (7, points, 3)
    assert (train.dtype, labels.dtype) == (np.float32, np.int32)
    np.testing.assert_array_equal(labels, np.zeros(7))
    np.testing.assert_array_equal(icl_nuim.load(tmp_path, "test")[0], arrays["source"])


def test_the_transform_maps_source_to_target(tmp_path):
    write_published(tmp_path)
    source, target, transform = icl_nuim.load_pairs(tmp_path)
    assert transform.dtype == np.float64
    for p, q, matrix in zip(source, target, transform, strict=True):
        moved = [matrix[:3, :3] @ x + matrix[:3, 3] for x in p.astype(np.float64)]
        np.testing.assert_allclose(moved, q, atol=1e-6)


@pytest.mark.parametrize(
    ("folder", "expected"), [(".", "icl_nuim"), ("icl_nuim", "icl_nuim"), ("mine", "mine")]
)
def test_figures_are_called_by_the_folder_of_the_files(folder, expected, tmp_path):
    write_published(tmp_path / folder)
    assert icl_nuim.label(tmp_path) == expected


SCALED = np.tile(np.eye(4), (5, 1, 1))
SCALED[3, :3, :3] *= 1.1
MIRRORED = np.tile(np.eye(4), (5, 1, 1))
MIRRORED[2, 0, 0] = -1
NOT_FINITE = np.tile(np.eye(4), (5, 1, 1))
NOT_FINITE[4, 0, 3] = np.nan


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"target": None}, "no array 'target'"),
        ({"source": np.zeros((5, 40), np.float32)}, r"'source' must be float \(n, P, 3\)"),
        ({"target": np.zeros((4, 40, 3), np.float32)}, "one row for each pair"),
        ({"transform": np.zeros((5, 3, 4))}, r"'transform' \(5, 3, 4\) must have one row"),
        ({"transform": SCALED}, "'transform' in row 3 is not rigid"),
        ({"transform": MIRRORED}, "'transform' in row 2 is not rigid"),
        ({"transform": NOT_FINITE}, "'transform' in row 4 is not rigid"),
    ],
)
def test_malformed_pairs(changes, message, tmp_path):
    write_published(tmp_path, changes=changes)
    with pytest.raises(ValueError, match=message):
        icl_nuim.load_pairs(tmp_path)


def test_missing_data_names_layout_and_source(tmp_path):
    with pytest.raises(ValueError, match=r"no ICL-NUIM train split in .*'points' \(n, P, 3\)") as e:
        icl_nuim.load(tmp_path, "train")
    assert "redwood-data.org" in str(e.value)


@pytest.mark.untyped
def test_unknown_split(tmp_path):
    with pytest.raises(ValueError, match="got 'validation'"):
        icl_nuim.load(tmp_path, "validation")


def test_files_at_hand(data_root):
    try:
        source, target, transform = icl_nuim.load_pairs(data_root)
    except ValueError as error:
        pytest.skip(str(error))
    moved = source[0] @ transform[0, :3, :3].T + transform[0, :3, 3]
    before, after = (cKDTree(target[0]).query(points)[0].mean() for points in (source[0], moved))
    assert after < 0.5 * before
    assert np.isfinite(icl_nuim.load(data_root, "train")[0]).all()
