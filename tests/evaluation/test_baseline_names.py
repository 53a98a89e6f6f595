"""Baselines by name, and what is said where their library is missing."""

import sys

import pytest

from jaxreg.evaluation.baselines import choose


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match="no classical baseline 'fgr': .*open3d_fgr,"):
        choose("fgr")


@pytest.mark.parametrize(("name", "module"), [("open3d_fgr", "open3d"), ("small_gicp",) * 2])
def test_a_missing_library_is_named_with_its_remedy(monkeypatch, name, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ValueError, match=r'pip install "jaxreg\[baselines\]"'):
        choose(name)


def test_a_spacing_is_given_with_the_name():
    pytest.importorskip("open3d", reason="the baselines are not installed", exc_type=ImportError)
    chosen = choose("open3d_fgr@0.02")
    plain = choose("open3d_fgr")
    assert chosen.func is plain.func
    assert chosen.keywords == plain.keywords | {"spacing": 0.02}
    for wrong in ("-1", "nan", "inf", "wide"):
        with pytest.raises(ValueError, match=f"positive number, got '{wrong}'"):
            choose(f"open3d_fgr@{wrong}")
