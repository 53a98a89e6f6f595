"""Kept programs: traced once for all processes, equal to the function, and never in the way of it."""

import os
import time
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg import _traced
from jaxreg._xla import from_host

pytestmark = pytest.mark.float32


class Pair(NamedTuple):
    first: jax.Array
    second: jax.Array


class Counted:
    """A jitted function of two leaves and a power, and how often it was traced."""

    def __init__(self):
        self.traced = 0

    def jitted(self):
        # By its name a program is found again in another process.
        def scaled(pair, factor, *, power):
            self.traced += 1
            return {"sum": Pair(pair.first + factor, pair.second**power)}

        return from_host(partial(jax.jit, static_argnames="power")(scaled), told=("counted",))


@pytest.fixture
def another_process(monkeypatch):
    """What a process remembers of kept programs is forgotten."""
    return lambda: monkeypatch.setattr(_traced, "_programs", {})


PAIR = Pair(np.arange(5.0), np.linspace(0, 1, 4, dtype=np.float32))


def expected(power=2, pair=PAIR, factor=2.0):
    return np.float32(pair.first) + factor, np.float32(pair.second) ** power


def same(found, power=2, pair=PAIR, factor=2.0):
    assert isinstance(found["sum"], Pair)
    for part, other in zip(found["sum"], expected(power, pair, factor), strict=True):
        np.testing.assert_allclose(part, other, rtol=1e-6)


def test_the_next_process_traces_nothing_and_finds_the_same(tmp_path, another_process):
    for traces in (1, 0):
        another_process()
        counted = Counted()
        function = counted.jitted()
        with _traced.kept_in(tmp_path):
            same(function(PAIR, 2.0, power=2))
            same(function(PAIR, 3.0, power=2), factor=3.0)
        assert counted.traced == traces


def test_programs_of_versions_that_nobody_used_for_a_month_are_removed(tmp_path, another_process):
    for name, days in (("old", 31), ("other", 29)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "program").write_bytes(b"x")
        used = tmp_path / f"{name}.used"
        used.touch()
        os.utime(used, 2 * (time.time() - 86_400 * days,))
    another_process()
    function = Counted().jitted()
    with _traced.kept_in(tmp_path):
        function(PAIR, 2.0, power=2)
    left = {path.stem for path in tmp_path.iterdir()}
    assert left == {"other", _traced._version()}
    assert (tmp_path / "other" / "program").exists()


def test_what_the_last_one_used_is_loaded_ahead(tmp_path, another_process):
    for ahead in (0, 2, 1):
        another_process()
        counted = Counted()
        function = counted.jitted()
        with _traced.kept_in(tmp_path):
            loading = dict(_traced._ahead)
            assert len(loading) == ahead
            same(function(PAIR, 2.0, power=2))
            assert all(future.exception(timeout=60) is None for future in loading.values())
            if ahead == 0:
                same(function(PAIR, 2.0, power=3), power=3)
            else:
                assert counted.traced == 0
        assert not _traced._ahead


def test_another_call_has_another_program(tmp_path, another_process):
    counted = Counted()
    function = counted.jitted()
    longer = Pair(np.arange(6.0), PAIR.second)
    with _traced.kept_in(tmp_path):
        same(function(PAIR, 2.0, power=2))
        same(function(PAIR, 2.0, power=3), power=3)
        same(function(longer, 2.0, power=2), pair=longer)
        whole = function(PAIR._replace(second=np.arange(4)), 2.0, power=2)
    assert counted.traced == 4
    assert whole["sum"].second.dtype == np.int32


@pytest.mark.loose
def test_a_number_does_not_promote_and_an_array_does(tmp_path, another_process):
    half = Pair(np.ones(3, np.float16), PAIR.second)
    with _traced.kept_in(tmp_path):
        for _ in range(2):
            another_process()
            function = Counted().jitted()
            assert function(half, 2.0, power=2)["sum"].first.dtype == np.float16
            assert function(half, np.float32(2), power=2)["sum"].first.dtype == np.float32


@pytest.mark.parametrize("content", [b"", b"\x80\x04broken", b"\x80\x04K\x01."])
def test_a_broken_file_is_written_again(tmp_path, another_process, content):
    for _ in range(2):
        another_process()
        with _traced.kept_in(tmp_path):
            same(Counted().jitted()(PAIR, 2.0, power=2))
        (path,) = tmp_path.glob("*/*")
        size, _ = path.stat().st_size, path.write_bytes(content)
        assert size > 100


def test_what_cannot_be_kept_is_traced(tmp_path, another_process):
    counted = Counted()
    function = counted.jitted()
    place = tmp_path / "file"
    place.write_text("")
    with _traced.kept_in(place):  # not a folder
        same(function(PAIR, 2.0, power=2))
    offset = jnp.ones(())
    untold = from_host(jax.jit(lambda x: x + offset))
    with _traced.kept_in(tmp_path):
        np.testing.assert_array_equal(untold(np.zeros(2, np.float32)), [1, 1])
        inside = jax.jit(lambda x: function(PAIR, x, power=2)["sum"].first)
        np.testing.assert_array_equal(inside(2.0), expected()[0])
    assert list(tmp_path.glob("*/*")) == []


def test_nothing_is_kept_after_the_block(tmp_path, another_process):
    with _traced.kept_in(tmp_path):
        pass
    same(Counted().jitted()(PAIR, 2.0, power=2))
    assert list(tmp_path.iterdir()) == []


def test_the_version_follows_the_files_and_the_settings(monkeypatch):
    before = _traced._version()
    assert _traced._version() == before
    with jax.default_matmul_precision("highest"):
        assert _traced._version() != before
    monkeypatch.setattr(jax, "__version__", "0")
    assert _traced._version() != before


def test_a_program_may_call_another_while_it_is_traced(tmp_path, another_process):
    inner = Counted().jitted()
    outer = from_host(
        jax.jit(lambda x: x * inner(PAIR, np.float32(2), power=2)["sum"].first), told=("outer",)
    )
    with _traced.kept_in(tmp_path):
        np.testing.assert_allclose(outer(np.float32(3)), 3 * expected()[0])
