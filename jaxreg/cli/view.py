"""`jaxreg view`: a page with clouds to turn."""

import dataclasses
import webbrowser
from pathlib import Path
from typing import Annotated

import tyro

from jaxreg.cli.options import SUCCESS, finite, line


@dataclasses.dataclass(frozen=True)
class View:
    """Write a page with clouds to turn; it needs no network."""

    files: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE...")]
    """Clouds in one frame."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = Path("view.html")
    """The page."""
    open: bool = False
    """Open it in the browser."""

    def run(self) -> int:
        """Write the page and say where; returns the exit status."""
        from jaxreg import io
        from jaxreg.view import page

        if not self.files:
            raise ValueError("no file to view: name at least one.")
        io.check_place(self.output, self.files)
        clouds = {str(path): finite(io.read_cloud(path), path) for path in self.files}
        with io.whole(self.output) as part:
            page.write_page(part, clouds)
        line("wrote", str(self.output))
        if self.open:
            webbrowser.open(self.output.resolve().as_uri())
        return SUCCESS
