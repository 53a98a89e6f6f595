import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.search import register_global
from jaxreg.search.config import SearchConfig
from jaxreg.search.learned import init_network
from jaxreg.search.pipeline import search_poses
from jaxreg.types import RigidTransform
from tests.search.clouds import angle_deg, make_pair, padded

pytestmark = [pytest.mark.float32]
CONFIG = SearchConfig(candidates=256, screened=24, aligned=8)


@jax.jit
def solve_and_grad(x, y, a, b):
    """The registration and the gradient of its rotation's first row: all tests share one program."""

    def total(x):
        found = register_global(x, y, source_mask=a, reference_mask=b, config=CONFIG)
        return jnp.sum(found.rotation[0]), found

    gradient, found = jax.grad(total, has_aux=True)(x)
    return found, gradient


def solve(*clouds):
    return solve_and_grad(*clouds)[0]


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_any_rotation_of_another_sampling_with_padding(scale, seed):
    source, reference, turn = make_pair(seed, scale)
    x, mask = padded(source, 400, np.nan)
    y, other = padded(reference, 400, np.nan)
    found = solve(x, y, mask, other)
    assert angle_deg(found.rotation, turn) < 2
    np.testing.assert_allclose(found.translation, 2 * scale, atol=0.05 * scale)
    assert bool(found.valid)
    confidence = np.asarray(found.confidence)
    assert np.all(confidence[380:] == 0)
    assert confidence[:380].mean() > 0.5
    moved = source @ np.asarray(found.rotation).T + np.asarray(found.translation)
    gap = np.linalg.norm(moved - np.asarray(found.correspondences)[:380], axis=1)
    assert np.median(gap) < 0.08 * scale


@pytest.mark.untyped
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"source_mask": np.ones(39, bool)}, "source_mask must be bool of shape"),
        ({"reference_mask": np.ones(30)}, "reference_mask must be bool"),
        ({"similarity": np.ones((30, 40), np.float32)}, r"shape \(40, 30\), .*one row for every"),
        ({"max_angle": 80}, "max_angle = 80: give an angle in"),
        ({"max_angle": 0.0}, "max_angle = 0.0"),
        ({"also": RigidTransform(np.eye(4), np.zeros(3))}, "also must be a transform"),
        ({"config": SearchConfig(radii=(0.2, 0.4))}, "choose as many radii"),
        ({"network": {"lift": np.ones((49, 64), np.float32)}}, "no weights 'far_add'"),
    ],
)
def test_what_does_not_fit_is_named(options, message):
    x, y = np.ones((40, 3), np.float32), np.ones((30, 3), np.float32)
    options = {"network": init_network(jax.random.key(0))} | options
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(lambda: search_poses(x, y, **options))


@pytest.mark.untyped
@pytest.mark.parametrize("shape", [(40, 2), (2, 40, 3), (0, 3)])
def test_what_is_no_cloud_is_named(shape):
    cloud, wrong = np.ones((40, 3), np.float32), np.ones(shape, np.float32)
    for clouds, name in (((wrong, cloud), "source"), ((cloud, wrong), "reference")):
        with pytest.raises(ValueError, match=f"{name} must have shape"):
            jax.eval_shape(lambda clouds=clouds: register_global(*clouds))
    with pytest.raises(ValueError, match="40 and 3 rows, but the search needs 4"):
        jax.eval_shape(lambda: register_global(cloud, cloud[:3]))
    with pytest.raises(ValueError, match="source has dtype int32"):
        jax.eval_shape(lambda: register_global(cloud.astype(np.int32), cloud))


def test_no_valid_point_gives_the_identity(seed):
    source, reference, _ = make_pair(seed)
    x, mask = padded(source, 400, np.nan)
    y, other = padded(reference, 400, np.nan)
    found = solve(x, y, mask & False, other)
    assert not bool(found.valid)
    np.testing.assert_allclose(found.transformation, np.eye(4), atol=1e-6)
    assert np.isfinite(found.correspondences).all()


def test_derivatives_are_finite_and_do_not_see_padding(seed):
    source, reference, _ = make_pair(seed)
    x, mask = padded(source, 400, np.nan)
    y, other = padded(reference, 400, np.nan)
    gradient = np.asarray(solve_and_grad(x, y, mask, other)[1])
    assert np.isfinite(gradient).all()
    assert np.any(gradient[:380] != 0)
    assert np.all(gradient[380:] == 0)


@pytest.mark.slow
def test_large_clouds_end():
    """With LAPACK's eigenvectors of every point the second call waited forever on two cores.

    In a process of its own, which can be ended.
    """
    program = (
        "import jax, numpy as np; from jaxreg.search import register_global;"
        "rng = np.random.default_rng(0); run = jax.jit(register_global);"
        "clouds = [rng.normal(size=(1536, 3)).astype(np.float32) for _ in range(5)];"
        "print(sum(bool(run(x, y).valid) for x, y in zip(clouds, clouds[1:])))"
    )
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=True)
    assert done.stdout.strip() == "4"
