"""The command line in this process: two scans to work on, and a user's cache that stays as it is."""

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from jaxreg import io
from jaxreg.cli import main, process
from jaxreg.data.procedural import shapes

TABLE = 9


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    """Tests leave nothing in the user's cache, and no cache on for the tests that follow."""
    monkeypatch.setattr(process, "enable_compilation_cache", lambda **_: None)
    monkeypatch.setattr(process, "restart_with_huge_pages", lambda: None)


@pytest.fixture(scope="session")
def truth():
    """The pose that lays the source of `folder` on its reference."""
    truth = np.eye(4)
    truth[:3, :3] = Rotation.from_euler("xyz", [100, -40, 25], degrees=True).as_matrix()
    truth[:3, 3] = [12.0, -7.0, 3.0]
    return truth


@pytest.fixture(scope="module")
def folder(tmp_path_factory, truth):
    """Two samplings of a table in decimetres that share no point, the source with colours."""
    folder = tmp_path_factory.mktemp("scans")
    cloud = 10 * shapes.sample_shape(5, TABLE, points=1000).astype(np.float64)
    source, reference = cloud[:500], cloud[500:] @ truth[:3, :3].T + truth[:3, 3]
    rows = np.zeros(500, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1")])
    rows["x"], rows["y"], rows["z"] = source.T
    rows["red"] = np.arange(500) % 256
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(folder / "a.ply"))
    io.write_cloud(folder / "b.pcd", reference)
    np.savetxt(folder / "T.txt", truth)
    return folder


@pytest.fixture
def run(capsys):
    """`jaxreg ARGUMENTS`: exit status, output, error output."""

    def run(*arguments) -> tuple[int, str, str]:
        status = main([str(part) for part in arguments])
        return status, *capsys.readouterr()

    return run
