"""The table of learned methods: which weights meet which pairs, and a record that fits the page."""

import numpy as np
import pytest

from benchmarks.paper import columns, peers
from jaxreg.config import Config, DataConfig, PairConfig, TrainConfig
from jaxreg.evaluation import methods
from jaxreg.training import train
from tests.peers.small import SMALL

pytestmark = [pytest.mark.float32, pytest.mark.loose]

TINY = Config(
    network="fmr",
    fmr=SMALL["fmr"],
    data=DataConfig(name="shapes", train_shapes=4, test_shapes=2),
    pairs=PairConfig(points=32, kept=24),
    test_pairs=PairConfig(points=32, kept=24),
    train=TrainConfig(steps=2, batch=2, validate_every=1, validation_pairs=2),
)


def test_every_method_with_weights_has_a_name_and_every_column_a_configuration():
    known = [name.partition(":")[0] for name in methods.names() if name.endswith(":FILE")]
    for method, label in peers.METHODS.items():
        name = peers.name_of(method, "clean", "folder", {})
        assert bool(name) == ("authors' weights" in label)
        assert not name or name.partition(":")[0] in known
    for column, file in (
        ("clean", "unseen0_noise0"),
        ("jitter_any", "unseen0_noise1"),
        ("categories", "unseen1_noise0"),
        ("noise", "unseen0_noise0"),
    ):
        name = peers.name_of("cemnet", column, "f", {})
        assert name == f"cemnet:f/cemnet_modelnet40_n768_{file}.npz"
    assert peers.name_of("idam", "clean", "f", {"idam": "runs/a"}) == "checkpoint:runs/a"
    for column in peers.COLUMNS.values():
        assert (columns.CONFIGS / f"{column.config}.toml").is_file()
    for ours, theirs in (("clean", "unseen_objects"), ("noise", "gaussian_noise")):
        assert peers.PUBLISHED[ours]["rienet"][0] == columns.PAPER_OF_OTHERS[theirs]["rienet"]


def test_a_column_of_any_rotation_differs_in_nothing_else():
    near, far = (peers.column_config(name).test_pairs for name in ("crops", "crops_any"))
    assert (near.rotation, near.rotation_max_deg, far.rotation) == ("euler", 45.0, "full")
    assert (near.kept, near.sampling, near.crop) == (far.kept, far.sampling, far.crop)
    assert peers.column_config("noise").model.robust_rounds == 0


@pytest.mark.parametrize("word", ["idam", "idam=", "cemnet=runs/a", "=runs/a"])
def test_a_run_without_a_name_or_a_folder_says_what_to_give(word):
    with pytest.raises(ValueError, match="give NAME=VALUE with NAME one of idam, rpmnet, fmr"):
        peers.named((word,), "runs")


def of_shapes(column):
    return Config(
        data=DataConfig(name="shapes", test_shapes=2), test_pairs=PairConfig(points=48, kept=36)
    )


@pytest.mark.slow
def test_a_run_has_a_row_with_its_budget_and_the_record_fits_the_page(
    records, monkeypatch, tmp_path, capsys
):
    train(TINY, tmp_path)
    monkeypatch.setattr(peers, "column_config", of_shapes)
    runs = (f"fmr={tmp_path}",)
    peers.main(peers.Options("nowhere", runs, ("fmr=0.5",), pairs=2, methods=("fmr",)))
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
        peers.trained("idam", str(tmp_path), None)


def test_the_record_fits_the_page_and_a_method_without_weights_has_no_figures(records, monkeypatch):
    monkeypatch.setattr(peers, "column_config", of_shapes)
    monkeypatch.setattr(peers, "name_of", lambda method, *_: "identity" if method == "dcp" else "")
    peers.main(peers.Options(folder="nowhere", pairs=2))
    assert records.fits("peers")
    rows = records.read("peers")["rows"]
    assert rows["dcp"]["clean_median"] > 1
    measured = {f"{column}_{key}" for column in peers.COLUMNS for key in peers.FIGURES}
    assert not measured & set(rows["rpmnet"])
    assert rows["rpmnet"]["label"] == "RPM-Net, not trained here"
    assert (rows["rpmnet"]["paper"], rows["rpmnet"]["noise_paper_mean"]) == (0.0051, 0.0221)
