"""An evaluation shared by processes is, to the bit, the one that a single process makes."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest

from jaxreg.config import Config, DataConfig, ModelConfig, PairConfig
from jaxreg.evaluation import score
from jaxreg.evaluation.parts import Parts, digest
from jaxreg.network.model import init_variables
from jaxreg.weights.checkpoint import open_run
from jaxreg.weights.released import save_weights

pytestmark = pytest.mark.float32

CONFIG = Config(
    data=DataConfig(name="shapes", test_shapes=7), test_pairs=PairConfig(points=24, kept=18)
)


def evaluated(parts=None, **options):
    return score.evaluate(CONFIG, method="icp", batch=2, parts=parts, **options)


def same(one, other):
    for a, b in zip((*one.predicted, *one.truth), (*other.predicted, *other.truth), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(one.first.source.points, other.first.source.points)


def files(folder):
    return sorted(path.name for path in folder.glob("batch_*.npz"))


def test_three_processes_find_what_one_finds(tmp_path):
    whole = evaluated()
    shares = [Parts(tmp_path, number, 3) for number in range(3)]
    assert evaluated(shares[2]) is None
    assert evaluated(shares[0]) is None
    assert files(tmp_path) == ["batch_000000.npz", "batch_000002.npz", "batch_000003.npz"]
    same(evaluated(shares[1]), whole)
    assert score.figures(evaluated(shares[1]))["pairs"] == 7


def test_what_a_killed_process_had_done_is_not_done_again(tmp_path, monkeypatch):
    whole, done = evaluated(), []
    keep = Parts.keep

    def dies(self, number, found):
        if number == 2:
            raise KeyboardInterrupt
        keep(self, number, found)

    monkeypatch.setattr(Parts, "keep", dies)
    with pytest.raises(KeyboardInterrupt):
        evaluated(Parts(tmp_path))
    assert len(files(tmp_path)) == 2
    monkeypatch.setattr(Parts, "keep", lambda *x: (done.append(x[1]), keep(*x)))
    same(evaluated(Parts(tmp_path)), whole)
    assert done == [2, 3]


def test_half_a_file_is_no_batch(tmp_path, monkeypatch):
    """A process that dies while it writes leaves nothing that another would read."""
    monkeypatch.setattr(np, "savez", lambda file, **_: (file.write(b"half"), 1 / 0))
    with pytest.raises(ZeroDivisionError):
        evaluated(Parts(tmp_path))
    assert files(tmp_path) == []
    monkeypatch.undo()
    assert evaluated(Parts(tmp_path)) is not None


def test_a_refined_batch_gets_its_own_poses(tmp_path):
    poses = tmp_path / "poses.npz"
    score.save_transforms(poses, evaluated().truth)
    options = {"transforms": str(poses), "refine": "icp", "batch": 2}
    whole = score.evaluate(CONFIG, **options)
    assert score.evaluate(CONFIG, **options, parts=Parts(tmp_path / "p", 1, 2)) is None
    same(score.evaluate(CONFIG, **options, parts=Parts(tmp_path / "p", 0, 2)), whole)


@pytest.mark.parametrize("change", [{"pairs": 3}, {"batch": 4}, {"method": "identity"}])
def test_parts_of_another_evaluation_are_not_mixed_in(tmp_path, change):
    evaluated(Parts(tmp_path))
    options = {"method": "icp", "batch": 2} | change
    with pytest.raises(ValueError, match="holds parts of another evaluation"):
        score.evaluate(CONFIG, parts=Parts(tmp_path), **options)
    assert json.loads((tmp_path / "evaluation.json").read_text())["batch"] == 2


SMALL = Config(
    model=ModelConfig(k=3, k_matching=3, channels=(4,), width=4, n_inliers=8, iterations=1)
)
IDLE = 999, 1000
"""Of seven pairs this process has none, so that it opens the folder and registers nothing."""


def trained(place, seed, step=0):
    """Weights of a small network, as two files or as the best checkpoint of a run."""
    variables = init_variables(jax.random.key(seed), SMALL.model)
    if step:
        with open_run(place, SMALL) as run:
            run.save(step, {"step": np.int32(step), "average": variables}, 1 / step)
    else:
        save_weights(place, "mine", jax.tree.map(np.asarray, variables), SMALL, {})


def clouds(folder, seed):
    """Five files of clouds, the last one the test; only it depends on the seed."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(5):
        rng = np.random.default_rng(k if k < 4 else seed)
        np.save(folder / f"{k}.npy", rng.normal(size=(40, 3)))


