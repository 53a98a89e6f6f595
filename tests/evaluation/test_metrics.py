"""Metrics against scipy's loops, closed forms and the artefact that they document."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.evaluation.metrics import evaluate_transforms, pair_errors
from jaxreg.types import RigidTransform


def transforms(rotations: Rotation, translations) -> RigidTransform:
    return RigidTransform(rotations.as_matrix(), np.asarray(translations, float))


@pytest.fixture
def pair(seed):
    """Ten truths, and estimates off by up to a few degrees, as scipy rotations."""
    rng = np.random.default_rng(seed)
    truth = Rotation.from_euler("zyx", rng.uniform(0, 45, (10, 3)), degrees=True)
    error = Rotation.from_rotvec(rng.normal(0, 0.05, (10, 3)))
    t = rng.uniform(-0.5, 0.5, (10, 3))
    return transforms(error * truth, t + rng.normal(0, 0.02, (10, 3))), transforms(truth, t), error


def test_equals_loops_over_scipy(pair):
    predicted, truth, error = pair
    result = evaluate_transforms(predicted, truth)
    angles, euler, lengths = [], [], []
    for r, s, t, u in zip(
        predicted.rotation, truth.rotation, predicted.translation, truth.translation, strict=True
    ):
        a, b = Rotation.from_matrix(r), Rotation.from_matrix(s)
        euler.append(a.as_euler("zyx", degrees=True) - b.as_euler("zyx", degrees=True))
        angles.append(np.degrees((a * b.inv()).magnitude()))
        lengths.append(np.linalg.norm(s.T @ (t - u)))
    angles, lengths = np.array(angles), np.array(lengths)
    np.testing.assert_allclose(angles, np.degrees(error.magnitude()), rtol=1e-9)
    expected = {
        "pairs": 10,
        "mae_r_deg": np.mean(np.abs(euler)),
        "rmse_r_deg": np.sqrt(np.mean(np.square(euler))),
        "mae_t": np.abs(predicted.translation - truth.translation).mean(),
        "mie_r_deg": angles.mean(),
        "mie_t": lengths.mean(),
        "median_rre_deg": np.median(angles),
        "median_rte": np.median(lengths),
        "recall_1deg": np.mean((angles < 1) & (lengths < 0.01)),
        "recall_5deg": np.mean((angles < 5) & (lengths < 0.1)),
        "worst_pair": angles.argmax(),
        "worst_rre_deg": angles.max(),
        "worst_rte": lengths[angles.argmax()],
    }
    for name, value in expected.items():
        np.testing.assert_allclose(result[name], value, rtol=1e-9, err_msg=name)
    np.testing.assert_allclose(result["mie_r_deg_float32_acos"], angles.mean(), atol=0.02)


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 1e-3, 0.02, 1.0, 90.0, 179.9, 180.0])
def test_angle_of_one_axis_in_closed_form(degrees):
    predicted = transforms(Rotation.from_euler("x", [[degrees]], degrees=True), [[0, 0, 0.25]])
    result = evaluate_transforms(predicted, transforms(Rotation.identity(1), np.zeros((1, 3))))
    np.testing.assert_allclose(result["mie_r_deg"], degrees, rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(result["mae_r_deg"], degrees / 3, rtol=1e-7)
    np.testing.assert_allclose(result["mae_t"], 0.25 / 3)
    np.testing.assert_allclose(result["mie_t"], 0.25)


def test_euler_convention_is_that_of_the_pair_generator():
    z, y, x = np.radians([10, 20, 30])
    rx = [[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]]
    ry = [[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]]
    rz = [[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]]
    predicted = RigidTransform((np.array(rx) @ ry @ rz)[None], np.zeros((1, 3)))
    errors = pair_errors(predicted, transforms(Rotation.identity(1), np.zeros((1, 3))))
    np.testing.assert_allclose(errors.euler_deg, [[10, 20, 30]], atol=1e-12)


def test_gimbal_lock_is_measured_without_a_warning():
    predicted = transforms(Rotation.from_euler("zyx", [[30, 90, 0]], degrees=True), [[0, 0, 0]])
    assert evaluate_transforms(predicted, predicted)["mae_r_deg"] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("angle", "length", "recall_1deg", "recall_5deg"),
    [(0.99, 0.0099, 1, 1), (1.01, 0, 0, 1), (0, 0.0101, 0, 1), (5.01, 0, 0, 0), (0, 0.101, 0, 0)],
)
def test_recall_needs_both_errors(angle, length, recall_1deg, recall_5deg):
    predicted = transforms(Rotation.from_euler("y", [[angle]], degrees=True), [[length, 0, 0]])
    result = evaluate_transforms(predicted, transforms(Rotation.identity(1), np.zeros((1, 3))))
    assert (result["recall_1deg"], result["recall_5deg"]) == (recall_1deg, recall_5deg)


def test_the_published_angle_has_a_floor_that_the_true_one_has_not(seed):
    """Rotations orthonormal only to float32 print about 0.01 degrees whatever their true error."""
    rng = np.random.default_rng(seed)
    exact = Rotation.random(200, rng=rng)
    product = np.eye(3, dtype=np.float32)[None]
    steps = [Rotation.random(200, rng=rng) for _ in range(2)]
    for step in [*steps, (steps[1] * steps[0]).inv(), exact]:
        product = step.as_matrix().astype(np.float32) @ product
    result = evaluate_transforms(
        RigidTransform(product, np.zeros((200, 3))), transforms(exact, np.zeros((200, 3)))
    )
    assert result["mie_r_deg"] < 5e-5
    assert 0.001 < result["mie_r_deg_float32_acos"] < 0.05


def test_takes_jax_arrays_and_measures_float32_in_float64(pair):
    predicted, truth, _ = pair
    single = RigidTransform(*(jnp.asarray(x, jnp.float32) for x in predicted))
    result, expected = evaluate_transforms(single, truth), evaluate_transforms(predicted, truth)
    for name in ("mae_r_deg", "mie_r_deg", "mie_t", "recall_5deg", "worst_pair"):
        np.testing.assert_allclose(result[name], expected[name], atol=1e-5, err_msg=name)
    assert all(type(value) in (int, float) for value in result.values())


def spoiled(pair, row, rotation=None, translation=None):
    r, t = pair.rotation.copy(), pair.translation.copy()
    r[row] = r[row] if rotation is None else rotation
    t[row] = t[row] if translation is None else translation
    return RigidTransform(r, t)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: spoiled(p, 3, translation=np.nan), "predicted transform of pair 3 .*not finite"),
        (lambda p: spoiled(p, 4, rotation=np.inf), "predicted transform of pair 4 .*not finite"),
        (lambda p: spoiled(p, 5, rotation=1.1 * np.eye(3)), "rotation of pair 5 is not a rotation"),
        (lambda p: spoiled(p, 6, rotation=np.diag([1, 1, -1])), "pair 6 .*det R = -1"),
        (lambda p: RigidTransform(p.rotation[:9], p.translation[:9]), "9 predicted .* for 10 true"),
        (lambda p: RigidTransform(p.rotation[0], p.translation[0]), "must be stacked"),
        (lambda p: RigidTransform(p.rotation[:0], p.translation[:0]), "n >= 1"),
        (lambda p: RigidTransform(p.rotation, p.translation[:, :2]), r"\(10, 2\)"),
    ],
)
def test_what_is_no_rigid_transform_is_refused(pair, change, message):
    predicted, truth, _ = pair
    with pytest.raises(ValueError, match=message):
        evaluate_transforms(change(predicted), truth)
