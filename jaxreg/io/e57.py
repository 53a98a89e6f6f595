"""E57, the exchange format of terrestrial scanners, by pye57 (extra `e57`)."""

from pathlib import Path

import numpy as np

from jaxreg._extras import extra
from jaxreg.io.contents import Scan


def read(path: Path) -> Scan:
    """The points of all scans in their common frame, without those that are marked as invalid.

    Raises:
      ImportError: pye57 is missing.
      ValueError: as `jaxreg.io.read_cloud`.
    """
    with extra("e57", f"{path}: E57"):
        import pye57  # pyright: ignore[reportMissingImports]
    with path.open("rb") as file:
        if file.read(8) != b"ASTM-E57":
            raise ValueError(
                f"{path} is not an E57 file (it does not begin with ASTM-E57): export it."
            )
    try:
        scans = _scans(pye57.E57(str(path)), path.stat().st_size)
    except Exception as error:  # noqa: BLE001 - libE57 raises types of its own
        told = " ".join(str(error).split())[:120]
        raise ValueError(
            f"{path} cannot be read as E57 ({type(error).__name__}: {told}): it is malformed or "
            "truncated; export it again."
        ) from None
    if not scans:
        return Scan(np.empty((0, 3)))
    notes = () if len(scans) == 1 else (_TOLD.format(count=len(scans)),)
    return Scan(np.concatenate(scans), notes)


_TOLD = "{count} scans as one cloud, each laid where its own pose says"


def _scans(file, size: int) -> list[np.ndarray]:
    scans = []
    for i in range(file.scan_count):
        if file.get_header(i).point_count > size:
            raise ValueError(f"it announces {file.get_header(i).point_count} points")
        data = file.read_scan(i, ignore_missing_fields=True)
        scans.append(np.stack([data[f"cartesian{axis}"] for axis in "XYZ"], axis=1))
    return [scan.astype(np.float64) for scan in scans]
