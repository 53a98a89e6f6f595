"""What fits and judges the verdict: pairs whose truth is known, a regression, and the counts."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxreg.data.procedural.shapes import sample_shape
from jaxreg.scans import verdict
from research import fit_verdict, verdict_records

pytestmark = pytest.mark.float32

SURE = verdict.Evidence(0.95, 0.95, 1.0, -0.02, 0.05, 0.5)
HOPELESS = verdict.Evidence(0.1, 0.05, 5.0, -0.8, 0.001, 0.0)


def entry(source="procedural", kind="full", right=True, evidence=SURE):
    return {"source": source, "kind": kind, "right": right} | evidence._asdict()


@pytest.mark.parametrize("kind", fit_verdict.KINDS)
def test_a_pair_is_what_its_kind_says(kind, seed):
    index = fit_verdict.KINDS.index(kind)
    rng = np.random.default_rng(seed)
    source, reference, truth, found = fit_verdict.make_pair(
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


def test_registering_the_pairs_finds_the_right_pose(monkeypatch):
    monkeypatch.setattr(
        fit_verdict,
        "sources",
        lambda options: {"procedural": lambda i: sample_shape(77, 100_007, points=900)},
    )
    entries = fit_verdict.run(fit_verdict.Options(pairs=1))
    assert [entry["kind"] for entry in entries] == ["full"]
    assert entries[0]["right"] is True
    assert verdict_records.as_judged(entries[0]) > 0.5
    for wanting in (verdict_records.without_search, verdict_records.without_rival):
        assert 0 < wanting(entries[0]) <= 1


def test_the_fit_separates_what_one_input_separates(seed):
    rng = np.random.default_rng(seed)
    right = rng.uniform(size=400) < 0.5
    inputs = np.stack([right + rng.normal(0, 0.1, 400), rng.normal(size=400)], axis=1)
    intercept, first, second = fit_verdict.fit(inputs, right)
    assert -intercept / first == pytest.approx(0.5, abs=0.1), "the border lies halfway"
    assert abs(second) < 0.2 * first


def test_counts_of_right_and_wrong_verdicts():
    entries = [entry(right=True, evidence=SURE)] * 5 + [entry(right=True, evidence=HOPELESS)] * 3
    entries += [entry(right=False, evidence=SURE)] * 2 + [entry(right=False, evidence=HOPELESS)]
    assert verdict_records.counts(entries, verdict_records.as_judged) == {
        "pairs": 11,
        "right": 8,
        "right_called_failure": 3,
        "wrong_called_success": 2,
    }
    ends = [entry(kind="apart", right=False, evidence=SURE)]
    assert verdict_records.counts(ends, verdict_records.as_judged) == {
        "pairs": 1,
        "right": 0,
        "right_called_failure": None,
        "wrong_called_success": 1,
    }


def test_the_records_fit_the_page_and_are_those_of_the_pairs(records):
    entries = [
        entry(source, kind, right=kind in verdict_records.GOOD, evidence=evidence)
        for source in verdict_records.SOURCES
        for kind in verdict_records.KINDS
        for evidence in (SURE, HOPELESS)
        if (source, kind) != ("7Scenes", "unrelated")
    ]
    assert len(list(verdict_records.write(entries))) == 3
    assert records.fits("verdict", "verdict_initial", "verdict_probability")
    rows, setting = (records.read("verdict")[key] for key in ("rows", "setting"))
    assert rows["modelnet"] == {
        "label": "ModelNet40: samplings, noise, own crops",
        "pairs": 6,
        "right": 6,
        "right_called_failure": 3,
        "wrong_called_success": 0,
    }
    assert "scenes_unrelated" not in rows
    assert rows["scenes_ends"]["label"] == "7Scenes: two ends of one scan"
    assert (setting["good"], setting["good_called_failure"]) == (18, 9)
    assert (setting["ends_of_shapes"], setting["ends_of_shapes_called_success"]) == (4, 2)
    probability = records.read("verdict_probability")["rows"]
    assert sum(row["pairs"] for row in probability.values()) == len(entries)
    assert probability["p90"] == {"label": "0.9 or more", "pairs": 14, "right": 9 / 14}
    assert records.read("verdict_initial")["rows"]["own_constants"]["good"] == 9


def test_a_fit_on_training_shapes_writes_no_record(records, monkeypatch):
    monkeypatch.setattr(fit_verdict, "run", lambda options: [entry(), entry(right=False)])
    fit_verdict.main(fit_verdict.Options(split="train"))
    assert not list(records.folder.iterdir())
    fit_verdict.main(fit_verdict.Options(split="test", record=False))
    assert not list(records.folder.iterdir())
