"""`jaxreg export`: a registration as a program in one file."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxreg.cli.options import SUCCESS, line


@dataclasses.dataclass(frozen=True)
class Export:
    """Write a registration of two clouds as a program (StableHLO) that runs without its Python code.

    jaxreg.load_exported(FILE) runs it, and so does whatever runs StableHLO.
    """

    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")]
    """register_global (any start, no weights), or released weights or the folder of a run: then it is
    register_pair with these, or the register of another network."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]
    """Write the program here."""
    points: Annotated[tuple[int, int], tyro.conf.arg(metavar="N M")] = (1024, 1024)
    """The largest number of points of the source and of the reference; smaller clouds are padded."""
    symbolic: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Any numbers of points from 256 to 2048 in place of --points; not for register_global."""
    platform: Annotated[
        tuple[Literal["cpu", "cuda", "rocm", "tpu"], ...], tyro.conf.arg(metavar="PLATFORM ...")
    ] = ("cpu",)
    """What it shall run on, one or more of cpu, cuda, rocm and tpu."""

    def run(self) -> int:
        """Write the file and say what is in it; returns the exit status."""
        from jaxreg import io
        from jaxreg.exported import export_program

        io.check_place(self.output, _weights_of(self.name))
        with io.whole(self.output) as part:
            export_program(
                part,
                self.name,
                points=self.points,
                symbolic=self.symbolic,
                platforms=self.platform,
            )
        sizes = "256 to 2048 each" if self.symbolic else "up to {} and {}".format(*self.points)
        line("program", self.name)
        line("points", sizes)
        line("platforms", ", ".join(self.platform))
        line("wrote", f"{self.output} ({self.output.stat().st_size / 1000:.0f} kB)")
        return SUCCESS


def _weights_of(name: str) -> tuple[Path, ...]:
    """The files that a program of this name is made of, if they are weights."""
    from jaxreg.exported import GLOBAL
    from jaxreg.weights.released import weight_files

    return () if name == GLOBAL or (Path(name) / "best").is_dir() else weight_files(name)
