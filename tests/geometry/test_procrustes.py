"""Weighted Procrustes against scipy, and its own derivative against finite differences.

T01 to T22 are the degenerate cases that every room is tested with.
"""

import functools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.geometry import procrustes
from tests import oracles
from tests.scenes import assert_proper, moved, pose, shape

weighted_procrustes = jax.jit(procrustes.weighted_procrustes)
special_procrustes = jax.jit(procrustes.special_procrustes)


robust_procrustes = jax.jit(procrustes.robust_procrustes, static_argnames="rounds")


@jax.jit
def derivative_along(covariance, direction):
    return jax.jvp(procrustes.special_procrustes, (covariance,), (direction,))[1]


@jax.jit
def second_derivative_along(covariance, one, two):
    return jax.jvp(lambda h: derivative_along(h, one), (covariance,), (two,))[1]


@jax.jit
def derivatives(source, reference, weights):
    """First (both modes) and second derivatives of a smooth function of R and t."""

    def value(source, reference, weights):
        rotation, translation = procrustes.weighted_procrustes(source, reference, weights)
        mix = jnp.arange(9, dtype=rotation.dtype).reshape(3, 3)
        return jnp.sum(jnp.sin(rotation * mix)) + jnp.sum(translation**2)

    every = (0, 1, 2)
    arguments = (source, reference, weights)
    return [d(value, every)(*arguments) for d in (jax.grad, jax.jacfwd, jax.hessian)]


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def noisy_problem(rng, n=20, noise=0.3):
    source, weights = rng.normal(size=(n, 3)), rng.uniform(0, 1, n)
    reference = source @ Rotation.random(rng=rng).as_matrix().T + rng.normal(size=3)
    return source, reference + noise * rng.normal(size=(n, 3)), weights


@pytest.mark.parametrize("noise", [0.0, 0.1, 1.0, 3.0])
def test_equals_scipy_with_noise(rng, noise):
    """T02."""
    # On exact data a solver that squares its weights passes too.
    for _ in range(10):
        problem = noisy_problem(rng, noise=noise)
        rotation, translation = weighted_procrustes(*problem)
        expected = oracles.procrustes(*problem)
        np.testing.assert_allclose(rotation, expected[0], atol=1e-12)
        np.testing.assert_allclose(translation, expected[1], atol=1e-12)


def test_identical_clouds_stay(rng):
    """T01."""
    points = shape(rng)
    rotation, translation = weighted_procrustes(points, points, np.ones(len(points)))
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(translation, 0, atol=1e-12)


@pytest.mark.parametrize("generic", [False, True], ids=["z = 0", "any plane"])
def test_coplanar_points_have_one_rotation(rng, generic):
    """T04."""
    points = rng.normal(size=(20, 3)) * [1.0, 1.0, 0.0]
    if generic:
        points = moved(points, *pose(rng))
    problem = points, moved(points, *pose(rng)), rng.uniform(0.1, 1, 20)
    result, expected = weighted_procrustes(*problem), oracles.procrustes(*problem)
    np.testing.assert_allclose(result.rotation, expected[0], atol=1e-12)
    np.testing.assert_allclose(result.translation, expected[1], atol=1e-12)


def test_no_rotation_nearby_costs_less(rng):
    source, reference, weights = noisy_problem(rng, noise=1.0)
    rotation, translation = (np.asarray(x) for x in weighted_procrustes(source, reference, weights))
    best = oracles.weighted_cost(rotation, translation, source, reference, weights)
    for _ in range(50):
        turned = Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix() @ rotation
        shifted = translation + rng.normal(0, 0.01, 3)
        assert oracles.weighted_cost(turned, shifted, source, reference, weights) > best