def opened(folder, share=IDLE, config=CONFIG, **options):
    assert score.evaluate(config, batch=2, parts=Parts(folder, *share), **options) is None


def test_parts_of_the_same_checkpoint_before_more_training_are_not_mixed_in(tmp_path):
    run, share = tmp_path / "run", tmp_path / "p"
    trained(run, 1, step=1)
    for _ in range(2):
        opened(share, method=f"checkpoint:{run}")
    trained(run, 2, step=2)
    with pytest.raises(ValueError, match=r"another evaluation \(with another weights; .*json says"):
        opened(share, method=f"checkpoint:{run}")


def test_parts_of_other_weights_in_the_same_file_are_not_mixed_in(tmp_path):
    name = f"weights:{tmp_path / 'mine'}"
    trained(tmp_path, 1)
    opened(tmp_path / "p", method=name)
    trained(tmp_path, 2)
    with pytest.raises(ValueError, match="with another weights;"):
        opened(tmp_path / "p", method=name)


def test_parts_of_other_transforms_in_the_same_file_are_not_mixed_in(tmp_path):
    poses = tmp_path / "poses.npz"
    options = {"transforms": str(poses), "refine": "icp"}
    for shift, refused in ((0, False), (1, True)):
        np.savez(poses, rotation=np.tile(np.eye(3), (7, 1, 1)), translation=np.full((7, 3), shift))
        if refused:
            with pytest.raises(ValueError, match="with another transforms;"):
                opened(tmp_path / "p", **options)
        else:
            opened(tmp_path / "p", **options)


def of_folder(folder):
    data = DataConfig(name="folder", folder=str(folder))
    return dataclasses.replace(CONFIG, data=data)


def test_parts_of_other_clouds_in_the_same_folder_are_not_mixed_in(tmp_path):
    clouds(tmp_path / "c", 7)
    opened(tmp_path / "p", config=of_folder(tmp_path / "c"), method="identity")
    clouds(tmp_path / "c", 8)
    with pytest.raises(ValueError, match="with another data;"):
        opened(tmp_path / "p", config=of_folder(tmp_path / "c"), method="identity")


def test_parts_of_another_version_are_not_mixed_in(tmp_path, monkeypatch):
    opened(tmp_path / "p", method="identity")
    monkeypatch.setattr(score, "__version__", "0.0.9")
    with pytest.raises(ValueError, match="with another version;"):
        opened(tmp_path / "p", method="identity")


def test_the_same_files_at_other_paths_are_the_same_evaluation(tmp_path):
    """As on hosts that mount a disk at different places."""
    here, there = tmp_path / "here", tmp_path / "there"
    clouds(here / "clouds", 7)
    trained(here / "run", 1, step=1)
    trained(here / "weights", 2)
    shutil.copytree(here, there)
    for host in (here, there):
        config = of_folder(host / "clouds")
        opened(tmp_path / "p", config=config, method=f"checkpoint:{host / 'run'}")
        config = dataclasses.replace(config, weights=str(host / "weights" / "mine"))
        opened(tmp_path / "q", config=config)


def test_a_digest_tells_names_kinds_and_numbers_apart():
    one = {"a": np.zeros((2, 3), np.float32), "b": np.ones(2)}
    others = [
        {"a": one["a"], "c": one["b"]},
        {"a": one["a"].reshape(3, 2), "b": one["b"]},
        {"a": one["a"].astype(np.int32), "b": one["b"]},
        {"a": one["a"], "b": np.array([1, np.nextafter(1, 2)])},
    ]
    assert digest(one) == digest({"b": np.ones(4)[::2], "a": jax.numpy.zeros((2, 3))})
    assert len({digest(one), *map(digest, others)}) == 5


def test_a_record_that_is_damaged_is_told(tmp_path):
    (tmp_path / "evaluation.json").write_text("[1")
    with pytest.raises(ValueError, match="its record is damaged; .*give another folder, or delete"):
        opened(tmp_path, method="identity")


def test_the_pairs_of_a_short_batch_are_counted_as_they_are(tmp_path, capsys):
    """Seven pairs in batches of two: this process has the last batch, and another one."""
    score.evaluate(CONFIG, method="identity", batch=2, parts=Parts(tmp_path, 1, 2))
    assert "identity: 3 pairs in" in capsys.readouterr().out


def test_a_number_that_is_none_of_the_processes_is_refused(tmp_path):
    with pytest.raises(ValueError, match="process 3 of 3: .* from 0 to 2"):
        evaluated(Parts(tmp_path, 3, 3))
