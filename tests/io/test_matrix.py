"""A 4x4 matrix from text, NPY and JSON."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.io.matrix import read_matrix

TRUTH = np.eye(4)
TRUTH[:3, :3] = Rotation.from_euler("xyz", [100, -40, 25], degrees=True).as_matrix()
TRUTH[:3, 3] = [12.0, -7.0, 3.0]


@pytest.mark.parametrize("name", ["T.txt", "T.csv", "T.npy", "T.json", "list.json", "print.txt"])
def test_matrices_are_read_from_any_form(tmp_path, name):
    path = tmp_path / name
    if name.endswith("npy"):
        np.save(path, TRUTH)
    elif name == "list.json":
        path.write_text(json.dumps(TRUTH.tolist()))
    elif name == "print.txt":
        path.write_text(f"# from an earlier run\n{np.array2string(TRUTH, precision=17)}\n")
    elif name.endswith("json"):
        path.write_text(json.dumps({"transformation": TRUTH.tolist()}))
    else:
        np.savetxt(path, TRUTH, delimiter="," if name.endswith("csv") else " ")
    np.testing.assert_array_equal(read_matrix(path), TRUTH)


def test_what_is_no_file_is_said(tmp_path):
    for name in ("T.txt", "T.npy", "T.json"):
        with pytest.raises(ValueError, match=f"{name}: no such file; check the path"):
            read_matrix(tmp_path / name)
        (tmp_path / name).mkdir()
        with pytest.raises(
            ValueError, match=f"{name} is a directory, not a file: name a file in it"
        ):
            read_matrix(tmp_path / name)


def test_a_pickled_matrix_is_refused(tmp_path):
    np.save(tmp_path / "T.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(ValueError, match="does not contain a 4x4 matrix"):
        read_matrix(tmp_path / "T.npy")
