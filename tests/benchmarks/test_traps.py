"""The traps: each way computes the same, and the record shows the library's way first."""

import jax
import numpy as np
import pytest

from benchmarks.paper import traps

pytestmark = [pytest.mark.float32, pytest.mark.loose, pytest.mark.untyped]

OPTIONS = traps.Options(points=40, batch=2, rounds=1)


def test_every_search_finds_the_same_neighbours():
    found = {name: task(0) for name, task in traps.search(OPTIONS).items()}
    first, *others = (np.sort(np.asarray(jax.tree.leaves(x)[0]), axis=-1) for x in found.values())
    assert first.shape[:2] == (2, 40)
    for other in others:
        np.testing.assert_array_equal(other[..., : first.shape[-1]], first)


def test_every_sum_and_its_gradient_are_the_same():
    found = {name: np.asarray(task(0)) for name, task in traps.sums(OPTIONS).items()}
    for kind in ("sum, ", "sum and gradient, "):
        first, *others = (x for name, x in found.items() if name.startswith(kind))
        assert first.shape == (2, 40, 40)
        assert len(others) == 2
        for other in others:
            np.testing.assert_allclose(other, first, rtol=1e-4)


def test_what_is_measured_has_a_row_that_begins_with_the_librarys_way(records, monkeypatch, capsys):
    seconds = iter(range(1, 100))
    monkeypatch.setattr(
        traps.timing,
        "alternate",
        lambda tasks, rounds: {
            name: traps.timing.Timing(float(next(seconds)), 0.0, rounds) for name in tasks
        },
    )
    monkeypatch.setattr(
        traps, "loop", lambda options: dict.fromkeys(traps.ROWS["compile_s"][1:], 7.0)
    )
    traps.main(OPTIONS)
    entry = records.read("traps")
    assert records.fits("traps")
    assert list(entry["rows"]) == list(traps.ROWS), "every name of a way is one that is measured"
    milliseconds = 1e3 / OPTIONS.batch
    assert entry["rows"]["batch"]["library"] == 1 * milliseconds
    assert entry["rows"]["batch"]["other"] == 2 * milliseconds
    assert entry["rows"]["fusion"]["other"] == 3 * milliseconds
    assert entry["rows"]["neighbours"]["third"] == 6 * milliseconds
    assert entry["rows"]["compile_s"] == {
        "label": traps.ROWS["compile_s"][0],
        "library": 7.0,
        "other": 7.0,
        "third": None,
    }
    assert "x 1.00" in capsys.readouterr().out
