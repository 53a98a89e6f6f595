"""Programs of ours inside other machinery of JAX."""

import functools
import os
import subprocess
import sys

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from jaxreg import training
from jaxreg.config import from_dict
from jaxreg.types import Refinement
from tests.compiled import icp


@pytest.mark.float32
def test_a_saved_program_gives_the_same_record(seed):
    pytest.importorskip("flatbuffers", reason="jax.export saves programs with flatbuffers")
    source, reference = np.random.default_rng(seed).normal(size=(2, 40, 3)).astype(np.float32)
    saved = export.export(icp)(source, reference).serialize()
    found = export.deserialize(saved).call(source, reference)
    assert isinstance(found, Refinement)
    jax.tree.map(np.testing.assert_array_equal, found, icp(source, reference))


TWO_DEVICES = """
import jax, numpy as np
from jax.sharding import AxisType, PartitionSpec
from jaxreg import RefineConfig, gicp, icp

source = np.random.default_rng(0).normal(size=(2, 40, 3)).astype(np.float32)
clouds = source, source + np.float32(0.02)
mesh = jax.make_mesh((2,), ("pairs",), axis_types=(AxisType.Auto,))
pairs = PartitionSpec("pairs")
for method in (icp, gicp):
    one = jax.vmap(lambda x, y: method(x, y, config=RefineConfig(iterations=2)))
    split = jax.jit(jax.shard_map(one, mesh=mesh, in_specs=pairs, out_specs=pairs))
    want = jax.jit(one)(*clouds)
    np.testing.assert_allclose(split(*clouds).rotation, want.rotation, atol=1e-6)
"""


@pytest.mark.slow
def test_shard_map_with_its_check_gives_what_vmap_gives():
    flags = "--xla_force_host_platform_device_count=2"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", TWO_DEVICES], env=environment, check=True, timeout=180)


@pytest.mark.slow
@pytest.mark.loose
def test_second_derivatives_of_the_training_loss_are_differences_of_its_gradient(seed):
    network = {"k": 3, "k_matching": 3, "channels": [4, 4], "width": 8, "inlier_width": 2}
    config = from_dict(
        {
            "model": network | {"n_inliers": 6, "iterations": 2},
            "pairs": {"points": 16, "kept": 12},
            "train": {"batch": 2},
        }
    )
    rng = np.random.default_rng(seed)
    shapes = jnp.asarray(rng.normal(size=(2, 16, 3)))
    pairs = training.draw_batch(jnp.zeros((), jnp.int32), shapes, config)
    variables = jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float64), training.create_train_state(config).variables
    )
    params, statistics = variables["params"], variables["batch_stats"]
    along = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), params)
    loss = functools.partial(training.batch_loss, config=config)
    slope = jax.grad(lambda p: loss(p, statistics, pairs)[0])
    moved = lambda step: jax.tree.map(lambda p, d: p + step * d, params, along)  # noqa: E731
    gradient = jax.jit(slope)
    expected = jax.tree.map(lambda a, b: (a - b) / 2e-6, *map(gradient, map(moved, (1e-6, -1e-6))))
    forward = jax.jit(lambda p: jax.jvp(slope, (p,), (along,))[1])(params)
    reverse = jax.jit(lambda p: jax.vjp(slope, p)[1](along)[0])(params)
    largest = max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(expected))
    for found in (forward, reverse):
        chex.assert_trees_all_close(found, expected, atol=1e-5 * largest, rtol=1e-4)
