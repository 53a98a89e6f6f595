import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from jaxreg.data import seven_scenes

POSE = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])


def write_fragment(folder, number, points, *, text=False, byte_order="<"):
    folder.mkdir(parents=True, exist_ok=True)
    vertex = np.array([tuple(p) for p in points], dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
    path = folder / f"cloud_bin_{number}.ply"
    PlyData([PlyElement.describe(vertex, "vertex")], text=text, byte_order=byte_order).write(path)
    info = "\n".join("\t ".join(f"{v:.8e}" for v in row) + "\t" for row in POSE)
    header = f"{folder.name}\t seq-01\t {50 * number}\t {50 * number + 49}\t\n"
    (folder / f"cloud_bin_{number}.info.txt").write_text(header + info + "\n")
    return path


@pytest.fixture
def write_scenes(tmp_path, seed):
    rng = np.random.default_rng(seed)

    def write(*scenes, fragments=11):
        clouds = {}
        for scene in scenes:
            for number in range(fragments):
                size = rng.integers(300, 400)
                points = rng.uniform(-1, 1, (size, 3)) * (1, 2, 3) + (10, 0, 5)
                folder = tmp_path / "7scene" / f"7-scenes-{scene}"
                write_fragment(folder, number, points)
                clouds[scene, number] = points.astype(np.float32)
        return clouds

    return write


def rows_of(sampled, cloud):
    distance = np.linalg.norm(sampled[:, None] - cloud[None], axis=2)
    assert distance.min(axis=1).max() < 1e-6
    return distance.argmin(axis=1)


def test_official_split_scale_and_order(write_scenes, tmp_path):
    written = write_scenes("chess", "office", "stairs")
    train, labels = seven_scenes.load(tmp_path, "train", points=200)
    assert train.shape == (22, 200, 3)
    assert train.dtype == np.float32
    np.testing.assert_array_equal(labels, [0] * 11 + [6] * 11)
    test, labels = seven_scenes.load(tmp_path, "test", points=200)
    np.testing.assert_array_equal(labels, [seven_scenes.SCENES.index("office")] * 11)
    for number in (0, 2, 10):  # Order by number: 10 comes after 9, not after 1.
        cloud = written["office", number].astype(np.float64)
        expected = (cloud - cloud.mean(axis=0)) / np.ptp(cloud, axis=0).max()
        rows = rows_of(test[number], expected)
        assert len(set(rows)) == 200


def test_small_fragments_are_repeated(write_scenes, tmp_path):
    write_scenes("chess", fragments=1)
    clouds, _ = seven_scenes.load(tmp_path, "train", points=1000)
    assert clouds.shape == (1, 1000, 3)
    assert 250 < len(np.unique(clouds[0], axis=0)) < 400


def test_resampling_is_seeded(write_scenes, tmp_path):
    write_scenes("chess", fragments=2)
    one, same, other = (
        seven_scenes.load(tmp_path, "train", points=64, seed=s)[0] for s in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


def test_draws_of_a_fragment_stand_together_and_differ(write_scenes, tmp_path):
    written = write_scenes("chess", fragments=2)
    clouds, labels = seven_scenes.load(tmp_path, "train", points=200, draws=3)
    assert clouds.shape == (6, 200, 3)
    assert labels.shape == (6,)
    for number in range(6):
        cloud = written["chess", number // 3].astype(np.float64)
        rows_of(clouds[number], (cloud - cloud.mean(axis=0)) / np.ptp(cloud, axis=0).max())
    assert len({tuple(cloud[0]) for cloud in clouds}) == 6


@pytest.mark.parametrize(
    ("scenes", "expected"),
    [
        (("chess", "office"), "seven_scenes"),
        (("chess", "stairs"), "seven_scenes stand-in (chess, stairs)"),
    ],
)
def test_the_label_tells_a_stand_in(write_scenes, tmp_path, scenes, expected):
    write_scenes(*scenes, fragments=1)
    assert seven_scenes.label(tmp_path) == expected


def test_absent_scenes_are_named_and_the_stand_in_is_offered(write_scenes, tmp_path):
    write_scenes("chess", "redkitchen")
    text = seven_scenes.describe(tmp_path)
    assert "found chess, redkitchen; absent: fire, heads, office, pumpkin, stairs." in text
    assert "stand-in split" in text
    with pytest.raises(ValueError, match="no fragment for the test split.*office.*stand_in=True"):
        seven_scenes.load(tmp_path, "test", points=64)
    train = seven_scenes.split_files(tmp_path, "train", stand_in=True)
    test = seven_scenes.split_files(tmp_path, "test", stand_in=True)
    names = [f"cloud_bin_{i}" for i in range(11)]
    assert [path.stem for _, path in test] == 2 * names[9:]
    assert [path.stem for _, path in train] == 2 * names[:9]
    assert len(seven_scenes.load(tmp_path, "train", points=64)[0]) == 22


def test_all_scenes_present(write_scenes, tmp_path):
    write_scenes(*seven_scenes.SCENES, fragments=1)
    assert seven_scenes.describe(tmp_path).endswith("all scenes are present.")


def test_no_scene_names_layout_and_source(tmp_path):
    with pytest.raises(ValueError, match=r"no 7Scenes in .*7scene/7-scenes-.*3dmatch") as error:
        seven_scenes.find_scenes(tmp_path)
    assert "github.com/XiaoshuiHuang/fmr" in str(error.value)


@pytest.mark.untyped
def test_unknown_split(tmp_path):
    with pytest.raises(ValueError, match="got 'validation'"):
        seven_scenes.load(tmp_path, "validation", points=64)


@pytest.mark.parametrize(("text", "byte_order"), [(False, "<"), (False, ">"), (True, "=")])
def test_every_kind_of_ply(text, byte_order, tmp_path, seed):
    points = np.random.default_rng(seed).normal(size=(5, 3)).astype(np.float32)
    path = write_fragment(tmp_path, 0, points, text=text, byte_order=byte_order)
    np.testing.assert_allclose(seven_scenes.read_fragment(path), points, rtol=1e-5)


def test_pose_of_a_fragment(tmp_path):
    path = write_fragment(tmp_path, 3, np.zeros((1, 3)))
    np.testing.assert_array_equal(seven_scenes.read_pose(path), POSE)
    path.with_name("cloud_bin_3.info.txt").write_text("scene\n1 2 3\n")
    with pytest.raises(ValueError, match=r"cloud_bin_3\.info\.txt must contain one line"):
        seven_scenes.read_pose(path)
    path.with_name("cloud_bin_3.info.txt").unlink()
    with pytest.raises(ValueError, match=r"cloud_bin_3\.info\.txt must contain one line"):
        seven_scenes.read_pose(path)


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("text", [False, True])
def test_truncated_ply(kept, text, tmp_path):
    path = write_fragment(tmp_path, 0, np.ones((50, 3)) * 0.123, text=text)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(ValueError, match=r"cloud_bin_0\.ply.*(empty|truncated).*again"):
        seven_scenes.read_fragment(path)


def test_malformed_fragments(tmp_path):
    with pytest.raises(ValueError, match=r"cloud_bin_7\.ply: no such file"):
        seven_scenes.read_fragment(tmp_path / "cloud_bin_7.ply")
    path = write_fragment(tmp_path, 0, np.zeros((0, 3)))
    with pytest.raises(ValueError, match=r"cloud_bin_0\.ply contains no points"):
        seven_scenes.read_fragment(path)
    path = write_fragment(tmp_path, 0, [(0, 0, 0), (0, np.nan, 0)])
    with pytest.raises(ValueError, match=r"cloud_bin_0\.ply: vertex 1 is not finite"):
        seven_scenes.read_fragment(path)
    vertex = np.zeros(3, dtype=[("x", "f4"), ("y", "f4")])
    PlyData([PlyElement.describe(vertex, "vertex")]).write(path)
    with pytest.raises(ValueError, match="vertices lack x, y or z"):
        seven_scenes.read_fragment(path)


def test_coincident_points(tmp_path):
    write_fragment(tmp_path / "7scene" / "7-scenes-fire", 0, np.ones((9, 3)))
    with pytest.raises(ValueError, match=r"cloud_bin_0\.ply: all points coincide"):
        seven_scenes.load(tmp_path, "train", points=4)


def test_real_fragments(data_root):
    if not (data_root / "7scene").is_dir():
        pytest.skip("no 7scene/ in the folder that JAXREG_DATA names")
    clouds, labels = seven_scenes.load(data_root, "train", points=2048)
    assert clouds.shape[1:] == (2048, 3)
    assert np.isfinite(clouds).all()
    assert np.ptp(clouds, axis=1).max(axis=1) == pytest.approx(1, abs=0.05)
    np.testing.assert_allclose(clouds.mean(axis=1), 0, atol=0.03)
    for _, path in seven_scenes.split_files(data_root, "train"):
        rotation = seven_scenes.read_pose(path)[:3, :3]
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-6)
