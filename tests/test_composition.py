"""Programs of ours inside other machinery of JAX."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from jax import export

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
