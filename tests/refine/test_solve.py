"""What `Refinement` says of a pose, and the implicit gradient against the unrolled one."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg.refine.config import RefineConfig
from jaxreg.refine.methods import refine as eager_refine
from jaxreg.types import RigidTransform
from tests.compiled import gicp, icp, point_to_plane, refine
from tests.refine.kernels import SHARED

each_method = pytest.mark.parametrize("method", SHARED)


def surface(rng, n):
    uv = rng.uniform(-1, 1, (n, 2))
    return np.column_stack([uv, 0.4 * np.sin(3 * uv[:, 0]) * np.cos(2 * uv[:, 1])])


def make_pair(seed, n=60, m=90, noise=0.01, unit=1.0):
    """Noisy copies of a part of a surface: every point has one partner, which stays the same."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    rotation = Rotation.from_rotvec(0.04 * axis / np.linalg.norm(axis)).as_matrix()
    points = surface(rng, m)
    source = points[:n] + noise * rng.normal(size=(n, 3))
    reference = points @ rotation.T + 0.02 * rng.normal(size=3)
    return jnp.asarray(unit * source), jnp.asarray(unit * reference)


def probe(pose):
    """A number that every entry of a pose has a part in."""
    weights = jnp.linspace(-1.0, 2.0, 9, dtype=pose.rotation.dtype).reshape(3, 3)
    return jnp.sum(pose.rotation * weights) + jnp.sum(pose.translation * weights[0])


SOLVED = RefineConfig(iterations=120, kernel_annealing=1.0, tolerance=1e-9)
"""Enough iterations at one width of the kernel to stand at the fixed point in float64."""


@partial(jax.jit, static_argnames="config")
def gradients(source, reference, config):
    def of_clouds(source, reference):
        result = eager_refine(source, reference, config=config)
        return probe(result), result

    return jax.value_and_grad(of_clouds, (0, 1), has_aux=True)(source, reference)


@each_method
@pytest.mark.parametrize("kernel", ["none", "geman_mcclure"])
@pytest.mark.parametrize("number", range(3))
def test_implicit_gradient_is_that_of_the_solution(method, kernel, number, seed):
    config = dataclasses.replace(SOLVED, method=method, kernel=kernel)
    for scene in range(number, 60, 10):  # some alternate between two sets of pairs for ever
        clouds = make_pair(seed + scene)
        (value, result), unrolled = gradients(*clouds, config)
        if result.converged:
            break
    (same_value, same), implicit = gradients(
        *clouds, dataclasses.replace(config, gradient="implicit")
    )
    assert result.converged
    np.testing.assert_allclose(same_value, value, atol=1e-12)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(same))
    rng, step = np.random.default_rng(seed), 1e-6
    for cloud, a, b in zip(range(2), unrolled, implicit, strict=True):
        np.testing.assert_allclose(b, a, atol=1e-3 * np.abs(a).max())
        direction = rng.normal(size=a.shape)
        moved = [list(clouds), list(clouds)]
        for pair, sign in zip(moved, (1, -1), strict=True):
            pair[cloud] = clouds[cloud] + sign * step * direction
        ahead, behind = (probe(refine(*pair, config=config)) for pair in moved)
        difference = (ahead - behind) / (2 * step)
        scale = np.linalg.norm(b) * np.linalg.norm(direction) / np.sqrt(b.size)
        np.testing.assert_allclose(np.sum(b * direction), difference, atol=1e-5 * scale)


@pytest.mark.slow
@each_method
def test_implicit_gradient_goes_forward_backward_and_in_batches(method, seed):
    pairs = [make_pair(seed + number, n=40, m=50) for number in range(2)]
    config = RefineConfig(method, iterations=4, gradient="implicit")
    x, y = (jnp.stack(clouds) for clouds in zip(*pairs, strict=True))
    direction = jnp.asarray(np.random.default_rng(seed).normal(size=x.shape))

    def one(x, y):
        return probe(eager_refine(x, y, config=config))

    @jax.jit
    def both(x, y, direction):
        tangent = jax.vmap(lambda x, y, d: jax.jvp(lambda x: one(x, y), (x,), (d,))[1])
        return tangent(x, y, direction), jax.vmap(jax.grad(one))(x, y)

    tangents, batch = both(x, y, direction)
    np.testing.assert_allclose(tangents, jnp.sum(batch * direction, axis=(1, 2)), rtol=1e-8)
    for i in range(2):
        alone = jax.jit(jax.grad(one))(x[i], y[i])
        np.testing.assert_allclose(batch[i], alone, atol=1e-9 * np.abs(alone).max())


