"""The README's Python runs as it stands and prints what it says."""

import re
from pathlib import Path

import pytest

pytestmark = [pytest.mark.float32, pytest.mark.loose]

TEXT = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```\n\n```\n(.*?)```", TEXT, re.DOTALL)


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_examples_print_what_they_say(number, capsys):
    code, promised = EXAMPLES[number]
    exec(compile(code, f"README example {number + 1}", "exec"), {})  # noqa: S102
    # Rounding differs between machines: compare the words, and numbers to one digit.
    words = [re.findall(r"[A-Za-z]{3,}", text) for text in (promised, capsys.readouterr().out)]
    assert words[0] == words[1]


def test_every_file_that_is_named_exists():
    root = Path(__file__).parents[1]
    named = re.findall(r"\]\(([^)h][^)]*)\)", TEXT) + re.findall(r"configs/\w+\.toml", TEXT)
    assert len(named) > 4
    assert [name for name in named if not (root / name).exists()] == []
