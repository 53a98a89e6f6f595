"""FMR: its encoder, its Jacobian and its iterations, against numpy, JAX's derivative and laws."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg.config import Config, FMRConfig, PairConfig, TrainConfig
from jaxreg.data.procedural.shapes import sample_shape
from jaxreg.geometry import rigid, se3
from jaxreg.network.features import BATCH_AXIS
from jaxreg.peers import fmr
from jaxreg.training import create_train_state, train_step
from jaxreg.types import PointCloud, RigidTransform
from tests import oracles
from tests.peers.small import draw_variables

pytestmark = pytest.mark.loose

SMALL = FMRConfig(channels=(8, 8, 24), hidden=(8, 6), decoded=7)
WIDE = FMRConfig(channels=(32, 32, 64, 256), hidden=(8,), decoded=4)
register = jax.jit(fmr.register, static_argnames="config")
align = jax.jit(fmr.align_features, static_argnames="config")
encode = jax.jit(fmr.encode, static_argnames="config")
twist_jacobian = jax.jit(fmr.twist_jacobian, static_argnames="config")


def whole(points):
    return PointCloud(jnp.asarray(points), jnp.ones(len(points), bool))


def doubles(config, seed=0):
    """What training starts from, in float64."""
    found = fmr.init_variables(jax.random.key(seed), config)
    return jax.tree.map(lambda x: np.asarray(x, np.float64), found)


def shape(number, points=200):
    return np.asarray(sample_shape(0, number, points=points), np.float64)


def test_encoder_and_decoder_are_those_of_the_layers(seed):
    rng = np.random.default_rng(seed)
    variables = draw_variables(fmr, SMALL, rng)
    x = points = rng.normal(size=(9, 3))
    params, statistics = (variables[kind]["encoder"] for kind in ("params", "batch_stats"))
    for i in range(3):
        x = oracles.dense(params[f"Dense_{i}"], x)
        x = np.maximum(oracles.batch_norm(params, statistics, f"BatchNorm_{i}", x), 0)
    found = encode(variables, whole(points), config=SMALL)
    np.testing.assert_allclose(found, x.max(axis=0), atol=1e-9)
    y = x = x.max(axis=0)
    layers = variables["params"]["decoder"]
    for i in range(2):
        y = oracles.dense(layers[f"Dense_{i}"], y)
        y = np.where(y > 0, y, 0.01 * y)
    y = np.tanh(oracles.dense(layers["Dense_2"], y)).reshape(7, 3)
    np.testing.assert_allclose(fmr.decode(variables, jnp.asarray(x), config=SMALL), y, atol=1e-9)


def test_the_feature_is_that_of_a_set_of_points(seed):
    rng = np.random.default_rng(seed)
    variables, points = draw_variables(fmr, SMALL, rng), rng.normal(size=(12, 3))
    plain = encode(variables, whole(points), config=SMALL)
    shuffled = encode(variables, whole(rng.permutation(points)), config=SMALL)
    np.testing.assert_allclose(shuffled, plain, atol=1e-12)
    padded = np.concatenate([points, 100 + np.zeros((4, 3))])
    cloud = PointCloud(jnp.asarray(padded), jnp.arange(16) < 12)
    np.testing.assert_allclose(encode(variables, cloud, config=SMALL), plain, atol=1e-12)


def test_small_differences_are_the_derivative_along_the_twists(seed):
    variables, cloud = doubles(WIDE, seed), whole(shape(16))
    variables["params"]["steps"] = np.full(6, 1e-7)

    def of_twist(twist):
        moved = cloud._replace(points=rigid.apply(se3.exp(-twist), cloud.points))
        return fmr.encode(variables, moved, config=WIDE)

    exact = jax.jit(jax.jacfwd(of_twist))(jnp.zeros(6))
    found = twist_jacobian(variables, cloud, config=WIDE)
    np.testing.assert_allclose(found, exact, atol=1e-6 * np.abs(exact).max())
    # And by hand: a channel moves with the point that it is the largest at.
    variables["params"]["steps"] = np.array([0.3, -0.2, 0.1, 0.05, 0.4, 0.2])
    found = twist_jacobian(variables, cloud, config=WIDE)
    before = encode(variables, cloud, config=WIDE)
    for i, step in enumerate(variables["params"]["steps"]):
        turn = Rotation.from_rotvec(-step * np.eye(3)[i] if i < 3 else np.zeros(3)).as_matrix()
        shift = -step * np.eye(3)[i - 3] if i >= 3 else np.zeros(3)
        after = encode(variables, whole(shape(16) @ turn.T + shift), config=WIDE)
        np.testing.assert_allclose(found[:, i], (after - before) / step, atol=1e-9)


def test_left_inverse_solves_as_lapack_does_with_and_without_full_rank(seed):
    rng = np.random.default_rng(seed)
    jacobian, residual = rng.normal(size=(40, 6)), rng.normal(size=40)
    blind = jacobian.copy()
    blind[:, 2] = jacobian[:, 0] - 2 * jacobian[:, 1]
    for matrix in (jacobian, blind, jacobian * 0):
        found = fmr.left_inverse(jnp.asarray(matrix)) @ residual
        expected = np.linalg.lstsq(matrix, residual, rcond=1e-9)[0]
        np.testing.assert_allclose(found, expected, atol=1e-10)


def test_identical_clouds_stay_where_they_are(seed):
    variables, points = doubles(WIDE, seed), shape(1)
    found = register(variables, points, points, config=WIDE)
    np.testing.assert_allclose(found.transformation, np.eye(4), atol=1e-12)
    np.testing.assert_array_equal(found.confidence, 1)


def test_the_mean_of_the_clouds_is_taken_away_and_given_back(seed):
    variables, points = doubles(WIDE, seed), shape(16)
    found = register(variables, points, points + np.array([5.0, -3.0, 40.0]), config=WIDE)
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(found.translation, [5, -3, 40], atol=1e-9)


@pytest.mark.parametrize("number", [1, 16])
def test_a_small_motion_of_the_same_points_is_found_by_any_encoder(number):
    """Random weights are enough, as all that is asked of a feature is that it changes with the pose."""
    variables, points = doubles(dataclasses.replace(WIDE, channels=(64, 64, 512))), shape(number)
    config = dataclasses.replace(WIDE, channels=(64, 64, 512))
    turn = Rotation.from_rotvec([0.05, -0.03, 0.04]).as_matrix()
    shift = np.array([0.2, -0.1, 0.3])
    source, reference = whole(points), whole(points @ turn.T + shift)
    found = align(variables, source, reference, config=config)
    errors = np.asarray(found.errors)
    assert errors.shape == (config.iterations + 1,)
    lower = errors[1:] < errors[:-1]
    assert lower[: max(np.argmax(errors < 1e-12 * errors[0]), 4)].all(), errors
    assert errors[-1] < 1e-6 * errors[0]
    np.testing.assert_allclose(found.transform.rotation, turn, atol=1e-3)
    np.testing.assert_allclose(found.transform.translation, shift, atol=1e-3)


def test_iterations_are_those_of_lapack_and_the_matrix_exponential(seed):
    rng = np.random.default_rng(seed)
    variables, x = doubles(WIDE, seed), shape(16)
    y = x @ Rotation.from_rotvec([0.3, -0.2, 0.25]).as_matrix().T + rng.normal(0, 0.02, x.shape)
    centres = x.mean(axis=0), y.mean(axis=0)
    jacobian = np.asarray(twist_jacobian(variables, whole(y - centres[1]), config=WIDE))
    target, pose = encode(variables, whole(y - centres[1]), config=WIDE), np.eye(4)
    for _ in range(2):
        moved = (x - centres[0]) @ pose[:3, :3].T + pose[:3, 3]
        error = encode(variables, whole(moved), config=WIDE) - target
        *omega, v1, v2, v3 = np.linalg.lstsq(jacobian, np.asarray(error))[0]
        algebra = np.zeros((4, 4))
        algebra[:3, :3], algebra[:3, 3] = np.cross(np.eye(3), omega), (v1, v2, v3)
        pose = scipy.linalg.expm(algebra) @ pose
    found = align(
        variables, whole(x), whole(y), config=dataclasses.replace(WIDE, iterations=2)
    ).transform
    np.testing.assert_allclose(found.rotation, pose[:3, :3], atol=1e-8)
    shift = pose[:3, 3] + centres[1] - pose[:3, :3] @ centres[0]
    np.testing.assert_allclose(found.translation, shift, atol=1e-8)


def test_no_increment_is_longer_than_a_linearisation_holds(seed):
    """A Jacobian of next to nothing asks for the largest increment in every iteration."""
    rng = np.random.default_rng(seed)
    variables, source = doubles(SMALL), rng.uniform(-1, 1, (20, 3))
    variables["params"]["steps"] = np.full(6, 1e6)
    config = dataclasses.replace(SMALL, iterations=1)
    found = register(variables, source, 3 * source[:15], config=config)
    twist = se3.log(found.transform)
    assert np.isfinite(found.transformation).all()
    assert np.linalg.norm(twist[:3]) <= 2.0 + 1e-9
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)


def test_chamfer_distance_is_that_of_both_ways(seed):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(9, 3)), rng.normal(size=(13, 3))
    there, back = cKDTree(y).query(x)[0], cKDTree(x).query(y)[0]
    padded = PointCloud(jnp.asarray(np.concatenate([y, x])), jnp.arange(22) < 13)
    found = fmr.chamfer_distance(whole(x), padded)
    np.testing.assert_allclose(found, np.mean(there**2) + np.mean(back**2), rtol=1e-12)


def terms_of(variables, pairs, config):
    def one(source, reference, truth):
        return fmr.loss(variables, source, reference, truth, config=config)[:2]

    return jax.vmap(one, axis_name=BATCH_AXIS)(*pairs)


def some_pairs(rng, angle):
    points = rng.uniform(-1, 1, (2, 20, 3))
    turn = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    clouds = (PointCloud(x, np.ones((2, 20), bool)) for x in (points, points @ turn.T))
    return *clouds, RigidTransform(np.tile(turn, (2, 1, 1)), np.zeros((2, 3)))


def test_the_loss_is_the_sum_of_what_it_says_and_sees_the_pose_only_if_asked_to(seed):
    rng = np.random.default_rng(seed)
    variables, pairs = doubles(SMALL, 1), some_pairs(rng, 0.3)
    run = jax.jit(terms_of, static_argnames="config")
    value, terms = run(variables, pairs, config=SMALL)
    np.testing.assert_allclose(value, terms["chamfer"] + terms["pose"], rtol=1e-12)
    for i in range(2):
        clouds = (jax.tree.map(lambda x, i=i: x[i], cloud) for cloud in pairs[:2])
        found = align(variables, *clouds, config=SMALL).transform
        matrix, truth = (np.eye(4), np.eye(4))
        matrix[:3, :3], matrix[:3, 3] = found
        truth[:3, :3] = pairs[2].rotation[i]
        expected = np.sum((matrix @ np.linalg.inv(truth) - np.eye(4)) ** 2)
        np.testing.assert_allclose(terms["pose"][i], expected, rtol=1e-9, atol=1e-15)

    still = pairs[2]._replace(rotation=np.tile(np.eye(3), (2, 1, 1)))
    alone = dataclasses.replace(SMALL, supervision="unsupervised")
    known, unknown = (run(variables, (*pairs[:2], still), config=x)[0] for x in (SMALL, alone))
    assert np.abs(known - value).min() > 1e-3
    np.testing.assert_array_equal(unknown, run(variables, pairs, config=alone)[0])
    np.testing.assert_allclose(unknown, terms["chamfer"], rtol=1e-12)


def test_statistics_of_a_step_are_those_of_both_clouds_in_turn(seed):
    """Running means keep nine tenths at each cloud, the source first."""
    rng = np.random.default_rng(seed)
    variables, (source, reference, truth) = draw_variables(fmr, SMALL, rng), some_pairs(rng, 0.2)

    def one(source, reference, truth):
        return fmr.loss(variables, source, reference, truth, config=SMALL)[2]["batch_stats"]

    step = jax.jit(jax.vmap(one, axis_name=BATCH_AXIS, out_axes=None))
    found = step(source, reference, truth)
    layer = variables["params"]["encoder"]["Dense_0"]
    expected = variables["batch_stats"]["encoder"]["BatchNorm_0"]["BatchNorm_0"]["mean"]
    for points in (source.points, reference.points):
        points = points - points.mean(axis=1, keepdims=True)
        expected = 0.9 * expected + 0.1 * oracles.dense(layer, points).mean(axis=(0, 1))
    mean = found["encoder"]["BatchNorm_0"]["BatchNorm_0"]["mean"]
    np.testing.assert_allclose(mean, expected, atol=1e-12)


@pytest.mark.float32
@pytest.mark.parametrize("supervision", ["semi-supervised", "unsupervised"])
def test_a_few_steps_lower_the_loss(supervision):
    network = FMRConfig(
        channels=(16, 16, 64), hidden=(32,), decoded=64, iterations=3, supervision=supervision
    )
    config = Config(
        network="fmr",
        fmr=network,
        pairs=PairConfig(points=64, crop="none"),
        train=TrainConfig(steps=40, batch=4, warmup=0, learning_rate=3e-3, weight_decay=0.0),
    )
    shapes = jnp.stack([jnp.asarray(sample_shape(0, i, points=64)) for i in range(4)])
    state = create_train_state(config)
    step = jax.jit(functools.partial(train_step, config=config))
    logged = []
    for _ in range(40):
        state, entry = step(state, shapes)
        logged.append(entry)
    for name in logged[0]:
        assert np.isfinite([entry[name] for entry in logged]).all(), name
    losses = np.array([entry["loss"] for entry in logged])
    assert losses[-10:].mean() < 0.8 * losses[:10].mean()