def degenerate_clouds(n=24):
    grid = np.column_stack([np.repeat(np.arange(4.0), 6), np.tile(np.arange(6.0), 4), np.zeros(n)])
    sphere = np.random.default_rng(0).normal(size=(n, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    line = np.linspace(0, 6, n)[:, None] * np.array([1.0, 2.0, 3.0])
    return jnp.asarray(np.stack([grid, sphere, line, np.ones((n, 3)), np.zeros((n, 3))]))


@each_method
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_implicit_gradient_is_finite_where_motions_are_free(method, dtype):
    clouds = degenerate_clouds().astype(dtype)
    config = RefineConfig(method, iterations=4, gradient="implicit")

    def one(x, shift):
        return probe(eager_refine(x, x + shift, config=config))

    shifts = jnp.asarray([0.0, 0.01, 1e3], dtype)
    every = jax.vmap(jax.vmap(jax.value_and_grad(one), (None, 0)), (0, None))
    value, gradient = jax.jit(every)(clouds, shifts)
    assert np.isfinite(value).all()
    assert np.isfinite(gradient).all()
    # Generalised ICP also differentiates normals, which divides by the gaps of eigenvalues.
    assert np.abs(gradient).max() < (1e8 if method == "gicp" else 1e4)


@each_method
def test_without_pairs_the_pose_is_the_start_and_so_is_its_derivative(method, seed):
    source, reference = make_pair(seed)
    config = RefineConfig(
        method, iterations=3, max_correspondence_distance=0.1, gradient="implicit"
    )
    turn = Rotation.from_rotvec([0.1, 0.2, -0.3]).as_matrix()
    start = RigidTransform(jnp.asarray(turn), jnp.array([1.0, -2.0, 0.5]))

    @jax.jit
    def solved(source, reference, shift):
        initial = start._replace(translation=start.translation + shift)
        result = eager_refine(source, reference, initial=initial, config=config)
        return result.translation, result

    arguments = source, reference + 100, jnp.zeros(3)
    derivatives, result = jax.jacrev(solved, (0, 1, 2), has_aux=True)(*arguments)
    np.testing.assert_allclose(result.rotation, start.rotation, atol=1e-12)
    np.testing.assert_allclose(result.translation, start.translation, atol=1e-12)
    np.testing.assert_allclose(derivatives[0], 0, atol=1e-10)
    np.testing.assert_allclose(derivatives[1], 0, atol=1e-10)
    np.testing.assert_allclose(derivatives[2], np.eye(3), atol=1e-10)
    assert result.residual == 0
    assert result.inliers == 0
    assert not result.confidence.any()
    assert not result.information.any()
    assert result.converged


def test_the_start_keeps_its_derivative_along_a_plane_only(seed):
    rng = np.random.default_rng(seed)
    plane = jnp.asarray(np.column_stack([rng.uniform(-1, 1, (80, 2)), np.zeros(80)]))
    config = RefineConfig("point_to_plane", iterations=40, gradient="implicit")

    @jax.jit
    def end(translation):
        initial = RigidTransform(jnp.eye(3), translation)
        return eager_refine(plane, plane, initial=initial, config=config).translation

    np.testing.assert_allclose(
        jax.jacfwd(end)(jnp.array([0.02, 0.01, 0.03])), np.diag([1.0, 1, 0]), atol=1e-3
    )


@pytest.mark.slow
def test_implicit_memory_does_not_grow_with_the_iterations():
    def temporary(gradient, iterations):
        config = RefineConfig("icp", iterations=iterations, gradient=gradient)
        cloud = jax.ShapeDtypeStruct((100, 3), jnp.float32)
        one = lambda x, y: probe(eager_refine(x, y, config=config))  # noqa: E731
        compiled = jax.jit(jax.grad(one, (0, 1))).lower(cloud, cloud).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    few, many = (temporary("implicit", count) for count in (10, 200))
    assert many < 1.05 * few + 4096
    few, many = (temporary("unrolled", count) for count in (10, 200))
    assert many > 5 * few, "that memory grows would be seen"


def expected_metrics(method, config, rotation, source, moved, reference, index):
    """``M_i`` by loops; the reference's neighbourhoods by a tree."""

    def axes(points):
        rows = cKDTree(points).query(points, k=config.k + 1)[1]
        return np.stack([np.linalg.eigh(np.cov(points[row].T))[1] for row in rows])

    if method == "icp":
        return np.tile(np.eye(3), (len(moved), 1, 1))
    normal = axes(reference)[index][:, :, 0]
    if method == "point_to_plane":
        return normal[:, :, None] * normal[:, None, :]
    sizes = np.diag([config.epsilon, 1, 1])
    there = axes(reference)[index]
    here = rotation @ axes(source)
    summed = there @ sizes @ there.transpose(0, 2, 1) + here @ sizes @ here.transpose(0, 2, 1)
    return 2 * config.epsilon * np.linalg.inv(summed)


@each_method
@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_what_is_reported_of_the_pose_is_what_a_loop_says(method, unit, seed):
    source, reference = make_pair(seed, unit=unit)
    config = RefineConfig(
        method, kernel="cauchy", trim=0.8, max_correspondence_distance=0.08 * unit, iterations=8,
        both_directions=True,
    )  # fmt: skip
    scale = 0.02 * unit
    result = refine(source, reference, config=config, kernel_scale=scale)
    x, y = np.asarray(source), np.asarray(reference)
    rotation, translation = np.asarray(result.rotation), np.asarray(result.translation)
    moved = x @ rotation.T + translation
    distance, index = cKDTree(y).query(moved)
    inliers = distance <= config.max_correspondence_distance
    inliers &= distance <= np.sort(distance[inliers])[int(np.ceil(0.8 * inliers.sum())) - 1]
    assert 0 < inliers.sum() < len(x)
    metric = expected_metrics(method, config, rotation, x, moved, y, index)
    squared = np.einsum("ni,nij,nj->n", moved - y[index], metric, moved - y[index])
    weights = np.where(inliers, 1 / (1 + squared / scale**2), 0)
    centre, information = y.mean(axis=0), np.zeros((6, 6))
    for point, weight, m in zip(moved, weights, metric, strict=True):
        jacobian = np.concatenate([np.cross(np.eye(3), point - centre).T, np.eye(3)], axis=1)
        information += weight * jacobian.T @ m @ jacobian
    assert int(result.inliers) == inliers.sum()
    np.testing.assert_allclose(result.confidence, weights, atol=1e-8)
    np.testing.assert_allclose(result.correspondences, y[index], atol=1e-9 * unit)
    expected = np.sqrt(np.sum(weights * squared) / weights.sum())
    np.testing.assert_allclose(result.residual, expected, rtol=1e-7)
    np.testing.assert_allclose(result.centre, centre, atol=1e-12 * unit)
    units = np.repeat([unit, 1.0], 3)
    scaled = np.asarray(result.information) / np.outer(units, units)
    np.testing.assert_allclose(scaled, information / np.outer(units, units), atol=1e-6 * len(x))
    matrix = np.block([[rotation, translation[:, None]], [np.zeros(3), 1]])
    np.testing.assert_array_equal(result.transformation, matrix)
    np.testing.assert_array_equal(result.transform.rotation, rotation)


@each_method
def test_converged_is_what_the_last_step_says(method, seed):
    clouds = make_pair(seed)
    config = dataclasses.replace(SOLVED, method=method, kernel="none")
    poses = [
        refine(*clouds, config=dataclasses.replace(config, iterations=count)) for count in (2, 3)
    ]
    radius = np.sqrt(np.mean([np.var(np.asarray(cloud), axis=0).sum() for cloud in clouds]))
    turned = Rotation.from_matrix(np.asarray(poses[1].rotation @ poses[0].rotation.T)).magnitude()
    source_centre = np.asarray(clouds[0]).mean(axis=0)
    centres = [pose.rotation @ source_centre + pose.translation for pose in poses]
    moved = float(np.linalg.norm(centres[1] - centres[0])) / radius
    for tolerance in (1.02 * max(turned, moved), 0.98 * max(turned, moved)):
        again = dataclasses.replace(config, iterations=3, tolerance=tolerance)
        assert refine(*clouds, config=again).converged == (tolerance > max(turned, moved))


@each_method
def test_padding_is_trusted_by_nothing_and_stays_finite(method, seed):
    source, reference = make_pair(seed)
    nan = jnp.full((5, 3), jnp.nan)
    padded = jnp.concatenate([nan, source]), jnp.concatenate([reference, nan])
    masks = {"source_mask": jnp.arange(65) >= 5, "reference_mask": jnp.arange(95) < 90}
    config = RefineConfig(method, iterations=5)
    plain, result = (
        refine(source, reference, config=config),
        refine(*padded, config=config, **masks),
    )
    assert not result.confidence[:5].any()
    assert all(np.isfinite(leaf).all() for leaf in result)
    for name in ("confidence", "correspondences"):
        np.testing.assert_allclose(getattr(result, name)[5:], getattr(plain, name), atol=1e-9)
    for name in ("residual", "inliers", "information", "centre", "rotation", "converged"):
        np.testing.assert_allclose(getattr(result, name), getattr(plain, name), atol=1e-9)


@pytest.mark.slow
def test_the_name_of_a_method_is_that_of_a_function(seed):
    clouds = make_pair(seed)
    start = RigidTransform(jnp.eye(3), jnp.array([0.03, 0.0, 0.01]))
    options = {"initial": start, "kernel_scale": 0.05, "max_correspondence_distance": 0.1}
    results = {}
    for name, function in (("icp", icp), ("point_to_plane", point_to_plane), ("gicp", gicp)):
        config = RefineConfig(name, iterations=2)
        results[name] = refine(*clouds, config=config, **options)
        expected = function(*clouds, config=RefineConfig(iterations=2), **options)
        for a, b in zip(results[name], expected, strict=True):
            np.testing.assert_array_equal(a, b)
    assert not np.allclose(results["icp"].rotation, results["gicp"].rotation, atol=1e-6)


@each_method
def test_keywords_win_over_the_configuration_and_may_be_traced(method, seed):
    source, reference = make_pair(seed)
    config = RefineConfig(method, iterations=3, max_correspondence_distance=0.05)
    wide = RefineConfig(method, iterations=3)
    found = refine(source, reference, config=wide, max_correspondence_distance=jnp.asarray(0.05))
    expected = refine(source, reference, config=config)
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-12)

    @jax.jit
    @jax.value_and_grad
    def residual(scale):
        return eager_refine(source, reference, config=config, kernel_scale=scale).residual

    (above, _), (below, _) = residual(jnp.asarray(0.02 + 1e-6)), residual(jnp.asarray(0.02 - 1e-6))
    slope, difference = residual(jnp.asarray(0.02))[1], (above - below) / 2e-6
    np.testing.assert_allclose(slope, difference, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
@each_method
def test_copies_correspond_in_batches_too(method, seed):
    """XLA computes the moved points of a batch again when their distances are compared."""
    x = np.random.default_rng(seed).normal(size=(3, 30, 3))
    turn = Rotation.from_rotvec([0.02, 0.05, 0.03]).as_matrix()
    y = jnp.asarray(x @ turn.T + 0.02)
    config = RefineConfig(method, iterations=8)
    result = jax.jit(jax.vmap(partial(eager_refine, config=config)))(jnp.asarray(x), y)
    np.testing.assert_allclose(result.correspondences, y, atol=1e-12)
    np.testing.assert_allclose(result.confidence, 1, atol=1e-12)


@each_method
@pytest.mark.parametrize("stretched", ["sheared", "mirrored", "not finite"])
def test_of_a_start_that_is_no_rotation_the_nearest_rotation_is_taken(method, stretched):
    """As no point has a partner, the start is the result; the nearest rotation is that of the SVD."""
    source, reference = make_pair(4)
    turn = Rotation.from_euler("xyz", [40, -20, 10], degrees=True).as_matrix()
    stretch = {"sheared": np.eye(3) + np.eye(3, k=1), "mirrored": np.diag([1, 2, -3.0])}
    matrix = turn @ stretch.get(stretched, np.full((3, 3), np.nan))
    start = RigidTransform(jnp.asarray(matrix), jnp.array([1.0, 2, 3]))
    config = RefineConfig(method, iterations=3, max_correspondence_distance=1e-9)
    found = refine(source, reference, initial=start, config=config)
    if stretched == "not finite":
        assert np.isnan(found.rotation).all()
        return
    u, _, vt = np.linalg.svd(matrix)
    nearest = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    np.testing.assert_allclose(found.rotation, nearest, atol=1e-6)
    np.testing.assert_allclose(found.translation, start.translation, atol=1e-6)
