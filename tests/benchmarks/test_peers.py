"""The table of learned methods: which weights meet which pairs, and a record that fits the page."""

import numpy as np
import pytest

from benchmarks.paper import peers, printed
from jaxreg.config import Config, DataConfig, PairConfig
from jaxreg.evaluation import methods
from jaxreg.training import train
from jaxreg.weights.released import load_card
from tests.peers.small import short_training

pytestmark = [pytest.mark.float32, pytest.mark.loose]


def test_every_method_has_a_name_and_every_column_a_configuration(data_root):
    known = [name.partition(":")[0] for name in methods.names()]
    for method in peers.METHODS:
        for column in peers.COLUMNS:
            name = peers.name_of(method, column, "folder", {})
            assert name in methods.names() or name.partition(":")[0] in known
    for column, file in (
        ("clean", "modelnet40_n768_unseen0_noise0"),
        ("jitter_any", "modelnet40_n768_unseen0_noise1"),
        ("categories", "modelnet40_n768_unseen1_noise0"),
        ("noise", "modelnet40_n768_unseen0_noise0"),
        ("scenes", "scene7_n768_unseen0_noise0"),
        ("icl", "icl_nuim_n768_unseen0_noise0"),
    ):
        assert peers.name_of("cemnet", column, "f", {}) == f"cemnet:f/cemnet_{file}.npz"
    assert peers.name_of("cemnet", "clean", "", {}) == ""
    assert peers.name_of("idam", "clean", "f", {"idam": "runs/a"}) == "checkpoint:runs/a"
    assert peers.name_of("jaxreg", "categories", "", {}) == "weights:modelnet40_first20"
    for column in ("scenes", "icl"):
        assert peers.column_config(column, data_root).test_pairs.kept == 1536


def test_the_paper_s_rows_are_those_of_its_tables():
    """Nine methods, five columns; and the errors of a rotation of which Euler angles are a part."""
    assert set(printed.TABLES) == {x.of_paper for x in peers.COLUMNS.values() if x.of_paper}
    for rows in printed.TABLES.values():
        assert list(rows) == list(peers.METHODS)[:9]
        assert all(
            found.mae_r <= found.mie_r and found.mae_t <= found.mie_t for found in rows.values()
        )
        assert min(rows, key=lambda row: rows[row].mae_r) == "jaxreg"


def test_a_column_of_any_rotation_differs_in_nothing_else(data_root):
    near, far = (peers.column_config(name, data_root).test_pairs for name in ("crops", "crops_any"))
    assert (near.rotation, near.rotation_max_deg, far.rotation) == ("euler", 45.0, "full")
    assert (near.kept, near.sampling, near.crop) == (far.kept, far.sampling, far.crop)
    assert peers.column_config("noise", data_root).model.robust_rounds == 0


@pytest.mark.parametrize("word", ["idam", "idam=", "cemnet=runs/a", "=runs/a"])
def test_a_run_without_a_name_or_a_folder_says_what_to_give(word):
    with pytest.raises(ValueError, match="give NAME=VALUE with NAME one of idam, rpmnet, fmr"):
        peers.named((word,), "runs")


def of_shapes(column, root):
    return Config(
        data=DataConfig(name="shapes", test_shapes=2), test_pairs=PairConfig(points=48, kept=36)
    )


@pytest.mark.slow
def test_a_run_has_a_row_with_its_budget_and_the_record_fits_the_page(
    records, monkeypatch, tmp_path, capsys
):
    train(short_training("fmr"), tmp_path)
    monkeypatch.setattr(peers, "column_config", of_shapes)
    runs = (f"fmr={tmp_path}",)
    peers.main(peers.Options("", runs, ("fmr=0.5",), pairs=2, methods=("fmr",)))
    assert records.fits("peers")
    row = records.read("peers")["rows"]["fmr"]
    assert row["label"] == "FMR, trained here: 2 steps of 2 pairs, 0.5 h"
    assert (row["steps"], row["pairs_seen"], row["hours"]) == (2, 4, 0.5)
    assert row["budget"] == "200 epochs, 8 pairs a step"
    for column in peers.COLUMNS:
        for key in (*peers.FIGURES, "ms"):
            assert np.isfinite(row[f"{column}_{key}"])
    printed = capsys.readouterr().out
    for column in peers.COLUMNS.values():
        assert f"\n{column.label}, 2 pairs\n" in printed
    with pytest.raises(ValueError, match="that is a run of fmr"):
        peers.trained("idam", {"idam": str(tmp_path)}, None)


def test_the_record_fits_the_page_and_a_method_without_weights_has_no_figures(
    records, monkeypatch, capsys
):
    names = {"dcp": "identity", "cemnet": "cemnet:nowhere.npz"}
    monkeypatch.setattr(peers, "column_config", of_shapes)
    monkeypatch.setattr(peers, "name_of", lambda method, *_: names.get(method, ""))
    peers.main(peers.Options(pairs=2))
    assert "cemnet, unseen objects: left out: nowhere.npz: no such file" in capsys.readouterr().out
    assert records.fits("peers")
    rows = records.read("peers")["rows"]
    assert rows["dcp"]["clean_median"] > 1
    measured = {f"{column}_{key}" for column in peers.COLUMNS for key in peers.FIGURES}
    for row in ("rpmnet", "cemnet"):
        assert not measured & set(rows[row])
    assert rows["rpmnet"]["label"] == "RPM-Net, not trained here"
    assert (rows["rpmnet"]["paper"], rows["rpmnet"]["noise_paper_mean"]) == (0.0051, 0.0221)


def test_weights_that_come_with_the_library_have_the_budget_of_their_card():
    row = peers.row_of("idam", peers.Options(hours=("idam=1.2",)))
    assert row["steps"] == load_card("idam")["step"]
    assert row["label"] == f"IDAM, trained here: {row['steps']} steps of 16 pairs, 1.2 h"
