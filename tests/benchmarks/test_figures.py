"""The pictures of the documentation: what they show is true, and the files are there."""

import json

import numpy as np
import pytest
from matplotlib.image import imread

from benchmarks import figures, search_figure
from jaxreg.config import PairConfig
from jaxreg.types import RigidTransform

pytestmark = [pytest.mark.float32, pytest.mark.loose]

SMALL = PairConfig(points=400, kept=300)
CHAIR = figures.FAMILIES.index("chair")


def test_a_registered_pair_lies_where_its_error_says(tmp_path):
    pair = figures.sample_pair(CHAIR, SMALL, 0)
    [found] = figures.register([pair], "modelnet40")
    moved = found.pair.source.points @ found.pair.transform.rotation.T
    moved = moved + found.pair.transform.translation
    assert found.error_deg < 1  # 300 points are few for this network
    np.testing.assert_allclose(found.aligned, moved, atol=0.01)
    assert found.confidence.shape == (300,)
    figures.draw_pairs([found], ["chair"], tmp_path / "pairs.png", "title")
    picture = imread(tmp_path / "pairs.png")[..., :3]
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100


@pytest.mark.slow
def test_the_best_match_of_an_exact_copy_is_the_copy():
    pair = figures.sample_pair(CHAIR, PairConfig(points=400, kept=400, crop="none"), 0)
    column, good = figures.best_matches(pair, "modelnet40", "self")
    assert good.mean() > 0.9
    moved = np.asarray(pair.source.points) @ np.asarray(pair.transform.rotation).T
    moved = moved + np.asarray(pair.transform.translation)
    apart = np.linalg.norm(moved[:, None] - np.asarray(pair.reference.points)[None], axis=2)
    np.testing.assert_array_equal(column[good], apart.argmin(axis=1)[good])


def test_the_drift_of_runs_is_read_from_their_logs(tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        lines = [{"step": i, "loss": 1 / (i + 1), "val_mie_r_deg": 2.0 - i / 40} for i in range(40)]
        log = "\n".join(json.dumps(line) for line in lines)
        (tmp_path / name / "metrics.jsonl").write_text(log)
    runs = tuple(str(tmp_path / name) for name in ("one", "two"))
    options = figures.Options(folder=str(tmp_path), only=("drift",), runs=runs)
    figures.draw("drift", options)
    assert imread(tmp_path / "drift.png").shape[1] == 1080


def test_a_pose_that_repeats_another_is_not_counted():
    shift = np.array([[0.0, 0, 0], [0.05, 0, 0], [0.2, 0, 0], [0.2, 0, 0]])
    turn = np.stack([np.eye(3)] * 3 + [np.diag([1.0, -1, -1])])
    counted = search_figure.distinct(RigidTransform(turn, shift))
    np.testing.assert_array_equal(counted, [True, False, True, True])
