"""The host driver: trees equal the pure functions, any offset and unit, errors that name the row."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.refine import kdtree
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.host import refine_on_host
from jaxreg.types import RigidTransform
from tests.compiled import pose_uncertainty, refine

METHODS = ["icp", "point_to_plane", "gicp"]


def make_pair(seed, n=400, m=500):
    rng = np.random.default_rng(seed)

    def sample(count):
        uv = rng.uniform(-1, 1, (count, 2))
        return np.column_stack([uv, 0.4 * np.sin(3 * uv[:, 0]) * np.cos(2 * uv[:, 1])])

    axis = rng.normal(size=3)
    rotation = Rotation.from_rotvec(0.08 * axis / np.linalg.norm(axis)).as_matrix()
    truth = RigidTransform(rotation, 0.05 * rng.normal(size=3))
    return sample(n), sample(m) @ rotation.T + truth.translation, truth


def angle_deg(a, b):
    return np.rad2deg(Rotation.from_matrix(a @ b.T).magnitude())


@pytest.mark.parametrize("method", METHODS)
def test_trees_equal_the_pure_functions(method, seed):
    source, reference, _ = make_pair(seed)
    config = RefineConfig(method=method, kernel="none", iterations=80, tolerance=1e-12)
    found = refine_on_host(source, reference, config=config)
    clouds = jnp.asarray(source), jnp.asarray(reference)
    expected = refine(*clouds, config=config)
    np.testing.assert_allclose(found.transform.rotation, expected.rotation, atol=1e-9)
    np.testing.assert_allclose(found.transform.translation, expected.translation, atol=1e-9)
    assert found.converged
    uncertainty = pose_uncertainty(expected.transform, *clouds, config=config)
    # The covariance is that of two noisy scans: `refine.uncertainty.scan_covariance`.
    for name in ("information", "variance", "weight", "centre", "length"):
        a, b = getattr(found.uncertainty, name), getattr(uncertainty, name)
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-12, err_msg=name)


def test_information_is_that_of_one_direction_whatever_the_pairs(seed):
    source, reference, _ = make_pair(seed)
    config = RefineConfig(kernel="none", iterations=80, tolerance=1e-12, both_directions=True)
    found = refine_on_host(source, reference, config=config)
    pose = jax.tree.map(jnp.asarray, found.transform)
    clouds = jnp.asarray(source), jnp.asarray(reference)
    expected = pose_uncertainty(pose, *clouds, config=config)
    np.testing.assert_allclose(
        found.uncertainty.information, expected.information, rtol=1e-5, atol=1e-9
    )


@pytest.mark.untyped
def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match="method 'plane' does not exist: choose icp"):
        refine_on_host(*make_pair(0)[:2], config=RefineConfig(method="plane"))


def test_edges_stop_a_plate_from_sliding():
    """As `test_gicp.py` has it, through the host."""
    x, y = np.random.default_rng(0).uniform(0, 1, (2, 700, 3)) * [1, 1, 0]
    offset = np.array([0.03, -0.02, 0.0])

    def slide(edges):
        config = RefineConfig(
            max_correspondence_distance=0.06, both_directions=True, k=16, epsilon=0.01, edges=edges
        )
        pose = refine_on_host(x + offset, y, config=config).transform
        centre = x.mean(axis=0)
        return np.linalg.norm(pose.rotation @ (centre + offset) + pose.translation - centre)

    assert slide(edges=True) < 0.5 * slide(edges=False)


@pytest.mark.float32
@pytest.mark.parametrize(("offset", "factor"), [(5e6, 1.0), (0.0, 1e-6), (0.0, 1e6)])
def test_offset_and_unit_do_not_matter(offset, factor, seed):
    source, reference, _ = make_pair(seed)
    plain = refine_on_host(source, reference).transform
    moved = refine_on_host(factor * (source + offset), factor * (reference + offset)).transform
    shift = np.full(3, offset)
    expected = shift + plain.translation - plain.rotation @ shift
    assert angle_deg(moved.rotation, plain.rotation) < 0.01
    error = moved.translation / factor - expected
    # A rotation of 1e-6 moves the origin by metres at such an offset: compare at the cloud.
    error = error + (moved.rotation - plain.rotation) @ shift
    np.testing.assert_allclose(error, 0, atol=1e-3)
    np.testing.assert_allclose(moved.rotation @ moved.rotation.T, np.eye(3), atol=1e-14)


@pytest.mark.parametrize("method", METHODS[1:])
def test_coarse_start_and_all_points_end(method, seed, monkeypatch):
    monkeypatch.setattr(kdtree, "_COARSE", 300)
    source, reference, truth = make_pair(seed, n=3000, m=4000)
    config = RefineConfig(method=method, both_directions=True)
    result = refine_on_host(source, reference, config=config)
    assert angle_deg(result.transform.rotation, truth.rotation) < 0.05
    np.testing.assert_allclose(result.transform.translation, truth.translation, atol=1e-3)


def test_initial_pose_is_used(seed):
    source, reference, truth = make_pair(seed)
    turn = Rotation.from_euler("y", 120, degrees=True).as_matrix()
    start = RigidTransform(truth.rotation @ turn.T, truth.translation)
    result = refine_on_host(source @ turn.T, reference, initial=start)
    assert angle_deg(result.transform.rotation, start.rotation) < 0.5


BAD = {
    "has shape": np.zeros((20, 2)),
    "has dtype": np.array([["a", "b", "c"]] * 20),
    "the first is point 3, ": np.where(np.arange(20)[:, None] >= 3, np.nan, np.zeros((20, 3))),
    "2 finite points": np.zeros((2, 3)),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_clouds_are_named(message):
    good = np.random.default_rng(0).normal(size=(20, 3))
    with pytest.raises(ValueError, match=f"reference.*{message}"):
        refine_on_host(good, BAD[message])
    with pytest.raises(ValueError, match=f"source.*{message}"):
        refine_on_host(BAD[message], good)
