"""Iterations whose pairs come from a k-d tree on the host: the driver for all three methods.

The tree finds the pairs in float64 on the CPU, the step is the pure one of `icp`, `point_to_plane`
or `gicp`, jitted. Arrays are padded to a few sizes, so a new size of cloud seldom needs a compilation.
"""

import dataclasses
import math
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial.transform import Rotation

from jaxreg._xla import from_host
from jaxreg.geometry import trees
from jaxreg.geometry.clouds import padded_size
from jaxreg.geometry.normals import edge_normals, normals, surface_covariances
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.correspondences import Pairs
from jaxreg.refine.cost import Scene, match
from jaxreg.refine.gauss_newton import gauss_newton_step
from jaxreg.refine.methods import method_of
from jaxreg.refine.robust import Weighting, widenings
from jaxreg.types import RigidTransform

_COARSE = 30_000
"""Number of points that find the pose before all of them refine it."""
_FAR = 2e-3
"""Steps longer than this (radians, radii of the clouds) lead to a pose that a narrower kernel
misses."""
_PARALLEL, _LONGEST = 0.8, 4.0
"""A step is extrapolated where the cosine to the last one is at least the first, up to so many
times its length."""
_SIZES = 1024, 4096
"""Padded sizes of small clouds, powers of two above. Programs are compiled for *pairs* of sizes: one
more size costs more time than the padding."""


class IndexedCloud(NamedTuple):
    """A cloud: on the host with its tree, and padded on the device with its normals and edges.

    Coordinates times `scale` are those in the frame of a pair: a cloud is indexed once, in its own
    unit, and placed in many frames.
    """

    points: Float[np.ndarray, "n 3"]
    tree: trees.Tree
    neighbors: Int[np.ndarray, "m k"]
    padded: Float[Array, "m 3"]
    normals: Float[Array, "m 3"]
    edge_normals: Float[Array, "m 3"]
    scale: float = 1.0

    @property
    def host_normals(self) -> Float[np.ndarray, "n 3"]:
        """The normals of `points`, float64."""
        return np.asarray(self.normals, np.float64)[: len(self.points)]

    def moved_by(self, pose: RigidTransform, stride: int = 1) -> Float[np.ndarray, "*k p 3"]:
        """Every `stride`-th point in the frame, moved from it by a pose (or by many: leading axes)."""
        turned = self.points[::stride] @ (np.swapaxes(pose.rotation, -1, -2) * self.scale)
        return turned + pose.translation[..., None, :]

    def moved_back_by(self, pose: RigidTransform, stride: int = 1) -> Float[np.ndarray, "*k p 3"]:
        """The same, moved by the inverse of the pose."""
        placed = self.points[::stride] * self.scale
        return (placed - pose.translation[..., None, :]) @ pose.rotation

    def nearest(
        self, queries: Float[np.ndarray, "*q 3"], *, within: float = math.inf
    ) -> tuple[Float[np.ndarray, "*q"], np.ndarray]:
        """Distance to, and index of, the nearest point of every query, both in the frame.

        Of points that lie farther than `within` only that is said: the distance is infinite, the
        index is any. Most of the time of a query goes into points that lie far off.
        """
        bound = within / self.scale
        distance, index = trees.nearest(self.tree, queries / self.scale, within=bound)
        return distance * self.scale, np.minimum(index, len(self.points) - 1)


def index_cloud(
    points: Float[np.ndarray, "n 3"], *, k: int, normals: Float[np.ndarray, "n 3"] | None = None
) -> IndexedCloud:
    """Tree, normals (from `k` neighbours, unless given) and edges of a cloud; fewer if it is small."""
    tree = trees.Tree(points)
    found = min(k, len(points) - 1) + 1
    # One more than asked for: the point finds itself, and a row of its own index does not count.
    _, index = trees.neighbors(tree, points, found)
    size = _padded_size(len(points))
    rows = np.broadcast_to(np.arange(size, dtype=np.int32)[:, None], (size, k + 1)).copy()
    rows[: len(points), :found] = index
    fill = ((0, size - len(points)), (0, 0))
    padded = jax.device_put(np.pad(points, fill))
    given = None if normals is None else jax.device_put(np.pad(normals, fill))
    return IndexedCloud(points, tree, rows[:, 1:], padded, *_described(padded, rows, given))


