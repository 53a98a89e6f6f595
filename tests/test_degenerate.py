"""What goes wrong with point clouds, one named case each, and what must happen then.

The cases about files are in the tests of the file formats. `register` stands for the host entry point,
`solve` for weighted Procrustes with true correspondences, `network` for a tiny untrained network.
"""

import functools
import os
import signal
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from jaxreg import checkpoint, losses, model, scans
from jaxreg.config import Config, LossConfig, ModelConfig
from jaxreg.model import init_variables, register_pair
from jaxreg.neighbors import knn, nearest_neighbor
from jaxreg.procrustes import weighted_procrustes
from jaxreg.register import register
from jaxreg.types import PointCloud

pytestmark = [pytest.mark.slow, pytest.mark.loose]

SMALL = ModelConfig(
    k=3, k_matching=3, channels=(3, 4), width=4, inlier_width=2, n_inliers=10, iterations=2
)
ROWS = 30
"""Rows of every cloud that a test here gives the network: one size, one compilation."""

solve = jax.jit(weighted_procrustes)


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def shape(rng, n=300) -> np.ndarray:
    """Points of a surface without symmetry: three plates of different sizes and a rod."""
    uv = rng.uniform(size=(4, n // 4, 2))
    zero = np.zeros(n // 4)
    return np.concatenate(
        [
            np.stack([2 * uv[0, :, 0], uv[0, :, 1], zero], axis=1),
            np.stack([2 * uv[1, :, 0], zero, 0.6 * uv[1, :, 1]], axis=1),
            np.stack([zero + 0.3, uv[2, :, 0], 0.8 * uv[2, :, 1]], axis=1),
            np.stack([1.5 + 0 * zero, 0.7 + 0 * zero, 1.2 * uv[3, :, 0]], axis=1),
        ]
    )


def pose(rng, largest=40.0):
    angles = rng.uniform(0, largest, 3)
    return Rotation.from_euler("zyx", angles, degrees=True).as_matrix(), rng.uniform(-0.5, 0.5, 3)


def moved(points, rotation, translation):
    return points @ rotation.T + translation


def angle_deg(a, b) -> float:
    return float(np.degrees(2 * np.arcsin(np.linalg.norm(a - b) / np.sqrt(8))))


def assert_proper(rotation, tolerance=1e-9):
    assert np.isfinite(rotation).all()
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=tolerance)
    assert np.linalg.det(rotation) == pytest.approx(1, abs=tolerance)


@functools.cache
def variables():
    shapes = jax.eval_shape(lambda: init_variables(jax.random.key(0), SMALL))
    rng = np.random.default_rng(0)
    tree = jax.tree.map(lambda x: rng.normal(0, 0.4, x.shape), shapes)
    return tree | {"batch_stats": jax.tree.map(lambda x: 0.5 + np.abs(x), tree["batch_stats"])}


@jax.jit
def network(variables, source, reference, source_mask, reference_mask):
    """The registration, and the gradient of the training loss by variables and clouds."""

    def loss(variables, source, reference):
        clouds = PointCloud(source, source_mask), PointCloud(reference, reference_mask)
        _, terms, _ = model.iterate(
            variables,
            *clouds,
            config=SMALL,
            observe=lambda step, graph: losses.step_losses(
                step, graph, source_mask, clouds[1], config=LossConfig(), model=SMALL
            ),
        )
        return losses.total_loss(terms, LossConfig())

    registration = register_pair(
        variables,
        source,
        reference,
        config=Config(model=SMALL),
        source_mask=source_mask,
        reference_mask=reference_mask,
    )
    return registration, jax.value_and_grad(loss, (0, 1, 2))(variables, source, reference)


def run_network(source, reference, fill=0.0):
    """The network on clouds of at most `ROWS` points, padded with `fill`."""
    inputs = []
    for points in (source, reference):
        padded = np.full((ROWS, 3), fill)
        padded[: len(points)] = points
        inputs.append((padded, np.arange(ROWS) < len(points)))
    (a, a_mask), (b, b_mask) = inputs
    return network(variables(), a, b, a_mask, b_mask)


def assert_finite(tree):
    for leaf in jax.tree.leaves(tree):
        assert np.isfinite(leaf).all()


@pytest.mark.loose
def test_t01_identical_clouds(rng):
    points = shape(rng)
    result = register(points, points)
    np.testing.assert_allclose(result.rotation, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(result.translation, 0, atol=2e-6)
    assert_finite(run_network(points[:ROWS], points[:ROWS]))


def test_t02_known_pose_without_noise_in_another_order(rng):
    points, (rotation, translation) = shape(rng), pose(rng)
    reference = rng.permutation(moved(points, rotation, translation))
    result = register(points.astype(np.float32), reference.astype(np.float32))
    assert angle_deg(result.rotation, rotation) < 1e-3
    np.testing.assert_allclose(result.translation, translation, atol=1e-4)


def test_t03_swapped_clouds_give_the_inverse(rng):
    points, (rotation, translation) = shape(rng), pose(rng)
    reference = moved(points, rotation, translation)
    there, back = register(points, reference), register(reference, points)
    product = there.transformation @ back.transformation
    np.testing.assert_allclose(product, np.eye(4), atol=1e-4)


@pytest.mark.parametrize("generic", [False, True], ids=["z = 0", "any plane"])
def test_t04_coplanar_points_have_one_rotation(rng, generic):
    points = rng.normal(size=(20, 3)) * [1.0, 1.0, 0.0]
    if generic:
        points = moved(points, *pose(rng))
    rotation, translation = pose(rng)
    result = solve(points, moved(points, rotation, translation), np.ones(20))
    np.testing.assert_allclose(result.rotation, rotation, atol=1e-12)
    assert_proper(register(points, moved(points, rotation, translation)).rotation)


@pytest.mark.parametrize("name", ["circle", "cylinder", "sphere"])
def test_t05_shapes_of_revolution_get_one_of_the_best_poses(rng, name):
    turn = rng.uniform(0, 2 * np.pi, 200)
    height = {"circle": 0 * turn, "cylinder": rng.uniform(-2, 2, 200)}.get(name)
    points = rng.normal(size=(200, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    if height is not None:
        points = np.stack([np.cos(turn), np.sin(turn), height], axis=1)
    rotation, translation = pose(rng)
    reference = moved(points, rotation, translation)
    exact = solve(points, reference, np.ones(200))
    np.testing.assert_allclose(moved(points, *exact), reference, atol=1e-10)
    result = register(points, reference)
    assert_proper(result.rotation)
    # Any turn about the axis is as good: the residual is the spacing of the points at most.
    assert result.inlier_rmse < 0.3


@pytest.mark.parametrize("count", [1, 2, 6])
def test_t06_points_of_a_line_and_fewer(rng, count):
    points = np.outer(np.arange(count) + 1.0, [1.0, -2.0, 0.5])
    rotation, translation = pose(rng)
    reference = moved(points, rotation, translation)
    result = solve(points, reference, np.ones(count))
    assert_proper(result.rotation)
    np.testing.assert_allclose(moved(points, *result), reference, atol=1e-10)
    if count < 3:
        with pytest.raises(ValueError, match="at least 3"):
            register(points, reference)
    else:
        assert_proper(register(points, reference).rotation)


@pytest.mark.loose
def test_t07_no_points():
    with pytest.raises(ValueError, match="n = 0 points"):
        jax.jit(nearest_neighbor)(np.zeros((0, 3)))
    with pytest.raises(ValueError, match="at least 3"):
        register(np.zeros((0, 3)), np.zeros((5, 3)))
    empty, some = np.zeros((0, 3)), np.ones((4, 3))
    for pair in ((empty, some), (some, empty), (empty, empty)):
        result, gradient = run_network(*pair, fill=np.nan)
        assert not result.valid
        np.testing.assert_allclose(result.transformation, np.eye(4), atol=1e-12)
        assert_finite((result, gradient))


def test_t08_each_point_ten_times_is_the_same_as_once(rng):
    points, (rotation, translation) = shape(rng), pose(rng)
    reference = moved(points, rotation, translation) + rng.normal(0, 0.01, points.shape)
    once, often = (
        solve(points, reference, np.ones(len(points))),
        solve(
            np.repeat(points, 10, axis=0),
            np.repeat(reference, 10, axis=0),
            np.ones(10 * len(points)),
        ),
    )
    np.testing.assert_allclose(often.rotation, once.rotation, atol=1e-12)
    once = register(points, reference)
    often = register(
        rng.permutation(np.repeat(points, 10, axis=0)), np.repeat(reference, 10, axis=0)
    )
    np.testing.assert_allclose(often.transformation, once.transformation, atol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_t09_a_point_that_is_not_finite(rng, bad):
    points, (rotation, translation) = shape(rng), pose(rng)
    reference = moved(points, rotation, translation)
    broken = points.copy()
    broken[17, 1] = bad
    with pytest.raises(ValueError, match=r"source: point 17 .*nonfinite='drop'"):
        register(broken, reference)
    with pytest.raises(ValueError, match=r"reference: point 17 "):
        register(points, broken)
    result = register(broken, reference, nonfinite="drop")
    assert result.dropped == 1
    assert result.confidence.shape == (len(points),)
    assert angle_deg(result.rotation, rotation) < 0.1


@pytest.mark.parametrize("sizes", [(500, 3000), (3000, 500)])
def test_t10_clouds_of_very_different_sizes(rng, sizes):
    source, reference = (shape(rng, n) for n in sizes)
    rotation, translation = pose(rng)
    result = register(source, moved(reference, rotation, translation))
    assert angle_deg(result.rotation, rotation) < 2
    assert result.confidence.shape == (len(source),)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_t11_the_unit_plays_no_role(rng, scale):
    points, (rotation, translation) = shape(rng), pose(rng)
    reference = moved(points, rotation, translation)
    plain, scaled = register(points, reference), register(scale * points, scale * reference)
    assert angle_deg(scaled.rotation, plain.rotation) < 1e-3
    np.testing.assert_allclose(scaled.translation / scale, plain.translation, atol=1e-4)


@pytest.mark.parametrize("offset", [1e6, 5e6])
def test_t12_far_from_the_origin(rng, offset):
    points, (rotation, translation) = shape(rng), pose(rng)
    reference = moved(points, rotation, translation)
    shift = np.array([offset, -offset, 0.3 * offset])
    near, far = register(points, reference), register(points + shift, reference + shift)
    assert angle_deg(far.rotation, near.rotation) < 0.01
    # Where the points land, in the frame of the reference without its offset.
    landed = moved(points + shift, far.rotation, far.translation) - shift
    extent = np.ptp(points, axis=0).max()
    expected = moved(points, near.rotation, near.translation)
    np.testing.assert_allclose(landed, expected, atol=1e-3 * extent)


def test_t13_right_angles_and_the_rotations_of_the_cube(rng):
    points = rng.normal(size=(12, 3))
    quarter_turns = list(Rotation.create_group("O").as_matrix())
    for axis in (*np.eye(3), rng.normal(size=3)):
        unit = axis / np.linalg.norm(axis)
        angles = np.radians([90, 120, 180])
        quarter_turns += list(Rotation.from_rotvec(angles[:, None] * unit).as_matrix())
    for rotation in quarter_turns:
        result = solve(points, points @ rotation.T, np.ones(12))
        np.testing.assert_allclose(result.rotation, rotation, atol=1e-12)


def test_t14_clouds_without_overlap_get_no_confident_pose(rng):
    flat = rng.uniform(size=(300, 3)) * [2.0, 1.0, 0.0]
    ball = rng.normal(size=(300, 3))
    ball *= 0.5 / np.linalg.norm(ball, axis=1, keepdims=True)
    result = register(flat, ball)
    assert_proper(result.rotation)
    assert not result.success


@pytest.mark.parametrize(("overlap", "outliers"), [(0.9, 0.0), (0.9, 0.2), (0.7, 0.0)])
def test_t15_part_of_the_points_in_common_and_outliers(rng, overlap, outliers):
    points, (rotation, translation) = shape(rng, 800), pose(rng)
    order = np.argsort(points[:, 0])
    cut = int(round(len(points) * (1 - overlap) / 2))
    source, reference = points[order[cut:]], points[order[: len(points) - cut]]
    extra = rng.uniform(-1, 3, (int(outliers * len(source)), 3))
    source = np.concatenate([source, extra])
    result = register(source, moved(reference, rotation, translation))
    error = angle_deg(result.rotation, rotation)
    print(f"overlap {overlap}, outliers {outliers}: {error:.3f} degrees")
    assert error < 2


def test_t16_a_mirrored_reference_never_gives_a_mirror(rng):
    points = shape(rng)
    mirrored = points * [1.0, 1.0, -1.0]
    assert_proper(np.asarray(solve(points, mirrored, np.ones(len(points))).rotation))
    assert_proper(register(points, mirrored).rotation)


def test_t17_weights_of_zero_below_zero_and_a_single_one(rng):
    source, reference = rng.normal(size=(2, 6, 3))
    for weights in (np.zeros(6), -np.ones(6)):
        result = solve(source, reference, weights)
        np.testing.assert_array_equal(result.rotation, np.eye(3))
        np.testing.assert_array_equal(result.translation, 0)
    result = solve(source, reference, np.eye(6)[4])
    np.testing.assert_allclose(moved(source[4], *result), reference[4], atol=1e-14)
    assert_proper(np.asarray(result.rotation))


@pytest.mark.loose
def test_t18_what_stands_in_the_padding_changes_no_bit(rng):
    # That padded equals unpadded is a test of each stage; here, the whole training objective.
    source, reference = shape(rng, 80)[::4], shape(rng, 80)[1::4]
    expected = run_network(source, reference, fill=0.0)
    for fill in (1e6, np.nan, np.inf):
        result = run_network(source, reference, fill=fill)
        jax.tree.map(np.testing.assert_array_equal, result, expected)
    assert_finite(expected)


@pytest.mark.loose
def test_t19_a_batch_of_three_equals_three_singles(rng):
    pairs = [(shape(rng, 4 * n)[::4], shape(rng, 4 * n)[1::4]) for n in (12, 20, 30)]
    clouds, masks = np.full((2, 3, ROWS, 3), np.nan), np.zeros((2, 3, ROWS), bool)
    for row, pair in enumerate(pairs):
        for side, points in enumerate(pair):
            clouds[side, row, : len(points)], masks[side, row, : len(points)] = points, True

    @jax.jit
    def batch(variables, *inputs):
        def one(a, b, a_mask, b_mask):
            config = Config(model=SMALL)
            return register_pair(
                variables, a, b, config=config, source_mask=a_mask, reference_mask=b_mask
            )

        return jax.vmap(one)(*inputs)

    together = batch(variables(), *clouds, *masks)
    for row, pair in enumerate(pairs):
        single, _ = run_network(*pair)
        for a, b in zip(together, single, strict=True):
            np.testing.assert_allclose(a[row], b, atol=1e-9)


@pytest.mark.parametrize("kind", ["generic", "grid", "duplicates"])
def test_t20_the_order_of_the_points_plays_no_role(rng, kind):
    points, (rotation, translation) = shape(rng), pose(rng)
    if kind == "grid":
        axis = np.arange(7.0)
        points = np.stack(np.meshgrid(axis, axis[:4], axis[:2]), axis=-1).reshape(-1, 3)
    if kind == "duplicates":
        points = np.repeat(points[::3], 3, axis=0)
    reference = moved(points, rotation, translation)
    p, q = rng.permutation(len(points)), rng.permutation(len(points))
    result, permuted = register(points, reference), register(points[p], reference[q])
    np.testing.assert_array_equal(permuted.transformation, result.transformation)
    np.testing.assert_array_equal(permuted.confidence, result.confidence[p])
    np.testing.assert_array_equal(permuted.correspondences, result.correspondences[p])


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


def test_t21_same_input_same_bits_on_one_device_and_on_two(rng):
    points, (rotation, translation) = shape(rng), pose(rng)
    reference = moved(points, rotation, translation)
    first, second = register(points, reference), register(points, reference)
    np.testing.assert_array_equal(first.transformation, second.transformation)
    flags = "--xla_force_host_platform_device_count=2"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", TWO_DEVICES], env=environment, check=True)


@pytest.mark.parametrize("argument", ["source", "reference", "weights"])
def test_t22_derivatives_equal_differences(rng, argument):
    problem = {
        "source": rng.normal(size=(7, 3)),
        "reference": rng.normal(size=(7, 3)),
        "weights": rng.uniform(0.5, 1, 7),
    }
    problem = {name: jnp.asarray(x) for name, x in problem.items()}

    def of_argument(x):
        return solve(**(problem | {argument: x}))

    check_grads(of_argument, (problem[argument],), order=2, rtol=1e-6, atol=1e-6)


def test_t23_ten_sizes_in_one_bucket_compile_once(rng):
    compilations = []

    def listen(event, duration, **_):
        if event.endswith("backend_compile_duration"):
            compilations.append(event)

    clouds = {n: (shape(rng, n), *pose(rng)) for n in (260, *range(264, 300, 4))}
    for n, (points, rotation, translation) in clouds.items():
        result = register(points, moved(points, rotation, translation))
        assert_proper(result.rotation)
        if n == 260:
            jax.monitoring.register_event_duration_secs_listener(listen)
    jax.monitoring.unregister_event_duration_listener(listen)
    assert len(compilations) == 0


KILLED = """
import os, signal, sys
import jax.numpy as jnp
from jaxreg import checkpoint
from jaxreg.config import Config

with checkpoint.open_run(sys.argv[1], Config()) as run:
    for step in (1, 2):
        run.save(step, {"weights": jnp.full((512, 512), float(step))}, error=1.0)
        run.log({"step": step})
        if step == 1:
            run._latest.wait_until_finished()
    # The second save is under way in another thread.
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_t24_killed_during_a_save(tmp_path):
    # What a resumed run then computes is compared bit by bit in the tests of training.
    done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
    assert done.returncode == -signal.SIGKILL
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"step": 3, "lo')  # Killed while it wrote a line, too.
    with checkpoint.open_run(tmp_path, Config()) as run:
        state = run.restore({"weights": jnp.zeros((512, 512), jnp.float32)})
    values = np.unique(state["weights"])
    assert values in ([1.0], [2.0])
    logged = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert len(logged) == int(values[0])


@pytest.mark.loose
def test_t25_a_regular_grid_has_constant_features(rng):
    axis = np.arange(3.0)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    for reference in (grid, grid + 0.25, 2 * grid):
        assert_finite(run_network(grid, reference))
    assert np.isfinite(np.asarray(jax.jit(knn, static_argnums=1)(grid, 6))).all()
    result = register(grid, grid + 0.1)
    assert_proper(result.rotation)


def test_buckets_hold_their_sizes():
    assert [scans.bucket(n, smallest=64, largest=256) for n in (3, 64, 65, 256)] == [
        64,
        64,
        128,
        256,
    ]