def test_float32_is_right_to_its_last_digits(rng):
    problem = [x.astype(np.float32) for x in noisy_problem(rng)]
    rotation, translation = weighted_procrustes(*problem)
    assert rotation.dtype == translation.dtype == np.float32
    expected = oracles.procrustes(*(x.astype(float) for x in problem))
    np.testing.assert_allclose(rotation, expected[0], atol=2e-6)
    np.testing.assert_allclose(translation, expected[1], atol=2e-6)
    assert_proper(rotation, 1e-6)


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e12, 1e30])
def test_weights_need_no_normalisation_and_clouds_no_scale(rng, scale):
    source, reference, weights = noisy_problem(rng)
    expected = weighted_procrustes(source, reference, weights)
    result = weighted_procrustes(source, reference, scale * weights)
    np.testing.assert_allclose(result.rotation, expected.rotation, atol=1e-12)
    np.testing.assert_allclose(result.translation, expected.translation, atol=1e-12)
    result = weighted_procrustes(scale * source, scale * reference, weights)
    np.testing.assert_allclose(result.rotation, expected.rotation, atol=1e-12)
    np.testing.assert_allclose(result.translation, scale * expected.translation, rtol=1e-9)


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_float32_at_any_scale(rng, scale):
    source, reference, weights = noisy_problem(rng, noise=0.0)
    expected = oracles.procrustes(source, reference, weights)[0]
    source, reference = (np.float32(scale * x) for x in (source, reference))
    rotation, _ = weighted_procrustes(source, reference, weights.astype(np.float32))
    np.testing.assert_allclose(rotation, expected, atol=2e-6)


def test_a_weight_counts_as_often_as_the_point_occurs(rng):
    """T08."""
    source, reference, _ = noisy_problem(rng, n=6)
    times = np.array([3, 1, 2, 0, 1, 4])
    result = weighted_procrustes(source, reference, times.astype(float))
    repeated = weighted_procrustes(
        np.repeat(source, times, axis=0), np.repeat(reference, times, axis=0), np.ones(times.sum())
    )
    np.testing.assert_allclose(result.rotation, repeated.rotation, atol=1e-12)
    np.testing.assert_allclose(result.translation, repeated.translation, atol=1e-12)


