"""The ablation: a row differs in what it is named after and in nothing else; the table is right."""

import dataclasses
import json

import pytest
from flax.traverse_util import flatten_dict

from benchmarks.paper import ablation, tables
from jaxreg.config import to_dict


@pytest.mark.parametrize("protocol", ablation.PROTOCOLS)
@pytest.mark.parametrize("row", ablation.ROWS)
def test_a_row_differs_from_the_full_method_in_its_own_fields(row, protocol):
    full, other = (
        flatten_dict(to_dict(ablation.row_config(name, 2, 50, protocol)), sep=".")
        for name in ("full", row)
    )
    # Known poses alone leave the other losses out already: a row cannot leave them out again.
    already = {key for key, value in ablation.ROWS[row].items() if full[key] == value}
    assert protocol == "posed" or not already
    changed = {key for key in full if full[key] != other[key]}
    assert changed == set(ablation.ROWS[row]) - already
    assert (other["train.seed"], other["train.steps"]) == (2, 50)


def test_the_table_has_the_mean_and_the_range_of_the_seeds(tmp_path):
    for seed, error in enumerate((0.1, 0.2, 0.6)):
        figures = {
            name: dict.fromkeys(ablation.FIGURES["copies"], error) for name in ablation.COLUMNS
        }
        record = {"row": "without L_in", "seed": seed, "figures": figures}
        (tmp_path / f"x-{seed}.json").write_text(json.dumps(record))
    *_, line = ablation.table(ablation.Options(workdir=str(tmp_path))).splitlines()
    assert line.startswith("| without L_in | 3 | 0.3 (0.1 to 0.6) |")


def test_the_columns_of_the_tables_are_configurations_and_show_their_cells(tmp_path):
    for column in tables.COLUMNS.values():
        assert (tables.CONFIGS / f"{column.config}.toml").is_file()
    options = tables.Options(folder=str(tmp_path))
    cell = dict.fromkeys(
        ("mae_r_deg", "mie_r_deg", "mie_r_deg_float32_acos", "median_rre_deg", "mae_t"), 0.25
    )
    cell |= {"recall_1deg": 1.0, "worst_rre_deg": 3.0, "worst_pair": 7, "seconds_per_pair": 0.1}
    cell |= {"row": "identity", "pairs": 9, "dataset": "modelnet40"}
    (tmp_path / "unseen_objects-identity.json").write_text(json.dumps(cell))
    text = tables.table("unseen_objects", options)
    assert "unseen_objects (modelnet40); the paper's MAE(R): 0.0006" in text
    assert text.splitlines()[-1].startswith("| identity | 9 | 0.25 |")
    assert "3 (7)" in text
    assert "nothing evaluated" in tables.table("gaussian_noise", dataclasses.replace(options))
