"""Many aligned scans: an interactive page, and a picture; every scan has its own colour."""

import colorsys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxreg.scans import alignment_summary as summary
from jaxreg.scans.many import Alignment
from jaxreg.view import page

_POINTS = 300_000
"""Points of all scans together on a page, and in a picture."""
_FEWEST = 500


def write_alignment_page(
    path: str | Path,
    clouds: Sequence[Float[np.ndarray, "_ 3"]],
    alignment: Alignment,
    *,
    names: Sequence[str],
) -> None:
    """Write an HTML page of the largest group: its scans, to be switched one by one, and the pairs.

    A pair is a line between the centres of two scans: the less probable, the redder; a thin one was not
    used. Numbers, groups and scans that are not placed stand beside it. Large clouds are thinned.
    """
    members = alignment.groups[0] if alignment.groups else ()
    shown = {k: _placed(clouds[k], alignment, k, _most(len(members))) for k in members}
    everything = np.concatenate([*shown.values(), *([] if shown else [np.zeros((1, 3))])])
    origin = page.middle(everything)
    content = {
        "clouds": [
            page.packed_cloud(Path(names[k]).name, points, origin, len(clouds[k]))
            | {"rgb": _hex(colour(k))}
            for k, points in shown.items()
        ],
        "motions": [],
        "edges": _lines(alignment, shown, origin),
        "figures": _figures(alignment, names),
        "verdict": {"text": summary.verdict(alignment), "good": alignment.success},
    }
    page.write_content(path, f"{len(clouds)} scans", content)


def draw_alignment(
    path: str | Path,
    clouds: Sequence[Float[np.ndarray, "_ 3"]],
    alignment: Alignment,
    *,
    names: Sequence[str],
) -> None:
    """Draw the largest group from two sides, every scan in its own colour (PNG, PDF or SVG)."""
    from jaxreg.view.pictures import plot_clouds  # matplotlib, which the page does not need

    members = alignment.groups[0] if alignment.groups else ()
    shown = [_placed(clouds[k], alignment, k, _most(len(members)) // 4) for k in members]
    plot_clouds(
        shown,
        [colour(k) for k in members],
        path,
        title=summary.verdict(alignment),
        labels=[page.encodable(Path(names[k]).name) for k in members],
    )


def colour(number: int) -> tuple[float, float, float]:
    """The colour of a scan: hues a golden section apart differ for as long as possible."""
    return colorsys.hls_to_rgb((0.58 + 0.618034 * number) % 1, 0.5 - 0.1 * (number % 2), 0.68)


def _hex(rgb: tuple[float, float, float]) -> str:
    return "#" + "".join(f"{round(255 * value):02x}" for value in rgb)


def _most(scans: int) -> int:
    return max(_FEWEST, _POINTS // max(scans, 1))


def _placed(cloud: np.ndarray, alignment: Alignment, k: int, most: int) -> np.ndarray:
    rows = page.shown_rows(cloud, most=most)
    return cloud[rows] @ alignment.rotation[k].T + alignment.translation[k]


def _lines(alignment: Alignment, shown: dict[int, np.ndarray], origin: np.ndarray) -> list[Any]:
    """From centre to centre, with the probability and whether it was used; likelier refusals only."""
    middles = {k: (points.mean(axis=0) - origin).tolist() for k, points in shown.items()}
    return [
        [*middles[p.relation.source], *middles[p.relation.reference], p.probability, int(p.used)]
        for p in alignment.pairs
        if {p.relation.source, p.relation.reference} <= set(shown)
        and (p.used or p.relation.success)
    ]


def _figures(alignment: Alignment, names: Sequence[str]) -> list[list[str]]:
    figures = [[name, value] for name, value in summary.figures(alignment).items()]
    short = [Path(name).name for name in names]
    for number, group in enumerate(alignment.groups):
        figures.append([f"group {number + 1}", "\n".join(
            f"{short[k]} ({alignment.probability[k]:.2f})" for k in group
        )])  # fmt: skip
    figures += [[f"not placed: {short[k]}", alignment.reasons[k]] for k in alignment.unplaced]
    refused = [p for p in alignment.pairs if not p.used and p.relation.success]
    for pair in refused:
        ends = f"{short[pair.relation.source]}, {short[pair.relation.reference]}"
        figures.append([f"refused: {ends}", pair.reason])
    return figures
