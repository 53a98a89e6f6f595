"""Calibrate a range sensor by gradients through registration.

A scanner adds an unknown constant to every range that it measures. From two scans of one room, taken
from two unknown poses, that constant can be learnt: with the right one the scans fit each other best.
The loss is the residual after registration, and its derivative runs through all iterations of ICP.
Prints the offset in each step; about ten seconds on a laptop.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxreg.geometry.rigid import apply
from jaxreg.refine.point_to_point import icp

TRUE_OFFSET = 0.08  # metres
STEPS = 8


def scan_room(points, rotation, position, rng):
    """What the scanner reports of `points` (n, 3) from a pose: in its own frame, ranges too long."""
    seen = (points - position) @ rotation
    ranges = np.linalg.norm(seen, axis=1, keepdims=True)
    return seen * (1 + (TRUE_OFFSET + rng.normal(0, 0.002, ranges.shape)) / ranges)


def corrected(scan, offset):
    """The scan with `offset` metres taken off every range."""
    return scan * (1 - offset / jnp.linalg.norm(scan, axis=1, keepdims=True))


def residual(offset, first, second):
    """Mean squared distance (m^2) between the corrected scans after ICP has aligned them."""
    first, second = corrected(first, offset), corrected(second, offset)
    moved = apply(icp(first, second, iterations=20), first)
    squared = jnp.sum((moved[:, None] - second[None]) ** 2, axis=-1)
    return jnp.mean(jnp.min(squared, axis=1))


def calibrate(seed: int = 0) -> float:
    """The offset learnt from two scans, in metres, by Newton's method through registration."""
    rng = np.random.default_rng(seed)
    room = rng.uniform(-1, 1, (150, 3)) * [4.0, 3.0, 1.5]
    turn = Rotation.from_euler("zyx", [6, 2, -3], degrees=True).as_matrix()
    first = scan_room(room, np.eye(3), np.zeros(3), rng)
    second = scan_room(rng.permutation(room), turn, np.array([0.5, -0.3, 0.2]), rng)
    slope, curvature = jax.jit(jax.grad(residual)), jax.jit(jax.hessian(residual))
    offset = jnp.zeros(())
    for step in range(STEPS):
        newton = slope(offset, first, second) / jnp.abs(curvature(offset, first, second))
        offset -= jnp.clip(newton, -0.02, 0.02)
        print(f"step {step + 1}: offset {float(offset):.4f} m")
    return float(offset)


if __name__ == "__main__":
    print(f"learnt {calibrate():.4f} m, true {TRUE_OFFSET} m")
