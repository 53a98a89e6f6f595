"""The paper's tables: cells of procedural shapes, the tables of these cells, and both records."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.paper import columns, tables
from benchmarks.paper import records as of_tables
from jaxreg.config import Config, DataConfig, PairConfig, load_config
from jaxreg.data.batches import true_transforms
from jaxreg.evaluation import methods, score

pytestmark = pytest.mark.float32


@pytest.fixture
def config(monkeypatch):
    """Every column is of four small procedural shapes in the place of its data."""
    config = Config(
        data=DataConfig(name="shapes", test_shapes=4),
        test_pairs=PairConfig(points=48, kept=36),
        weights="modelnet40",
    )
    monkeypatch.setattr(tables, "column_config", lambda column, root: config)
    return config


def fake(name, *, model=None):
    """The network as the truth itself, which names the settings that it was asked with."""
    if not name.startswith("weights:"):
        return real(name, model=model)
    rounds.append(model.robust_rounds)
    return methods.Method(lambda pair: pair.transform, None)


rounds, real = [], methods.choose


def test_cells_are_of_the_same_pairs_and_are_not_made_again(config, tmp_path, monkeypatch, capsys):
    rounds.clear()
    monkeypatch.setattr(methods, "choose", fake)
    options = tables.Options(
        only=("unseen_objects",),
        rows=(*columns.NETWORK, "identity", "icp"),
        folder=str(tmp_path),
        record=False,
    )
    tables.main(options)
    assert rounds == [0, 3], "the refined row starts from the transforms of the first"
    cells = tables.read_cells("unseen_objects", options)
    assert set(cells) == {*columns.NETWORK, "identity", "icp"}
    truth = true_transforms(score.pair_stream(config, root=None).batches())
    angles = np.degrees(Rotation.from_matrix(truth.rotation).magnitude())
    assert cells["identity"]["mie_r_deg"] == pytest.approx(angles.mean(), rel=1e-4)
    assert cells["jaxreg"]["worst_rre_deg"] == 0
    assert 0 < cells["jaxreg + icp"]["worst_rre_deg"] < 0.01
    assert cells["jaxreg + icp"]["method"].endswith("jaxreg.npz + icp")
    with np.load(tmp_path / "unseen_objects-jaxreg.npz") as saved:
        np.testing.assert_array_equal(saved["rotation"], truth.rotation)
    printed = capsys.readouterr().out
    assert f"| identity | 4 | {cells['identity']['mae_r_deg']:.3g} |" in printed
    tables.main(options)
    assert len(rounds) == 2, "cells that are there are not made again"


def test_rienet_has_a_row_where_its_weights_are(tmp_path):
    column = columns.COLUMNS["unseen_objects"]
    options = tables.Options(rienet="x.npz", rienet_pairs=5)
    assert tables.rows(column, options)["rienet"] == tables.Row(5, "rienet:x.npz")
    assert "rienet" not in tables.rows(column, tables.Options())


def test_the_columns_are_configurations_and_their_methods_have_names():
    for column in columns.COLUMNS.values():
        assert (columns.CONFIGS / f"{column.config}.toml").is_file()
    known = [name.partition("@")[0] for name in columns.BASELINES.values()]
    assert set(known) <= set(methods.names())


def test_a_column_differs_from_its_file_in_what_it_says(data_root):
    six = tables.column_config(columns.COLUMNS["gaussian_noise_six"], data_root)
    file = load_config(columns.CONFIGS / "modelnet40_gaussian_noise.toml")
    assert six == dataclasses.replace(file, model=dataclasses.replace(file.model, iterations=6))
    given = tables.column_config(columns.COLUMNS["icl_nuim_given"], data_root)
    assert given.data.test_pairs_from == "file"


def test_the_table_shows_the_cells_that_are_there(tmp_path):
    write_cell(tmp_path, "unseen_objects", "identity", pairs=9, worst_rre_deg=3.0, worst_pair=7)
    options = tables.Options(folder=str(tmp_path))
    text = tables.table("unseen_objects", options)
    assert "unseen_objects (modelnet40); the paper's MAE(R): 0.0006" in text
    assert text.splitlines()[-1].startswith("| identity | 9 | 0.25 |")
    assert "3 (7)" in text
    assert "nothing evaluated" in tables.table("gaussian_noise", options)


def test_both_records_fit_the_page_and_hold_what_the_cells_say(tmp_path, records, monkeypatch):
    monkeypatch.setattr(of_tables, "shared", lambda root: 0.949)
    for number, name in enumerate(columns.COLUMNS):
        for row in columns.COLUMNS[name].rows:
            write_cell(tmp_path, name, row, mae_r_deg=0.001 * number, pairs=2468)
    for row in columns.BASELINES:
        write_cell(tmp_path, "unseen_objects", row, recall_1deg=0.75, seconds_per_pair=0.2)
        write_cell(tmp_path, "gaussian_noise", row)
    write_cell(tmp_path, "unseen_objects", "rienet")
    options = tables.Options(folder=str(tmp_path), baseline_pairs=8)
    cells = {name: tables.read_cells(name, options) for name in columns.COLUMNS}
    of_tables.write_paper(cells, None)
    of_tables.write_others(cells, options.baseline_pairs)
    assert records.fits("paper", "other_methods")
    paper, others = records.read("paper"), records.read("other_methods")
    for number, (name, column) in enumerate(columns.COLUMNS.items()):
        row = paper["rows"][name]
        for kind, label in zip(("network", "robust", "refined"), columns.NETWORK, strict=True):
            expected = 0.001 * number if label in column.rows else None
            assert row[f"{kind}_mae_r"] == expected
    assert paper["setting"]["shared_percent"] == 95
    assert paper["setting"]["float32_floor_deg"] == 0.02
    assert others["rows"]["open3d_fgr_gicp_tuned"]["label"] == "`open3d_fgr_gicp@0.02`"
    assert others["rows"]["small_gicp"]["clean_ms"] == 200
    assert others["rows"]["small_gicp"]["clean_recall"] == 0.75
    assert others["setting"]["failed"] == 2
    assert others["setting"]["all_pairs"] == 2468
    changed = {"mae_r_deg": 7.0, "seconds_per_pair": 9.0}
    again = {"unseen_objects": {"jaxreg": cells["unseen_objects"]["jaxreg"] | changed}}
    of_tables.write_paper(again, None)
    of_tables.write_others(again, options.baseline_pairs)
    kept, kept_others = records.read("paper"), records.read("other_methods")
    paper["rows"]["unseen_objects"]["network_mae_r"] = 7.0
    others["rows"]["jaxreg"]["clean_mae_r"] = 7.0
    assert (kept["rows"], kept_others["rows"]) == (paper["rows"], others["rows"])
    assert "rienet" in kept_others["note"]
    assert records.fits("paper", "other_methods")


@pytest.mark.modelnet
def test_most_points_of_a_pair_are_copies(data_root):
    """As the text says: some 95 % of three quarters cropped by one viewpoint."""
    assert 0.9 < of_tables.shared(data_root, pairs=4) < 1


def write_cell(folder, column, row, **figures):
    keys = ("mae_r_deg", "mie_r_deg", "mie_r_deg_float32_acos", "median_rre_deg", "mae_t")
    cell = dict.fromkeys(keys, 0.25) | {"recall_1deg": 1.0, "worst_rre_deg": 3.0, "worst_pair": 0}
    cell |= {"seconds_per_pair": 0.1, "row": row, "pairs": 8, "dataset": "modelnet40"}
    tables._cell(folder, column, row).write_text(json.dumps(cell | figures))