def _padded_size(count: int) -> int:
    return padded_size(count, smallest=next((s for s in _SIZES if s >= count), _SIZES[-1]))


def iterate(
    pose: RigidTransform,
    source: IndexedCloud,
    reference: IndexedCloud,
    weighting: Weighting,
    *,
    config: RefineConfig,
    step: int = 1,
    more: int = 0,
    motions: Float[np.ndarray, "6 f"] | None = None,
) -> tuple[RigidTransform, int, bool, Pairs]:
    """Pose (numpy), iterations taken, whether the last step was below tolerance, the last pairs.

    The kernel narrows to its final width. After a step below `config.tolerance` half of the
    remaining widths are skipped; at the final width all are. Up to `more` further iterations are
    made where the pose still moves: far at a wide kernel, at all at the final one. There steps are
    extrapolated. Only every `step`-th point looks for a partner; large clouds first converge with
    fewer. `motions` is a basis of the unknown motions (rotation vector, translation) in the frame;
    None: all of them.
    """
    widths = widenings(config.iterations, config.kernel_annealing, np.dtype("float32"))
    stride = -(-max(len(source.points), len(reference.points)) // _COARSE)
    stride = max(stride, step)
    levels = [(stride, widths)]
    if stride > step:
        levels.append((step, np.ones_like(widths)))
    # The distance is in the weighting; a static one that differs from pair to pair would compile
    # every time.
    settings = dataclasses.replace(config, max_correspondence_distance=math.inf)
    taken, converged, pairs = 0, False, None
    for stride, widths in levels:
        i, converged, spare, last = 0, False, more, None
        while i < len(widths) and not converged:
            pairs = tree_pairs(
                pose,
                source,
                reference,
                stride,
                both_directions=config.both_directions,
                within=_within(weighting),
            )
            new = _step(
                pose, source[3:], reference[3:], pairs, weighting.kernel_scale,
                weighting.max_correspondence_distance, float(widths[i]), motions, config=settings,
            )  # fmt: skip
            new = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), new)
            change = _change(pose, new)
            still = change < config.tolerance
            converged = bool(still and widths[i] == 1)
            if widths[i] == 1 and not converged:
                new, last = _extrapolated(pose, new, last)
            pose, taken = new, taken + 1
            # From a wider kernel at least to the next one, at most to the last.
            halfway = min((i + config.iterations) // 2, config.iterations - 1)
            moving = change > _FAR or (i == len(widths) - 1 and not still)
            if moving and spare > 0:
                spare -= 1
            else:
                i = max(i + 1, halfway) if still else i + 1
    assert pairs is not None  # there is one iteration at least
    return pose, taken, converged, pairs


def iterate_all(
    poses: RigidTransform,
    source: IndexedCloud,
    reference: IndexedCloud,
    weighting: Weighting,
    *,
    config: RefineConfig,
    step: int = 1,
    motions: Float[np.ndarray, "6 f"] | None = None,
    counted: Bool[np.ndarray, "k n"] | None = None,
) -> RigidTransform:
    """All iterations of `config` for many poses (leading axis, numpy) at once.

    One search of the tree and one program for all of them, which takes a fraction of the time that
    they would take in turn. `counted` says which points of the source take part, for every pose.
    """
    settings = dataclasses.replace(config, max_correspondence_distance=math.inf)
    for width in widenings(config.iterations, config.kernel_annealing, np.dtype("float32")):
        pairs = tree_pairs(
            poses, source, reference, step, both_directions=config.both_directions,
            within=_within(weighting),
        )  # fmt: skip
        if counted is not None:
            part = np.take_along_axis(counted, pairs.source_index, axis=1)
            pairs = pairs._replace(mask=pairs.mask & part)
        poses = _steps(
            poses, source[3:], reference[3:], pairs, weighting.kernel_scale,
            weighting.max_correspondence_distance, float(width), motions, config=settings,
        )  # fmt: skip
        poses = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), poses)
    return poses


def _within(weighting: Weighting) -> float:
    """The largest distance of pairs that count, and a little more than rounding adds to it."""
    return 1.0001 * float(weighting.max_correspondence_distance)


