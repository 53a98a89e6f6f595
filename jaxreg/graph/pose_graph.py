"""A pose graph: scans are its nodes, registrations of two scans its edges.

Pose ``X_k`` maps scan k to the common frame. An edge is a measured ``Z``, which maps its source to
its reference, so that without errors ``Z = X_r^-1 X_s``. Its residual is
``e = log(Z^-1 X_r^-1 X_s)``, and the cost ``sum_e w_e e^T Omega_e e``. Steps are from the right,
``X_k exp(delta_k)``: what the literature, g2o and GTSAM do.
"""

from typing import Any, NamedTuple

import numpy as np
from jax import export
from jax.core import Tracer
from jaxtyping import Bool, Float, Int

from jaxreg.geometry import arguments, se3
from jaxreg.types import RigidTransform

CHI_SQUARED = 16.8
"""Of the errors of right edges, chi squared with 6 degrees of freedom, 1 % are larger."""


class PoseGraph(NamedTuple):
    """The edges of a pose graph: ``transform[e]`` maps scan ``source[e]`` to scan ``reference[e]``.

    JAX or numpy arrays. `information` is the inverse covariance of a small motion (rotation vector,
    translation) of the *source's* frame, ``Z exp(xi)``. Where `mask` is False an edge does not count.
    """

    source: Int[Any, "e"]
    reference: Int[Any, "e"]
    transform: RigidTransform
    information: Float[Any, "e 6 6"]
    mask: Bool[Any, "e"]


export.register_namedtuple_serialization(PoseGraph, serialized_name="jaxreg.PoseGraph")


def check_graph(graph: PoseGraph, initial: RigidTransform, **flags: Any) -> None:
    """Raise ValueError unless every array has its shape, and indices are those of poses.

    `flags` are further masks by their names: `fixed`, one a pose, and others, one an edge. At trace
    time: a row that does not exist would be clamped, and another pose moved.
    """
    if not isinstance(initial, RigidTransform):
        raise ValueError(
            f"initial is {type(initial).__name__}: give a RigidTransform with a leading axis, as "
            "jaxreg.from_matrix makes it of (n, 4, 4)."
        )
    poses = arguments.leading_axes("initial", initial)
    if len(poses) != 1:
        raise ValueError(
            f"initial must be poses with one leading axis, got {poses}: give one pose for every scan, "
            "and use jax.vmap for a batch."
        )
    shapes = [
        ("source", np.shape(graph.source), ()),
        ("reference", np.shape(graph.reference), ()),
        ("transform", arguments.leading_axes("graph.transform", graph.transform), ()),
        ("information", np.shape(graph.information), (6, 6)),
        ("mask", np.shape(graph.mask), ()),
    ]
    edges = np.shape(graph.source)[:1]
    for name, shape, rest in shapes:
        if len(edges) != 1 or shape != (*edges, *rest):
            raise ValueError(
                f"graph.{name} is {shape}, but graph.source {np.shape(graph.source)}: give one row for "
                "every edge."
            )
    for name, given in (("graph.mask", graph.mask), *flags.items()):
        count = poses if name == "fixed" else edges
        if given is not None and (np.shape(given) != count or _dtype(given).kind != "b"):
            raise ValueError(
                f"{name} must be bool of shape {count}, got {_dtype(given)} of {np.shape(given)}."
            )
    check_indices(graph, *poses)


def _dtype(array: Any) -> np.dtype:
    return array.dtype if hasattr(array, "dtype") else np.asarray(array).dtype


def check_indices(graph: PoseGraph, count: int) -> None:
    """Raise ValueError unless edges join poses that are there, as far as it is known (not traced)."""
    for name, index in (("source", graph.source), ("reference", graph.reference)):
        index = index if isinstance(index, Tracer) else np.asarray(index)
        if index.dtype.kind not in "iu":
            raise ValueError(
                f"graph.{name} has dtype {index.dtype}: give integers, the numbers of poses from 0."
            )
        if isinstance(index, Tracer):
            continue
        wrong = index[(index < 0) | (index >= count)]
        if len(wrong):
            raise ValueError(
                f"graph.{name} has the index {wrong[0]}, but there are {count} poses: number them "
                "from 0."
            )


