"""What measures the verdict: pairs whose truth is known, and the counts of what was said of them."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks.scans import verdict
from jaxreg.data.procedural.shapes import sample_shape

pytestmark = pytest.mark.float32

SURE, HOPELESS = 0.97, 0.02


def entry(source="procedural", kind="full", *, right=True, probability=SURE, rival=0.0):
    return {
        "source": source, "kind": kind, "right": right, "success": probability >= 0.5,
        "probability": probability, "rival": rival,
    }  # fmt: skip


@pytest.mark.parametrize("kind", verdict.KINDS)
def test_a_pair_is_what_its_kind_says(kind, seed):
    index = list(verdict.KINDS).index(kind)
    rng = np.random.default_rng(seed)
    source, reference, truth, found = verdict.make_pair(
        lambda i: sample_shape(5, i, points=600), index, rng
    )
    assert found == kind
    assert (truth is None) == (kind in ("unrelated", "apart"))
    if truth is None:
        return
    moved = source @ truth[:3, :3].T + truth[:3, 3]
    distance = cKDTree(reference).query(moved)[0]
    assert np.median(distance) < 0.15, "the truth lays one sampling on the other"
    assert (len(source) < 300) == (kind == "crops")
    assert distance.min() > 0, "the two share no point"


@pytest.mark.slow
def test_registering_the_pairs_finds_the_right_pose(monkeypatch, records):
    monkeypatch.setattr(
        verdict,
        "sources",
        lambda options: {"procedural": lambda i: sample_shape(77, 100_007, points=900)},
    )
    [found] = verdict.run(verdict.Options(pairs=1))
    assert (found["source"], found["kind"]) == ("procedural", "full")
    assert found["right"] is True
    assert found["success"] is True
    assert found["probability"] + found["rival"] <= 1 + 1e-6
    verdict.main(verdict.Options(pairs=1, record=False))
    assert not list(records.folder.iterdir())


def test_counts_of_right_and_wrong_verdicts():
    entries = [entry()] * 5 + [entry(probability=HOPELESS)] * 3
    entries += [entry(right=False)] * 2 + [entry(right=False, probability=0.55, rival=0.4)]
    entries += [entry(right=False, probability=HOPELESS)]
    assert verdict.counts(entries) == {
        "pairs": 12,
        "right": 8,
        "right_called_failure": 3,
        "wrong_called_success": 3,
        "wrong_without_rival": 2,
    }
    assert verdict.counts([entry(kind="apart", right=False)]) == {
        "pairs": 1,
        "right": 0,
        "right_called_failure": None,
        "wrong_called_success": 1,
        "wrong_without_rival": 1,
    }


def test_the_records_fit_the_page_and_are_those_of_the_pairs(records):
    entries = [
        entry(source, kind, right=kind in verdict.GOOD, probability=probability)
        for source in verdict.SOURCES
        for kind in verdict.KINDS
        for probability in (SURE, HOPELESS)
        if (source, kind) != ("7Scenes", "unrelated")
    ]
    assert len(list(verdict.write(entries))) == 2
    assert records.fits("verdict", "verdict_probability")
    rows, setting = (records.read("verdict")[key] for key in ("rows", "setting"))
    assert rows["modelnet"] == {
        "label": "ModelNet40: samplings, noise, own crops",
        "pairs": 6,
        "right": 6,
        "right_called_failure": 3,
        "wrong_called_success": 0,
        "wrong_without_rival": 0,
    }
    assert "scenes_unrelated" not in rows
    assert rows["scenes_ends"]["label"] == "7Scenes: two ends of one scan"
    assert (setting["good"], setting["good_called_failure"]) == (18, 9)
    assert (setting["ends_of_shapes"], setting["ends_of_shapes_called_success"]) == (4, 2)
    probability = records.read("verdict_probability")["rows"]
    assert sum(row["pairs"] for row in probability.values()) == len(entries)
    assert probability["p90"] == {"label": "0.9 or more", "pairs": 14, "right": 9 / 14}
