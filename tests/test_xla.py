"""`compilation.jit`: jax.jit in all it does, with options that may vanish and that start nothing."""

import functools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from jaxreg import _xla

pytestmark = [pytest.mark.float32, pytest.mark.loose]

UNKNOWN = {"xla_no_such_option": ""}

# Fails in the second line where a backend has been started.
CONFIGURED_AFTERWARDS = """
import jax, jaxreg.training, jaxreg.evaluation.score, jaxreg.scans, jaxreg.search
jax.config.update("jax_num_cpu_devices", 2)
assert len(jax.devices()) == 2
"""


def test_importing_the_library_starts_no_backend():
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", CONFIGURED_AFTERWARDS], env=environment, check=True)


def test_it_is_as_jax_jit():
    def power(x, *, n):
        """Raised."""
        traced.append(n)
        return x**n

    traced = []
    jitted = functools.partial(_xla.jit, static_argnames="n")(power)
    assert (jitted.__name__, jitted.__doc__) == ("power", "Raised.")
    assert [float(jitted(2.0, n=3)), float(jitted(3.0, n=3))] == [8.0, 27.0]
    assert traced == [3]
    assert jitted._cache_size() == 1
    assert jax.vmap(lambda x: jitted(x, n=2))(jnp.arange(3.0)).tolist() == [0.0, 1.0, 4.0]
    slope = _xla.jit(jax.grad(lambda x: power(x, n=3)))
    assert slope(2.0) == 12.0
    number = jax.ShapeDtypeStruct((), jnp.float32)
    assert jitted.lower(number, n=2).compile()(jnp.float32(3)) == 9.0
    assert jitted.eval_shape(number, n=2) == number
    assert jitted.trace(number, n=2).jaxpr.in_avals[0].shape == ()
    jitted.clear_cache()
    assert jitted._cache_size() == 0


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="other backends get no options")
def test_an_option_that_xla_does_not_know_is_left_out(monkeypatch):
    with pytest.raises(jax.errors.JaxRuntimeError, match="xla_no_such_option"):
        jax.jit(lambda x: 2 * x, compiler_options=UNKNOWN)(1.0)
    monkeypatch.setattr(_xla, "_CPU_OPTIONS", UNKNOWN)
    double = _xla.jit(lambda x: 2 * x)
    assert double(3.0) == 6.0
    assert double.lower(3.0).compile()(3.0) == 6.0


def test_options_of_the_caller_are_not_left_out():
    double = _xla.jit(lambda x: 2 * x, compiler_options=UNKNOWN)
    with pytest.raises(jax.errors.JaxRuntimeError, match="xla_no_such_option"):
        double(1.0)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="other backends get no options")
def test_what_xla_knows_is_tried_once_and_counts_as_no_program_of_the_caller(caplog):
    options = {"xla_dump_to": ""}
    with jax.log_compiles():
        assert _xla._known(tuple(options.items()))
        assert _xla._known(tuple(options.items()))
    assert not [text for text in caplog.messages if text.startswith("Compiling")]
    assert _xla._known.cache_info().hits >= 1
