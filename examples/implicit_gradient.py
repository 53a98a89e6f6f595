"""Which points decide the pose of a scan? Two derivatives of one registration.

The derivative of the pose with respect to every point of the source: once back through all
iterations of GICP, once from the equation that the solution satisfies. They agree if the iterations
have converged, and the second needs the memory and time of one iteration. Prints both, and how far
they differ.
"""

import time

import jax
import jax.numpy as jnp

from jaxreg import RefineConfig, gicp, sample_shape

shape = jnp.asarray(sample_shape(0, 7, points=1000))
source, reference = shape[::2] + jnp.array([0.02, -0.01, 0.03]), shape[1::2]


def influence(gradient: str) -> jax.Array:
    """How far the solution moves when a source point moves, as a share of that motion (n,)."""
    config = RefineConfig(iterations=50, kernel_annealing=1.0, gradient=gradient)
    of_points = jax.jit(jax.jacrev(lambda x: gicp(x, reference, config=config).translation))
    of_points(source)  # compiles
    begin = time.perf_counter()
    jacobian = jax.block_until_ready(of_points(source))  # (3, n, 3)
    print(f"{gradient:9} {1e3 * (time.perf_counter() - begin):7.1f} ms")
    return jnp.sqrt(jnp.sum(jacobian**2, axis=(0, 2)))


if __name__ == "__main__":
    unrolled, implicit = influence("unrolled"), influence("implicit")
    point = ", ".join(f"{value:.2f}" for value in source[implicit.argmax()])
    print(f"most influential point: ({point})")
    print(f"largest difference: {jnp.abs(unrolled - implicit).max() / implicit.max():.1e} of it")