def test_swapping_the_clouds_inverts_the_transform(rng):
    """T03."""
    source, reference, weights = noisy_problem(rng)
    there = weighted_procrustes(source, reference, weights)
    back = weighted_procrustes(reference, source, weights)
    np.testing.assert_allclose(there.rotation @ back.rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(moved(moved(source, *there), *back), source, atol=1e-12)


def test_mirrored_reference_gives_the_best_rotation_not_a_mirror(rng):
    """T16."""
    source, _, weights = noisy_problem(rng)
    reference = source * np.array([1.0, 1.0, -1.0])
    rotation, translation = weighted_procrustes(source, reference, weights)
    assert_proper(rotation, 1e-12)
    expected = oracles.procrustes(source, reference, weights)
    np.testing.assert_allclose(rotation, expected[0], atol=1e-10)
    np.testing.assert_allclose(translation, expected[1], atol=1e-10)


def test_right_angles_and_the_24_rotations_of_the_cube(rng):
    """T13."""
    source, _, weights = noisy_problem(rng)
    axis = rng.normal(size=3)
    turns = np.radians([[90], [120], [180]]) * axis / np.linalg.norm(axis)
    cube = Rotation.create_group("O")
    for rotation in Rotation.concatenate([cube, Rotation.from_rotvec(turns)]).as_matrix():
        result = weighted_procrustes(source, source @ rotation.T + 1.0, weights)
        np.testing.assert_allclose(result.rotation, rotation, atol=1e-12)
        np.testing.assert_allclose(result.translation, 1.0, atol=1e-12)


def test_weights_that_vanish(rng):
    """T17."""
    source, reference, _ = noisy_problem(rng, n=5)
    for weights in (np.zeros(5), -np.ones(5)):
        rotation, translation = weighted_procrustes(source, reference, weights)
        np.testing.assert_array_equal(rotation, np.eye(3))
        np.testing.assert_array_equal(translation, 0)
    one_hot = np.eye(5)[2]
    rotation, translation = weighted_procrustes(source, reference, one_hot)
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(translation, reference[2] - source[2], atol=1e-14)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_cloud_in_one_place_does_not_turn_by_its_rounding(rng, dtype):
    """Its centroid differs from it in the last digit, and so would a covariance, for every place."""
    program = jax.jit(
        lambda x, y, w: (
            weighted_procrustes(x, y, w),
            jax.jacrev(lambda y: weighted_procrustes(x, y, w).rotation)(y),
        )
    )
    source, weights = rng.normal(size=(23, 3)).astype(dtype), rng.uniform(0.1, 1, 23).astype(dtype)
    for size in (1e-20, 1.0, 1e6):
        place = np.tile((size * rng.normal(size=3)).astype(dtype), (23, 1))
        for x, y in ((source, place), (place, source)):
            transform, derivative = program(x, y, weights)
            np.testing.assert_array_equal(transform.rotation, np.eye(3))
            np.testing.assert_array_equal(derivative, 0)
    # What is small beside its offset, but more than rounding, does turn.
    far = source + np.asarray(1e3, dtype)
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix().astype(dtype)
    found = program(far, far @ turn.T, weights)[0].rotation
    np.testing.assert_allclose(found, turn, atol=1e-3 if dtype == "float32" else 1e-9)


def test_negative_weights_count_as_zero(rng):
    source, reference, weights = noisy_problem(rng)
    signed = np.where(np.arange(20) % 3, weights, -weights)
    result = weighted_procrustes(source, reference, signed)
    expected = oracles.procrustes(source, reference, np.maximum(signed, 0))
    np.testing.assert_allclose(result.rotation, expected[0], atol=1e-12)


def degenerate_clouds(rng) -> dict[str, np.ndarray]:
    turn = 2 * np.pi * np.arange(12) / 12
    circle = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    return {
        "cube": cube,
        "octahedron": np.concatenate([np.eye(3), -np.eye(3)]),
        "cylinder": np.concatenate([circle + [0, 0, 3], circle - [0, 0, 3]]),
        "circle": circle,
        "plane": rng.normal(size=(12, 3)) * [1.0, 1.0, 0.0],
        "line": np.outer(np.arange(5.0), [1.0, 2.0, 3.0]),
        "two points": np.array([[0.0, 0, 0], [1, 2, 3]]),
        "one point": np.array([[1.0, 2.0, 3.0]]),
        "coincident": np.ones((4, 3)),
        "mirrored": rng.normal(size=(9, 3)),
    }


NAMES = sorted(degenerate_clouds(np.random.default_rng(0)))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", NAMES)
def test_degenerate_clouds_give_a_rotation_and_finite_derivatives(rng, name, dtype):
    """T05, T06."""
    source = degenerate_clouds(rng)[name]
    tolerance = 1e-10 if dtype == "float64" else 1e-5
    rotation = Rotation.random(rng=rng).as_matrix()
    mirror = np.diag([1.0, 1.0, -1.0]) if name == "mirrored" else np.eye(3)
    reference = source @ mirror @ rotation.T + 0.5
    # To one size by points without weight, so that all share what is compiled.
    missing = ((0, 24 - len(source)), (0, 0))
    problem = [np.pad(x, missing).astype(dtype) for x in (source, reference)]
    problem.append((np.arange(24) < len(source)).astype(dtype))
    result = weighted_procrustes(*problem)
    assert_proper(result.rotation, tolerance)
    if name != "mirrored":  # Whatever R is, it moves the points to where they belong.
        pose = (np.asarray(part, float) for part in result)
        np.testing.assert_allclose(moved(source, *pose), reference, atol=10 * tolerance)
    for derivative in jax.tree.leaves(derivatives(*problem)):
        assert np.isfinite(derivative).all()


def covariances(rng) -> dict[str, np.ndarray]:
    """Covariances with the singular values that break other derivatives, where R is unique."""
    u, v = Rotation.random(2, rng=rng).as_matrix()
    values = {
        "generic": (3.0, 2.0, 1.0),
        "isotropic": (1.0, 1.0, 1.0),
        "coplanar": (2.0, 1.0, 0.0),
        "circle": (1.0, 1.0, 0.0),
        "mirrored": (3.0, 2.0, -1.0),
        "cylindrical": (2.0, 1.0, 1.0),
        "near-equal": (1.0, 1.0 - 1e-9, 1.0 - 2e-9),
        "flat": (1.0, 1e-3, 1e-6),
    }
    return {name: u @ np.diag(s) @ v.T for name, s in values.items()}


@pytest.mark.parametrize("name", sorted(covariances(np.random.default_rng(0))))
def test_derivative_equals_finite_differences(rng, name):
    covariance = covariances(rng)[name]
    step = 1e-8 if name == "flat" else 1e-5
    for _ in range(5):
        direction = rng.normal(size=(3, 3))
        [difference] = oracles.directional_difference(
            lambda x: [special_procrustes(x[0])], [covariance], [direction], step
        )
        derivative = derivative_along(covariance, direction)
        scale = np.abs(difference).max()
        tolerance = 1e-3 * scale if name == "flat" else 1e-7
        np.testing.assert_allclose(derivative, difference, atol=tolerance)


def test_isotropic_derivative_in_closed_form(rng):
    # For H = I the rotation is I and dR is the skew part of dH^T.
    direction = rng.normal(size=(3, 3))
    expected = (direction.T - direction) / 2
    np.testing.assert_allclose(derivative_along(np.eye(3), direction), expected, atol=1e-14)


def test_derivative_is_zero_along_motions_that_change_nothing(rng):
    # On a line the turn about the line is not determined: of the derivatives, the least.
    line = np.outer(np.array([1.0, 0, 0]), np.array([1.0, 0, 0]))
    about_line = np.array([[0.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    np.testing.assert_allclose(derivative_along(line, about_line), 0, atol=1e-14)
    np.testing.assert_array_equal(derivative_along(np.zeros((3, 3)), about_line), 0)


@pytest.mark.parametrize("argument", [0, 1, 2])
def test_derivatives_of_the_transform_by_each_input(rng, argument):
    """T22."""
    problem = list(noisy_problem(rng, n=8))
    direction = [np.zeros_like(x) for x in problem]
    direction[argument] = rng.normal(size=problem[argument].shape)
    difference = oracles.directional_difference(
        lambda x: list(weighted_procrustes(*x)), problem, direction
    )
    forward = jax.jit(functools.partial(jax.jvp, procrustes.weighted_procrustes))
    tangent = forward(tuple(problem), tuple(direction))[1]
    for derivative, expected in zip(tangent, difference, strict=True):
        np.testing.assert_allclose(derivative, expected, atol=1e-7)


@pytest.mark.parametrize("name", sorted(set(covariances(np.random.default_rng(0))) - {"flat"}))
def test_second_derivative_equals_differences_of_the_first(rng, name):
    covariance = covariances(rng)[name]
    one, two = rng.normal(size=(2, 3, 3))
    [difference] = oracles.directional_difference(
        lambda x: [derivative_along(x[0], one)], [covariance], [two]
    )
    derivative = second_derivative_along(covariance, one, two)
    np.testing.assert_allclose(derivative, difference, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_derivatives_scale_with_the_clouds(rng, scale):
    source, reference, weights = noisy_problem(rng, n=6)

    def turn(source, reference, weights):
        return procrustes.weighted_procrustes(source, reference, weights).rotation[0, 1]

    gradient = jax.jit(jax.grad(turn))
    expected = gradient(source, reference, weights)
    scaled = gradient(scale * source, scale * reference, weights) * scale
    np.testing.assert_allclose(scaled, expected, rtol=1e-9, atol=1e-12)


def with_wrong_pairs(rng, n=60, wrong=9, noise=0.0):
    """A thin cloud, most of it moved, and some pairs that are far off."""
    source = rng.normal(size=(n, 3)) * (0.1, 0.1, 1.0)
    truth, shift = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    reference = source @ truth.T + shift + noise * rng.normal(size=(n, 3))
    reference[:wrong] += rng.normal(size=(wrong, 3))
    return source, reference, rng.uniform(0.5, 1, n), truth, shift


def test_robust_rounds_take_the_pull_from_wrong_pairs(rng):
    source, reference, weights, truth, shift = with_wrong_pairs(rng)
    plain = weighted_procrustes(source, reference, weights)
    assert np.abs(plain.rotation - truth).max() > 1e-2
    robust = robust_procrustes(source, reference, weights, rounds=40)
    np.testing.assert_allclose(robust.rotation, truth, atol=1e-8)
    np.testing.assert_allclose(robust.translation, shift, atol=1e-8)


def test_robust_procrustes_minimises_the_geman_mcclure_cost_by_scipy(rng):
    # Iterated to its end it is a stationary point of the robust cost at the last width.
    source, reference, weights, *_ = with_wrong_pairs(rng, noise=0.02)
    found = robust_procrustes(source, reference, weights, rounds=40)
    rotation, translation = map(np.asarray, found)
    residual = np.linalg.norm(source @ rotation.T + translation - reference, axis=1)
    width = 3 * np.sort(residual)[(len(residual) - 1) // 2]
    forgiving = weights * (width**2 / (width**2 + residual**2)) ** 2
    share = (forgiving / forgiving.sum())[:, None]
    x, y = source - (share * source).sum(axis=0), reference - (share * reference).sum(axis=0)
    expected, _ = Rotation.align_vectors(y, x, weights=forgiving)
    np.testing.assert_allclose(rotation, expected.as_matrix(), atol=1e-6)


def test_without_rounds_or_without_weights_the_robust_solution_is_the_plain_one(rng):
    source, reference, weights = noisy_problem(rng)
    plain = weighted_procrustes(source, reference, weights)
    robust = robust_procrustes(source, reference, weights, rounds=0)
    np.testing.assert_allclose(robust.rotation, plain.rotation, atol=1e-12)
    nothing = robust_procrustes(source, reference, np.zeros(20), rounds=3)
    np.testing.assert_allclose(nothing.rotation, np.eye(3), atol=1e-12)


def test_padded_pairs_do_not_move_the_robust_solution(rng):
    source, reference, weights, *_ = with_wrong_pairs(rng, noise=0.02)
    padded = [np.concatenate([x, np.full((30, 3), 0.7)]) for x in (source, reference)]
    solve = functools.partial(robust_procrustes, rounds=3)
    expected = solve(source, reference, weights)
    found = solve(*padded, np.concatenate([weights, np.zeros(30)]))
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-10)


@pytest.mark.parametrize("exact", [False, True])
def test_the_robust_derivative_equals_finite_differences(rng, exact):
    source, reference, weights, *_ = with_wrong_pairs(rng, n=12, wrong=2, noise=0.05)
    if exact:
        reference = source + 1.0
    source, reference, weights = map(jnp.asarray, (source, reference, weights))

    def turn(source):
        return robust_procrustes(source, reference, weights, rounds=2).rotation[0, 1]

    gradient = jax.jit(jax.grad(turn))(source)
    assert np.isfinite(gradient).all()
    if not exact:
        direction = rng.normal(size=source.shape)
        [difference] = oracles.directional_difference(
            lambda x: [jax.jit(turn)(x[0])], [source], [direction]
        )
        assert np.sum(gradient * direction) == pytest.approx(float(difference), abs=1e-6)


TWO_DEVICES = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from jaxreg import knn, weighted_procrustes

assert len(jax.devices()) == 2
rng = np.random.default_rng(0)
source, reference = rng.normal(size=(2, 4, 20, 3)).astype(np.float32)
weights = rng.uniform(size=(4, 20)).astype(np.float32)
mesh = jax.make_mesh((2,), ("pairs",), axis_types=(AxisType.Auto,))
split = NamedSharding(mesh, PartitionSpec("pairs"))
run = jax.jit(jax.vmap(lambda x, y, w: (weighted_procrustes(x, y, w), knn(x, 3))))
one = run(source, reference, weights)
two = run(*(jax.device_put(x, split) for x in (source, reference, weights)))
assert len(two[1].sharding.device_set) == 2
jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b), one, two)
"""


def test_same_input_gives_the_same_bits_on_one_device_and_on_two():
    """T21."""
    flags = "--xla_force_host_platform_device_count=2"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", TWO_DEVICES], env=environment, check=True)


@pytest.mark.untyped
def test_shapes_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match=r"reference must have shape \(4, 3\), got \(5, 3\)"):
        procrustes.weighted_procrustes(np.ones((4, 3)), np.ones((5, 3)), np.ones(4))
    with pytest.raises(ValueError, match=r"got \(4, 2\)"):
        procrustes.weighted_procrustes(np.ones((4, 2)), np.ones((4, 2)), np.ones(4))
    with pytest.raises(ValueError, match=r"weights must have shape \(4,\), got \(3,\)"):
        procrustes.weighted_procrustes(np.ones((4, 3)), np.ones((4, 3)), np.ones(3))
