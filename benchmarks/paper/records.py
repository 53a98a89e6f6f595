"""The records of the paper's tables, from the cells that `benchmarks.paper.tables` has made."""

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks import record
from benchmarks.paper import printed
from benchmarks.paper.columns import (
    BASELINES,
    COLUMNS,
    CONFIGS,
    NETWORK,
    PAPER,
    ROBUST_ROUNDS,
)
from jaxreg.config import load_config
from jaxreg.evaluation import score

Cells = dict[str, dict[str, dict]]
"""By column and row, what `score.figures` gave."""
FIGURES = {
    "mae_r": ("mae_r_deg", "MAE(R)"),
    "mie_r": ("mie_r_deg", "MIE(R)"),
    "printed_mie_r": ("mie_r_deg_float32_acos", "printed MIE(R)"),
    "worst": ("worst_rre_deg", "worst"),
    "worst_pair": ("worst_pair", "worst pair"),
    "mae_t": ("mae_t", "MAE(t)"),
    "recall": ("recall_1deg", "recall 1 deg"),
}
"""Columns of the records, the figures that fill them, and their heads."""


def _with_kept(
    name: str, rows: dict[str, dict], setting: dict
) -> tuple[dict[str, dict], dict, str | None]:
    """Rows and setting of a record, and what this run did not measure from the record as it stands.

    RIENet's weights, or hours, are not at hand in every run. Times compare within one run only: they
    stay as they are unless all rows were made. Also a note that names the commit of what was kept.
    """
    old = record.read(name)
    if old is None:
        return rows, setting, None
    kept = sorted(
        key
        for key in old["rows"]
        if any(
            value is not None and rows.get(key, {}).get(figure) is None
            for figure, value in old["rows"][key].items()
        )
    )
    merged = {
        key: old["rows"].get(key, {})
        | {
            figure: value
            for figure, value in rows.get(key, {}).items()
            if value is not None and not (kept and figure.endswith("_ms"))
        }
        for key in dict.fromkeys([*rows, *old["rows"]])
    }
    told = old["setting"] | setting if kept else setting
    return merged, told, record.kept(old, kept)


def write_paper(cells: Cells, root: Path | None) -> Path:
    """The record `paper`: a row a set of pairs, with what the network makes of it in three ways."""
    kinds = dict(zip(("network", "robust", "refined"), NETWORK, strict=True))
    table = {}
    for name, found in cells.items():
        of_network = [found[row] for row in NETWORK if row in found]
        table[name] = {
            "label": COLUMNS[name].label,
            "pairs": of_network[0]["pairs"] if of_network else None,
            "paper": COLUMNS[name].paper,
        } | {
            f"{kind}_{key}": found[row][figure] if row in found else None
            for kind, row in kinds.items()
            for key, (figure, _) in FIGURES.items()
        }
    heads = {f"{kind}_{key}": f"{kind}: {x[1]}" for kind in kinds for key, x in FIGURES.items()}
    table, told, note = _with_kept("paper", table, setting(root))
    return record.write(
        "paper",
        question="Is the paper's accuracy reached?",
        command=record.command("benchmarks.paper.tables"),
        columns={"pairs": "pairs", "paper": "paper's MAE(R)"} | heads,
        rows=table,
        setting=told,
        note=note,
    )


def setting(root: Path | None) -> dict[str, float]:
    """The numbers of the protocol that the text names."""
    clean, kept, noise, scans = (
        load_config(CONFIGS / f"{name}.toml").test_pairs
        for name in (
            "modelnet40_unseen_objects",
            "modelnet40_unseen_objects_717",
            "modelnet40_gaussian_noise",
            "seven_scenes",
        )
    )
    return PAPER | {
        "source_points": clean.points,
        "kept_points": clean.kept,
        "kept_points_70": kept.kept,
        "most_degrees": clean.rotation_max_deg,
        "outliers": noise.outliers,
        "scan_source_points": scans.points,
        "scan_kept_points": scans.kept,
        "robust_rounds": ROBUST_ROUNDS,
        "draws": COLUMNS["seven_scenes"].draws,
        "float32_floor_deg": round(float(np.degrees(np.arccos(1 - 2.0**-24))), 2),
        "shared_percent": round(100 * shared(root)),
    }


def shared(root: Path | None, pairs: int = 64) -> float:
    """The share of the source's points that the reference has too, of the unseen objects."""
    config = load_config(CONFIGS / "modelnet40_unseen_objects.toml")
    shares = []
    for batch, count in score.pair_stream(config, root=root, pairs=pairs).batches():
        for i in range(count):
            source, reference = (np.asarray(x.points[i])[np.asarray(x.mask[i])] for x in batch[:2])
            rotation, translation = (np.asarray(x[i]) for x in batch.transform)
            distance, _ = cKDTree(reference).query(source @ rotation.T + translation)
            shares.append(np.mean(distance < 1e-5))
    return float(np.mean(shares))


OTHERS = {
    "jaxreg": ("jaxreg", "jaxreg, network"),
    "jaxreg_robust": ("jaxreg + robust Procrustes", "jaxreg, network and robust Procrustes"),
    "rienet": ("rienet", "RIENet, its released weights"),
    "identity": ("identity", "identity"),
    "icp": ("icp", "`icp` (jaxreg)"),
} | {name: (name, f"`{x}`") for name, x in BASELINES.items() if name not in ("identity", "icp")}
"""Rows of the record `other_methods`: the row of the cell, and what a reader sees."""


def write_others(cells: Cells, some_pairs: int) -> Path:
    """The record `other_methods`: a row a method, on clean pairs and on those with outliers."""
    table = {}
    for key, (row, label) in OTHERS.items():
        table[key] = {"label": label}
        for kind, name in (("clean", "unseen_objects"), ("noise", "gaussian_noise")):
            if cell := cells.get(name, {}).get(row):
                table[key] |= {
                    "pairs": cell["pairs"],
                    f"{kind}_mae_r": cell["mae_r_deg"],
                    f"{kind}_worst": cell["worst_rre_deg"],
                    f"{kind}_recall": cell["recall_1deg"],
                    f"{kind}_ms": 1e3 * cell["seconds_per_pair"],
                }
            paper = printed.TABLES[name].get(key)
            table[key][f"{kind}_paper"] = paper.mae_r if paper else None
    heads = {"mae_r": "MAE(R)", "worst": "worst", "recall": "recall 1 deg", "ms": "ms a pair"}
    heads["paper"] = "paper's MAE(R)"
    names = {"clean": "unseen objects", "noise": "Gaussian noise"}
    found = {"some_pairs": some_pairs}
    clean = cells.get("unseen_objects", {})
    if best := clean.get("open3d_ransac_gicp_tuned"):
        found["ransac_gicp_median_deg"] = best["median_rre_deg"]
        found["failed"] = round((1 - best["recall_1deg"]) * best["pairs"])
    if own := clean.get("jaxreg"):
        found["all_pairs"] = own["pairs"]
    table, found, note = _with_kept("other_methods", table, found)
    return record.write(
        "other_methods",
        question="What do other methods reach on the same pairs?",
        command=record.command("benchmarks.paper.tables"),
        columns={"pairs": "pairs"}
        | {
            f"{kind}_{key}": f"{x}: {head}"
            for kind, x in names.items()
            for key, head in heads.items()
        },
        rows=table,
        setting=found,
        note=note,
    )
