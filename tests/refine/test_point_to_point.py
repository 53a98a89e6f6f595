"""Point-to-point ICP against a scipy loop, its laws, derivatives and degenerate inputs."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg.geometry import rigid
from jaxreg.geometry.arguments import clouds
from jaxreg.refine.config import RefineConfig
from jaxreg.types import RigidTransform
from tests.compiled import icp
from tests.refine.kernels import KERNELS

plain = partial(RefineConfig, kernel="none")


def make_pair(seed, n=80, m=None, angle_deg=8.0, noise=0.0):
    print("seed =", seed)
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(n, 3)) * [1.0, 0.7, 0.4]
    rotation = Rotation.from_rotvec(np.deg2rad(angle_deg) * _unit(rng)).as_matrix()
    translation = 0.05 * rng.normal(size=3)
    reference = source @ rotation.T + translation + noise * rng.normal(size=source.shape)
    extra = rng.normal(size=((m or n) - n, 3))
    reference = rng.permutation(np.concatenate([reference, extra]))
    return source, reference, RigidTransform(rotation, translation)


def _unit(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def angle_deg(a, b):
    return np.rad2deg(Rotation.from_matrix(np.asarray(a) @ np.asarray(b).T).magnitude())


def icp_by_loop(source, reference, iterations, max_correspondence_distance=np.inf, trim=1.0):
    """The textbook: a k-d tree and scipy's solution of Wahba's problem."""
    rotation, translation = np.eye(3), np.zeros(3)
    tree = cKDTree(reference)
    for _ in range(iterations):
        distance, index = tree.query(source @ rotation.T + translation)
        kept = distance <= max_correspondence_distance
        kept &= distance <= np.sort(distance[kept])[int(np.ceil(trim * kept.sum())) - 1]
        x, y = source[kept], reference[index[kept]]
        centre_x, centre_y = x.mean(0), y.mean(0)
        rotation = Rotation.align_vectors(y - centre_y, x - centre_x)[0].as_matrix()
        translation = centre_y - rotation @ centre_x
    return rotation, translation


@pytest.mark.parametrize("options", [{}, {"max_correspondence_distance": 0.4}, {"trim": 0.7}])
def test_equals_the_loop(options):
    source, reference, _ = make_pair(1, noise=0.02, m=110)
    result = icp(jnp.asarray(source), jnp.asarray(reference), config=plain(iterations=4, **options))
    rotation, translation = icp_by_loop(source, reference, 4, **options)
    np.testing.assert_allclose(result.rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(result.translation, translation, atol=1e-9)


@pytest.mark.parametrize("kernel", KERNELS)
def test_recovers_a_known_motion(kernel):
    source, reference, truth = make_pair(2)
    result = icp(jnp.asarray(source), jnp.asarray(reference), config=plain(kernel=kernel))
    assert angle_deg(result.rotation, truth.rotation) < 1e-6
    np.testing.assert_allclose(result.translation, truth.translation, atol=1e-8)


def test_robust_weights_ignore_what_has_no_partner():
    source, reference, truth = make_pair(3, n=200, angle_deg=4.0)
    kept = source[:, 0] < 0.6
    clouds = jnp.asarray(source), jnp.asarray(reference[reference[:, 0] < 0.6])
    result = icp(*clouds, config=plain(kernel="geman_mcclure"))
    least_squares = icp(*clouds, config=plain())
    assert kept.mean() < 0.8
    assert angle_deg(result.rotation, truth.rotation) < 1e-2
    assert angle_deg(least_squares.rotation, truth.rotation) > 0.1


def test_copies_give_the_identity_in_single_precision():
    source, _, _ = make_pair(4)
    points = jnp.asarray(source, jnp.float32)
    result = icp(points, points, config=plain())
    assert result.rotation.dtype == jnp.float32
    np.testing.assert_allclose(result.rotation, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(result.translation, 0, atol=1e-6)


def test_common_motion_conjugates_the_result():
    source, reference, _ = make_pair(5, noise=0.02)
    motion = RigidTransform(
        jnp.asarray(Rotation.from_euler("xyz", [40, 70, -20], degrees=True).as_matrix()),
        jnp.array([3.0, -2.0, 5.0]),
    )
    result = icp(jnp.asarray(source), jnp.asarray(reference), config=plain())
    expected = rigid.compose(rigid.compose(motion, result.transform), rigid.inverse(motion))
    start = rigid.compose(motion, rigid.inverse(motion))
    moved = icp(
        rigid.apply(motion, jnp.asarray(source)),
        rigid.apply(motion, jnp.asarray(reference)),
        initial=start,
        config=plain(),
    )
    np.testing.assert_allclose(moved.rotation, expected.rotation, atol=1e-9)
    np.testing.assert_allclose(moved.translation, expected.translation, atol=1e-8)


def test_swapped_clouds_give_the_inverse():
    source, reference, _ = make_pair(6, noise=0.02)
    config = plain(both_directions=True)
    a = icp(jnp.asarray(source), jnp.asarray(reference), config=config).transform
    b = icp(jnp.asarray(reference), jnp.asarray(source), config=config)
    np.testing.assert_allclose(b.rotation, rigid.inverse(a).rotation, atol=1e-9)
    np.testing.assert_allclose(b.translation, rigid.inverse(a).translation, atol=1e-9)


def test_initial_pose_is_used():
    source, reference, truth = make_pair(7, angle_deg=170.0)
    start = RigidTransform(jnp.asarray(truth.rotation), jnp.asarray(truth.translation))
    result = icp(
        jnp.asarray(source), jnp.asarray(reference), initial=start, config=plain(iterations=1)
    )
    np.testing.assert_allclose(result.rotation, truth.rotation, atol=1e-9)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_scale_of_the_clouds_does_not_matter(dtype, factor):
    source, reference, _ = make_pair(8, noise=0.02)
    options = {"config": plain(iterations=10, kernel="cauchy")}
    x, y = jnp.asarray(source, dtype), jnp.asarray(reference, dtype)
    unscaled, scaled = icp(x, y, **options), icp(x * factor, y * factor, **options)
    tolerance = 2e-5 if dtype == jnp.float32 else 1e-9
    np.testing.assert_allclose(scaled.rotation, unscaled.rotation, atol=tolerance)
    np.testing.assert_allclose(scaled.translation / factor, unscaled.translation, atol=tolerance)


def test_offset_does_not_matter():
    source, reference, _ = make_pair(9, noise=0.02)
    still = icp(jnp.asarray(source), jnp.asarray(reference), config=plain())
    shift = np.array([1e6, -2e6, 5e5])
    moved = icp(jnp.asarray(source + shift), jnp.asarray(reference + shift), config=plain())
    expected = shift + still.translation - still.rotation @ shift
    np.testing.assert_allclose(moved.rotation, still.rotation, atol=1e-8)
    np.testing.assert_allclose(moved.translation, expected, atol=1e-2)


def pose_sum(source, reference, options, **masks):
    result = icp(source, reference, config=plain(**options), **masks)
    probe = jnp.linspace(-1.0, 2.0, 9, dtype=source.dtype).reshape(3, 3)
    return jnp.sum(result.rotation * probe) + jnp.sum(result.translation * probe[0])


@pytest.mark.parametrize("kernel", KERNELS)
def test_derivatives_equal_finite_differences(kernel):
    source, reference, _ = make_pair(10, n=30, m=40, noise=0.05)
    options = {"iterations": 4, "kernel": kernel, "trim": 0.9}
    check_grads(
        jax.jit(lambda x, y: pose_sum(jnp.asarray(x), jnp.asarray(y), options)),
        (jnp.asarray(source), jnp.asarray(reference)),
        order=1,
        modes=("fwd", "rev"),
        eps=1e-6,
        rtol=1e-5,
    )


def degenerate_clouds():
    circle = np.stack([np.cos(np.arange(20)), np.sin(np.arange(20)), np.zeros(20)], axis=1)
    cube = np.stack(np.meshgrid([-1.0, 1], [-1.0, 1], [-1.0, 1]), axis=-1).reshape(-1, 3)
    line = np.linspace(-1, 1, 12)[:, None] * np.array([1.0, 2, 3])
    clouds = [circle, cube, line, np.ones((5, 3)), np.ones((1, 3)), np.zeros((3, 3))]
    points = np.full((len(clouds), 20, 3), np.nan)
    for row, cloud in zip(points, clouds, strict=True):
        row[: len(cloud)] = cloud
    return jnp.asarray(points), jnp.asarray(~np.isnan(points[..., 0]))


@pytest.mark.parametrize("kernel", ["none", "geman_mcclure"])
def test_finite_at_degenerate_clouds(kernel):
    points, mask = degenerate_clouds()
    options = {"iterations": 5, "kernel": kernel}

    def solve(cloud, mask):
        masks = {"source_mask": mask, "reference_mask": mask}
        pose = icp(cloud, cloud + 0.01, config=plain(**options), **masks)
        return pose, jax.grad(pose_sum, (0, 1))(cloud, cloud + 0.01, options, **masks)

    pose, gradients = jax.jit(jax.vmap(solve))(points, mask)
    np.testing.assert_allclose(np.linalg.det(pose.rotation), 1)
    assert all(np.isfinite(g).all() for g in gradients)


@pytest.mark.parametrize("kernel", ["none", "cauchy"])
def test_no_overlap_keeps_the_initial_pose(kernel):
    source, _, _ = make_pair(11)
    options = {"max_correspondence_distance": 0.1, "kernel": kernel}
    far = jnp.asarray(source + 100)
    result = icp(jnp.asarray(source), far, config=plain(**options))
    np.testing.assert_allclose(result.rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(result.translation, 0, atol=1e-12)
    differentiate = jax.jit(jax.grad(lambda x, y: pose_sum(x, y, options), (0, 1)))
    gradients = differentiate(jnp.asarray(source), far)
    assert all(np.isfinite(g).all() for g in gradients)


@pytest.mark.parametrize("both_directions", [False, True])
def test_padding_changes_nothing(both_directions):
    source, reference, _ = make_pair(12, noise=0.02, m=100)
    options = {"iterations": 5, "kernel": "cauchy", "trim": 0.8, "both_directions": both_directions}
    x, y = jnp.asarray(source), jnp.asarray(reference)
    padded_x = jnp.concatenate([x, jnp.full((7, 3), jnp.nan)])
    padded_y = jnp.concatenate([jnp.full((9, 3), jnp.nan), y])
    masks = {"source_mask": jnp.arange(len(padded_x)) < len(x),
             "reference_mask": jnp.arange(len(padded_y)) >= 9}  # fmt: skip

    @jax.jit
    def differentiate(x, y, masks):
        return jax.value_and_grad(lambda x, y: pose_sum(x, y, options, **masks), (0, 1))(x, y)

    value, gradient = differentiate(x, y, {})
    padded, padded_gradient = differentiate(padded_x, padded_y, masks)
    np.testing.assert_allclose(padded, value, rtol=1e-9)
    np.testing.assert_allclose(padded_gradient[0][: len(x)], gradient[0], atol=1e-9)
    np.testing.assert_allclose(padded_gradient[1][9:], gradient[1], atol=1e-9)
    assert not padded_gradient[0][len(x) :].any()
    assert not padded_gradient[1][:9].any()


def test_nothing_valid_gives_the_initial_pose():
    points = jnp.full((4, 3), jnp.nan)
    nothing = jnp.zeros(4, bool)
    config = plain(kernel="huber")
    result = icp(points, points, source_mask=nothing, reference_mask=nothing, config=config)
    np.testing.assert_array_equal(result.rotation, np.eye(3))
    np.testing.assert_array_equal(result.translation, np.zeros(3))


@pytest.mark.slow
def test_jit_and_vmap_equal_eager():
    pairs = [make_pair(seed, n=20, noise=0.02)[:2] for seed in (13, 14, 15)]
    x, y = (jnp.asarray(np.stack(clouds)) for clouds in zip(*pairs, strict=True))
    options = {"config": plain(iterations=3, kernel="cauchy")}
    batch = jax.jit(jax.vmap(lambda a, b: icp(a, b, **options)))(x, y)
    for i in range(3):
        with jax.disable_jit():
            single = icp(x[i], y[i], **options)
        np.testing.assert_allclose(batch.rotation[i], single.rotation, atol=1e-10)
        np.testing.assert_allclose(batch.translation[i], single.translation, atol=1e-10)


@pytest.mark.parametrize(
    ("options", "message"), [({"iterations": 0}, "iterations = 0"), ({"trim": 1.5}, "trim = 1.5")]
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        icp(jnp.zeros((5, 3)), jnp.zeros((5, 3)), config=plain(**options))


@pytest.mark.parametrize("shape", [(2, 5, 3), (0, 3), (5, 2), (3,)])
def test_wrong_shapes_are_named(shape):
    with pytest.raises(ValueError, match=r"reference must have shape \(n, 3\)"):
        clouds(jnp.zeros((5, 3)), jnp.zeros(shape))
