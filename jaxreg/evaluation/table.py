"""A table of results to read."""

from collections.abc import Mapping, Sequence

from rich.table import Table

Result = Mapping[str, float | str | None]
"""What `evaluate.py` writes: `evaluation.metrics.summarize` and the name of the method."""


_COLUMNS = {
    "pairs": ("pairs", "d"),
    "mae_r_deg": ("MAE(R) deg", ".3g"),
    "mie_r_deg": ("MIE(R) deg", ".3g"),
    "mie_r_deg_float32_acos": ("as published", ".3g"),
    "median_rre_deg": ("median deg", ".3g"),
    "mae_t": ("MAE(t)", ".3g"),
    "mie_t": ("MIE(t)", ".3g"),
    "recall_1deg": ("recall 1 deg", ".3f"),
    "recall_5deg": ("recall 5 deg", ".3f"),
    "worst_rre_deg": ("worst deg", ".3g"),
    "seconds_per_pair": ("s / pair", ".4f"),
}


def results_table(results: Sequence[Result], *, title: str | None = None) -> Table:
    """A table of results: a single one has one row per metric, several have one row each.

    Metrics that no result has are left out. "As published" is MIE(R) with a float32 arccos,
    meaningless below 0.02 degrees.
    """
    present = [name for name in _COLUMNS if any(r.get(name) is not None for r in results)]
    labels = [str(r.get("method", "")) for r in results]
    cells = [[_cell(r, name) for name in present] for r in results]
    table = Table(title=title, title_justify="left")
    if len(results) == 1:
        table.add_column("metric")
        table.add_column(labels[0] or "value", justify="right")
        for name, cell in zip(present, cells[0], strict=True):
            table.add_row(_COLUMNS[name][0], cell)
        return table
    table.add_column("method")
    for name in present:
        table.add_column(_COLUMNS[name][0], justify="right")
    for label, row in zip(labels, cells, strict=True):
        table.add_row(label, *row)
    return table


def _cell(result: Result, name: str) -> str:
    value = result.get(name)
    return "-" if value is None else format(value, _COLUMNS[name][1])