def tree_pairs(
    pose: RigidTransform,
    source: IndexedCloud,
    reference: IndexedCloud,
    stride: int,
    *,
    both_directions: bool,
    within: float = math.inf,
) -> Pairs:
    """`closest_pairs` of every `stride`-th point, padded, by the trees of the unmoved clouds.

    Of poses with leading axes there are as many pairs. Those farther apart than `within` do not count.
    """
    forward = source.moved_by(pose, stride)
    size = -(-len(source.padded) // stride)
    distance, index = reference.nearest(forward, within=within)
    found, i, j = np.isfinite(distance), _rows(source, index, stride), index
    if both_directions:
        backward = reference.moved_back_by(pose, stride)
        # A sum of two sizes, so that only the sizes of the clouds decide which program runs.
        size += -(-len(reference.padded) // stride)
        distance, index = source.nearest(backward, within=within)
        found = np.concatenate([found, np.isfinite(distance)], axis=-1)
        i = np.concatenate([i, index], axis=-1)
        j = np.concatenate([j, _rows(reference, index, stride)], axis=-1)
    padding = [(0, 0)] * (found.ndim - 1) + [(0, size - found.shape[-1])]
    return Pairs(
        *(np.pad(x.astype(t), padding) for x, t in ((i, np.int32), (j, np.int32), (found, bool)))
    )


def _rows(cloud: IndexedCloud, like: np.ndarray, stride: int) -> np.ndarray:
    return np.broadcast_to(np.arange(0, len(cloud.points), stride), like.shape)


@from_host
@jax.jit
def _described(points, neighbors, given):
    across = normals(points, neighbors) if given is None else given
    return across, edge_normals(points, neighbors, across)


@from_host
@partial(jax.jit, static_argnames="config")
def _steps(
    poses, source, reference, pairs, kernel_scale, distance, width, motions, *, config: RefineConfig
):
    def one(pose_and_pairs):
        pose, pairs = pose_and_pairs
        return _step(
            pose, source, reference, pairs, kernel_scale, distance, width, motions, config=config
        )

    return jax.lax.map(one, (poses, pairs))


@from_host
@partial(jax.jit, static_argnames="config")
def _step(
    pose, source, reference, pairs, kernel_scale, distance, width, motions, *, config: RefineConfig
):
    (x, *source_shape, source_scale), (y, *reference_shape, reference_scale) = source, reference
    weighting = Weighting(config.kernel, kernel_scale, distance, config.trim)
    pose = RigidTransform(*(leaf.astype(x.dtype) for leaf in pose))
    here, there = (_surface(shape, config) for shape in (source_shape, reference_shape))
    scene = Scene(x * source_scale, y * reference_scale, here, there, weighting)
    method = method_of(config)
    matched = match(scene, pose, pairs, method, width)
    if motions is None:
        return method.step(pose, matched)
    basis = motions.astype(x.dtype)
    return gauss_newton_step(pose, matched.moved, matched.target, matched.metric, basis)


def _surface(shape, config: RefineConfig):
    """What the method uses of a surface with these normals and edges."""
    across, ends = shape
    if config.method == "gicp":
        return surface_covariances(across, config.epsilon, ends if config.edges else None)
    return across


def _extrapolated(
    old: RigidTransform, new: RigidTransform, last: Float[np.ndarray, "6"] | None
) -> tuple[RigidTransform, Float[np.ndarray, "6"] | None]:
    """The pose farther along a step that repeats the `last` one, and the step if it is as it was.

    Near the solution every step is about the same share q of the last: the rest of the way is then
    the sum of a geometric series, step / (1 - q) (Aitken's extrapolation).
    """
    turn = new.rotation @ old.rotation.T
    step = np.concatenate(
        [Rotation.from_matrix(turn).as_rotvec(), new.translation - turn @ old.translation]
    )
    if last is None:
        return new, step
    lengths = np.linalg.norm(step), np.linalg.norm(last)
    if step @ last < _PARALLEL * lengths[0] * lengths[1]:
        return new, step
    longer = step / max(1 / _LONGEST, 1 - lengths[0] / lengths[1])
    turn = Rotation.from_rotvec(longer[:3]).as_matrix()
    return RigidTransform(turn @ old.rotation, turn @ old.translation + longer[3:]), None


def _change(old: RigidTransform, new: RigidTransform) -> float:
    """The larger of rotation (radians, for small ones) and translation between two poses."""
    turned = np.linalg.norm(new.rotation - old.rotation) / np.sqrt(2)
    return max(float(turned), float(np.linalg.norm(new.translation - old.translation)))
