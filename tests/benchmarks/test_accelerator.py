"""The check of an accelerator, with CPU devices in its place."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.speed import accelerator, workload
from jaxreg.refine.point_to_point import icp
from jaxreg.types import RigidTransform

pytestmark = [pytest.mark.float32, pytest.mark.loose]

TINY = accelerator.Options(points=272, pairs=2, batches=(1, 3), rounds=1)


def test_what_agrees_and_what_does_not():
    batch = workload.draw(64, 4)
    cpu = jax.devices("cpu")[0]
    assert accelerator.agreement(icp, batch, (cpu, cpu)) == 1
    calls = []

    def coarse(source, reference):
        """As a device would that is exact in its first call only."""
        calls.append(None)
        found = icp(source, reference)
        if len(calls) == 1:
            return found
        turn = jnp.asarray([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        return found._replace(rotation=turn @ found.rotation)

    assert accelerator.agreement(coarse, batch, (cpu, cpu)) == 0


def test_every_function_is_timed_and_a_cpu_is_no_accelerator(monkeypatch, capsys):
    still = accelerator.Method(
        lambda source, reference: _Still(RigidTransform(jnp.eye(3), source.mean(axis=0))), 1.0
    )
    monkeypatch.setattr(accelerator, "methods", lambda: {"still": still})
    assert accelerator.main(TINY) == 0
    printed = capsys.readouterr().out
    assert "no accelerator" in printed
    assert np.all([f"  {size}: " in printed for size in TINY.batches])


def test_the_functions_are_those_that_run_on_any_device():
    assert list(accelerator.methods()) == ["register_pair", "register_global", "icp", "gicp"]


class _Still:
    def __init__(self, transform):
        self.transform = transform
