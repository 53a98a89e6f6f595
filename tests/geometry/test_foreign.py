"""Clouds as other libraries hold them, and advice that works."""

import types

import numpy as np
import pytest
import trimesh

from jaxreg.geometry.clouds import check_points

pytestmark = pytest.mark.untyped
POINTS = np.random.default_rng(0).normal(size=(300, 3))


def given(cloud, **options):
    return check_points(cloud, "source", **options)


def test_objects_are_read_by_their_own_points():
    structured = np.zeros(300, [("intensity", "f4"), ("z", "f8"), ("y", "f8"), ("x", "f8")])
    for axis, column in zip("xyz", POINTS.T, strict=True):
        structured[axis] = column
    tensor = types.SimpleNamespace(cpu=lambda: types.SimpleNamespace(numpy=lambda: POINTS))
    clouds = {
        "as Open3D and PyVista": types.SimpleNamespace(points=POINTS.tolist()),
        "as tensors of Open3D": types.SimpleNamespace(
            point=types.SimpleNamespace(positions=tensor)
        ),
        "trimesh": trimesh.PointCloud(POINTS),
        "structured": structured,
        "objects": POINTS.astype(object),
        "lists": POINTS.tolist(),
    }
    for name, cloud in clouds.items():
        points, finite = given(cloud)
        np.testing.assert_array_equal(points, POINTS, err_msg=name)
        assert finite.all()


def test_open3d():
    o3d = pytest.importorskip("open3d", reason="Open3D is not here", exc_type=ImportError)
    legacy = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    np.testing.assert_array_equal(given(legacy)[0], POINTS)
    tensors = o3d.t.geometry.PointCloud(o3d.core.Tensor(POINTS))
    np.testing.assert_array_equal(given(tensors)[0], POINTS)
    with pytest.raises(ValueError, match=r"source\.sample_points_uniformly\(20_000\)\.points"):
        given(o3d.geometry.TriangleMesh.create_box())


def test_a_coarse_mesh_is_refused_and_a_fine_one_is_its_vertices():
    with pytest.raises(ValueError, match=r"mesh of 8 vertices.*source\.sample\(20_000\)"):
        given(trimesh.creation.box())
    ball = trimesh.creation.icosphere(subdivisions=4)
    np.testing.assert_array_equal(given(ball)[0], ball.vertices)
    assert len(given(trimesh.creation.box().sample(20_000))[0]) == 20_000


class Table:
    """As a pandas DataFrame looks."""

    def __init__(self, columns, rows):
        self.columns, self.rows = list(columns), rows

    def __getitem__(self, names):
        return Table(names, self.rows[:, [self.columns.index(name) for name in names]])

    def to_numpy(self):
        return self.rows

    def __array__(self, dtype=None, copy=None):
        return self.rows


def test_tables_are_read_by_the_names_of_their_columns():
    rows = np.column_stack([np.arange(300.0), POINTS])
    np.testing.assert_array_equal(given(Table(["t", "X", "Y", "Z"], rows))[0], POINTS)
    with pytest.raises(ValueError, match=r"points\.to_numpy\(\)\[:, :3\]"):
        given(Table("tabc", rows))


def test_masked_rows_count_as_not_finite_and_raise_nothing():
    masked = np.ma.masked_array(POINTS.copy(), mask=np.zeros((300, 3), bool))
    masked.data[[0, 7], [0, 2]], masked.mask[[0, 7], [0, 2]] = 1e9, True
    points, finite = given(masked)
    np.testing.assert_array_equal(np.flatnonzero(~finite), [0, 7])
    np.testing.assert_array_equal(points[finite], POINTS[finite])
    masked.data[5, 1] = np.nan
    with pytest.raises(ValueError, match="1 of 300 points are not finite, the first is point 5"):
        given(masked)


def test_masked_coordinates_of_structured_arrays_are_no_points():
    """Whatever stands below the mask; what is masked besides x, y, z does not count."""
    kinds = [("intensity", "i4"), ("x", "f4"), ("y", "f8"), ("z", "f8")]
    rows = np.ma.masked_array(
        np.zeros(300, kinds), mask=np.zeros(300, [(n, "?") for n, _ in kinds])
    )
    for axis, column in zip("xyz", POINTS.astype(np.float32).T, strict=True):
        rows[axis] = column
    for axis, row, fill in (("x", 0, -9999), ("z", 7, np.nan), ("intensity", 9, -9999)):
        rows[axis][row] = fill
        rows.mask[axis][row] = True
    for cloud in (
        rows,
        types.SimpleNamespace(points=np.ma.stack([rows[a] for a in "xyz"], axis=1)),
    ):
        points, finite = given(cloud)
        np.testing.assert_array_equal(np.flatnonzero(~finite), [0, 7])
        np.testing.assert_array_equal(points[finite], POINTS.astype(np.float32)[finite])
    assert given(rows.data, nonfinite="drop")[1].sum() == 299, "without a mask a fill is a value"


@pytest.mark.parametrize(
    ("cloud", "advice"),
    [
        (POINTS.T, "points.T"),
        (np.vstack([POINTS.T, np.ones(300)]), "points.T[:, :3]"),
        (POINTS.reshape(15, 20, 3), "points.reshape(-1, 3)"),
        (
            np.dstack([POINTS.reshape(15, 20, 3), np.ones((15, 20))]),
            "points[..., :3].reshape(-1, 3)",
        ),
        (np.column_stack([POINTS, np.ones(300)]), "points[:, :3]"),
    ],
)
def test_the_advice_for_a_shape_gives_the_points(cloud, advice):
    with pytest.raises(ValueError, match="not \\(n, 3\\)") as caught:
        given(cloud)
    assert f"as in {advice}." in str(caught.value)
    found, _ = given(eval(advice, {"points": cloud}))
    np.testing.assert_array_equal(found, POINTS)


def test_what_is_no_cloud_is_told_in_one_line():
    class Tensor:
        def __array__(self, *_, **__):
            raise RuntimeError("Can't call numpy() on Tensor that requires grad.")

    for cloud, told in (
        ("scan.ply", r"jaxreg\.read_cloud\('scan\.ply'\)"),
        (Tensor(), "requires grad"),
        (object(), "is a object, without an attribute .points"),
        (np.zeros((5, 3), complex), "dtype complex128"),
        (np.zeros((5, 2)), "add a column"),
    ):
        with pytest.raises(ValueError, match=told):
            given(cloud)
