"""What point-to-plane and generalised ICP share: laws, derivatives, degenerate inputs."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from jaxreg.geometry import rigid
from jaxreg.refine.config import RefineConfig
from jaxreg.types import RigidTransform
from tests.compiled import gicp, point_to_plane
from tests.refine.kernels import KERNELS

METHODS = {"point_to_plane": point_to_plane, "gicp": gicp}
both = pytest.mark.parametrize("method", METHODS)
gicp_first = pytest.mark.parametrize(
    "method", ["gicp", pytest.param("point_to_plane", marks=pytest.mark.slow)]
)
"""For what takes long, and differs in the residual alone."""


def surface(rng, n):
    uv = rng.uniform(-1, 1, (n, 2))
    return np.column_stack([uv, 0.4 * np.sin(3 * uv[:, 0]) * np.cos(2 * uv[:, 1])])


def make_pair(seed, n=120, m=150, angle_deg=5.0):
    """Two samplings of one surface that share no point, and the motion between them."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    rotation = Rotation.from_rotvec(np.deg2rad(angle_deg) * axis / np.linalg.norm(axis))
    truth = RigidTransform(rotation.as_matrix(), 0.05 * rng.normal(size=3))
    source = surface(rng, n)
    reference = surface(rng, m) @ truth.rotation.T + truth.translation
    return jnp.asarray(source), jnp.asarray(reference), truth


def angle_deg(a, b):
    return np.rad2deg(Rotation.from_matrix(np.asarray(a) @ np.asarray(b).T).magnitude())


def pose_sum(solve, *arrays, config, **masks):
    pose = solve(*arrays, config=config, **masks)
    probe = jnp.linspace(-1.0, 2.0, 9, dtype=arrays[0].dtype).reshape(3, 3)
    return jnp.sum(pose.rotation * probe) + jnp.sum(pose.translation * probe[0])


@both
@pytest.mark.parametrize("kernel", KERNELS)
def test_recovers_the_motion_of_another_sampling(method, kernel, seed):
    source, reference, truth = make_pair(seed, n=400, m=500)
    pose = METHODS[method](source, reference, config=RefineConfig(kernel=kernel))
    assert angle_deg(pose.rotation, truth.rotation) < 0.5
    np.testing.assert_allclose(pose.translation, truth.translation, atol=0.01)


@both
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_copies_are_aligned_exactly(method, dtype, seed):
    source, _, truth = make_pair(seed)
    moved = jnp.asarray(np.asarray(source) @ truth.rotation.T + truth.translation, dtype)
    pose = METHODS[method](source.astype(dtype), moved)
    assert pose.rotation.dtype == dtype
    tolerance = 2e-6 if dtype == "float32" else 1e-9
    np.testing.assert_allclose(pose.rotation, truth.rotation, atol=tolerance)
    np.testing.assert_allclose(pose.translation, truth.translation, atol=tolerance)


