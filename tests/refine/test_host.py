"""The host driver: tree equals brute force, any offset and unit, and errors that name the row."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.refine import kdtree
from jaxreg.refine.host import refine
from jaxreg.refine.uncertainty import pose_uncertainty
from jaxreg.types import RigidTransform
from tests.compiled import gicp

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
def test_tree_equals_brute_force(method, seed):
    source, reference, _ = make_pair(seed)
    options = {"method": method, "kernel": "none", "iterations": 80, "tolerance": 1e-12}
    dense = refine(source, reference, **options)
    large = refine(source, reference, dense_limit=0, **options)
    np.testing.assert_allclose(large.transform.rotation, dense.transform.rotation, atol=1e-9)
    np.testing.assert_allclose(large.transform.translation, dense.transform.translation, atol=1e-9)
    assert dense.converged is None
    assert large.converged
    for a, b in zip(large.uncertainty, dense.uncertainty, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-12)


def test_covariance_is_that_of_one_direction_above_the_limit_too(seed):
    source, reference, _ = make_pair(seed)
    options = {"kernel": "none", "iterations": 80, "tolerance": 1e-12, "both_directions": True}
    small = refine(source, reference, **options).uncertainty
    large = refine(source, reference, dense_limit=0, **options).uncertainty
    np.testing.assert_allclose(large.covariance, small.covariance, rtol=1e-5, atol=1e-12)


@pytest.mark.untyped
def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match="icp, point_to_plane, gicp, got 'plane'"):
        refine(*make_pair(0)[:2], method="plane")


@pytest.mark.parametrize("dense_limit", [0, 1000])
def test_edges_stop_a_plate_from_sliding(dense_limit):
    """As `test_gicp.py` has it, through the host, by trees and by brute force."""
    x, y = np.random.default_rng(0).uniform(0, 1, (2, 700, 3)) * [1, 1, 0]
    offset = np.array([0.03, -0.02, 0.0])
    options = {"max_distance": 0.06, "thickness": 0.01, "neighbors": 16, "both_directions": True}

    def slide(edges):
        options["edges"] = edges
        pose = refine(x + offset, y, dense_limit=dense_limit, **options).transform
        centre = x.mean(axis=0)
        return np.linalg.norm(pose.rotation @ (centre + offset) + pose.translation - centre)

    assert slide(edges=True) < 0.5 * slide(edges=False)


def test_brute_force_is_the_pure_function(seed):
    source, reference, _ = make_pair(seed)
    expected = gicp(jnp.asarray(source), jnp.asarray(reference))
    result = refine(source, reference)
    np.testing.assert_allclose(result.transform.rotation, expected.rotation, atol=1e-9)
    np.testing.assert_allclose(result.transform.translation, expected.translation, atol=1e-9)
    uncertainty = pose_uncertainty(expected, jnp.asarray(source), jnp.asarray(reference))
    for a, b in zip(result.uncertainty, uncertainty, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-12)


@pytest.mark.float32
@pytest.mark.parametrize("dense_limit", [0, 1000])
@pytest.mark.parametrize(("offset", "factor"), [(5e6, 1.0), (0.0, 1e-6), (0.0, 1e6)])
def test_offset_and_unit_do_not_matter(offset, factor, dense_limit, seed):
    source, reference, _ = make_pair(seed)
    plain = refine(source, reference, dense_limit=dense_limit).transform
    moved = refine(
        factor * (source + offset), factor * (reference + offset), dense_limit=dense_limit
    ).transform
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
    result = refine(source, reference, method=method, both_directions=True)
    assert angle_deg(result.transform.rotation, truth.rotation) < 0.05
    np.testing.assert_allclose(result.transform.translation, truth.translation, atol=1e-3)


def test_initial_pose_is_used(seed):
    source, reference, truth = make_pair(seed)
    turn = Rotation.from_euler("y", 120, degrees=True).as_matrix()
    start = RigidTransform(truth.rotation @ turn.T, truth.translation)
    result = refine(source @ turn.T, reference, initial=start)
    assert angle_deg(result.transform.rotation, start.rotation) < 0.5


BAD = {
    "must have shape": np.zeros((20, 2)),
    "not numeric": np.array([["a", "b", "c"]] * 20),
    "first in row 3": np.where(np.arange(20)[:, None] >= 3, np.nan, np.zeros((20, 3))),
    "need more": np.zeros((4, 3)),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_clouds_are_named(message):
    good = np.random.default_rng(0).normal(size=(20, 3))
    with pytest.raises(ValueError, match=f"reference.*{message}"):
        refine(good, BAD[message])
    with pytest.raises(ValueError, match=f"source.*{message}"):
        refine(BAD[message], good)
