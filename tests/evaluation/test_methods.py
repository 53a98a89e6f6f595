"""One chooser: every name that there is runs in both of its forms, and a wrong one is told from it."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.config import Config, ModelConfig
from jaxreg.data.procedural import shapes
from jaxreg.evaluation import baselines, methods
from jaxreg.network.model import init_variables
from jaxreg.types import Pair, PointCloud, RigidTransform
from jaxreg.weights.checkpoint import open_run
from jaxreg.weights.released import available_weights, load_pretrained

pytestmark = pytest.mark.float32

NAMES = [name for name in methods.names() if not name.endswith((":FILE", ":DIR"))]


@pytest.fixture(scope="module")
def pair():
    """Exact copies of 800 points, turned by six degrees about their origin and moved a little."""
    source = shapes.sample_shape(0, 7, points=800)
    turn = Rotation.from_euler("zyx", [5, 3, 2], degrees=True).as_matrix().astype(np.float32)
    truth = RigidTransform(turn, np.float32([0.02, 0, 0.01]))
    clouds = (source, source @ turn.T + truth.translation)
    return Pair(*(PointCloud(x, np.ones(800, bool)) for x in clouds), truth)


def chosen(name, **options):
    """The method, or a skip with what is said of a library that is not there."""
    try:
        return methods.choose(name, **options)
    except ValueError as error:
        if "jaxreg[baselines]" in str(error):
            pytest.skip(str(error))
        raise


def angle_deg(found, truth):
    turn = np.asarray(found.rotation, np.float64) @ truth.rotation.T
    return np.degrees(Rotation.from_matrix(turn).magnitude())


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.slow] * n.startswith("register_global")) for n in NAMES],
)
def test_every_name_is_a_method_of_a_batch_and_of_two_clouds(name, pair):
    method = chosen(name)
    outcome = method.clouds(pair.source.points, pair.reference.points)
    batch = method.batch(
        Pair(*(PointCloud(x.points[None], x.mask[None]) for x in pair[:2]), pair.transform)
    )
    assert np.shape(batch.rotation) == (1, 3, 3)
    assert np.shape(batch.translation) == (1, 3)
    if name == "identity":
        assert angle_deg(outcome.transform, pair.transform) == pytest.approx(6.206, abs=1e-3)
        return
    for found in (outcome.transform, RigidTransform(batch.rotation[0], batch.translation[0])):
        assert angle_deg(found, pair.transform) < WITHIN_DEG.get(name, 0.1)
        np.testing.assert_allclose(found.translation, pair.transform.translation, atol=0.02)


# Without a refinement; and networks that were trained for an hour or less.
WITHIN_DEG = {
    "open3d_fgr": 1,
    "open3d_fpfh_ransac": 1,
    "weights:idam": 3,
    "weights:rpmnet": 3,
    "weights:fmr": 8,
}


def test_only_register_judges_itself(pair):
    clouds = pair.source.points, pair.reference.points
    assert methods.choose("identity").clouds(*clouds)[1:] == (None, None)
    outcome = methods.choose("register").clouds(*clouds)
    assert outcome.success is True
    assert 0.9 < outcome.probability <= 1


def test_all_that_the_library_has_is_in_the_list():
    assert {f"weights:{name}" for name in available_weights()} < set(methods.names())
    assert set(baselines.NAMES) < set(methods.names())


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("magic", "no method 'magic': choose one of identity, icp, register, .*open3d_fgr_icp"),
        ("weights:", "no method 'weights:'"),
        ("dense", "no method 'dense'"),
        ("identity@0.1", "no method 'identity@0.1'"),
        ("weights:magic", "modelnet40_first20"),
        ("checkpoint:nowhere", "no checkpoint in nowhere"),
        ("rienet:nowhere.npz", "nowhere.npz"),
        ("dcp:nowhere.npz", "nowhere.npz: no such file; give the .npz of DCP's"),
        ("cemnet:nowhere.npz", "nowhere.npz: no such file; give the .npz of CEMNet's"),
    ],
)
def test_a_wrong_name_says_what_there_is(name, message):
    with pytest.raises(ValueError, match=message):
        methods.choose(name)


def test_a_spacing_reaches_the_baseline(pair):
    near, far = chosen("open3d_icp@0.0001"), chosen("open3d_icp")
    clouds = pair.source.points, pair.reference.points
    # Within ten spacings there is no pair of points at first, so that nothing moves.
    assert angle_deg(near.clouds(*clouds).transform, pair.transform) > 5
    assert angle_deg(far.clouds(*clouds).transform, pair.transform) < 0.1


def test_a_checkpoint_is_the_network_that_was_saved(pair, tmp_path):
    """Its name, the fields that may change after training, and those that may not."""
    config = ModelConfig(k=3, k_matching=3, channels=(4,), width=4, n_inliers=8, iterations=1)
    variables = init_variables(jax.random.key(0), config)
    with open_run(tmp_path, Config(model=config)) as run:
        run.save(1, {"step": np.int32(1), "average": variables}, 0.5)
    name = f"checkpoint:{tmp_path}"
    assert methods.trained_config(name).model == config
    whole = PointCloud(pair.source.points[None, :40], pair.source.mask[None, :40])
    small = Pair(whole, whole, pair.transform)
    expected = methods.network_method(variables, config)(small)
    np.testing.assert_array_equal(methods.choose(name).batch(small).rotation, expected.rotation)
    other = ModelConfig(iterations=3, n_inliers=16, robust_rounds=2, k=9)
    longer = methods.network_method(
        variables,
        ModelConfig(
            k=3, k_matching=3, channels=(4,), width=4, n_inliers=16, iterations=3, robust_rounds=2
        ),
    )(small)
    found = methods.choose(name, model=other).batch(small)
    np.testing.assert_array_equal(found.rotation, longer.rotation)
    assert not np.array_equal(found.rotation, expected.rotation)


@pytest.mark.peers
def test_rienet_is_a_method(pair, peers_root):
    name = f"rienet:{peers_root / 'rie_modelnet.npz'}"
    outcome = methods.choose(name).clouds(pair.source.points, pair.reference.points)
    assert angle_deg(outcome.transform, pair.transform) < 0.1
    assert methods.trained_config(name).model.inlier_network == "rienet"


@pytest.mark.peers
def test_a_peer_is_a_method(pair, peers_root):
    name = f"dcp:{peers_root / 'dcp_v1.npz'}"
    outcome = methods.choose(name).clouds(pair.source.points, pair.reference.points)
    assert angle_deg(outcome.transform, pair.transform) < 5
    assert methods.trained_config(name).network == "dcp"


def test_only_networks_have_a_configuration_of_their_training():
    assert methods.trained_config("icp") is None
    assert methods.trained_config("open3d_fgr@0.02") is None
    assert methods.trained_config("weights:modelnet40") == load_pretrained("modelnet40")[1]
