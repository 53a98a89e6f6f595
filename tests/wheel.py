"""The wheel, as a user gets it: built, installed without extras in an empty environment, and used.

Run by `make wheel`. Anything that only a checkout has (configurations, scripts, extras that tests need)
is out of reach here. Words after the command are options of pip install: `--python` of another version
is that of the interpreter that runs this.
"""

import json
import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).parent.parent

INSIDE = {
    *("jaxreg/view/viewer.html", "jaxreg/py.typed", "jaxreg/configs/synthetic_cpu.toml"),
    *(f"jaxreg/weights/{path.name}" for path in ROOT.glob("jaxreg/weights/*.npz")),
    *(f"jaxreg/weights/{path.stem}.json" for path in ROOT.glob("jaxreg/weights/*.npz")),
    *(f"jaxreg/configs/{path.name}" for path in ROOT.glob("configs/*.toml")),
}

# Two samplings of a box with a smaller one on it, which share no point.
CLOUDS = """
import numpy as np
import jaxreg.io
rng = np.random.default_rng(0)
def sampled(n):
    points = rng.uniform(-1, 1, (n, 3)) * [1.0, 0.7, 0.4]
    face = rng.integers(0, 3, n)
    points[np.arange(n), face] = np.sign(points[np.arange(n), face]) * np.array([1.0, 0.7, 0.4])[face]
    points[: n // 4] = points[: n // 4] * [0.4, 0.5, 0.6] + [0.4, 0.1, 0.64]
    return points
c, s = np.cos(2.0), np.sin(2.0)
turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
jaxreg.io.write_cloud("a.ply", sampled(900))
jaxreg.io.write_cloud("b.ply", sampled(900) @ turn.T + [5, 6, 7])
"""
RIGHT = """
import json
import numpy as np
found = np.array(json.load(open("r.json"))["transformation"])
c, s = np.cos(2.0), np.sin(2.0)
assert np.abs(found[:3, :3] - [[c, -s, 0], [s, c, 0], [0, 0, 1]]).max() < 0.1, found
assert np.abs(found[:3, 3] - [5, 6, 7]).max() < 0.1, found
assert "<canvas" in open("page.html").read()
"""
NETWORK = """
import jax
import jaxreg
variables, config = jaxreg.load_pretrained()
x = jax.random.normal(jax.random.key(0), (300, 3))
found = jaxreg.register_pair(variables, x, x, config=config)
assert found.rotation.shape == (3, 3), found
"""


def checks(version: str) -> list[tuple[list[str], int, str]]:
    """Commands in a folder of their own, the exit status they must have, and what they must print."""
    return [
        (["jaxreg", "--version"], 0, f"jaxreg {version}"),
        (["python", "-c", CLOUDS], 0, ""),
        (["jaxreg", "info", "a.ply"], 0, "900"),
        (["jaxreg", "register", "a.ply", "b.ply", "--json", "r.json", "--html", "page.html"], 0, "ve"),
        (["python", "-c", RIGHT], 0, ""),
        (["python", "-c", NETWORK], 0, ""),
        (["jaxreg", "evaluate", "synthetic_cpu", "--method", "identity", "--pairs", "2"], 0, "MAE(R)"),
        (["jaxreg", "train", "no_such_name"], 2, "modelnet40_unseen_objects"),
        # What is not installed is named, with the command that installs it.
        (["jaxreg", "register", "a.ply", "b.ply", "--plot", "p.png"], 2, "pip install 'jaxreg[view]'"),
        (["jaxreg", "register", "a.ply", "b.ply", "-o", "o.las"], 2, "pip install 'jaxreg[las]'"),
        (
            ["jaxreg", "evaluate", "modelnet40_unseen_objects", "--data-root", "data"],
            2,
            "HDF5 needs h5py, which is not installed: run pip install 'jaxreg[train]'",
        ),
    ]  # fmt: skip


def build(folder: Path) -> Path:
    """The wheel of this checkout."""
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, ROOT]
    subprocess.run(command, check=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def check_content(wheel: Path) -> None:
    """Everything that is read from files is inside, and nothing that is only for developers."""
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert names >= INSIDE, f"missing: {sorted(INSIDE - names)}"
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"jaxreg"}, tops


def use(binaries: Path, version: str, folder: Path) -> None:
    """Run the checks with the programs of an environment."""
    (folder / "data" / "modelnet40_ply_hdf5_2048").mkdir(parents=True)
    for name, content in (("test_files.txt", "ply_data_test0.h5"), ("shape_names.txt", "chair")):
        (folder / "data" / "modelnet40_ply_hdf5_2048" / name).write_text(content + "\n")
    hidden = ("PYTHONPATH", "JAXREG_DATA", "JAXREG_WEIGHTS")
    environment = {k: v for k, v in os.environ.items() if k not in hidden}
    environment |= {"XDG_CACHE_HOME": str(folder / "cache"), "JAX_PLATFORMS": "cpu"}
    for (program, *rest), status, text in checks(version):
        done = subprocess.run(
            [binaries / program, *rest],
            cwd=folder, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        printed = done.stdout + done.stderr
        shown = " ".join([program, *(word for word in rest if "\n" not in word)])
        if done.returncode != status or text not in printed:
            sys.exit(f"{shown}: status {done.returncode}, wanted {status} and {text!r}:\n{printed}")
        print(f"ok: {shown}", flush=True)


def main() -> None:
    """Build, install, use."""
    with tempfile.TemporaryDirectory() as directory:
        folder = Path(directory)
        wheel = build(folder)
        check_content(wheel)
        subprocess.run([sys.executable, "-m", "venv", folder / "venv"], check=True)
        pip = [folder / "venv" / "bin" / "python", "-m", "pip"]
        subprocess.run([*pip, "install", "--quiet", *sys.argv[1:], wheel], check=True)
        listed = subprocess.run([*pip, "list", "--format=json"], capture_output=True, check=True)
        packages = {entry["name"]: entry["version"] for entry in json.loads(listed.stdout)}
        absent = {"matplotlib", "h5py", "laspy", "chex"} & set(packages)
        assert not absent, f"the core brings {absent}"
        (folder / "work").mkdir()
        use(folder / "venv" / "bin", packages["jaxreg"], folder / "work")
    print(f"{wheel.name}: {len(packages)} packages installed, every check passed")


if __name__ == "__main__":
    main()
