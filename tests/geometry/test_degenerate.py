"""What goes wrong with point clouds, one named case each, and what must happen then.

Here the solver with true correspondences. The network is in test_degenerate_network.py, the host entry
point in test_degenerate_scans.py, and T26, the files, in the tests of the file formats.
"""

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

from jaxreg.config import Config
from jaxreg.geometry.procrustes import weighted_procrustes
from jaxreg.weights import checkpoint
from tests.scenes import assert_proper, moved, pose, revolved, shape

solve = jax.jit(weighted_procrustes)


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def test_t01_identical_clouds(rng):
    points = shape(rng)
    result = solve(points, points, np.ones(len(points)))
    np.testing.assert_allclose(result.rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(result.translation, 0, atol=1e-12)


def test_t02_t03_a_known_pose_and_its_inverse(rng):
    points, (rotation, translation) = shape(rng), pose(rng)
    reference, weights = moved(points, rotation, translation), np.ones(len(points))
    there, back = solve(points, reference, weights), solve(reference, points, weights)
    np.testing.assert_allclose(there.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(back.rotation, rotation.T, atol=1e-12)
    np.testing.assert_allclose(moved(reference, *back), points, atol=1e-12)


@pytest.mark.parametrize("generic", [False, True], ids=["z = 0", "any plane"])
def test_t04_coplanar_points_have_one_rotation(rng, generic):
    points = rng.normal(size=(20, 3)) * [1.0, 1.0, 0.0]
    if generic:
        points = moved(points, *pose(rng))
    rotation, translation = pose(rng)
    result = solve(points, moved(points, rotation, translation), np.ones(20))
    np.testing.assert_allclose(result.rotation, rotation, atol=1e-12)


@pytest.mark.parametrize("name", ["circle", "cylinder", "sphere"])
def test_t05_shapes_of_revolution(rng, name):
    points = revolved(rng, name)
    reference = moved(points, *pose(rng))
    exact = solve(points, reference, np.ones(len(points)))
    np.testing.assert_allclose(moved(points, *exact), reference, atol=1e-10)


@pytest.mark.parametrize("count", [1, 2, 6])
def test_t06_points_of_a_line_and_fewer(rng, count):
    points = np.outer(np.arange(count) + 1.0, [1.0, -2.0, 0.5])
    reference = moved(points, *pose(rng))
    result = solve(points, reference, np.ones(count))
    assert_proper(np.asarray(result.rotation))
    np.testing.assert_allclose(moved(points, *result), reference, atol=1e-10)


def test_t08_each_point_ten_times_is_the_same_as_once(rng):
    points = shape(rng)
    reference = moved(points, *pose(rng)) + rng.normal(0, 0.01, points.shape)
    often = [np.repeat(x, 10, axis=0) for x in (points, reference)]
    once = solve(points, reference, np.ones(len(points)))
    ten = solve(*often, np.ones(10 * len(points)))
    np.testing.assert_allclose(ten.rotation, once.rotation, atol=1e-12)
    np.testing.assert_allclose(ten.translation, once.translation, atol=1e-12)


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


def test_t16_a_mirrored_reference_never_gives_a_mirror(rng):
    points = shape(rng)
    result = solve(points, points * [1.0, 1.0, -1.0], np.ones(len(points)))
    assert_proper(np.asarray(result.rotation))


def test_t17_weights_of_zero_below_zero_and_a_single_one(rng):
    source, reference = rng.normal(size=(2, 6, 3))
    for weights in (np.zeros(6), -np.ones(6)):
        result = solve(source, reference, weights)
        np.testing.assert_array_equal(result.rotation, np.eye(3))
        np.testing.assert_array_equal(result.translation, 0)
    result = solve(source, reference, np.eye(6)[4])
    np.testing.assert_allclose(moved(source[4], *result), reference[4], atol=1e-14)
    assert_proper(np.asarray(result.rotation))


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


def test_t21_same_input_same_bits_on_one_device_and_on_two():
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
