"""An evaluation shared by processes is, to the bit, the one that a single process makes."""

import json

import numpy as np
import pytest

from jaxreg.config import Config, DataConfig, PairConfig
from jaxreg.evaluation import score
from jaxreg.evaluation.parts import Parts

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


def test_a_number_that_is_none_of_the_processes_is_refused(tmp_path):
    with pytest.raises(ValueError, match="process 3 of 3: .* from 0 to 2"):
        evaluated(Parts(tmp_path, 3, 3))
