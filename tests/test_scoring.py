"""One score for every method: names, files of transforms, and what is refused."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg import scoring
from jaxreg.config import PairConfig, from_dict
from tests.data.test_icl_nuim import write_published

pytestmark = pytest.mark.float32

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def config():
    return from_dict(
        {"data": {"name": "shapes", "test_shapes": 3}, "pairs": {"points": 32, "kept": 24}}
    )


def test_transforms_of_another_program_are_scored_like_our_own(config, tmp_path):
    saved = tmp_path / "identity.npz"
    ours = scoring.score(config, method="identity", batch=2, save_transforms=str(saved))
    theirs = scoring.score(config, transforms=str(saved), batch=3)
    assert ours["pairs"] == theirs["pairs"] == 3
    metrics = [name for name in ours if name not in ("method", "seconds_per_pair")]
    assert {name: ours[name] for name in metrics} == {name: theirs[name] for name in metrics}
    # The identity is wrong by the angle of each true rotation, and by the true translation.
    truth = scoring.evaluation.true_transforms(scoring.pair_stream(config, root=None)[1])
    angles = np.degrees(np.arccos((np.trace(truth.rotation, axis1=1, axis2=2) - 1) / 2))
    assert ours["mie_r_deg"] == pytest.approx(angles.mean(), rel=1e-4)
    assert ours["mae_t"] == pytest.approx(np.abs(truth.translation).mean(), rel=1e-5)


def test_refined_transforms_of_another_program_are_those_of_the_refined_method(config, tmp_path):
    saved = str(tmp_path / "identity.npz")
    scoring.score(config, method="identity", save_transforms=saved)
    ours = scoring.score(config, method="identity", refine="icp", batch=2)
    theirs = scoring.score(config, transforms=saved, refine="icp", batch=2)
    assert theirs["method"] == "transforms of identity.npz + icp"
    assert theirs["seconds_per_pair"] > 0
    metrics = [name for name in ours if name not in ("method", "seconds_per_pair")]
    assert {name: ours[name] for name in metrics} == {name: theirs[name] for name in metrics}


@pytest.mark.parametrize("refine", ["icp", "point_to_plane", "gicp"])
def test_refinement_leaves_a_right_pose_where_it_is(config, tmp_path, refine):
    """Of partial copies: what has no counterpart must not draw the pose away."""
    partial = dataclasses.replace(
        config,
        data=dataclasses.replace(config.data, test_shapes=12),
        test_pairs=PairConfig(points=256, kept=192),
    )
    truth = scoring.evaluation.true_transforms(scoring.pair_stream(partial, root=None)[1])
    np.savez(tmp_path / "true.npz", **truth._asdict())
    found = scoring.score(partial, transforms=str(tmp_path / "true.npz"), refine=refine)
    assert found["worst_rre_deg"] < 0.01


def test_saved_pairs_are_the_evaluated_ones(config, tmp_path):
    _, stream = scoring.pair_stream(config, root=None, batch=2)
    scoring.save_pairs(str(tmp_path / "pairs.npz"), stream)
    truth = scoring.evaluation.true_transforms(scoring.pair_stream(config, root=None)[1])
    with np.load(tmp_path / "pairs.npz", allow_pickle=False) as pairs:
        source, reference = pairs["source"][0], pairs["reference"][0]
    moved = source @ truth.rotation[0].T + truth.translation[0]
    distance = np.linalg.norm(moved[:, None] - reference[None], axis=2).min(axis=1)
    assert np.mean(distance < 1e-5) > 0.5, "most points of a pair are exact copies"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "icp", "checkpoint": "x"}, "choose one of"),
        ({}, "choose one of"),
        ({"method": "magic"}, "magic"),
        ({"method": "icp", "refine": "magic"}, "no refinement 'magic': choose one of icp"),
        ({"transforms": "nowhere.npz"}, "nowhere.npz must be an NPZ file"),
        ({"checkpoint": "nowhere"}, "no checkpoint in nowhere"),
    ],
)
def test_what_cannot_be_scored_says_why(config, options, message):
    with pytest.raises(ValueError, match=message):
        scoring.score(config, **options)


def test_transforms_of_the_wrong_number_are_refused(config, tmp_path):
    np.savez(tmp_path / "two.npz", rotation=np.zeros((2, 3, 3)), translation=np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"3 pairs need rotation \(3, 3, 3\)"):
        scoring.score(config, transforms=str(tmp_path / "two.npz"))


def test_a_refined_method_says_so_and_is_better(config):
    easy = dataclasses.replace(config, test_pairs=PairConfig(32, crop="none", rotation_max_deg=3))
    plain, refined = (
        scoring.score(easy, method="identity", refine=refine) for refine in ("", "icp")
    )
    assert refined["method"] == "identity + icp"
    assert refined["mie_r_deg"] < plain["mie_r_deg"]


def test_pairs_of_a_file_are_scored_in_their_own_pose(tmp_path):
    arrays = write_published(tmp_path / "rooms", points=40)
    config = from_dict(
        {"data": {"name": "icl_nuim", "test_pairs_from": "file"}, "test_pairs": {"kept": 30}}
    )
    result = scoring.score(config, root=tmp_path, method="identity", pairs=4)
    angles = np.degrees(Rotation.from_matrix(arrays["transform"][:4, :3, :3]).magnitude())
    assert (result["dataset"], result["pairs"]) == ("rooms", 4)
    assert result["mie_r_deg"] == pytest.approx(angles.mean(), rel=1e-5)
    with pytest.raises(ValueError, match="needs data.name = 'icl_nuim'"):
        scoring.score(from_dict({"data": {"test_pairs_from": "file"}}), method="icp")


def run(script, *arguments):
    command = [sys.executable, str(ROOT / script), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


def test_the_command_prints_a_table_and_writes_the_figures(tmp_path):
    out = tmp_path / "r.json"
    toml = tmp_path / "c.toml"
    toml.write_text('[data]\nname = "shapes"\ntest_shapes = 2\n[pairs]\npoints = 32\nkept = 24\n')
    done = run("evaluate.py", toml, "--method", "identity", "--json", out)
    assert done.returncode == 0, done.stderr
    assert "MAE(R) deg" in done.stdout
    figures = json.loads(out.read_text())
    names = {"method", "config", "dataset", "pairs", "mae_r_deg", "mae_t", "mie_r_deg"}
    names |= {"mie_r_deg_float32_acos", "mie_t", "median_rre_deg", "median_rte"}
    assert names | {"recall_1deg", "recall_5deg", "seconds_per_pair"} <= set(figures)


def test_a_mistake_on_the_command_line_is_one_line(tmp_path):
    toml = tmp_path / "c.toml"
    toml.write_text("[model]\nalpah = 1.0\n")
    done = run("evaluate.py", toml)
    assert done.returncode == 2
    assert "did you mean 'alpha'" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("script", ["train.py", "evaluate.py"])
def test_data_that_is_not_there_is_one_line_and_status_2(tmp_path, script):
    toml = tmp_path / "c.toml"
    toml.write_text('[data]\nname = "modelnet40"\n')
    done = run(script, toml, "--data-root", tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ")
    assert len(done.stderr.splitlines()) == 1
