"""The site has every public name, every equation and every page, and builds without a warning."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxreg
import jaxreg.network

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def table(text: str) -> list[list[str]]:
    """The rows of the first Markdown table of a text, without its head, and without backticks."""
    rows = re.search(r"^\|.*?(?=\n\n|\Z)", text, re.DOTALL | re.MULTILINE)[0].splitlines()[2:]
    return [[cell.strip().replace("`", "") for cell in row.strip("|").split("|")] for row in rows]


def equations(text: str) -> list[tuple[str, str, str]]:
    return [(number.replace("–", "-"), name, file) for number, _, name, file in table(text)]


def defined_in(path: Path) -> set[str]:
    body = ast.parse(path.read_text(encoding="utf-8")).body
    return {node.name for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)}


def test_equations_name_functions_that_are_where_the_table_says():
    rows = equations(jaxreg.network.__doc__)
    assert len(rows) >= 18
    for _, function, file in rows:
        folder = "jaxreg" if "/" in file else "jaxreg/network"
        assert function in defined_in(ROOT / folder / file), f"{function} is not in {file}"


def test_every_equation_of_the_paper_has_a_function():
    found = set()
    for numbers, _, _ in equations(jaxreg.network.__doc__):
        if numbers != "-":
            first, _, last = numbers.partition("-")
            found |= set(range(int(first), int(last or first) + 1))
    assert found == set(range(1, 19))


def test_the_site_has_the_table_of_the_docstring():
    page = (DOCS / "the-paper.md").read_text(encoding="utf-8")
    assert equations(page) == equations(jaxreg.network.__doc__)


def test_every_public_name_is_in_the_reference_once():
    pages = [path.read_text(encoding="utf-8") for path in (DOCS / "reference").glob("*.md")]
    shown = re.findall(r"^::: jaxreg\.(\w+)$", "\n".join(pages), re.MULTILINE)
    assert sorted(shown) == sorted(jaxreg.__all__)
    rows = table((DOCS / "reference" / "index.md").read_text(encoding="utf-8"))
    listed = [name for row in rows for name in re.findall(r"\w+", row[1])]
    assert sorted(listed) == sorted(jaxreg.__all__)


def test_every_public_name_has_a_docstring():
    # A NamedTuple or a dataclass without one gets its signature in its place.
    silent = [
        name
        for name in jaxreg.__all__
        if not (doc := getattr(jaxreg, name).__doc__) or doc.startswith(f"{name}(")
    ]
    assert silent == []


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    listed = set(re.findall(r"[\w/-]+\.md", navigation))
    pages = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    # Notes are found by docs/site_hooks.py, which also makes this page.
    assert {page for page in pages if not page.startswith("notes/")} == listed - {"results.md"}


def test_it_builds_without_a_warning(tmp_path):
    pytest.importorskip("mkdocstrings", reason="pip install '.[docs]'")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    assert "register_global" in (tmp_path / "site/reference/search.html").read_text("utf-8")
