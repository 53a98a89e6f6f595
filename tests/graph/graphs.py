"""Pose graphs whose truth is known."""

import numpy as np
from scipy.spatial.transform import Rotation

from jaxreg.graph.pose_graph import PoseGraph
from jaxreg.types import RigidTransform


def random_poses(rng, count: int, spread: float = 1.0) -> RigidTransform:
    turns = Rotation.random(count, random_state=rng).as_matrix()
    return RigidTransform(turns, spread * rng.normal(size=(count, 3)))


def between(poses: RigidTransform, reference, source) -> RigidTransform:
    """``X_r^-1 X_s``, in numpy."""
    r, s = poses.rotation[reference], poses.rotation[source]
    shift = poses.translation[source] - poses.translation[reference]
    back = np.swapaxes(r, -1, -2)
    return RigidTransform(back @ s, np.einsum("eij,ej->ei", back, shift))


def perturbed(rng, transform: RigidTransform, sigma) -> RigidTransform:
    """``Z exp(xi)`` with ``xi`` of these standard deviations, up to second order."""
    twist = rng.normal(size=(len(transform.translation), 6)) * sigma
    turn = Rotation.from_rotvec(twist[:, :3]).as_matrix()
    shift = np.einsum("eij,ej->ei", transform.rotation, twist[:, 3:]) + transform.translation
    return RigidTransform(transform.rotation @ turn, shift)


def graph_of(rng, poses, reference, source, *, sigma=0.0, wrong=0) -> PoseGraph:
    """Edges with noise; the first `wrong` ones are any transform instead."""
    transform = perturbed(rng, between(poses, reference, source), sigma)
    transform.rotation[:wrong] = Rotation.random(wrong, random_state=rng).as_matrix() if wrong else 0
    transform.translation[:wrong] = rng.normal(size=(wrong, 3))
    information = np.repeat(np.eye(6)[None], len(source), 0) / max(sigma, 1e-2) ** 2
    source, reference = (np.asarray(side, np.int32) for side in (source, reference))
    return PoseGraph(source, reference, transform, information, np.ones(len(source), bool))


def ring(count: int, skips=(1, 2)) -> tuple[np.ndarray, np.ndarray]:
    """References and sources: every node and those so many places on, around a ring."""
    nodes = np.arange(count)
    reference = np.concatenate([nodes] * len(skips))
    source = np.concatenate([(nodes + skip) % count for skip in skips])
    return reference, source


def aligned(poses: RigidTransform, truth: RigidTransform) -> RigidTransform:
    """The poses in the frame in which the first one is that of the truth."""
    turn = truth.rotation[0] @ poses.rotation[0].T
    shift = truth.translation[0] - turn @ poses.translation[0]
    return RigidTransform(turn @ poses.rotation, poses.translation @ turn.T + shift)
