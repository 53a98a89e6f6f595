"""What a start costs: libraries that only some tasks need are not imported by the others.

Each of them takes a tenth of a second to two seconds; a clock would measure the machine instead.
"""

import importlib.util
import os
import subprocess
import sys

import pytest

import jaxreg

PICTURES, CHECKPOINTS, MESHES = {"matplotlib", "PIL"}, {"orbax", "tensorstore"}, {"trimesh"}
TRAINING, FILES, BROWSER = {"optax", "h5py"}, {"plyfile", "laspy"}, {"selenium"}
HEAVY = PICTURES | CHECKPOINTS | MESHES | TRAINING | FILES | BROWSER | {"open3d", "sklearn"}
OPTIONAL = {"laspy", "open3d", "selenium", "sklearn"}
SCIPY = {"scipy.optimize", "scipy.stats", "scipy.interpolate", "scipy.signal"}


def loaded_by(code: str) -> set[str]:
    program = f"import sys\n{code}\nprint(*sys.modules, sep='\\n')"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    return set(done.stdout.splitlines())


def test_the_lists_are_of_modules_that_exist():
    """What no installation holds is never imported, so that a wrong name would test nothing."""
    missing = {name for name in HEAVY | SCIPY if importlib.util.find_spec(name) is None}
    assert missing <= OPTIONAL
    assert loaded_by("import plyfile") & HEAVY == {"plyfile"}


@pytest.mark.parametrize(
    ("code", "unneeded"),
    [
        ("import jaxreg", HEAVY | SCIPY | {"flax", "tyro", "rich.progress"}),
        ("import jaxreg.cli, jaxreg.scans.pair", (HEAVY - {"plyfile"}) | SCIPY | {"flax"}),
        ("import jaxreg.io, jaxreg.scans.summary, jaxreg.view.page", (HEAVY - {"plyfile"}) | SCIPY),
    ],
)
def test_start_is_lean(code, unneeded):
    assert loaded_by(code) & unneeded == set()


def test_importing_the_library_starts_no_backend():
    """So that a program may import it and configure JAX afterwards."""
    loaded_by(
        "import jax, jaxreg.training, jaxreg.evaluation.score, jaxreg.scans, jaxreg.search\n"
        "jax.config.update('jax_num_cpu_devices', 2)\n"  # Fails where a backend was started.
        "assert len(jax.devices()) == 2"
    )


def test_every_public_name_is_there_and_no_other():
    found = loaded_by(
        "from jaxreg import *\nimport jaxreg\nassert set(jaxreg.__all__) <= set(dir())"
    )
    assert "flax" in found
    assert set(jaxreg.__all__) <= set(dir(jaxreg))
    with pytest.raises(AttributeError, match="register_pairs"):
        jaxreg.register_pairs  # noqa: B018


@pytest.mark.skipif(sys.platform != "linux", reason="huge pages are asked of glibc")
@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("", "glibc.malloc.hugetlb=1"),
        ("glibc.malloc.perturb=0", "glibc.malloc.perturb=0:glibc.malloc.hugetlb=1"),
        ("glibc.malloc.hugetlb=0", "glibc.malloc.hugetlb=0"),
    ],
)
def test_a_restart_for_huge_pages_keeps_settings_and_arguments(given, expected):
    program = (
        "import os, sys; from jaxreg.cli.process import restart_with_huge_pages\n"
        "restart_with_huge_pages(); print(os.environ['GLIBC_TUNABLES'], sys.argv[1:])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, "--steps", "two words"],
        env=os.environ | {"GLIBC_TUNABLES": given},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == f"{expected} ['--steps', 'two words']\n"
