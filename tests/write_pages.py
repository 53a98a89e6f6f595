"""Run the guides, the README and the notebooks, and write what they print into them.

    python -m tests.write_pages [NAME ...]    # such as how-to-choose, README, two_scans

Run it twice: the second time nothing is compiled, and the seconds are those of a usual run.
"""

import base64
import contextlib
import json
import re
import sys
import tempfile
import types
from pathlib import Path

from jaxreg.cli import process
from tests.pages import refreshed, run_blocks, run_python

ROOT = Path(__file__).parents[1]
FILES = [*(ROOT / "docs").glob("*.md"), ROOT / "README.md", *(ROOT / "examples").glob("*.ipynb")]


def write_page(path: Path) -> None:
    """Put what every block prints below it; blocks that are not run keep what stands there."""
    text, pieces, end = path.read_text(encoding="utf-8"), [], 0
    for match, printed in run_blocks(text):
        if printed is None:
            continue
        output = refreshed(match[3] or "", printed)
        block = f"\n```\n{output}```\n" if output else ""
        pieces += [text[end : match.end(2)], "```\n", block]
        end = match.end()
    path.write_text("".join([*pieces, text[end:]]), encoding="utf-8")


def write_notebook(path: Path) -> None:
    """The same for the cells of a notebook, and the pictures that they show."""
    notebook, names = json.loads(path.read_text(encoding="utf-8")), {}
    display = types.SimpleNamespace(Image=lambda path, width: None)
    sys.modules["IPython.display"] = display  # Nothing else of IPython is needed here.
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            source = "".join(cell["source"])
            printed = run_python(source, names).splitlines(keepends=True)
            stream = {"name": "stdout", "output_type": "stream", "text": printed}
            cell["outputs"] = [stream] if printed else []
            if shown := re.search(r'^Image\("(.+)", width=(\d+)\)', source, re.MULTILINE):
                cell["outputs"].append(picture(Path(shown[1]), int(shown[2])))
    path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def picture(path: Path, width: int) -> dict:
    """A PNG file as the output of a cell."""
    data = {"image/png": base64.b64encode(path.read_bytes()).decode()}
    return {
        "data": data,
        "metadata": {"image/png": {"width": width}},
        "output_type": "display_data",
    }


def main(chosen: list[str]) -> None:
    """Write the files of these names, or all; each runs in a folder of its own."""
    process.enable_compilation_cache(least_seconds=0.0)
    for path in FILES:
        if not chosen or path.stem in chosen:
            print(path.name, flush=True)
            with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
                (write_notebook if path.suffix == ".ipynb" else write_page)(path)


if __name__ == "__main__":
    main(sys.argv[1:])
