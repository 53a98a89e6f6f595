"""Parity with RIENet: its released weights in our single-neighbourhood network give its outputs.

Reads `rie_modelnet.npz` (weights) and `rie_parity.npz` (what its own code computed with them, stage
by stage) from the folder `peers` beside the data; skips where they are absent.
"""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.io.arrays import read_arrays
from jaxreg.network.losses import step_losses
from jaxreg.network.matching import feature_distance, matching_scores
from jaxreg.network.model import init_variables, iterate, neighborhood_graph, point_features
from jaxreg.peers.rienet import load_rienet
from jaxreg.types import PointCloud

# In float64, so that only their rounding is seen; Flax promotes with the float32 that it starts from.
pytestmark = pytest.mark.loose

CLEAN, FAILURES = (0, 1), (2, 3)
STEPS = 3


def peers() -> Path:
    places = [Path(__file__).parents[3] / "shared" / "peers"]
    if "JAXREG_DATA" in os.environ:
        places.insert(0, Path(os.environ["JAXREG_DATA"]).resolve().parent / "peers")
    for place in places:
        if (place / "rie_modelnet.npz").is_file() and (place / "rie_parity.npz").is_file():
            return place
    pytest.skip("no folder `peers` beside $JAXREG_DATA with RIENet's weights and outputs")


@pytest.fixture(scope="module")
def predecessor():
    variables, config = load_rienet(peers() / "rie_modelnet.npz")
    return jax.tree.map(lambda x: np.asarray(x, np.float64), variables), config


@pytest.fixture(scope="module")
def theirs():
    with np.load(peers() / "rie_parity.npz") as file:
        return dict(file)


def cloud(points) -> PointCloud:
    """A cloud of theirs, (3, n), as one of ours."""
    return PointCloud(jnp.asarray(points.T, jnp.float64), jnp.ones(points.shape[1], bool))


@pytest.fixture(scope="module")
def ours(predecessor, theirs):
    """Transform, steps and losses of the four pairs."""
    variables, config = predecessor

    @jax.jit
    def run(source, reference):
        def observe(step, graph):
            losses = step_losses(
                step, graph, source.mask, reference, config=config.loss, model=config.model
            )
            return step, losses

        return iterate(variables, source, reference, config=config.model, observe=observe)[:2]

    return [run(cloud(a), cloud(b)) for a, b in zip(theirs["src"], theirs["tgt"], strict=True)]


def test_every_array_of_the_network_is_loaded(predecessor):
    variables, config = predecessor
    fresh = jax.eval_shape(lambda: init_variables(jax.random.key(0), config.model))
    assert jax.tree.map(jnp.shape, variables) == jax.tree.map(jnp.shape, fresh)


def test_features_and_matching_scores(predecessor, theirs):
    variables, config = predecessor

    @jax.jit
    def stages(source, reference):
        features = []
        for points in (source, reference):
            graph = neighborhood_graph(points, config.model)
            features.append(
                point_features(variables, points.points, graph, points.mask, config=config.model)[0]
            )
        return *features, matching_scores(feature_distance(*features))

    source, reference, scores = stages(cloud(theirs["src"][0]), cloud(theirs["tgt"][0]))
    rows = theirs["rows"]
    np.testing.assert_allclose(source[rows].T, theirs["it0_src_feat_p0_rows"], atol=1e-4)
    np.testing.assert_allclose(reference[rows].T, theirs["it0_tgt_feat_p0_rows"], atol=1e-4)
    np.testing.assert_allclose(scores[rows], theirs["it0_match_before_p0_rows"], atol=1e-4)
    peak = theirs["it0_match_before_rowmax"][0]
    np.testing.assert_allclose(jnp.max(scores, axis=1), peak, atol=1e-4)


