"""What a page promises is compared with what is printed: what may differ, and what may not."""

import pytest

from tests.pages import compare, refreshed, run_blocks


@pytest.mark.parametrize(("promised", "printed"), [
    ("fitness 0.93\n", "fitness 0.93\n"),
    ("fitness 0.93\n", "fitness 0.94\n"),  # another machine's rounding
    ("56,567 points\n", "56567 points\n"),
    ("time 1.00 s\nfound\n", "time 9.00 s\nfound\n"),
    ("source 3 points\n...\nwrote it\n", "source 3 points\nfitness 0.9\nwrote it\n"),
])  # fmt: skip
def test_equal_outputs_pass(promised, printed):
    compare(promised, printed)


@pytest.mark.parametrize(("promised", "printed"), [
    ("fitness 0.93\n", "fitness 0.73\n"),
    ("fitness 0.93\n", "overlap 0.93\n"),
    ("fitness 0.93\n", "fitness\n"),
    ("", "found\n"),
    ("found\n", ""),
    ("source 3 points\n...\nwrote it\n", "source 3 points\nfitness 0.9\n"),
    ("source 3 points\n...\nwrote it\n", "source 9 points\nfitness 0.9\nwrote it\n"),
    ("wrote it\n...\nsource 3 points\n", "source 3 points\nwrote it\n"),
])  # fmt: skip
def test_other_outputs_fail(promised, printed):
    with pytest.raises(AssertionError):
        compare(promised, printed)


def test_blocks_share_their_names_and_other_programs_are_not_run():
    text = "```python\na = 1\n```\n\n```python\nprint(a)\n```\n\n```\n1\n```\n\n```sh\nmake demo\n```\n"
    assert [(match[3], printed) for match, printed in run_blocks(text)] == [
        (None, ""), ("1\n", "1\n"), (None, None)
    ]  # fmt: skip


def test_a_page_that_leaves_lines_out_is_refreshed_line_by_line():
    promised, printed = "found 3\n...\nwrote it\n", "found 4\nfitness 0.9\nwrote it\n"
    assert refreshed(promised, printed) == "found 4\n...\nwrote it\n"
    assert refreshed("found 3\n", printed) == printed
