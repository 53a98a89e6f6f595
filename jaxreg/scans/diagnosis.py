"""What is odd about a cloud, or about two clouds beside each other, in sentences with figures.

It stands behind `jaxreg info`, and behind the hints where a registration fails: most failures lie in
how the data were exported.
"""

import numpy as np
from jaxtyping import Float

from jaxreg.geometry import trees
from jaxreg.scans import strays

_SAMPLE = 20_000
"""Points that neighbours are sought for."""
_UNITS = (
    (1000.0, "metres and millimetres"),
    (304.8, "feet and millimetres"),
    (100.0, "metres and centimetres"),
    (39.37, "metres and inches"),
    (25.4, "inches and millimetres"),
    (10.0, "centimetres and millimetres"),
    (3.2808, "metres and feet"),
)
_UNIT_LIKE = 1.3
"""Scans of one thing rarely show parts whose sizes differ by more from a ratio of units."""
_FLAT, _THIN = 1e-3, 1e-2
"""Shares of the length: thinner across than the first is a plane, narrower than the second a line."""
_CUT, _GRID = 3.0, 0.5
"""Steps of so many spacings are cuts; with many repeated points, so small ones are."""
_COARSE, _DIGITS = 0.2, 5e4
"""So are still smaller ones where the numbers have five or six digits alone."""
_REPEATED = 0.2
_TWIN = 1e-3
"""Share of the distance to the 4th nearest point: a nearer one is a copy, rounded in another way. Of
points at random on a surface one in a million has such a neighbour, on a line one in a hundred."""
_UNEVEN = 100.0


def findings(points: Float[np.ndarray, "n 3"]) -> list[str]:
    """Sentences on one cloud of finite points; none where nothing is odd.

    Strays; of all other points coordinates cut to steps, by few digits or by single precision at a
    large offset; many repeated points, or copies with other digits; two-dimensional, planar, thin
    clouds; a density that varies a hundredfold.
    """
    distinct, row = np.unique(points, axis=0, return_inverse=True)
    row = row.ravel()
    far = strays.strays(distinct)
    told = [strays.told(points, far[row])] if far.any() else []
    points, distinct = points[~far[row]], distinct[~far]
    if len(distinct) < 3:
        return [f"only {len(distinct)} distinct points: a pose needs 3"]
    repeated = 1 - len(distinct) / len(points)
    nearest, near = _neighbours(distinct)
    told += _steps(distinct, float(np.median(near)), repeated)
    if repeated > _REPEATED:
        told.append(f"{repeated:.0%} of the points repeat others: was the file written twice?")
    twins = nearest < _TWIN * near
    if np.mean(twins) > _REPEATED:
        told.append(
            f"{np.mean(twins):.0%} of the points nearly coincide with another, "
            f"{nearest[twins].max():.2g} away or less: does the file hold a scan twice, once with "
            "fewer digits?"
        )
    return [*told, *_shape(distinct), *_density(near)]


def compared(
    source: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
    names: tuple[str, str] = ("source", "reference"),
    *,
    least: float = 1.1,
) -> list[str]:
    """A sentence where the sizes differ by a factor of `least` or more: of units, or of scales.

    The size is the median distance from the centre, so that parts of one thing differ somewhat too.
    """
    sizes = [_size(points) for points in (source, reference)]
    if min(sizes) <= 0:
        return []
    ratio = max(sizes) / min(sizes)
    if ratio < least:
        return []
    large, small = names if sizes[0] >= sizes[1] else names[::-1]
    many = f"{ratio:,.0f}" if ratio >= 100 else f"{ratio:.3g}"
    told = f"the {large} is {many} times the size of the {small}"
    if unit := _unit(ratio):
        return [f"{told}: are their units {unit}? Bring both to one unit"]
    return [f"{told}: if both show the whole of one thing, their scales differ"]


def _unit(ratio: float) -> str:
    """The units that differ by about this ratio."""
    factor, words = min(_UNITS, key=lambda unit: abs(np.log(ratio / unit[0])))
    least = 3 if factor < 10 else factor / _UNIT_LIKE
    return words if least <= ratio <= factor * _UNIT_LIKE else ""


