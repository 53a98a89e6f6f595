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

import jaxreg
from jaxreg import training
from jaxreg.config import from_dict
from jaxreg.refine.host import refine_on_host
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


HOST = {
    "few": lambda p: jaxreg.register(p[:8], p[:8]),
    "in the plane": lambda p: jaxreg.register(p[:, :2], p[:, :2] + 0.1, initial=np.eye(4)),
    "surfaces": lambda p: jaxreg.register(p, p, initial=np.eye(4)),
    "refinement": lambda p: refine_on_host(p, p),
}


@pytest.mark.float32
@pytest.mark.parametrize("name", HOST)
def test_functions_of_the_host_run_where_stray_transfers_are_an_error(name, seed):
    points = np.random.default_rng(seed).normal(size=(90, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    free = HOST[name](points)
    with jax.transfer_guard("disallow"):
        with pytest.raises(Exception, match="Disallowed host-to-device transfer"):
            jax.jit(jnp.sum)(points)
        found = HOST[name](points)
    np.testing.assert_array_equal(found.transform.rotation, free.transform.rotation)


TWO_DEVICES = """
import jax, numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec
import jaxreg

small = jaxreg.ModelConfig(
    k=3, k_matching=3, channels=(4, 4), width=8, inlier_width=2, n_inliers=20, iterations=2
)
few = jaxreg.RefineConfig(iterations=2)
variables = jaxreg.init_variables(jax.random.key(0), small)
methods = {
    "icp": lambda x, y: jaxreg.icp(x, y, config=few),
    "gicp": lambda x, y: jaxreg.gicp(x, y, config=few),
    "network": lambda x, y: jaxreg.register_pair(variables, x, y, config=small),
    "procrustes": lambda x, y: jaxreg.weighted_procrustes(x, y, np.ones(len(x), np.float32)),
}
source = np.random.default_rng(0).normal(size=(2, 40, 3)).astype(np.float32)
clouds = source, source + np.float32(0.02)
pairs = PartitionSpec("pairs")
automatic = jax.make_mesh((2,), ("pairs",), axis_types=(AxisType.Auto,))
explicit = jax.make_mesh((2,), ("pairs",))
for name, method in methods.items():
    one = jax.vmap(method)
    want = jax.jit(one)(*clouds).rotation
    split = jax.shard_map(one, mesh=automatic, in_specs=pairs, out_specs=pairs)
    np.testing.assert_allclose(jax.jit(split)(*clouds).rotation, want, atol=1e-4, err_msg=name)
    with jax.set_mesh(explicit):
        placed = [jax.device_put(x, NamedSharding(explicit, pairs)) for x in clouds]
        found = jax.jit(one)(*placed).rotation
        assert found.sharding.spec[0] == "pairs"
        np.testing.assert_allclose(found, want, atol=1e-4, err_msg=name)
"""


@pytest.mark.slow
def test_on_two_devices_of_any_mesh_there_is_what_vmap_gives():
    flags = "--xla_force_host_platform_device_count=2"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", TWO_DEVICES], env=environment, check=True, timeout=400)


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
