"""`jaxreg view`: an interactive page of clouds."""

import dataclasses
import webbrowser
from pathlib import Path
from typing import Annotated

import tyro

from jaxreg.cli.options import SUCCESS, finite, line


@dataclasses.dataclass(frozen=True)
class View:
    """Write an interactive HTML page of one or more clouds; it works offline."""

    files: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE...")]
    """The clouds, all in one frame."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = Path("view.html")
    """Write the page to this file."""
    open: bool = False
    """Open it in the browser."""

    def run(self) -> int:
        """Write the page and print where it is; returns the exit status."""
        from jaxreg import io
        from jaxreg.view import page

        if not self.files:
            raise ValueError("no file given: name at least one.")
        io.check_place(self.output, self.files)
        clouds = {str(path): finite(io.read_cloud(path), path) for path in self.files}
        with io.whole(self.output) as part:
            page.write_page(part, clouds)
        line("wrote", str(self.output))
        if self.open:
            webbrowser.open(self.output.resolve().as_uri())
        return SUCCESS
