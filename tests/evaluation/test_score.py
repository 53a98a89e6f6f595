"""One score for every method: names, files of transforms, and what is refused."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.config import PairConfig, from_dict
from jaxreg.data.batches import true_transforms
from jaxreg.evaluation import score
from jaxreg.types import RigidTransform
from tests.data.test_icl_nuim import write_published

pytestmark = pytest.mark.float32

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def config():
    return from_dict(
        {"data": {"name": "shapes", "test_shapes": 3}, "pairs": {"points": 32, "kept": 24}}
    )


def scored(config, **options):
    return score.figures(score.evaluate(config, **options))


def test_transforms_of_another_program_are_scored_like_our_own(config, tmp_path):
    saved = tmp_path / "identity.npz"
    found = score.evaluate(config, method="identity", batch=2)
    score.save_transforms(saved, found.predicted)
    ours = score.figures(found)
    theirs = scored(config, transforms=str(saved), batch=3)
    assert ours["pairs"] == theirs["pairs"] == 3
    metrics = [name for name in ours if name not in ("method", "seconds_per_pair")]
    assert {name: ours[name] for name in metrics} == {name: theirs[name] for name in metrics}
    # The identity is wrong by the angle of each true rotation, and by the true translation.
    truth = true_transforms(score.pair_stream(config, root=None).batches())
    angles = np.degrees(np.arccos((np.trace(truth.rotation, axis1=1, axis2=2) - 1) / 2))
    assert ours["mie_r_deg"] == pytest.approx(angles.mean(), rel=1e-4)
    assert ours["mae_t"] == pytest.approx(np.abs(truth.translation).mean(), rel=1e-5)


def test_refined_transforms_of_another_program_are_those_of_the_refined_method(config, tmp_path):
    saved = str(tmp_path / "identity.npz")
    score.save_transforms(saved, score.evaluate(config, method="identity").predicted)
    ours = scored(config, method="identity", refine="icp", batch=2)
    theirs = scored(config, transforms=saved, refine="icp", batch=2)
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
    truth = true_transforms(score.pair_stream(partial, root=None).batches())
    np.savez(tmp_path / "true.npz", **truth._asdict())
    found = scored(partial, transforms=str(tmp_path / "true.npz"), refine=refine)
    assert found["worst_rre_deg"] < 0.01


def test_saved_pairs_are_the_evaluated_ones(config, tmp_path):
    stream = score.pair_stream(config, root=None, batch=2).batches()
    score.save_pairs(str(tmp_path / "pairs.npz"), stream)
    truth = true_transforms(score.pair_stream(config, root=None).batches())
    with np.load(tmp_path / "pairs.npz", allow_pickle=False) as pairs:
        source, reference = pairs["source"][0], pairs["reference"][0]
    moved = source @ truth.rotation[0].T + truth.translation[0]
    distance = np.linalg.norm(moved[:, None] - reference[None], axis=2).min(axis=1)
    assert np.mean(distance < 1e-5) > 0.5, "most points of a pair are exact copies"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "icp", "transforms": "x"}, "both a method .* are given: choose one"),
        ({}, "nothing to evaluate: .*Methods: identity, icp, register"),
        ({"method": "magic"}, "no method 'magic': choose one of identity"),
        ({"method": "icp", "refine": "magic"}, "no refinement 'magic': choose one of icp"),
        ({"transforms": "nowhere.npz"}, "nowhere.npz: no such file; give an NPZ file with"),
        ({"transforms": str(ROOT / "LICENSE")}, "LICENSE is not an .npz of arrays"),
        ({"method": "checkpoint:nowhere"}, "no checkpoint in nowhere"),
    ],
)
def test_what_cannot_be_scored_says_why(config, options, message):
    with pytest.raises(ValueError, match=message):
        scored(config, **options)


def test_transforms_of_the_wrong_number_are_refused(config, tmp_path):
    np.savez(tmp_path / "two.npz", rotation=np.zeros((2, 3, 3)), translation=np.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"3 pairs need rotation \(3, 3, 3\)"):
        scored(config, transforms=str(tmp_path / "two.npz"))
    np.savez(tmp_path / "text.npz", rotation=np.full((3, 3, 3), "1"), translation=np.zeros((3, 3)))
    with pytest.raises(ValueError, match="`rotation` is of type <U1: give an NPZ file"):
        scored(config, transforms=str(tmp_path / "text.npz"), refine="icp")


def test_a_refined_method_says_so_and_is_better(config):
    easy = dataclasses.replace(config, test_pairs=PairConfig(32, crop="none", rotation_max_deg=3))
    plain, refined = (scored(easy, method="identity", refine=refine) for refine in ("", "icp"))
    assert refined["method"] == "identity + icp"
    assert refined["mie_r_deg"] < plain["mie_r_deg"]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["register", "register_global", "register_global_learned"])
def test_the_methods_for_any_rotation_are_scored_by_name(config, method):
    pairs = PairConfig(512, kept=400, sampling="disjoint", rotation="full")
    easy = dataclasses.replace(config, test_pairs=pairs)
    result = scored(easy, method=method, pairs=1)
    assert result["method"] == method
    # Two samplings of a shape of the configuration that share no point.
    assert result["mie_r_deg"] < 5


def test_pairs_of_a_file_are_scored_in_their_own_pose(tmp_path):
    arrays = write_published(tmp_path / "rooms", points=40)
    config = from_dict(
        {"data": {"name": "icl_nuim", "test_pairs_from": "file"}, "test_pairs": {"kept": 30}}
    )
    result = scored(config, root=tmp_path, method="identity", pairs=4)
    angles = np.degrees(Rotation.from_matrix(arrays["transform"][:4, :3, :3]).magnitude())
    assert (result["dataset"], result["pairs"]) == ("rooms", 4)
    assert result["mie_r_deg"] == pytest.approx(angles.mean(), rel=1e-5)
    with pytest.raises(ValueError, match="needs data.name = 'icl_nuim'"):
        scored(from_dict({"data": {"test_pairs_from": "file"}}), method="icp")


def test_transforms_in_another_convention_are_told(seed):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(20, random_state=seed).as_matrix()
    truth = RigidTransform(rotation, rng.normal(size=(20, 3)))
    matrices = np.tile(np.eye(4), (20, 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = truth
    back = np.linalg.inv(matrices)

    def told(rotation, translation):
        predicted = RigidTransform(rotation, translation)
        return score.other_convention(score.Scored("", "", predicted, truth, None, None))

    assert told(*truth) == ""
    assert told(Rotation.random(20, random_state=seed + 1).as_matrix(), truth.translation) == ""
    assert "row vectors" in told(rotation.swapaxes(1, 2), truth.translation)
    assert "from reference to source" in told(back[:, :3, :3], back[:, :3, 3])


@pytest.mark.parametrize(
    ("given", "method", "message"),
    [
        ("idam.k", "icp", "icp is not a network"),
        ("idam.k", "weights:modelnet40", "the weights are those of network = 'paper'"),
        ("network", "weights:modelnet40", "trained with network = paper"),
    ],
)
def test_settings_of_a_peer_have_no_effect_on_another_method(given, method, message):
    config = from_dict({"network": "idam", "idam": {"k": 5}})
    with pytest.raises(ValueError, match=message):
        score.check_given(config, [given], method=method)
