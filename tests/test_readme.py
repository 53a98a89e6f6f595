"""The README's blocks run as they stand, in Python and in the shell, and print what they say."""

import re
from pathlib import Path

import pytest

from jaxreg.cli import process
from tests.pages import compare, run_blocks

pytestmark = [pytest.mark.float32, pytest.mark.loose]

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def test_blocks_print_what_they_say(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(process, "enable_compilation_cache", lambda **_: None)
    ran = []
    for match, printed in run_blocks(TEXT):
        if printed is not None:
            assert match[3], f"a block without its output: {match[2]}"
            compare(match[3], printed)
            ran.append(match[1])
    assert ran.count("python") >= 3
    assert "sh" in ran


def test_every_file_that_is_named_exists():
    named = re.findall(r"\]\((?!https?:)([^)]+)\)", TEXT) + re.findall(r"configs/\w+\.toml", TEXT)
    assert len(named) > 4
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_it_is_short():
    assert len(TEXT.split()) <= 900
