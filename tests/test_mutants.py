"""A mutant whose text or test is gone breaks nothing: found here at once, not by `make mutants`."""

import pytest

from tests import mutants

UNBROKEN = {"view"}
"""The room without a mutant: it draws."""


@pytest.mark.parametrize("mutant", mutants.MUTANTS, ids=lambda m: f"{m.module}: {m.text}")
def test_text_stands_once_and_the_test_exists(mutant):
    module = (mutants.ROOT / mutants.file_of(mutant)).read_text(encoding="utf-8")
    assert module.count(mutant.text) == 1
    path, _, name = mutants.test_of(mutant).partition("::")
    tests = (mutants.ROOT / path).read_text(encoding="utf-8")
    assert f"def {name.partition('[')[0]}(" in tests


def test_every_room_is_broken_somewhere():
    rooms = {path.parent.name for path in (mutants.ROOT / "jaxreg").glob("*/__init__.py")}
    assert rooms - {mutant.module.partition(".")[0] for mutant in mutants.MUTANTS} == UNBROKEN
