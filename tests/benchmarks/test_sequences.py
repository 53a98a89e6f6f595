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
        kept = "balm, Open3D on redkitchen"
        expected = f"Not made in this run, but at commit abcdef0: figures of {kept}. One core."
        assert found["note"] == expected
        assert found["rows"]["redkitchen"] == first["redkitchen"] | {"scans": 7}
    assert set(found["rows"]) == {"redkitchen", "balm", "kitti00"}


def test_a_run_without_open3d_says_whose_figures_stay(records):
    old = {
        "rows": {"balm": {"label": "balm", "jaxreg_right": 5, "open3d_right": 6}},
        "commit": "abcdef0",
    }
    sequences.write({"balm": {"label": "balm", "jaxreg_right": 7}}, old)
    found = records.read("sequences")
    assert found["rows"]["balm"] == {"label": "balm", "jaxreg_right": 7, "open3d_right": 6}
    assert (
        found["note"] == "Not made in this run, but at commit abcdef0: figures of Open3D on balm."
    )
