"""Every public function checks, at trace time, every array that it takes.

Each row is a function of arrays that are all right but one; the traced call must be a ValueError that
names this one. Nothing is compiled.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxreg
from jaxreg.config import ModelConfig
from jaxreg.geometry.normals import edge_normals, neighborhood_covariances, surface_covariances
from jaxreg.network.model import iterate
from jaxreg.refine.methods import refine
from jaxreg.search.description import describe
from jaxreg.types import PointCloud, RigidTransform

pytestmark = pytest.mark.untyped

N, M = 40, 50
MODEL = ModelConfig(n_inliers=8)
SHAPES = {
    "points": (N, 3),
    "source": (N, 3),
    "reference": (M, 3),
    "same": (N, 3),
    "weights": (N,),
    "unit_normals": (N, 3),
    "reference_normals": (M, 3),
    "source_covariances": (N, 3, 3),
    "reference_covariances": (M, 3, 3),
    "similarity": (N, M),
    "u": (N, 3),
    "v": (N, 3),
    "matrix": (4, 4),
}
MASKS = {"mask": N, "source_mask": N, "reference_mask": M}
CLOUDS = {"source", "reference", "source_mask", "reference_mask", "initial"}


def variables():
    return jax.eval_shape(lambda: jaxreg.init_variables(jax.random.key(0), MODEL))


def network(source, reference, source_mask, reference_mask):
    given = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), variables())
    masks = {"source_mask": source_mask, "reference_mask": reference_mask}
    return jaxreg.register_pair(given, source, reference, config=MODEL, **masks)


def iterated(source, reference, source_mask, reference_mask):
    given = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), variables())
    clouds = PointCloud(source, source_mask), PointCloud(reference, reference_mask)
    return iterate(given, *clouds, config=MODEL)[0]


def uncertain(initial, **arrays):
    return jaxreg.pose_uncertainty(initial, **arrays)


FUNCTIONS = {
    "knn": (lambda points, mask: jaxreg.knn(points, 3, mask), {"points", "mask"}),
    "nearest_neighbor": (jaxreg.nearest_neighbor, {"points", "mask"}),
    "normals": (jaxreg.normals, {"points", "neighbors", "mask"}),
    "neighborhood_covariances": (neighborhood_covariances, {"points", "neighbors", "mask"}),
    "edge_normals": (edge_normals, {"points", "neighbors", "unit_normals", "mask"}),
    "surface_covariances": (lambda unit_normals: surface_covariances(unit_normals, 0.1),
                            {"unit_normals"}),
    "weighted_procrustes": (
        lambda source, same, weights: jaxreg.weighted_procrustes(source, same, weights),
        {"source", "same", "weights"},
    ),
    "robust_procrustes": (
        lambda source, same, weights: jaxreg.robust_procrustes(source, same, weights, rounds=2),
        {"source", "same", "weights"},
    ),
    "included_angle": (jaxreg.included_angle, {"u", "v"}),
    "from_matrix": (jaxreg.from_matrix, {"matrix"}),
    "icp": (jaxreg.icp, CLOUDS),
    "point_to_plane": (jaxreg.point_to_plane, CLOUDS | {"reference_normals"}),
    "gicp": (jaxreg.gicp, CLOUDS | {"source_covariances", "reference_covariances"}),
    "refine": (refine, CLOUDS),
    "pose_uncertainty": (uncertain, CLOUDS | {"reference_normals"}),
    "register_global": (jaxreg.register_global, CLOUDS - {"initial"} | {"similarity"}),
    "search_poses": (jaxreg.search_poses, CLOUDS - {"initial"} | {"similarity"}),
    "describe": (lambda points, mask: describe(points, mask, unit=1.0), {"points", "mask"}),
    "register_pair": (network, CLOUDS - {"initial"}),
    "iterate": (iterated, CLOUDS - {"initial"}),
}  # fmt: skip


def right(name):
    if name in MASKS:
        return jax.ShapeDtypeStruct((MASKS[name],), bool)
    if name == "neighbors":
        return jax.ShapeDtypeStruct((N, 5), np.int32)
    if name == "initial":
        return RigidTransform(
            jax.ShapeDtypeStruct((3, 3), np.float32), jax.ShapeDtypeStruct((3,), np.float32)
        )
    return jax.ShapeDtypeStruct(SHAPES[name], np.float32)


def wrongs(name):
    """What each kind of mistake makes of an argument."""
    shape = jax.ShapeDtypeStruct
    if name == "initial":
        matrix = right(name).rotation
        return {
            "matrix": shape((4, 4), np.float32),
            "tuple": tuple(right(name)),
            "batch": RigidTransform(shape((2, 3, 3), np.float32), shape((2, 3), np.float32)),
            "column": RigidTransform(matrix, shape((3, 1), np.float32)),
            "int32": RigidTransform(matrix, shape((3,), np.int32)),
        }
    fine = right(name)
    kinds = {
        "longer": shape((fine.shape[0] + 1, *fine.shape[1:]), fine.dtype),
        "batch": shape((1, *fine.shape), fine.dtype),
        "flat": shape((int(np.prod(fine.shape)) + 1,), fine.dtype),
    }
    for dtype in ("float16", "int32", "float64", "bool"):
        kinds[dtype] = shape(fine.shape, dtype)
    if name in MASKS:
        kinds["uint8"] = shape(fine.shape, "uint8")
        del kinds["bool"]
    if name == "neighbors":
        del kinds["int32"]
    if name in ("points", "source", "reference", "u", "matrix"):
        del kinds["longer"]  # another cloud, or, below, one that does not fit to the rest
    if name in ("u", "v", "matrix", "unit_normals"):
        kinds.pop("batch")  # leading axes
    return kinds


def cases():
    for label, (_, names) in FUNCTIONS.items():
        for name in sorted(names):
            for kind in wrongs(name):
                if kind == "float64" and len(names - set(MASKS) - {"neighbors", "initial"}) < 2:
                    continue  # alone it is as good as float32
                if (label, name, kind) in (("surface_covariances", "unit_normals", "longer"),):
                    continue
                yield pytest.param(label, name, kind, id=f"{label}-{name}-{kind}")


def traced(label, changed=None):
    function, names = FUNCTIONS[label]
    given = {name: right(name) for name in names} | (changed or {})
    return jax.eval_shape(lambda arrays: function(**arrays), given)


@pytest.mark.parametrize("label", FUNCTIONS)
def test_right_arrays_are_taken_and_float32_stays_float32(label):
    found = jax.tree.leaves(traced(label))
    assert all(x.dtype != np.float64 for x in found)


@pytest.mark.parametrize(("label", "name", "kind"), list(cases()))
def test_a_wrong_array_is_refused_by_its_name(label, name, kind):
    shown = {"same": "reference", "initial": "initial|transform"}.get(name, name)
    if kind == "float64" and name in ("source", "points"):
        shown = f"{shown}|reference|dtype"
    with pytest.raises(ValueError, match=shown):
        traced(label, {name: wrongs(name)[kind]})


@pytest.mark.parametrize("name", ["trim", "max_correspondence_distance", "iterations", "k"])
def test_settings_that_are_traced_are_refused(name):
    cloud = jax.ShapeDtypeStruct((N, 3), np.float32)

    def run(points, value):
        return jaxreg.gicp(points, points, config=jaxreg.RefineConfig(**{name: value}))

    with pytest.raises(ValueError, match=f"config.{name} is traced.*static"):
        jax.eval_shape(run, cloud, jax.ShapeDtypeStruct((), np.int32))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kernel_scale": 0.0}, "kernel_scale = 0.0"),
        ({"max_correspondence_distance": -1.0}, "max_correspondence_distance = -1.0"),
        ({"kernel_scale": np.ones(3)}, "kernel_scale must be one real number"),
        ({"config": {"k": 5}}, "config must be a jaxreg.RefineConfig, got dict"),
        ({"source": [[0.0, 0.0, 0.0]]}, "source must be an array, got list"),
        ({"reference": np.full((N, 3), 1e39)}, r"reference contains 1e\+39, which float32"),
    ],
)
@pytest.mark.float32
def test_other_arguments_are_refused_by_their_name(change, message):
    given = {"source": np.zeros((N, 3), np.float32), "reference": np.zeros((N, 3), np.float32)}
    with pytest.raises(ValueError, match=message):
        jaxreg.icp(**(given | change))


@pytest.mark.parametrize("epsilon", [0.0, -1.0, 1.5])
def test_surfaces_need_a_thickness(epsilon):
    with pytest.raises(ValueError, match=f"epsilon = {epsilon}"):
        surface_covariances(jnp.zeros((3, 3)), epsilon)


@pytest.mark.parametrize("x64", [False, True])
def test_numbers_of_numpy_leave_the_dtype_of_the_clouds(x64):
    """NumPy's float64 scalars are not weakly typed, as Python's floats are."""
    cloud = jax.ShapeDtypeStruct((N, 3), np.float32)
    config = jaxreg.RefineConfig(
        iterations=np.int64(3),
        epsilon=np.float64(0.01),
        trim=np.float64(0.9),
        tolerance=np.float64(1e-5),
    )
    with jax.enable_x64(x64):
        found = jax.eval_shape(
            lambda x: jaxreg.gicp(x, x, config=config, kernel_scale=np.float64(0.1)), cloud
        )
        fresh = jax.eval_shape(lambda: jaxreg.init_variables(jax.random.key(0), MODEL))
    assert found.rotation.dtype == np.float32
    assert {x.dtype for x in jax.tree.leaves(fresh)} == {np.dtype(np.float32)}
