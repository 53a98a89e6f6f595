"""The ablation: a row differs in what it is named after and in nothing else; the table is right."""

import json

import pytest
from flax.traverse_util import flatten_dict

from benchmarks.paper import ablation
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
