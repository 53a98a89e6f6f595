"""What the site shows of files outside docs/: the results, the changelog, and the notes in order."""

import re
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
PAGES = {"results.md": "RESULTS.md", "changelog.md": "CHANGELOG.md"}


def _title(path: Path) -> str:
    return path.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")


def on_config(config):
    """Notes are found, not listed, so that a new one needs no other change."""
    notes = sorted((ROOT / "docs" / "notes").glob("*.md"))
    if notes:
        pages = [{_title(path): f"notes/{path.name}"} for path in notes]
        config.nav.append({"What was tried": pages})
    config.nav.append({"Changelog": "changelog.md"})
    return config


def on_files(files, config):
    """Pages from the root of the repository, their links turned from there to the site."""
    for page, name in PAGES.items():
        text = (ROOT / name).read_text(encoding="utf-8").replace("](docs/", "](")
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown, page, config, files):
    """A link that is right in the repository, `../RESULTS.md`, is right on the site too."""
    up = "../" * page.file.src_uri.count("/")
    for name, source in PAGES.items():
        markdown = re.sub(rf"\]\((?:\.\./)*{source}", f"]({up}{name}", markdown)
    return markdown
