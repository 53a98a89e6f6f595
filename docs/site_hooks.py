"""What the site shows from outside docs/: the results, the changelog, the examples; and the notes."""

import ast
import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
PAGES = {"RESULTS.md": "results.md", "CHANGELOG.md": "changelog.md"}
PAGES |= {f"examples/{path.name}": f"examples/{path.stem}.md" for path in EXAMPLES}
"""From files of the repository to pages of the site."""
_WIDE = "---\nhide: [toc]\n---\n\n"  # Tables of results take the whole width.


def on_config(config):
    """Notes and examples are found, not listed, so that a new one needs no other change."""
    guides = next(entry["Guides"] for entry in config.nav if "Guides" in entry)
    guides += [{_title(path): f"examples/{path.stem}.md"} for path in EXAMPLES]
    results = next(entry["Results"] for entry in config.nav if "Results" in entry)
    notes = sorted((ROOT / "docs" / "notes").glob("[0-9]*.md"))
    results.append({"What was tried": ["notes/README.md", *(f"notes/{p.name}" for p in notes)]})
    config.nav.append({"Changelog": "changelog.md"})
    return config


def on_files(files, config):
    """Add the pages; links that are right at the root of the repository are turned to the site."""
    for source, page in PAGES.items():
        path = ROOT / source
        text = path.read_text(encoding="utf-8").replace("](docs/", "](")
        content = _page_of(path) if path in EXAMPLES else _WIDE + text
        files.append(File.generated(config, page, content=content))
    return files


def on_page_markdown(markdown, page, config, files):
    """A link that is right in the repository, `../RESULTS.md`, is right on the site too."""
    up = "../" * page.file.src_uri.count("/")
    for source, name in PAGES.items():
        markdown = re.sub(rf"\]\((?:\.\./)+{source}", f"]({up}{name}", markdown)
    return markdown


def _title(path):
    return f"Example: {path.stem.replace('_', ' ')}"


def _page_of(path):
    """The docstring of an example as text, then its code."""
    code = path.read_text(encoding="utf-8")
    tree = ast.parse(code)
    rest = "\n".join(code.splitlines()[tree.body[0].end_lineno :]).strip()
    name = f"`examples/{path.name}`"
    return f"# {_title(path)}\n\n{ast.get_docstring(tree)}\n\n{name}\n\n```python\n{rest}\n```\n"
