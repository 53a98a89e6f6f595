"""What the paper prints: Table 1 (ModelNet40) and Table 2 (scans), by column and method.

The columns are those of `benchmarks.paper.columns`, the methods go by the names of the records' rows;
`jaxreg` is the method of the paper itself.
"""

from typing import NamedTuple


class Errors(NamedTuple):
    """A row: rotations in degrees; translations in units of the unit sphere, or of the scan."""

    mae_r: float
    mae_t: float
    mie_r: float
    mie_t: float


TABLES = {
    "unseen_objects": {
        "open3d_icp": Errors(3.4339, 0.0114, 6.7706, 0.0227),
        "open3d_fgr": Errors(0.5972, 0.0021, 1.1563, 0.0041),
        "open3d_ransac": Errors(0.7031, 0.0025, 1.2772, 0.0050),
        "idam": Errors(0.4243, 0.0020, 0.8170, 0.0040),
        "rpmnet": Errors(0.0051, 0.0000, 0.0201, 0.0000),
        "fmr": Errors(3.6497, 0.0101, 7.2810, 0.0200),
        "cemnet": Errors(0.1385, 0.0001, 0.2489, 0.0002),
        "rienet": Errors(0.0033, 0.0000, 0.0210, 0.0000),
        "jaxreg": Errors(0.0006, 0.0000, 0.0195, 0.0000),
    },
    "unseen_categories": {
        "open3d_icp": Errors(3.6099, 0.0116, 7.0556, 0.0228),
        "open3d_fgr": Errors(0.4579, 0.0016, 0.8442, 0.0032),
        "open3d_ransac": Errors(0.4427, 0.0021, 0.9447, 0.0043),
        "idam": Errors(0.4809, 0.0028, 0.9157, 0.0055),
        "rpmnet": Errors(0.0064, 0.0001, 0.0207, 0.0001),
        "fmr": Errors(3.8594, 0.0114, 7.6450, 0.0225),
        "cemnet": Errors(0.0804, 0.0002, 0.1405, 0.0003),
        "rienet": Errors(0.0059, 0.0000, 0.0228, 0.0001),
        "jaxreg": Errors(0.0007, 0.0000, 0.0182, 0.0000),
    },
    "gaussian_noise": {
        "open3d_icp": Errors(4.6441, 0.0167, 9.2194, 0.0333),
        "open3d_fgr": Errors(1.0676, 0.0036, 2.0038, 0.0072),
        "open3d_ransac": Errors(1.4316, 0.0061, 2.5345, 0.0120),
        "idam": Errors(2.3076, 0.0124, 4.5332, 0.0246),
        "rpmnet": Errors(0.0075, 0.0000, 0.0221, 0.0001),
        "fmr": Errors(18.0355, 0.0536, 35.7986, 0.1063),
        "cemnet": Errors(10.7026, 0.0393, 21.1836, 0.0781),
        "rienet": Errors(0.0069, 0.0001, 0.0230, 0.0001),
        "jaxreg": Errors(0.0006, 0.0000, 0.0193, 0.0000),
    },
    "icl_nuim": {
        "open3d_icp": Errors(2.4022, 0.0699, 4.4832, 0.1410),
        "open3d_fgr": Errors(2.2477, 0.0808, 4.1850, 0.1573),
        "open3d_ransac": Errors(1.2349, 0.0429, 2.3167, 0.0839),
        "idam": Errors(4.4153, 0.1385, 8.6178, 0.2756),
        "rpmnet": Errors(0.3267, 0.0125, 0.6277, 0.0246),
        "fmr": Errors(1.1085, 0.0398, 2.1323, 0.0786),
        "cemnet": Errors(0.2374, 0.0005, 0.3987, 0.0010),
        "rienet": Errors(0.0492, 0.0023, 0.0897, 0.0049),
        "jaxreg": Errors(0.0005, 0.0002, 0.0210, 0.0004),
    },
    "seven_scenes": {
        "open3d_icp": Errors(6.0091, 0.0130, 13.0484, 0.0260),
        "open3d_fgr": Errors(0.0919, 0.0004, 0.1705, 0.0008),
        "open3d_ransac": Errors(1.2325, 0.0062, 2.1875, 0.0124),
        "idam": Errors(5.6727, 0.0303, 11.5949, 0.0629),
        "rpmnet": Errors(0.3885, 0.0021, 0.7649, 0.0042),
        "fmr": Errors(2.5438, 0.0072, 4.9089, 0.0150),
        "cemnet": Errors(0.0559, 0.0001, 0.0772, 0.0003),
        "rienet": Errors(0.0121, 0.0001, 0.0299, 0.0001),
        "jaxreg": Errors(0.0036, 0.0000, 0.0191, 0.0001),
    },
}
