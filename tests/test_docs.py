"""The guides and the notebook run as they stand and print what they say.

`python -m tests.write_pages` runs them and writes what they print into them.
"""

import json
import os
import re
import shlex
import subprocess
import sys
import types
from pathlib import Path

import pytest

from jaxreg.cli import process
from jaxreg.config import load_config
from tests.pages import BLOCK, compare, run_blocks, run_python

pytestmark = [pytest.mark.float32, pytest.mark.loose]

ROOT = Path(__file__).parents[1]
DOCS = {path.stem: path for path in sorted((ROOT / "docs").glob("*.md"))}
PAGES = {name: path for name, path in DOCS.items() if BLOCK.search(path.read_text("utf-8"))}
# What these need is compiled by no other test; the other pages run in every suite.
SLOW = ("read-the-results", "register-two-scans", "use-it-inside-your-jax-code")
NOTEBOOKS = {path.stem: path for path in sorted((ROOT / "examples").glob("*.ipynb"))}


def forms(text: str) -> set[str]:
    """The words of each line, without its numbers and the time that is left."""
    lines = re.sub(r" +about \d+ s left$", "", text, flags=re.MULTILINE).splitlines()
    lines = [re.sub(r"-?\d[\d.]*(e[-+]?\d+)?", "", line) for line in lines]
    return {" ".join(re.findall(r"[A-Za-z][\w.()/]*", line)) for line in lines}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder to run in, and no compilation cache."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(process, "enable_compilation_cache", lambda **_: None)
    return tmp_path


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in PAGES]
)
def test_guides_print_what_they_say(folder, name):
    for match, printed in run_blocks(PAGES[name].read_text(encoding="utf-8")):
        if printed is not None:
            compare(match[3] or "", printed)


@pytest.mark.slow
def test_training_on_a_folder_runs_as_its_guide_says(folder):
    blocks = [match for match, _ in run_blocks(PAGES["train-on-your-own-clouds"].read_text())]
    commands = [
        line
        for kind, code, _ in (b.groups() for b in blocks)
        if kind == "sh"
        for line in code.splitlines()
    ]
    short = "--train.steps 3 --train.validate-every 2 --train.validation-pairs 2"
    (folder / "configs").symlink_to(ROOT / "configs")
    outputs = []
    for command, options in zip(commands[:2], (short, "--pairs 2"), strict=True):
        program, *rest = shlex.split(command)
        assert program == "jaxreg"
        done = subprocess.run(
            [sys.executable, "-c", "import jaxreg.cli; jaxreg.cli.main()", *rest, *options.split()],
            env=os.environ | {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(folder / "cache")},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        outputs.append(done.stdout)
    assert "curves.png: runs/own" in outputs[0]
    assert (folder / "runs" / "own" / "curves.png").is_file()
    assert "MAE(R) deg" in outputs[1]
    shown = next(block[3] for block in blocks if block[2].startswith("jaxreg train"))
    assert forms(shown) <= forms("".join(outputs))


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_print_what_they_show(folder, name, monkeypatch):
    display = types.SimpleNamespace(Image=lambda path, width: Path(path).read_bytes())
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    cells = json.loads(NOTEBOOKS[name].read_text(encoding="utf-8"))["cells"]
    names, ran = {}, 0
    for cell in cells:
        if cell["cell_type"] != "code":
            continue
        shown = [out["text"] for out in cell["outputs"] if out["output_type"] == "stream"]
        compare("".join(sum(shown, [])), run_python("".join(cell["source"]), names))
        ran += 1
    assert ran >= 4


@pytest.mark.parametrize("path", DOCS.values(), ids=DOCS)
def test_links_and_configurations_of_guides_exist(path):
    text = path.read_text(encoding="utf-8")
    for name in re.findall(r"\]\((?!https?:|#)([^)#]+)", text):
        assert (path.parent / name).exists(), name
    for name in re.findall(r"configs/\w+\.toml", text):
        load_config(ROOT / name)