@both
def test_common_motion_conjugates_the_result(method, seed):
    source, reference, _ = make_pair(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    motion = RigidTransform(jnp.asarray(rotation), jnp.array([3.0, -2.0, 5.0]))
    options = {"config": RefineConfig(iterations=6)}
    pose = METHODS[method](source, reference, **options).transform
    expected = rigid.compose(rigid.compose(motion, pose), rigid.inverse(motion))
    moved = METHODS[method](rigid.apply(motion, source), rigid.apply(motion, reference), **options)
    np.testing.assert_allclose(moved.rotation, expected.rotation, atol=1e-8)
    np.testing.assert_allclose(moved.translation, expected.translation, atol=1e-8)


@pytest.mark.slow
def test_swapped_clouds_stay_near_the_inverse(seed):
    # Near: the metric is held while a pose turns, and it turns about the points of the moving cloud.
    source, reference, _ = make_pair(seed)
    config = RefineConfig(iterations=100, both_directions=True, kernel="none")
    inverse = rigid.inverse(METHODS["gicp"](source, reference, config=config).transform)
    few = dataclasses.replace(config, iterations=5)
    backward = METHODS["gicp"](reference, source, initial=inverse, config=few)
    assert angle_deg(backward.rotation, inverse.rotation) < 0.3
    np.testing.assert_allclose(backward.translation, inverse.translation, atol=5e-3)


@pytest.mark.slow
def test_swapped_copies_stay_at_the_inverse(seed):
    # Without residuals nothing that is held pulls.
    source, _, truth = make_pair(seed)
    moved = rigid.apply(jax.tree.map(jnp.asarray, truth), source)
    config = RefineConfig(iterations=100, both_directions=True, kernel="none")
    inverse = rigid.inverse(METHODS["gicp"](source, moved, config=config).transform)
    few = dataclasses.replace(config, iterations=5)
    backward = METHODS["gicp"](moved, source, initial=inverse, config=few)
    np.testing.assert_allclose(backward.rotation, inverse.rotation, atol=1e-6)
    np.testing.assert_allclose(backward.translation, inverse.translation, atol=1e-6)


@both
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_scale_of_the_clouds_does_not_matter(method, dtype, factor, seed):
    source, reference, _ = make_pair(seed)
    x, y = source.astype(dtype), reference.astype(dtype)
    plain = METHODS[method](x, y)
    scaled = METHODS[method](x * factor, y * factor)
    tolerance = 1e-4 if dtype == "float32" else 1e-9
    np.testing.assert_allclose(scaled.rotation, plain.rotation, atol=tolerance)
    np.testing.assert_allclose(scaled.translation / factor, plain.translation, atol=tolerance)


@gicp_first
@pytest.mark.parametrize("kernel", ["none", "geman_mcclure"])
def test_derivatives_equal_finite_differences(method, kernel, seed):
    source, reference, _ = make_pair(seed, n=40, m=50)
    config = RefineConfig(iterations=3, kernel=kernel, both_directions=True, trim=0.9)
    solve = partial(pose_sum, METHODS[method], config=config)
    check_grads(
        lambda x, y: solve(jnp.asarray(x), jnp.asarray(y)), (source, reference),
        order=1, modes=("fwd", "rev"), eps=1e-6, rtol=1e-5,
    )  # fmt: skip


def degenerate_clouds(n=24):
    t = np.linspace(0, 6, n)
    grid = np.column_stack([np.repeat(np.arange(4.0), 6), np.tile(np.arange(6.0), 4)])
    sphere = np.random.default_rng(0).normal(size=(n, 3))
    clouds = {
        "plane": np.column_stack([grid, np.zeros(n)]),
        "sphere": sphere / np.linalg.norm(sphere, axis=1, keepdims=True),
        "cylinder": np.column_stack([np.cos(5 * t), np.sin(5 * t), t]),
        "line": t[:, None] * np.array([1.0, 2.0, 3.0]),
        "point": np.ones((n, 3)),
        "two": np.repeat([[0.0, 0, 0], [1, 0, 0]], n // 2, axis=0),
        "cube": np.resize(
            np.array(np.meshgrid([-1.0, 1], [-1, 1], [-1, 1])).reshape(3, 8).T, (n, 3)
        ),
    }
    return jnp.asarray(np.stack(list(clouds.values())))


@gicp_first
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_finite_at_degenerate_clouds(method, dtype):
    clouds = degenerate_clouds().astype(dtype)
    options = {"config": RefineConfig(iterations=5)}

    def solve(cloud, offset):
        pose = METHODS[method](cloud, cloud + offset, **options)
        arguments = (METHODS[method], cloud, cloud + offset)
        return pose, jax.grad(pose_sum, (1, 2))(*arguments, **options)

    both_offsets = jnp.repeat(jnp.array([0.0, 0.01], dtype), len(clouds))
    pose, gradients = jax.jit(jax.vmap(solve))(jnp.concatenate([clouds, clouds]), both_offsets)
    np.testing.assert_allclose(np.linalg.det(pose.rotation), 1, atol=1e-5)
    assert np.isfinite(pose.translation).all()
    assert np.abs(pose.translation).max() < 1
    assert all(np.isfinite(g).all() for g in gradients)


@gicp_first
def test_no_overlap_keeps_the_initial_pose(method, seed):
    source, reference, _ = make_pair(seed)
    arguments = (METHODS[method], source, reference + 100)
    config = RefineConfig(max_correspondence_distance=0.1, iterations=3)
    pose = METHODS[method](source, reference + 100, config=config)
    np.testing.assert_allclose(pose.rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose.translation, 0, atol=1e-12)
    gradients = jax.grad(pose_sum, (1, 2))(*arguments, config=config)
    assert all(np.isfinite(g).all() for g in gradients)


@gicp_first
def test_padding_changes_nothing(method, seed):
    x, y, _ = make_pair(seed, n=40, m=50)
    options = {"config": RefineConfig(iterations=4, both_directions=True)}
    padded = (
        jnp.concatenate([x, jnp.full((7, 3), jnp.nan)]),
        jnp.concatenate([jnp.full((9, 3), jnp.nan), y]),
    )
    masks = {"source_mask": jnp.arange(47) < 40, "reference_mask": jnp.arange(59) >= 9}
    differentiate = jax.jit(
        jax.value_and_grad(partial(pose_sum, METHODS[method], **options), (0, 1))
    )
    value, gradient = differentiate(x, y)
    padded_value, padded_gradient = differentiate(*padded, **masks)
    np.testing.assert_allclose(padded_value, value, rtol=1e-9)
    np.testing.assert_allclose(padded_gradient[0][:40], gradient[0], atol=1e-7)
    np.testing.assert_allclose(padded_gradient[1][9:], gradient[1], atol=1e-7)
    assert not padded_gradient[0][40:].any()
    assert not padded_gradient[1][:9].any()


@pytest.mark.slow
@both
def test_jit_and_vmap_equal_eager(method, seed):
    pairs = [make_pair(seed + i, n=30, m=30)[:2] for i in range(3)]
    x, y = (jnp.stack(clouds) for clouds in zip(*pairs, strict=True))
    solve = partial(METHODS[method], config=RefineConfig(iterations=2))
    batch = jax.jit(jax.vmap(solve))(x, y)
    for i in range(3):
        with jax.disable_jit(i == 0):
            single = solve(x[i], y[i])
        np.testing.assert_allclose(batch.rotation[i], single.rotation, atol=1e-9)
        np.testing.assert_allclose(batch.translation[i], single.translation, atol=1e-9)


@both
@pytest.mark.parametrize(("option", "value"), [("iterations", 0), ("trim", 2.0), ("k", 1)])
def test_wrong_options_are_named(method, option, value):
    with pytest.raises(ValueError, match=option):
        METHODS[method](
            jnp.zeros((20, 3)), jnp.zeros((20, 3)), config=RefineConfig(**{option: value})
        )


@both
def test_too_few_points_for_normals_are_named(method):
    with pytest.raises(ValueError, match="k = 10"):
        METHODS[method](jnp.zeros((5, 3)), jnp.zeros((5, 3)))
