"""The library against the equations as first written (`benchmarks.paper.transcription`)."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from benchmarks.paper import transcription
from jaxreg.config import Config, ModelConfig
from jaxreg.network.model import register_pair
from jaxreg.training import batch_loss
from jaxreg.types import Pair, PointCloud, RigidTransform
from jaxreg.weights.released import load_pretrained
from tests.scenes import draw_pair, variables_of

# Flax promotes float64 with the float32 that it starts from.
pytestmark = pytest.mark.loose

SMALL = ModelConfig(
    k=4,
    k_matching=3,
    channels=(8, 16),
    width=16,
    angles="next",
    inlier_width=4,
    n_inliers=12,
    iterations=2,
)


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


@functools.cache
def both(config):
    """The two registrations, compiled."""
    library = functools.partial(register_pair, config=Config(model=config))
    written = functools.partial(transcription.register, config=config)
    return jax.jit(library), jax.jit(written)


def assert_close(ours, written, atol):
    np.testing.assert_allclose(ours.rotation, written.rotation, atol=atol)
    np.testing.assert_allclose(ours.translation, written.translation, atol=atol)
    np.testing.assert_allclose(ours.confidence, written.confidence, atol=atol)
    np.testing.assert_allclose(ours.correspondences, written.copy, atol=atol)


@pytest.mark.parametrize("angles", ["all", "next"])
def test_registration_is_that_of_the_equations(rng, angles):
    config = dataclasses.replace(SMALL, k_matching=5, angles=angles)
    variables = variables_of(config)
    pair = draw_pair(rng, 30, 24)
    results = [register(variables, *pair) for register in both(config)]
    assert_close(*results, atol=1e-9)


@pytest.mark.slow
def test_gradient_of_the_loss_is_that_of_the_equations(rng):
    config = Config(model=SMALL)
    variables = variables_of(SMALL)
    arguments = variables["params"], variables["batch_stats"]
    sources, references = (
        np.stack(x) for x in zip(*[draw_pair(rng, 24, 20) for _ in range(2)], strict=True)
    )
    clouds = [PointCloud(x, np.ones(x.shape[:2], bool)) for x in (sources, references)]
    pairs = Pair(*clouds, RigidTransform(np.zeros((2, 3, 3)), np.zeros((2, 3))))
    # As a user compiles it: the derivative of `jnp.max`, which one writes first, is NaN where XLA
    # computes the entries again with another last bit, as LLVM's level 0 does (tests/conftest.py).
    optimised = {"xla_backend_optimization_level": 3}
    ours, written = (
        jax.jit(
            jax.value_and_grad(functools.partial(f, config=config), has_aux=aux),
            compiler_options=optimised,
        )
        for f, aux in ((batch_loss, True), (transcription.batch_loss, False))
    )
    (loss, _), gradient = ours(*arguments, pairs)
    expected_loss, expected = written(*arguments, sources, references)
    np.testing.assert_allclose(loss, expected_loss, rtol=1e-9)
    assert max(np.abs(x).max() for x in jax.tree.leaves(expected)) > 1
    for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)


@pytest.mark.float32
def test_released_weights_register_as_the_equations_say(rng):
    variables, config = load_pretrained("modelnet40")
    source, reference = (np.float32(0.5 * x) for x in draw_pair(rng, 768, 768))
    ours, written = (register(variables, source, reference) for register in both(config.model))
    np.testing.assert_allclose(ours.rotation, written.rotation, atol=1e-5)
    np.testing.assert_allclose(ours.translation, written.translation, atol=1e-5)
    # Rounding of the moved points may swap neighbours that are equally far in the last digit.
    for a, b in ((ours.confidence, written.confidence), (ours.correspondences, written.copy)):
        difference = np.sort(np.abs(np.asarray(a) - b).reshape(768, -1).max(axis=1))
        assert difference[-8] < 1e-4, difference[-16:]
