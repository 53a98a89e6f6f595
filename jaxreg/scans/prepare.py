"""A cloud prepared once: checked, centred, at two densities, with trees, normals and descriptors.

Everything here is float64 on the host. Float32 at an offset of 1e6 m has a resolution of 6 cm, so
offset and unit are removed before any array reaches a device, and restored at the end. Nothing in a
`Prepared` depends on a partner: what a pair has in common (one unit, one density) is chosen from a
few steps, so a cloud that meets many others is thinned and described once per step.
"""

import dataclasses
import functools
import math
from typing import Literal

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxreg._xla import from_host
from jaxreg.geometry import frame, trees
from jaxreg.geometry.clouds import check_normals, check_points, padded
from jaxreg.judge.surface import Examined, examine
from jaxreg.refine.kdtree import IndexedCloud, index_cloud
from jaxreg.scans import free_space, planes
from jaxreg.scans import strays as stray_points
from jaxreg.scans.config import RegisterConfig, checked
from jaxreg.search.config import SearchConfig
from jaxreg.search.description import Described, describe

_FLAT = 1e-9
"""Clouds less thick than this, in radii, are in a plane of one z."""
_FOURTH = 4
"""The neighbour whose distance is the spacing; see `spacing`."""
FINEST = 1e-6
"""The resolution of float32 in a cloud of radius 1: a smaller spacing counts as zero."""
_CUBES = 1 << 20
"""Up to this many cubes, a table of all of them is faster than sorting the occupied ones."""
_GUESSES, _CLOSE = 12, 1.02
"""Sizes tried from the number of occupied voxels, and how near to the smallest the last one is."""
_STEPS = 4
"""Units and densities that pairs are compared at, per factor of two."""
_UNALIKE = 1.3
"""Ratio of the spacings above which the denser cloud of a pair is thinned to the other's spacing."""


@dataclasses.dataclass(frozen=True, eq=False)
class Level:
    """A cloud at one density, in its own frame. What is expensive is computed on first use, and kept.

    `normals`, if the user gave some, are those of the nearest points of the whole cloud.
    """

    points: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"] | None
    k: int
    _described: dict[tuple[float, int, tuple[float, ...]], Described] = dataclasses.field(
        default_factory=dict
    )

    @functools.cached_property
    def index(self) -> IndexedCloud:
        """Tree, normals and edges."""
        return index_cloud(self.points, k=self.k, normals=self.normals)

    @functools.cached_property
    def spacing(self) -> float:
        """See `spacing`; by the neighbours that the index has found anyway, if it has four."""
        if min(self.k, len(self.points) - 1) < _FOURTH:
            return spacing(self.points, self.index.tree)
        fourth = self.index.neighbors[: len(self.points), _FOURTH - 1]
        return float(np.median(np.linalg.norm(self.points - self.points[fourth], axis=1)))

    @functools.cached_property
    def examined(self) -> Examined:
        """The level as the judge sees it, padded as the index is, in the unit of the level."""
        mask = np.arange(len(self.index.padded)) < len(self.points)
        return _examine(self.index.padded, self.index.normals, self.index.neighbors, mask)

    def described(self, unit: float, size: int, radii: tuple[float, ...]) -> Described:
        """The cloud as the search takes it, padded to `size` rows; `unit` is in units of the level."""
        key = (unit, size, radii)
        if key not in self._described:
            normals = None if self.normals is None else padded(self.normals, size)[0]
            found = self.index.neighbors[: len(self.points)]
            neighbors = np.repeat(np.arange(size, dtype=np.int32)[:, None], found.shape[1], axis=1)
            neighbors[: len(found)] = found
            arrays = padded(self.points, size)
            scale = np.float32(np.clip(unit, 1e-30, 1e30))
            self._described[key] = _describe(*arrays, scale, normals, neighbors, radii=radii)
        return self._described[key]