class EdgeEquations(NamedTuple):
    """What each edge adds to ``H delta = -g``.

    Of its (source, reference) the gradient and the block on the diagonal, and the block of H in the
    reference's row and the source's column.
    """

    gradient: tuple[Float[Any, "e 6"], Float[Any, "e 6"]]
    diagonal: tuple[Float[Any, "e 6 6"], Float[Any, "e 6 6"]]
    coupling: Float[Any, "e 6 6"]


def residuals(graph: PoseGraph, poses: RigidTransform) -> Float[Any, "e 6"]:
    """``log(Z^-1 X_r^-1 X_s)`` of every edge; of masked ones as if ``Z`` were the identity."""
    graph = _cleaned(graph)
    return se3.log(se3.between(graph.transform, _measured(graph, poses)))


def squared_errors(graph: PoseGraph, poses: RigidTransform) -> Float[Any, "e"]:
    """``e^T Omega e`` of every edge: of right ones distributed as chi squared with 6 degrees."""
    error, graph = residuals(graph, poses), _cleaned(graph)
    xp = se3.module_of(error)
    return xp.where(graph.mask, xp.sum(error * se3.applied(graph.information, error), axis=-1), 0)


def edge_equations(
    graph: PoseGraph, poses: RigidTransform, weights: Float[Any, "e"]
) -> EdgeEquations:
    """What every edge adds to the normal equations of a Gauss-Newton step at `poses`."""
    graph = _cleaned(graph)
    xp = se3.module_of(graph.information)
    measured = _measured(graph, poses)
    error = se3.log(se3.between(graph.transform, measured))
    source = se3.inverse_right_jacobian(error)
    reference = -se3.product(source, se3.adjoint(se3.inverted(measured)))
    weighted = xp.where(graph.mask, weights, 0)[:, None, None] * graph.information
    left, right = se3.product(weighted, reference), se3.product(weighted, source)
    force = se3.applied(weighted, error)
    return EdgeEquations(
        (se3.applied(source.mT, force), se3.applied(reference.mT, force)),
        (se3.product(source.mT, right), se3.product(reference.mT, left)),
        se3.product(reference.mT, right),
    )


def retract(poses: RigidTransform, step: Float[Any, "n 6"]) -> RigidTransform:
    """``X_k exp(delta_k)`` for every pose, with rotations kept orthogonal to rounding."""
    moved = se3.composed(poses, se3.exp(step))
    gram = se3.product(moved.rotation.mT, moved.rotation)
    # A Newton step towards the nearest orthogonal matrix, or a chain of products drifts away.
    eye = se3.module_of(gram).eye(3, dtype=gram.dtype)[None]
    return RigidTransform(se3.product(moved.rotation, 1.5 * eye - 0.5 * gram), moved.translation)


def truncated_weights(squared: Float[Any, "e"], threshold: Any, control: Any) -> Float[Any, "e"]:
    """Weights of truncated least squares made convex by `control` (Yang et al., 2020, eq. 14).

    1 below ``mu / (mu + 1) c^2``, 0 above ``(mu + 1) / mu c^2``; `threshold` is ``c^2``. As `control`
    (mu) grows from 0, the cost goes from convex to that which ignores residuals above c.
    """
    xp = se3.module_of(squared)
    low, high = control / (control + 1) * threshold, (control + 1) / control * threshold
    safe = xp.maximum(squared, low)
    between = xp.sqrt(threshold * control * (control + 1) / safe) - control
    return xp.where(squared <= low, 1.0, xp.where(squared >= high, 0.0, between))


def _cleaned(graph: PoseGraph) -> PoseGraph:
    """Unit matrices where an edge is masked: what stands there may be NaN."""
    xp, mask = se3.module_of(graph.information), graph.mask[:, None, None]
    eyes = (xp.eye(n, dtype=graph.information.dtype)[None] for n in (3, 6))
    rotation, information = (
        xp.where(mask, part, eye)
        for part, eye in zip((graph.transform.rotation, graph.information), eyes, strict=True)
    )
    translation = xp.where(graph.mask[:, None], graph.transform.translation, 0)
    return graph._replace(transform=RigidTransform(rotation, translation), information=information)


def _measured(graph: PoseGraph, poses: RigidTransform) -> RigidTransform:
    """What the edges would be without errors: ``X_r^-1 X_s``."""
    reference, source = (
        RigidTransform(poses.rotation[index], poses.translation[index])
        for index in (graph.reference, graph.source)
    )
    return se3.between(reference, source)
