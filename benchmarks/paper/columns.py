"""The columns of the paper's tables, which methods meet them, and what the paper prints."""

from pathlib import Path
from typing import NamedTuple

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
PAPER_OF_OTHERS = {
    "unseen_objects": {
        "jaxreg": 0.0006,
        "rienet": 0.0033,
        "open3d_icp": 3.4339,
        "open3d_fgr": 0.5972,
        "open3d_ransac": 0.7031,
    },
    "gaussian_noise": {
        "jaxreg": 0.0006,
        "rienet": 0.0069,
        "open3d_icp": 4.6441,
        "open3d_fgr": 1.0676,
        "open3d_ransac": 1.4316,
    },
}
"""The paper's MAE(R) of the methods, in degrees."""
PAPER = {
    "paper_printed_mie_r_unseen_objects": 0.0195,
    "paper_printed_mie_r_unseen_categories": 0.0182,
    "paper_printed_mie_r_gaussian_noise": 0.0193,
    "paper_mae_r_seven_scenes": 0.0036,
    "paper_mae_r_icl_nuim": 0.0005,
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


COLUMNS = {
    "unseen_objects": Column("modelnet40_unseen_objects", "unseen objects", 0.0006, baselines=True),
    "unseen_categories": Column(
        "modelnet40_unseen_categories", "unseen categories", 0.0007, baselines=True
    ),
    "gaussian_noise": Column(
        "modelnet40_gaussian_noise", "Gaussian noise, three steps", 0.0006, baselines=True
    ),
    "gaussian_noise_six": Column(
        "modelnet40_gaussian_noise",
        "Gaussian noise, six steps",
        0.0006,
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
