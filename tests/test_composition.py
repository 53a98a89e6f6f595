"""Programs of ours inside other machinery of JAX."""

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