@dataclasses.dataclass(frozen=True, eq=False)
class Prepared:
    """A cloud prepared by `jaxreg.prepare`, for any number of registrations.

    `points` are the distinct finite points in lexicographic order, around `centre` in units of
    `radius` (root mean square), so order and repetition of the rows, offset and unit do not change
    a result. `kept` says which rows of the input are finite and no strays, and ``points[row]`` are
    the kept rows in their own order. `notes` are sentences on what was odd about the cloud. `fine`
    and `coarse` have at most `config.refine_points` and `config.search_points` points. `viewpoint`
    is where the scanner stood, in the unit and frame of `points`, None if unknown.
    """

    points: Float[np.ndarray, "p 3"]
    normals: Float[np.ndarray, "p 3"] | None
    centre: Float[np.ndarray, "3"]
    radius: float
    kept: Bool[np.ndarray, "n"]
    row: Int[np.ndarray, "r"]
    notes: tuple[str, ...]
    fine: Level
    coarse: Level
    config: RegisterConfig
    viewpoint: Float[np.ndarray, "3"] | None = None
    _thinned: dict[float, Level] = dataclasses.field(default_factory=dict)

    @functools.cached_property
    def tree(self) -> trees.Tree:
        """Over all points."""
        return trees.Tree(self.points)

    @property
    def flat(self) -> bool:
        """Whether all points have one z."""
        return bool(np.ptp(self.points[:, 2]) <= _FLAT)

    def rows(self, most: int) -> Int[np.ndarray, "s"]:
        """Indices of at most so many points, evenly along their order."""
        return np.linspace(0, len(self.points) - 1, min(most, len(self.points))).astype(int)

    @functools.cached_property
    def surface(self) -> planes.Surface:
        """Its patches: whatever asks for one finds it again, in this registration and the next."""
        return planes.Surface(self.points, self.tree)

    @functools.cached_property
    def view(self) -> free_space.View | None:
        """What the scanner saw, if it is known where it stood."""
        return None if self.viewpoint is None else free_space.view(self.points, self.viewpoint)

    def thinned(self, size: float) -> Level:
        """`coarse` averaged in cubes of edge `size` (unit of the input)."""
        if size not in self._thinned:
            points = voxel_reduced(self.coarse.points, size / self.radius)
            self._thinned[size] = _level(points, self.points, self.normals, self.coarse.k)
        return self._thinned[size]

    def in_frame(self, level: Level, where: frame.Frame) -> IndexedCloud:
        """The indexed cloud of a level, placed in the frame of a pair."""
        return level.index._replace(scale=self.radius / float(where.length))

    def per_input_row(self, values: np.ndarray, *, missing: float) -> np.ndarray:
        """Values of `points` as rows of the input, `missing` where a row was dropped."""
        if len(self.row) == len(self.kept):
            return values[self.row]
        rows = np.full((len(self.kept), *values.shape[1:]), missing)
        rows[self.kept] = values[self.row]
        return rows


def prepare(
    cloud: object,
    *,
    normals: object = None,
    viewpoint: object = None,
    nonfinite: Literal["raise", "drop"] = "raise",
    strays: Literal["drop", "keep", "raise"] = "drop",
    config: RegisterConfig | None = None,
    name: str = "cloud",
) -> Prepared:
    """Compute once what registration needs to know about a cloud; give it to `jaxreg.register`.

    `cloud` is array-like (n, 3), or (n, 2) in the plane z = 0. `normals` (n, 3), of any length and
    sign, replace the computed ones; give zeros where unknown. `viewpoint` (3,), or (2,) in the plane,
    is where the scanner stood: a pose that puts points between it and what it measured is then held
    to be wrong. Give it only for a cloud that was seen from one place. `strays` are a few points ten
    times as far from the middle as all others (`Prepared.notes` tells of them): they are left out,
    take part, or are an error; centre and radius are those of the others in any case. `config` must
    be that of the registration, and `name` is how messages refer to the cloud.

    Raises:
      ValueError: the cloud is not a numeric (n, 3) array with at least three finite points (the
        message names the row), the normals or the viewpoint have another shape or are not finite, or
        there are strays
        and `strays` is "raise".
    """
    config = checked(config)
    array, kept = check_points(cloud, name, nonfinite=nonfinite, planar=True)
    across = None if normals is None else check_normals(normals, kept, name)
    heights = array[kept, 2]
    height = float(heights[0]) if np.ptp(heights) == 0 else None
    place = free_space.check_place(viewpoint, name, height=height)
    points, first, row = _distinct(array[kept])
    across = None if across is None else across[kept][first]
    far, notes = _strays(points, row, strays, name)
    if strays == "drop" and far.any():
        points, across = points[~far], None if across is None else across[~far]
        kept[kept] = ~far[row]
        row = (np.cumsum(~far) - 1)[row[~far[row]]]
        far = far[~far]
    centre, radius = frame.measure(points[~far])
    points = (points - centre) / (radius or 1.0)
    place = None if place is None else (place - centre) / (radius or 1.0)
    k = 10 if config.refine is None else config.refine.k
    fine = reduce_to(points, config.refine_points)
    coarse = reduce_to(fine, config.search_points)
    fine, coarse = (_level(level, points, across, k) for level in (fine, coarse))
    return Prepared(
        points, across, centre, radius or 1.0, kept, row, notes, fine, coarse, config, place
    )  # fmt: skip


