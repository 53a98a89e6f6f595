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
from jaxtyping import Array, Float
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from jaxreg.geometry.clouds import padded_size
from jaxreg.geometry.normals import edge_normals, normals, surface_covariances
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.correspondences import Pairs
from jaxreg.refine.cost import Scene, match
from jaxreg.refine.methods import method_of
from jaxreg.refine.robust import Weighting, widenings
from jaxreg.types import RigidTransform

_COARSE = 30_000
"""Number of points that find the pose before all of them refine it."""
_SMALLEST = 512
"""Smallest padded size: below, one more compilation costs more than the padding."""


class IndexedCloud(NamedTuple):
    """A cloud: on the host with its tree, and padded on the device with its normals and edges.

    Coordinates times `scale` are those in the frame of a pair: a cloud is indexed once, in its own
    unit, and placed in many frames.
    """

    points: Float[np.ndarray, "n 3"]
    tree: cKDTree
    padded: Float[Array, "m 3"]
    normals: Float[Array, "m 3"]
    edge_normals: Float[Array, "m 3"]
    scale: float = 1.0

    @property
    def host_normals(self) -> Float[np.ndarray, "n 3"]:
        """The normals of `points`, float64."""
        return np.asarray(self.normals, np.float64)[: len(self.points)]

    def nearest(
        self, queries: Float[np.ndarray, "q 3"]
    ) -> tuple[Float[np.ndarray, "q"], np.ndarray]:
        """Distance to, and index of, the nearest point of every query, both in the frame."""
        distance, index = self.tree.query(queries / self.scale, workers=-1)
        return np.asarray(distance) * self.scale, np.asarray(index)


def index_cloud(
    points: Float[np.ndarray, "n 3"], *, k: int, normals: Float[np.ndarray, "n 3"] | None = None
) -> IndexedCloud:
    """Tree, normals (from `k` neighbours, unless given) and edges of a cloud; fewer if it is small."""
    tree = cKDTree(points)
    found = min(k, len(points) - 1) + 1
    # One more than asked for: the point finds itself, and a row of its own index does not count.
    _, index = tree.query(points, k=list(range(1, found + 1)), workers=-1)
    size = padded_size(len(points), smallest=_SMALLEST)
    rows = np.broadcast_to(np.arange(size, dtype=np.int32)[:, None], (size, k + 1)).copy()
    rows[: len(points), :found] = index
    fill = ((0, size - len(points)), (0, 0))
    padded = jax.device_put(np.pad(points, fill))
    given = None if normals is None else jax.device_put(np.pad(normals, fill))
    return IndexedCloud(points, tree, padded, *_described(padded, rows, given))


def iterate(
    pose: RigidTransform,
    source: IndexedCloud,
    reference: IndexedCloud,
    weighting: Weighting,
    *,
    config: RefineConfig,
) -> tuple[RigidTransform, int, bool, Pairs]:
    """Pose (numpy), iterations taken, whether the last step was below tolerance, the last pairs.

    The kernel narrows to its final width. After a step below `config.tolerance` half of the
    remaining widths are skipped; at the final width all are. Large clouds first converge with every
    k-th point.
    """
    widths = widenings(config.iterations, config.kernel_annealing, np.dtype("float32"))
    stride = -(-max(len(source.points), len(reference.points)) // _COARSE)
    levels = [(stride, widths)] if stride == 1 else [(stride, widths), (1, np.ones_like(widths))]
    # The distance is in the weighting; a static one that differs from pair to pair would compile
    # every time.
    settings = dataclasses.replace(config, max_correspondence_distance=math.inf)
    taken, converged, pairs = 0, False, None
    for stride, widths in levels:
        i, converged = 0, False
        while i < len(widths) and not converged:
            pairs = tree_pairs(
                pose, source, reference, stride, both_directions=config.both_directions
            )
            new = _step(
                pose, source[2:], reference[2:], pairs, weighting.kernel_scale,
                weighting.max_correspondence_distance, float(widths[i]), config=settings,
            )  # fmt: skip
            new = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), new)
            still = _change(pose, new) < config.tolerance
            pose, taken, converged = new, taken + 1, bool(still and widths[i] == 1)
            # From a wider kernel at least to the next one, at most to the last.
            halfway = min((i + config.iterations) // 2, config.iterations - 1)
            i = max(i + 1, halfway) if still else i + 1
    assert pairs is not None  # there is one iteration at least
    return pose, taken, converged, pairs


def tree_pairs(
    pose: RigidTransform,
    source: IndexedCloud,
    reference: IndexedCloud,
    stride: int,
    *,
    both_directions: bool,
) -> Pairs:
    """`closest_pairs` of every `stride`-th point, padded, by the trees of the unmoved clouds."""
    rotation, translation = pose
    rows = np.arange(0, len(source.points), stride)
    moved = source.points[rows] @ (rotation.T * source.scale) + translation
    size = padded_size(len(rows), smallest=_SMALLEST)
    source_index, reference_index = rows, reference.nearest(moved)[1]
    if both_directions:
        rows = np.arange(0, len(reference.points), stride)
        back = (reference.points[rows] * reference.scale - translation) @ rotation
        source_index = np.concatenate([source_index, source.nearest(back)[1]])
        reference_index = np.concatenate([reference_index, rows])
        # A sum of two sizes, so that only the sizes of the clouds decide which program runs.
        size += padded_size(len(rows), smallest=_SMALLEST)
    count = len(source_index)
    padding = (0, size - count)
    return Pairs(
        np.pad(source_index, padding).astype(np.int32),
        np.pad(reference_index, padding).astype(np.int32),
        np.pad(np.ones(count, bool), padding),
    )


@jax.jit
def _described(points, neighbors, given):
    across = normals(points, neighbors) if given is None else given
    return across, edge_normals(points, neighbors, across)


@partial(jax.jit, static_argnames="config")
def _step(pose, source, reference, pairs, kernel_scale, distance, width, *, config: RefineConfig):
    (x, *source_shape, source_scale), (y, *reference_shape, reference_scale) = source, reference
    weighting = Weighting(config.kernel, kernel_scale, distance, config.trim)
    pose = RigidTransform(*(leaf.astype(x.dtype) for leaf in pose))
    here, there = (_surface(shape, config) for shape in (source_shape, reference_shape))
    scene = Scene(x * source_scale, y * reference_scale, here, there, weighting)
    method = method_of(config)
    return method.step(pose, match(scene, pose, pairs, method, width))


def _surface(shape, config: RefineConfig):
    """What the method uses of a surface with these normals and edges."""
    across, ends = shape
    if config.method == "gicp":
        return surface_covariances(across, config.epsilon, ends if config.edges else None)
    return across


def _change(old: RigidTransform, new: RigidTransform) -> float:
    """The larger of rotation (radians, for small ones) and translation between two poses."""
    turned = np.linalg.norm(new.rotation - old.rotation) / np.sqrt(2)
    return max(float(turned), float(np.linalg.norm(new.translation - old.translation)))