def _size(points: np.ndarray) -> float:
    """Twice the median distance from the centre; a few points far away do not count."""
    centre = points.mean(axis=0)
    for _ in range(3):
        distance = np.linalg.norm(points - centre, axis=1)
        centre = points[distance <= np.quantile(distance, 0.98)].mean(axis=0)
    return 2 * float(np.median(np.linalg.norm(points - centre, axis=1)))


def _neighbours(distinct: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of a sample, the distances to the nearest other point and to the 4th nearest."""
    some = distinct[:: max(1, len(distinct) // _SAMPLE)]
    middle = distinct.mean(axis=0)
    tree, k = trees.Tree(distinct - middle), min(5, len(distinct))
    distances = trees.neighbors(tree, some - middle, k)[0]
    return distances[:, 1], distances[:, -1]


def _steps(distinct: np.ndarray, spacing: float, repeated: float) -> list[str]:
    """Sentences on coordinates that come in steps which are coarse beside the spacing."""
    steps = [_step(column) for column in distinct.T]
    if _is_raster(distinct, steps):
        return []
    told = []
    for axis, column, step in zip("xyz", distinct.T, steps, strict=True):
        if step == 0:
            continue
        largest = float(np.abs(column).max())
        single = step <= np.spacing(np.float32(largest)) and np.array_equal(
            column, column.astype(np.float32)
        )
        least = _CUT * spacing
        if single or largest / step > _DIGITS:
            least = _COARSE * spacing
        elif repeated > _REPEATED:
            least = _GRID * spacing
        if step < least:
            continue
        beside = f"{axis} comes in steps of {step:.3g} beside a spacing of {spacing:.3g}"
        if single:
            told.append(
                f"{beside}, as single precision has at {largest:.4g}: export double precision, or "
                "subtract an offset first"
            )
        else:
            told.append(f"{beside}: if it was cut when written, export it with more digits")
    return told


def _is_raster(distinct: np.ndarray, steps: list[float]) -> bool:
    """Whether x and y are the cells of a grid with one height each, as in a terrain model."""
    if not (steps[0] > 0 and np.isclose(steps[0], steps[1], rtol=1e-3)):
        return False
    return len(np.unique(distinct[:, :2], axis=0)) > 0.9 * len(distinct)


def _step(column: np.ndarray) -> float:
    """The step that all differences are multiples of; 0 where there is none, or a single value."""
    values = np.unique(column)
    if len(values) < 3:
        return 0.0
    gaps = np.diff(values)
    step = float(gaps.min())
    # Ten digits of the largest value are what a text file may have rounded to.
    slack = 1e-3 + 4e-10 * float(np.abs(values).max()) / step
    multiples = gaps / step
    whole = np.abs(multiples - np.round(multiples)) <= slack
    return step if slack < 0.2 and whole.all() else 0.0


def _shape(distinct: np.ndarray) -> list[str]:
    flat = [
        axis for axis, extent in zip("xyz", np.ptp(distinct, axis=0), strict=True) if extent == 0
    ]
    if len(flat) == 1:
        return [f"two-dimensional: {flat[0]} is the same for all points"]
    centred = distinct - distinct.mean(axis=0)
    widths = np.sqrt(np.maximum(np.linalg.eigvalsh(centred.T @ centred / len(centred)), 0))[::-1]
    if widths[1] <= _THIN * widths[0]:
        return [
            f"thin: {widths[1] / widths[0]:.1g} of its length across, so that a turn about its "
            "length cannot be told"
        ]
    if widths[2] <= _FLAT * widths[1]:
        return [
            f"planar: {widths[2] / widths[1]:.1g} of its width thick, so that shifts and turns in "
            "the plane are told by its outline alone"
        ]
    return []


def _density(near: np.ndarray) -> list[str]:
    low, high = np.quantile(near, [0.05, 0.95])
    if low <= 0 or (high / low) ** 2 < _UNEVEN:
        return []
    return [
        f"uneven: the density of points varies {(high / low) ** 2:.2g} times (spacing {low:.2g} to "
        f"{high:.2g})"
    ]
