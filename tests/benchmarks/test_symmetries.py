"""Which wrong poses are symmetries of the shape: of shapes whose symmetries are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.scans import protocols, symmetries
from jaxreg.data.procedural.shapes import sample_shape
from jaxreg.types import RigidTransform

pytestmark = pytest.mark.float32


def box(rng, n=6000, size=(1.0, 0.6, 0.3)):
    points = rng.uniform(-1, 1, (n, 3))
    points[np.arange(n), rng.integers(0, 3, n)] = rng.choice([-1, 1], n)
    return points * size


def test_the_half_turns_of_a_box_lay_it_on_itself(seed):
    rng = np.random.default_rng(seed)
    truth = RigidTransform(Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3))
    whole = box(rng) @ truth.rotation.T + truth.translation
    for axis, quarters, same in (("x", 2, True), ("y", 2, True), ("z", 1, False)):
        turn = Rotation.from_euler(axis, 90 * quarters, degrees=True).as_matrix()
        found = RigidTransform(truth.rotation @ turn, truth.translation)
        assert (symmetries.apart(whole, found, truth) < 0.08) == same
    # Where the source came from does not matter, what matters is the motion between the two poses.
    before = Rotation.random(random_state=rng).as_matrix()
    moved = [
        RigidTransform(pose.rotation @ before, pose.translation + pose.rotation @ [1.0, 2.0, 3.0])
        for pose in (found, truth)
    ]
    assert symmetries.apart(whole, *moved) == pytest.approx(symmetries.apart(whole, found, truth))


def test_the_whole_shape_lies_where_the_reference_does(seed):
    clouds = np.stack([sample_shape(3, i, points=64) for i in range(4)])
    shapes = protocols.Shapes(clouds, np.array(["chair", "vase", "table", "sofa"]))
    options = symmetries.Options(pairs=8)
    made = list(symmetries.cases("crops50", shapes, seed, options))
    assert len(made) == 6, "two of the eight are vases"
    for case in made:
        reference = np.asarray(case.pair.reference.points)
        apart = np.linalg.norm(reference[:, None] - case.whole[None], axis=2).min(axis=1)
        np.testing.assert_allclose(apart, 0, atol=1e-5)


def test_the_identity_is_right_nowhere_and_the_truth_everywhere(monkeypatch):
    clouds = np.stack([sample_shape(3, i, points=64) for i in range(2)])
    shapes = protocols.Shapes(clouds, np.array(["chair", "table"]))
    options = symmetries.Options(pairs=3, seeds=(1, 2))
    for batch, right in (
        (lambda pair: pair.transform, 6),
        (protocols.methods.choose("identity").batch, 0),
    ):
        monkeypatch.setattr(
            symmetries.methods, "choose", lambda _, b=batch: protocols.methods.Method(b, None)
        )
        row = symmetries.measure("resampled", shapes, options)
        assert (row["pairs"], row["right"], row["wrong"]) == (6, right, 6 - right)