def prepared(
    cloud: object,
    *,
    viewpoint: object,
    nonfinite: Literal["raise", "drop"],
    strays: Literal["drop", "keep", "raise"],
    config: RegisterConfig,
    name: str,
    caller: str,
) -> Prepared:
    """`prepare`, or the cloud itself if that was done with the same settings for `caller`.

    Raises:
      ValueError: as `prepare`; or the cloud was prepared with another configuration, or has its
        viewpoint already.
    """
    if not isinstance(cloud, Prepared):
        return prepare(
            cloud, viewpoint=viewpoint, nonfinite=nonfinite, strays=strays, config=config, name=name
        )
    if viewpoint is not None:
        raise ValueError(f"{name} is prepared: give its viewpoint to jaxreg.prepare.")
    if cloud.config != config:
        raise ValueError(
            f"{name} was prepared with another configuration than this registration's: give "
            f"jaxreg.prepare and {caller} the same config."
        )
    return cloud


def part(cloud: Prepared, rows: Bool[np.ndarray, "n"], config: RegisterConfig) -> Prepared:
    """The cloud of these rows of the input alone; rows of it that were dropped stay dropped.

    Its own rows are those that are left.
    """
    return of_points(cloud, cloud.row[rows[cloud.kept]], config)


def of_points(
    cloud: Prepared,
    chosen: Int[np.ndarray, "m"] | Bool[np.ndarray, "p"],
    config: RegisterConfig,
) -> Prepared:
    """The cloud of these of its points, which are the rows of the new one, with its viewpoint."""
    points = cloud.points[chosen] * cloud.radius + cloud.centre
    across = None if cloud.normals is None else cloud.normals[chosen]
    place = None if cloud.viewpoint is None else cloud.viewpoint * cloud.radius + cloud.centre
    return prepare(points, normals=across, viewpoint=place, strays="keep", config=config)


def mirrored(cloud: Prepared, config: RegisterConfig) -> Prepared:
    """The mirror image of a cloud, about its centre."""
    return prepare(cloud.points * cloud.radius * [-1, 1, 1], config=config)


def at_one_density(source: Prepared, reference: Prepared) -> tuple[Level, Level]:
    """The coarse levels of both clouds, the denser one thinned if their spacings differ.

    Counts around a point depend on the density, and clouds are compared by such counts.
    """
    return _alike(source, reference, source.coarse, reference.coarse)


def at_fine_density(source: Prepared, reference: Prepared) -> tuple[Level, Level]:
    """The same of the fine levels: a small scan in a large one is a few points of a coarse level."""
    return _alike(source, reference, source.fine, reference.fine)


def _alike(source: Prepared, reference: Prepared, one: Level, other: Level) -> tuple[Level, Level]:
    clouds, levels = (source, reference), (one, other)
    sides = list(zip(levels, clouds, strict=True))
    spacings = [level.spacing * cloud.radius for level, cloud in sides]
    size = in_steps(max(spacings))
    first, second = (
        cloud.thinned(size) if _UNALIKE * spacing < max(spacings) else level
        for spacing, (level, cloud) in zip(spacings, sides, strict=True)
    )
    return first, second


def in_steps(value: float) -> float:
    """The nearest of the values at which pairs are compared, a fifth apart; 0 stays."""
    return 2.0 ** (round(_STEPS * math.log2(value)) / _STEPS) if value > 0 else 0.0


def voxel_reduced(points: Float[np.ndarray, "n 3"], size: float) -> Float[np.ndarray, "v 3"]:
    """The mean of the points in every occupied cube of edge `size`, in lexicographic order."""
    return _means(points, _cubes(_from_corner(points), size))


def reduce_to(points: Float[np.ndarray, "n 3"], most: int) -> Float[np.ndarray, "v 3"]:
    """At most `most` points that cover the cloud evenly; the cloud itself if it is small enough.

    Voxel means with the smallest voxel that suffices, to a few per cent.
    """
    if len(points) <= most:
        return points
    columns = _from_corner(points)
    low, high = 0.0, max(float(column.max()) for column in columns)
    size, best = high / np.sqrt(most), None
    for _ in range(_GUESSES):
        cubes, count = _counted(columns, size)
        if count > most:
            low = size
        else:
            high, best = size, cubes
            if count > 0.92 * most:
                break
        # A surface has about 1 / size^2 occupied voxels.
        guess = size * np.sqrt(count / (0.96 * most))
        size = guess if low < guess < high else (low + high) / 2
    if best is None:
        # Of evenly spaced points, hardly more than `most`, no two share a cube that is smaller than
        # their spacing: there the guesses grow by a few per cent only.
        best = _cubes(columns, high)  # two an axis at most, eight in all
        while high > _CLOSE * low:
            size = math.sqrt(low * high)
            cubes, count = _counted(columns, size)
            if count > most:
                low = size
            else:
                high, best = size, cubes
    return _means(points, best)


