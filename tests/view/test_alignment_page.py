"""The page of many scans: its data against what was put in."""

import os

import numpy as np
import pytest
from matplotlib.image import imread
from scipy.spatial.transform import Rotation

from jaxreg.scans.many import AlignedPair, Alignment
from jaxreg.scans.relation import Relation
from jaxreg.view.alignment_page import colour, draw_alignment, write_alignment_page
from tests.view.test_page import content_of

NAMES = ["a.ply", "b.ply", "c.ply", "d.ply"]


def pair(source, reference, *, used=True, success=True, probability=0.98):
    relation = Relation(
        source, reference, "search", np.eye(4), probability, success, "", 0.5, 0.1, np.eye(6)
    )
    return AlignedPair(relation, probability, used, "" if used else "It contradicts others.")


@pytest.fixture
def alignment(seed):
    """Three scans in a group, the fourth alone; a pair is refused, another was no success."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(4, random_state=rng).as_matrix()
    translation = rng.normal(size=(4, 3)) + [4e5, 5e6, 0]
    rotation[3], translation[3] = np.nan, np.nan
    covariance = np.repeat(1e-4 * np.eye(6)[None], 4, 0)
    covariance[3] = np.nan
    return Alignment(
        rotation, translation, ((0, 1, 2),), np.array([1.0, 0.95, 0.9, 0]), covariance,
        np.zeros((4, 3)),
        (pair(1, 0), pair(2, 1), pair(2, 0, used=False), pair(3, 0, used=False, success=False)),
        ("", "", "", "No pair of it is sure."), (), (),
    )  # fmt: skip


def test_scans_stand_where_they_are_placed_and_pairs_join_them(alignment, tmp_path, seed):
    rng = np.random.default_rng(seed)
    clouds = [rng.normal(size=(100, 3)) for _ in NAMES]
    write_alignment_page(tmp_path / "p.html", clouds, alignment, names=NAMES)
    content = content_of(tmp_path / "p.html")
    assert [cloud["name"] for cloud in content["clouds"]] == NAMES[:3]
    assert len({cloud["rgb"] for cloud in content["clouds"]}) == 3
    assert [edge[6:] for edge in content["edges"]] == [[0.98, 1], [0.98, 1], [0.98, 0]]
    placed = [
        cloud @ alignment.rotation[k].T + alignment.translation[k]
        for k, cloud in enumerate(clouds[:3])
    ]
    way = placed[1].mean(axis=0) - placed[0].mean(axis=0)
    edge = np.array(content["edges"][0])
    np.testing.assert_allclose(edge[:3] - edge[3:6], way, atol=1e-6)
    figures = dict(content["figures"])
    assert figures["not placed: d.ply"] == "No pair of it is sure."
    assert figures["refused: c.ply, a.ply"] == "It contradicts others."
    assert content["verdict"] == {
        "text": "3 of 4 scans placed (the probability of each is 0.90 or more)", "good": False
    }  # fmt: skip


def test_a_picture_is_drawn(alignment, tmp_path, seed):
    rng = np.random.default_rng(seed)
    clouds = [rng.normal(size=(100, 3)) for _ in NAMES]
    draw_alignment(tmp_path / "p.png", clouds, alignment, names=NAMES)
    assert imread(tmp_path / "p.png").ndim == 3


def test_names_that_are_not_utf8_are_drawn_and_written_as_far_as_they_are(
    alignment, tmp_path, seed
):
    rng = np.random.default_rng(seed)
    clouds = [rng.normal(size=(10 + k, 3)) for k in range(4)]
    names = [os.fsdecode(b"sc\xe4n%d.ply" % k) for k in range(4)]
    draw_alignment(tmp_path / "p.png", clouds, alignment, names=names)
    assert imread(tmp_path / "p.png").ndim == 3
    write_alignment_page(tmp_path / "p.html", clouds, alignment, names=names)
    assert [cloud["name"] for cloud in content_of(tmp_path / "p.html")["clouds"]] == names[:3]


def test_colours_of_a_hundred_scans_differ():
    found = np.array([colour(k) for k in range(100)])
    distance = np.linalg.norm(found[:, None] - found[None], axis=2)
    assert (distance[~np.eye(100, dtype=bool)] > 0.01).all()
    near = distance[np.arange(99), np.arange(1, 100)]
    assert (near > 0.3).all()
