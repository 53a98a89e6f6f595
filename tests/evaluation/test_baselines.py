"""Every baseline on exact copies of a shape without symmetry, with and without outliers."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.evaluation.baselines import choose, open3d
from jaxreg.evaluation.metrics import evaluate_transforms
from jaxreg.types import RigidTransform

pytest.importorskip("open3d", reason="the baselines are not installed", exc_type=ImportError)
pytest.importorskip("small_gicp", reason="the baselines are not installed", exc_type=ImportError)

LOCAL = ("open3d_icp", "open3d_icp_point_to_plane", "open3d_icp_coarse_to_fine", "small_gicp")
GLOBAL = ("open3d_fgr", "open3d_fpfh_ransac")
TUTORIAL = ("open3d_fgr_icp", "open3d_fgr_icp_default", "open3d_ransac_icp")
REFINED = ("open3d_fgr_gicp", "open3d_ransac_gicp", *TUTORIAL)


def shape(rng, n=900):
    """A bumpy ellipsoid: smooth, closed, and unlike itself under any rotation."""
    p = rng.normal(size=(n, 3))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    radius = 1 + 0.25 * np.sin(3 * p[:, :1] + p[:, 1:2]) + 0.2 * np.cos(4 * p[:, 2:] * p[:, :1])
    return p * radius * [0.9, 0.65, 0.45]


def make_pair(seed, degrees):
    rng = np.random.default_rng(seed)
    source = shape(rng)
    axis = rng.normal(size=3)
    rotation = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    truth = RigidTransform(rotation, rng.uniform(-0.1, 0.1, 3))
    return source, rng.permutation(source @ rotation.T + truth.translation), truth


def errors(transform, truth):
    stack = [RigidTransform(t.rotation[None], t.translation[None]) for t in (transform, truth)]
    return evaluate_transforms(*stack)


@pytest.mark.parametrize("name", LOCAL)
def test_local_methods_find_a_small_motion(name, seed):
    source, reference, truth = make_pair(seed, 8)
    assert errors(choose(name)(source, reference), truth)["recall_1deg"] == 1


@pytest.mark.parametrize("name", GLOBAL + REFINED)
def test_global_methods_find_a_large_motion(name, seed):
    source, reference, truth = make_pair(seed, 120)
    result = errors(choose(name)(source, reference), truth)
    # Without refinement any pose counts whose matches lie within 1.5 spacings, some degrees.
    assert result["recall_5deg"] == 1
    if name in REFINED:
        assert result["mie_r_deg"] < 0.05
        assert result["mie_t"] < 0.001


def test_normals_turn_with_the_cloud(seed):
    """Else FPFH would describe the same surface in two ways."""
    source, _, _ = make_pair(seed, 0)
    rotation = Rotation.random(random_state=seed).as_matrix()
    normals, turned = (
        np.asarray(open3d._cloud(x, "source", 0.1).normals) for x in (source, source @ rotation.T)
    )
    np.testing.assert_allclose(turned, normals @ rotation.T, atol=1e-6)


@pytest.mark.parametrize("name", TUTORIAL)
def test_the_tutorial_takes_features_of_voxels_and_refines_on_all_points(name, seed, monkeypatch):
    """On scans that are much denser than the voxels; and one that is not stays as it is."""
    described, refined = [], []
    fpfh, to_plane = open3d._fpfh, open3d._to_plane
    monkeypatch.setattr(
        open3d, "_fpfh", lambda cloud, s: described.append(len(cloud.points)) or fpfh(cloud, s)
    )
    monkeypatch.setattr(
        open3d,
        "_to_plane",
        lambda x, y, *rest: refined.append((len(x.points), len(y.points))) or to_plane(x, y, *rest),
    )
    rng = np.random.default_rng(seed)
    source, reference = shape(rng, 12_000), shape(rng, 10_000)
    rotation = Rotation.from_euler("xyz", [30, 50, 20], degrees=True).as_matrix()
    truth = RigidTransform(rotation, np.array([0.3, 0.0, -0.2]))
    found = choose(name)(source, reference @ rotation.T + truth.translation, spacing=0.1)
    assert errors(found, truth)["mie_r_deg"] < 1
    voxels = [len(np.unique(np.floor(x / 0.1), axis=0)) for x in (source, reference)]
    assert described == pytest.approx(voxels, rel=0.15)
    assert refined == [(12_000, 10_000)]
    described.clear()
    choose(name)(source[:900], reference[:800], spacing=0.05)
    assert described == [900, 800]


def test_fgr_is_run_as_its_authors_do_and_as_open3d_does(seed, monkeypatch):
    given = []
    registration = open3d._registration()
    option = registration.FastGlobalRegistrationOption
    monkeypatch.setattr(
        registration,
        "FastGlobalRegistrationOption",
        lambda **options: given.append(options) or option(**options),
    )
    source, reference, _ = make_pair(seed, 5)
    for name in ("open3d_fgr", "open3d_fgr_gicp", "open3d_fgr_icp", "open3d_fgr_icp_default"):
        choose(name)(source, reference)
    assert [options["decrease_mu"] for options in given] == [True, True, True, False]
    assert {options["maximum_correspondence_distance"] for options in given} == {0.025}
    assert option().decrease_mu is False, "what the default row is named after"


def test_kiss_matcher_finds_a_large_motion(seed):
    pytest.importorskip("kiss_matcher", reason="the baselines are not installed")
    source, reference, truth = make_pair(seed, 120)
    result = errors(choose("kiss_matcher_icp@0.1")(source, reference), truth)
    assert result["recall_1deg"] == 1


@pytest.mark.parametrize("name", LOCAL + GLOBAL + REFINED)
def test_sizes_differ_and_the_same_call_gives_the_same_transform(name, seed):
    source, reference, truth = make_pair(seed, 5)
    first, second = (choose(name)(source[:800], reference) for _ in range(2))
    np.testing.assert_allclose(first.rotation, second.rotation, atol=1e-9)
    np.testing.assert_allclose(first.translation, second.translation, atol=1e-9)
    assert errors(first, truth)["recall_5deg"] == 1


@pytest.mark.parametrize("name", ["open3d_fgr_gicp", "open3d_ransac_icp", "small_gicp"])
def test_spacing_is_the_only_length(name, seed):
    source, reference, truth = make_pair(seed, 5)
    scaled = choose(name)(100 * source, 100 * reference, spacing=5.0)
    np.testing.assert_allclose(scaled.rotation, truth.rotation, atol=1e-3)
    np.testing.assert_allclose(scaled.translation, 100 * truth.translation, atol=0.1)


@pytest.mark.untyped
@pytest.mark.parametrize("name", ["open3d_icp", "small_gicp"])
def test_bad_input_is_named(name, seed):
    source, reference, _ = make_pair(seed, 5)
    spoiled = reference.copy()
    spoiled[7, 1] = np.nan
    for arguments, options, message in (
        ((source, spoiled), {}, "reference: 1 of 900 points are not finite, the first is point 7"),
        ((source[:, :2], reference), {}, r"source has shape \(900, 2\)"),
        ((source, reference[:2]), {}, "reference has 2 finite points"),
        ((source, reference), {"spacing": 0.0}, "spacing = 0.0 must be positive"),
    ):
        with pytest.raises(ValueError, match=message):
            choose(name)(*arguments, **options)
