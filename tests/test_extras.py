"""A library that is not installed is named where it is needed, with the command that installs it."""

import subprocess
import sys

import pytest

from jaxreg._extras import extra

# What is blocked, what needs it, and the extra that brings it.
USES = {
    "matplotlib": ("import jaxreg.view.pictures", "view"),
    "optax": ("import jaxreg.training", "train"),
    "orbax": ("import jaxreg.weights.checkpoint", "train"),
    "h5py": (
        "import pathlib, jaxreg.data.hdf5 as h; h.read(pathlib.Path('a.h5'), 'data')",
        "train",
    ),
    "laspy": ("import jaxreg.io; jaxreg.io.read_cloud('a.las')", "las"),
    "pye57": ("import jaxreg.io; jaxreg.io.read_cloud('a.e57')", "e57"),
}
# What `pip install jaxreg` promises works without any of them.
CORE = """
import numpy as np, jaxreg.cli
from jaxreg import io
io.write_cloud("a.ply", np.random.default_rng(0).normal(size=(60, 3)))
assert len(io.read_cloud("a.ply")) == 60
assert jaxreg.cli.main(["info", "a.ply"]) == 0
assert jaxreg.cli.main(["view", "a.ply"]) == 0
assert jaxreg.cli.main(["register", "a.ply", "a.ply", "--plot", "a.png"]) == 2
variables, config = jaxreg.load_pretrained()
import jaxreg.data
"""


def run_without(names, code, folder):
    blocked = f"import sys; sys.modules |= dict.fromkeys({tuple(names)!r})\n"
    return subprocess.run(
        [sys.executable, "-c", blocked + code],
        cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip


@pytest.mark.parametrize("name", USES)
def test_a_missing_library_is_named_with_its_extra(name, tmp_path):
    code, brings = USES[name]
    (tmp_path / "a.las").write_bytes(b"LASF")
    (tmp_path / "a.e57").write_bytes(b"ASTM-E57")
    done = run_without([name], code, tmp_path)
    message = done.stderr.splitlines()[-1]
    assert message.startswith("ImportError: ")
    assert f"needs {name}" in message
    assert message.endswith(f"which is not installed: run pip install 'jaxreg[{brings}]'.")


def test_the_core_works_without_any_extra(tmp_path):
    # Flax brings optax and orbax, and imports them for itself.
    done = run_without(["matplotlib", "h5py", "laspy"], CORE, tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith("error: a picture needs matplotlib")


def test_other_errors_pass_through():
    with pytest.raises(ZeroDivisionError), extra("view", "a picture"):
        1 / 0  # noqa: B018
