"""The benchmark of real scans, on fragments of a shape in the files that 3DMatch has."""

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from benchmarks.scans import red_kitchen
from jaxreg.data.procedural.shapes import sample_shape
from jaxreg.evaluation import methods
from jaxreg.types import RigidTransform

pytestmark = pytest.mark.float32

POSES = {(0, 1): ([10, 20, 30], [0.1, 0.0, -0.2]), (0, 2): ([5, 0, 40], [0.0, 0.3, 0.0])}


@pytest.fixture
def kitchen(tmp_path):
    """Three fragments of which (0, 1) and (0, 2) overlap by half or more, and (1, 2) does not."""
    folder = tmp_path / "7scene" / "7-scenes-redkitchen"
    folder.mkdir(parents=True)
    cloud = sample_shape(0, 7, points=900).astype(np.float64)
    for number in range(3):
        points = cloud[number::3]
        if (0, number) in POSES:
            pose = matrix(*POSES[0, number])
            points = (points - pose[:3, 3]) @ pose[:3, :3]
        rows = np.zeros(len(points), [(axis, "f8") for axis in "xyz"])
        rows["x"], rows["y"], rows["z"] = points.T
        element = PlyElement.describe(rows, "vertex")
        PlyData([element]).write(str(folder / f"cloud_bin_{number}.ply"))
    overlaps = ["head", "3DMatch 0 1 0.6 0.5", "3DMatch 0 2 0.9 0.9", "3DMatch 1 2 0.4 0.5"]
    (folder / "gt_overlap.txt").write_text("\n".join([*overlaps, "Other 1 2 0.9 0.9"]))
    lines = []
    for i, j in ((0, 1), (0, 2), (1, 2)):
        pose = matrix(*POSES.get((i, j), ([0, 0, 0], [0, 0, 0])))
        lines += [f"{i} {j} 3", *(" ".join(map(str, row)) for row in pose)]
    (folder / "gt.log").write_text("\n".join(lines))
    return tmp_path


def matrix(degrees, shift):
    """The pose of fragment j in the frame of fragment i."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix(), shift
    return pose


def test_the_truth_of_a_case_lays_the_fragments_on_each_other(kitchen):
    options = red_kitchen.Options(data_root=str(kitchen))
    folder = kitchen / "7scene" / "7-scenes-redkitchen"
    for rotation, largest in (("full", 180), ("limited", 30)):
        cases = red_kitchen.read_cases(folder, rotation, options)
        assert [case.name for case in cases] == ["0-1", "0-2"]
        cloud = sample_shape(0, 7, points=900).astype(np.float64)
        for case, number in zip(cases, (1, 2), strict=True):
            moved = case.source @ case.truth[:3, :3].T + case.truth[:3, 3]
            np.testing.assert_allclose(moved, cloud[number::3], atol=1e-6)
            turn = case.truth[:3, :3].T @ matrix(*POSES[0, number])[:3, :3]
            assert np.degrees(Rotation.from_matrix(turn).magnitude()) <= largest + 1e-6


def test_every_method_meets_the_same_cases_and_identity_is_wrong_by_the_truth(
    kitchen, records, monkeypatch, capsys
):
    seen, cases = {}, {}
    folder = kitchen / "7scene" / "7-scenes-redkitchen"
    options = red_kitchen.Options(
        methods=("identity", "truth", "register", "open3d_nothing@0.05"), data_root=str(kitchen)
    )
    for rotation in options.rotations:
        cases[rotation] = red_kitchen.read_cases(folder, rotation, options)
    truths = {c.source.tobytes(): c.truth for found in cases.values() for c in found}

    def truth(source, reference):
        pose = truths[source.tobytes()]
        return methods.Outcome(RigidTransform(pose[:3, :3], pose[:3, 3]), True, 0.9)

    def choose(name):
        clouds = truth if name in ("truth", "register") else real(name).clouds
        return methods.Method(
            None, lambda *pair: seen.setdefault(name, []).append(pair) or clouds(*pair)
        )

    real = methods.choose
    monkeypatch.setattr(methods, "choose", choose)
    red_kitchen.main(options)
    first = [x.tobytes() for pair in seen["identity"] for x in pair]
    assert first == [x.tobytes() for pair in seen["register"] for x in pair]
    entry = records.read("scans")
    assert list(entry["rows"]) == ["identity", "truth", "jaxreg"]
    assert "open3d_nothing@0.05 left out: no method" in capsys.readouterr().out
    for rotation, found in cases.items():
        angles = [np.degrees(Rotation.from_matrix(c.truth[:3, :3]).magnitude()) for c in found]
        shifts = [
            np.linalg.norm(c.truth[:3, :3] @ c.source.mean(0) + c.truth[:3, 3] - c.source.mean(0))
            for c in found
        ]
        right = sum(a < 15 and s < 0.3 for a, s in zip(angles, shifts, strict=True))
        assert entry["rows"]["identity"][f"{rotation}_right"] == right
        assert entry["rows"]["truth"][f"{rotation}_right"] == 2
        assert entry["rows"]["truth"][f"{rotation}_median_deg"] < 1e-5
        errors = [
            x[0]
            for x in (red_kitchen.errors(RigidTransform(np.eye(3), np.zeros(3)), c) for c in found)
        ]
        np.testing.assert_allclose(errors, angles, rtol=1e-6)
    assert entry["setting"]["called_success"] == entry["setting"]["all_pairs"] == 4
    assert entry["command"] == "python -m benchmarks.scans.red_kitchen --pairs 2"


def test_the_record_of_all_methods_fits_the_page(records):
    """Rows and columns are those that the template names; KISS-Matcher is run several times."""
    cells = {"right": 1, "median_deg": None, "s": 0.5, "s_max": 1.0}
    rows = dict.fromkeys(red_kitchen.METHODS, cells)
    setting = {"called_success": 1, "all_pairs": 2, "kiss_matcher_low": 1, "kiss_matcher_high": 2}
    table = red_kitchen.Table(rows, setting)
    red_kitchen.write({"full": table, "limited": table}, red_kitchen.Options())
    assert records.fits("scans")
    assert "open3d_fgr_icp_default" in records.read("scans")["rows"]
    assert records.read("scans")["setting"]["all_pairs"] == 4


def test_what_is_not_deterministic_is_run_again(kitchen, monkeypatch, capsys):
    """The first run is in the table, the range of all of them beside it."""
    answers = iter([np.eye(3)] * 3 + [None] * 2 + [np.eye(3)] * 2)
    folder = kitchen / "7scene" / "7-scenes-redkitchen"
    options = red_kitchen.Options(rotations=("full",), repeats=3, data_root=str(kitchen))
    truths = {c.source.tobytes(): c.truth for c in red_kitchen.read_cases(folder, "full", options)}

    def sometimes(source, reference):
        pose = truths[source.tobytes()]
        rotation = pose[:3, :3] if next(answers) is None else -pose[:3, :3]
        return methods.Outcome(RigidTransform(rotation, pose[:3, 3]))

    chosen = {"kiss_matcher_icp@0.05": methods.Method(None, sometimes)}
    table = red_kitchen.measure("full", chosen, options)
    assert table.rows["kiss_matcher_icp@0.05"]["right"] == 0
    assert table.setting == {"kiss_matcher_low": 0, "kiss_matcher_high": 2}
    assert "right in 3 runs: [0, 2, 0]" in capsys.readouterr().out
