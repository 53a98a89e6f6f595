"""`jaxreg info`: what a cloud's file contains."""

import dataclasses
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from jaxreg.cli.options import SUCCESS, finite, line


@dataclasses.dataclass(frozen=True)
class Info:
    """Describe a cloud: number of points, extent, spacing, and what is odd about it."""

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """PLY, PCD, text of points, PTX, E57, LAS/LAZ, NPY/NPZ, meshes (sampled); also packed (.gz)."""

    def run(self) -> int:
        """Print one line per property; returns the exit status."""
        from jaxreg import io
        from jaxreg.scans import diagnosis, prepare

        points, notes, _ = io.read_scan(self.file)
        broken = ~np.isfinite(points).all(axis=1)
        line("file", f"{self.file}")
        for note in notes:
            line("read as", note)
        line("points", f"{len(points):,}")
        if broken.any():
            line("not finite", f"{broken.sum():,} points, the first is point {np.argmax(broken)}")
        points = finite(points, self.file)
        for axis, a, b in zip("xyz", points.min(axis=0), points.max(axis=0), strict=True):
            line(axis, f"{a:.9g} to {b:.9g} (extent {b - a:.4g})")
        distinct = np.unique(points, axis=0)
        line("repeated", f"{len(points) - len(distinct):,} points")
        line("spacing", f"{prepare.spacing(distinct - distinct.mean(axis=0)):.4g}")
        for finding in diagnosis.findings(points):
            line("note", finding)
        return SUCCESS