@pytest.mark.parametrize("pair", CLEAN + FAILURES)
def test_final_map_and_confidence_of_the_first_step(ours, theirs, pair):
    _, (step, _) = ours[pair]
    peak = theirs["it0_match_after_rowmax"][pair]
    np.testing.assert_allclose(step.matches.final_peak[0], peak, atol=1e-4)
    np.testing.assert_allclose(step.confidence[0], theirs["it0_weights"][pair], atol=1e-4)
    # Where the final map is sharp, the reference copy is the point that it names.
    named = theirs["tgt"][pair].T[theirs["it0_match_after_argmax"][pair]]
    sharp = peak > 0.9999
    np.testing.assert_allclose(step.matches.copy[0][sharp], named[sharp], atol=3e-4)


@pytest.mark.parametrize("number", range(1, STEPS))
@pytest.mark.parametrize("pair", CLEAN)
def test_confidence_of_later_steps(ours, theirs, pair, number):
    _, (step, _) = ours[pair]
    expected = theirs[f"it{number}_weights"][pair]
    np.testing.assert_allclose(step.confidence[number], expected, atol=1e-4)


@pytest.mark.parametrize("pair", CLEAN)
def test_transforms_of_every_step_and_of_all(ours, theirs, pair):
    transform, (step, _) = ours[pair]
    for number in range(STEPS):
        rotation, translation = theirs[f"it{number}_R"][pair], theirs[f"it{number}_t"][pair]
        np.testing.assert_allclose(step.transform.rotation[number], rotation, atol=1e-5)
        np.testing.assert_allclose(step.transform.translation[number], translation, atol=1e-5)
    np.testing.assert_allclose(transform.rotation, theirs["eval_R"][pair], atol=1e-5)
    np.testing.assert_allclose(transform.translation, theirs["eval_t"][pair], atol=1e-5)


@pytest.mark.parametrize("pair", FAILURES)
def test_transform_of_the_first_step_where_the_method_fails(ours, theirs, pair):
    # Its weights nearly vanish here, so that rounding of either program shows in the fourth digit.
    _, (step, _) = ours[pair]
    np.testing.assert_allclose(step.transform.rotation[0], theirs["it0_R"][pair], atol=3e-4)
    np.testing.assert_allclose(step.transform.translation[0], theirs["it0_t"][pair], atol=1e-4)


@pytest.mark.parametrize("pair", CLEAN)
def test_losses_summed_over_the_steps(ours, theirs, pair):
    _, (_, losses) = ours[pair]
    mine = [
        float(jnp.sum(term))
        for term in (
            losses.global_consistency,
            losses.neighborhood_consistency,
            losses.spatial_consistency,
        )
    ]
    np.testing.assert_allclose(mine, theirs["eval_losses_per_pair"][pair], rtol=1e-3)


def test_what_is_no_weight_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"missing\.npz: no such file"):
        load_rienet(tmp_path / "missing.npz")
    text, other = tmp_path / "text.npz", tmp_path / "other.npz"
    text.write_text("no archive")
    np.savez(other, weight=np.zeros(3))
    with pytest.raises(ValueError, match=r"text\.npz is not an \.npz"):
        load_rienet(text)
    with pytest.raises(ValueError, match=r"other\.npz has no array 'emb_nn"):
        load_rienet(other)


def test_whatever_is_no_archive_of_arrays_is_refused_by_name_and_with_the_remedy(tmp_path):
    np.savez(tmp_path / "whole.npz", a=np.arange(1000.0), b=np.zeros(3))
    np.testing.assert_array_equal(read_arrays(tmp_path / "whole.npz", remedy="x")["b"], np.zeros(3))
    whole = (tmp_path / "whole.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "damaged.npz").write_bytes(whole[:500] + bytes(100) + whole[600:])
    (tmp_path / "empty.npz").touch()
    (tmp_path / "folder.npz").mkdir()
    np.save(tmp_path / "one.npy", np.zeros(3))
    np.savez(tmp_path / "objects.npz", a=np.array([None]))
    for name in ("cut.npz", "damaged.npz", "empty.npz", "folder.npz", "one.npy", "objects.npz"):
        with pytest.raises(ValueError, match=rf"{name} is .*: give the right one\.$"):
            read_arrays(tmp_path / name, remedy="give the right one")
    with pytest.raises(ValueError, match=r"whole\.npz has no array 'c': give the right one\.$"):
        read_arrays(tmp_path / "whole.npz", ("a", "c"), remedy="give the right one")
