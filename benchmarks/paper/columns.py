"""The columns of the paper's tables, which methods meet them, and what the paper prints."""

from pathlib import Path
from typing import NamedTuple

from benchmarks.paper import printed

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
NETWORK = ("jaxreg", "jaxreg + robust Procrustes", "jaxreg + icp")
"""Rows of the network: as in the paper, solved robustly, refined on the clouds."""
ROBUST_ROUNDS = 3
BASELINES = {
    "identity": "identity",
    "icp": "icp",
    "open3d_icp": "open3d_icp",
    "open3d_icp_coarse_to_fine": "open3d_icp_coarse_to_fine@0.07",
    "open3d_fgr": "open3d_fgr",
    "open3d_fgr_gicp": "open3d_fgr_gicp",
    "open3d_fgr_gicp_tuned": "open3d_fgr_gicp@0.02",
    "open3d_ransac": "open3d_fpfh_ransac",
    "open3d_ransac_gicp_tuned": "open3d_ransac_gicp@0.02",
    "small_gicp": "small_gicp",
}
"""As usually run, and with the spacing (`@`) that tune_baselines.py finds best on training shapes; by
the names of their rows in the record."""
PAPER = {
    f"paper_printed_mie_r_{column}": printed.TABLES[column]["jaxreg"].mie_r
    for column in ("unseen_objects", "unseen_categories", "gaussian_noise")
} | {
    f"paper_mae_r_{column}": printed.TABLES[column]["jaxreg"].mae_r
    for column in ("seven_scenes", "icl_nuim")
}
"""What else the paper prints, in degrees; its scans are others than those here."""


class Column(NamedTuple):
    """One set of test pairs: a file in configs/, what deviates from it, the paper's MAE(R)."""

    config: str
    label: str
    paper: float | None = None
    draws: int = 1
    from_file: bool = False
    baselines: bool = False
    iterations: int = 0
    rows: tuple[str, ...] = NETWORK


_OURS = {column: rows["jaxreg"].mae_r for column, rows in printed.TABLES.items()}
COLUMNS = {
    "unseen_objects": Column(
        "modelnet40_unseen_objects", "unseen objects", _OURS["unseen_objects"], baselines=True
    ),
    "unseen_categories": Column(
        "modelnet40_unseen_categories",
        "unseen categories",
        _OURS["unseen_categories"],
        baselines=True,
    ),
    "gaussian_noise": Column(
        "modelnet40_gaussian_noise",
        "Gaussian noise, three steps",
        _OURS["gaussian_noise"],
        baselines=True,
    ),
    "gaussian_noise_six": Column(
        "modelnet40_gaussian_noise",
        "Gaussian noise, six steps",
        _OURS["gaussian_noise"],
        iterations=6,
        rows=NETWORK[:1],
    ),
    "unseen_objects_717": Column("modelnet40_unseen_objects_717", "unseen objects, 70 % kept"),
    "unseen_categories_717": Column(
        "modelnet40_unseen_categories_717", "unseen categories, 70 % kept", rows=NETWORK[:1]
    ),
    "gaussian_noise_717": Column(
        "modelnet40_gaussian_noise_717", "Gaussian noise, 70 % kept", rows=NETWORK[1:2]
    ),
    "seven_scenes": Column("seven_scenes", "7Scenes stand-in", draws=64, baselines=True),
    "icl_nuim": Column("icl_nuim", "`icl_nuim_like`, posed as in the paper", baselines=True),
    "icl_nuim_given": Column(
        "icl_nuim", "`icl_nuim_like`, the pairs of its file", from_file=True, baselines=True
    ),
}