def spacing(points: Float[np.ndarray, "n 3"], tree: trees.Tree | None = None) -> float:
    """How far apart neighbouring points of the surface are: the median distance to the 4th nearest.

    On a surface covered by squares of edge a, one point each, this is about a; 0 for a single point.
    """
    k = min(_FOURTH, len(points) - 1)
    if k < 1:
        return 0.0
    found = trees.Tree(points) if tree is None else tree
    return float(np.median(trees.neighbors(found, points, k + 1)[0][:, -1]))


_examine = from_host(jax.jit(examine))


@from_host
@functools.partial(jax.jit, static_argnames="radii")
def _describe(points, mask, unit, normals, neighbors, *, radii: tuple[float, ...]) -> Described:
    return describe(
        points, mask, unit=unit, normals=normals, neighbors=neighbors,
        config=SearchConfig(radii=radii),
    )  # fmt: skip


def _strays(
    points: np.ndarray, row: np.ndarray, wanted: Literal["drop", "keep", "raise"], name: str
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Which of the distinct points are strays, and a sentence on the rows that have them."""
    if wanted not in ("drop", "keep", "raise"):
        raise ValueError(f"strays must be 'drop', 'keep' or 'raise', got {wanted!r}.")
    far = stray_points.strays(points)
    if not far.any():
        return far, ()
    told = f"{name}: {stray_points.told(points[row], far[row])}"
    if wanted == "raise":
        raise ValueError(f"{told}: remove them, or pass strays='drop' or strays='keep'.")
    return far, (told + ("; left out" if wanted == "drop" else ""),)


def _level(points: np.ndarray, whole: np.ndarray, normals: np.ndarray | None, k: int) -> Level:
    if normals is not None:
        normals = normals[trees.nearest(trees.Tree(whole), points)[1]]
    return Level(points, normals, k)


def _distinct(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The distinct rows in lexicographic order, the first row of each, and which one every row is."""
    points = points + 0.0  # -0.0 and 0.0 are one number.
    order, tied = _lexicographic(points)
    ordered = points[order]
    row = np.empty(len(points), np.int64)
    if not tied:
        row[order] = np.arange(len(points))
        return ordered, order, row
    new = np.ones(len(ordered), bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    row[order] = np.cumsum(new) - 1
    return ordered[new], order[new], row


def _lexicographic(points: np.ndarray) -> tuple[np.ndarray, bool]:
    """The order of the rows by x, then y, then z, and whether any two share an x.

    Coordinates of scans rarely repeat, so one sort by x leaves little to do: a third of the time of
    a lexsort (and numpy.unique on rows takes several times as long).
    """
    order = np.argsort(points[:, 0], kind="stable")
    x = points[order, 0]
    tied = np.zeros(len(x), bool)
    tied[1:] = x[1:] == x[:-1]
    if not tied.any():
        return order, False
    tied[:-1] |= tied[1:]
    rows = order[tied]
    order[tied] = rows[np.lexsort(points[rows].T[::-1])]
    return order, True


def _from_corner(points: np.ndarray) -> list[np.ndarray]:
    """The three coordinates minus their smallest values, each contiguous: three times as fast."""
    return [column - column.min() for column in np.ascontiguousarray(points.T)]


def _cubes(columns: list[np.ndarray], size: float) -> Int[np.ndarray, "n"]:
    """For every point, the number of its cube of edge `size`, in lexicographic order."""
    cells = [(column / size).astype(np.int64) for column in columns]
    extent = [int(cell.max()) + 1 for cell in cells]
    if math.prod(extent) > _CUBES:
        # Ranks instead of coordinates: the number itself would overflow for cells far apart.
        ranked = [np.unique(cell, return_inverse=True) for cell in cells]
        cells = [rank for _, rank in ranked]
        extent = [len(values) for values, _ in ranked]
    key = (cells[0] * extent[1] + cells[1]) * extent[2] + cells[2]
    return np.unique(key, return_inverse=True)[1] if math.prod(extent) > _CUBES else key


def _counted(columns: list[np.ndarray], size: float) -> tuple[Int[np.ndarray, "n"], int]:
    """`_cubes`, and how many of them have points."""
    cubes = _cubes(columns, size)
    return cubes, int(np.count_nonzero(np.bincount(cubes)))


def _means(points: np.ndarray, group: Int[np.ndarray, "n"]) -> Float[np.ndarray, "v 3"]:
    count = np.bincount(group)
    occupied = np.flatnonzero(count)
    sums = np.stack([np.bincount(group, weights=axis)[occupied] for axis in points.T], axis=1)
    return sums / count[occupied, None]
