"""The record of sequences: a run of some keeps the others, and names the commit that made them."""

from benchmarks import record
from benchmarks.scans import sequences


def test_a_run_of_some_sequences_names_the_commit_of_the_others(records):
    first = {
        "redkitchen": {"label": "redkitchen", "scans": 10, "open3d_right": 9},
        "balm": {"label": "balm"},
    }
    sequences.write(first, {"rows": {}})
    assert records.read("sequences").get("note") is None
    old = record.read("sequences") | {"commit": "abcdef0", "note": "One core."}
    for rows in ({}, {"kitti00": {"label": "kitti00", "scans": 8}}):  # it writes after each of them
        sequences.write({"redkitchen": {"label": "redkitchen", "scans": 7}} | rows, old)
        found = records.read("sequences")
        expected = "Not made in this run, but at commit abcdef0: figures of balm. One core."
        assert found["note"] == expected
        assert found["rows"]["redkitchen"] == first["redkitchen"] | {"scans": 7}
    assert set(found["rows"]) == {"redkitchen", "balm", "kitti00"}
