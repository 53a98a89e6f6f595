"""Pipelines of people who train and compose: members of the kinds D14 to D19 that no other test has.

The right value is a law, a loop, numpy, or what a pair was made with. A member that is marked `xfail`
is a fault that stands; its reason says what comes out today.
"""

import concurrent.futures
import dataclasses
import multiprocessing
import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import jaxreg
from jaxreg import peers, training
from jaxreg.cli import main, process
from jaxreg.config import Config
from jaxreg.evaluation import score
from jaxreg.network import batch
from jaxreg.network.features import BATCH_AXIS
from jaxreg.peers import by_name
from jaxreg.refine.host import refine_on_host
from jaxreg.types import Pair, PointCloud, RigidTransform

pytestmark = [pytest.mark.float32, pytest.mark.untyped, pytest.mark.slow]

FEW = jaxreg.RefineConfig(iterations=3)
IMPLICIT = jaxreg.RefineConfig(iterations=3, gradient="implicit")
N = 40
SMALL = jaxreg.ModelConfig(
    k=3, k_matching=3, channels=(4, 4), width=8, inlier_width=2, n_inliers=20, iterations=2
)
PROGRAM = Path(__file__).parents[1] / "exported" / "register_global_v1.jaxreg"
LEARNED = {
    "dcp": peers.dcp, "cemnet": peers.cemnet, "idam": peers.idam, "rpmnet": peers.rpmnet,
    "fmr": peers.fmr,
}  # fmt: skip


def members(table, faults=(), slow=()):
    """A parameter for every name; those that stand for a fault are expected to fail."""
    faults = dict(faults)
    assert set(faults) <= set(table)
    return [
        pytest.param(
            name,
            id=name,
            marks=[
                *([pytest.mark.xfail(strict=True, reason=faults[name])] if name in faults else []),
                *([pytest.mark.slow] if name in slow else []),
            ],
        )
        for name in table
    ]


def two_clouds(count=N, dtype=np.float32):
    """A cloud and itself in another pose: 7 degrees and 0.06 away."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(count, 3))
    rotation = Rotation.from_euler("xyz", [5, -4, 3], degrees=True).as_matrix()
    shift = np.array([0.05, -0.02, 0.03])
    truth = RigidTransform(rotation.astype(dtype), shift.astype(dtype))
    return points.astype(dtype), (points @ rotation.T + shift).astype(dtype), truth


X, Y, TRUTH = two_clouds()
ONES = np.ones(N, np.float32)
IDENTITY = RigidTransform(np.eye(3, dtype=np.float32), np.zeros(3, np.float32))


def chain(points, dtype=np.float32, count=5):
    """A graph of poses in a row, one shift after the other, and where all of them begin."""
    edges = count - 1
    eyes = jnp.broadcast_to(jnp.eye(3, dtype=dtype), (count, 3, 3))
    graph = jaxreg.PoseGraph(
        jnp.arange(1, count), jnp.arange(edges), RigidTransform(eyes[1:], points[:edges]),
        jnp.broadcast_to(jnp.eye(6, dtype=dtype), (edges, 6, 6)), jnp.ones(edges, bool),
    )  # fmt: skip
    return graph, RigidTransform(eyes, jnp.zeros((count, 3), dtype))


def optimized(points):
    return jaxreg.optimize_poses(*chain(points, points.dtype), iterations=3).poses.translation


# --- D14: waits without end --------------------------------------------------------------------------


def pose_of(points):
    return jaxreg.gicp(points, jnp.asarray(Y), config=IMPLICIT).translation


def peer_loss(name):
    """The derivative of a network's loss, for weights and a pair of clouds."""
    config = Config(network=name)

    def run(points):
        variables = by_name.init_variables(jax.random.key(0), config)
        cloud = PointCloud(points, jnp.ones(N, bool))

        def loss(params):
            return LEARNED[name].loss(
                variables | {"params": params}, cloud, cloud, IDENTITY, config=getattr(config, name)
            )[0]

        return jax.grad(loss)(variables["params"])

    return run


DERIVATIVES = {
    "gradient of a pose graph": jax.grad(lambda x: optimized(x[:4])[-1, 0]),
    "Jacobian of implicit gicp": jax.jacrev(pose_of),
    "Hessian of robust procrustes": jax.hessian(
        lambda x: jaxreg.robust_procrustes(x, jnp.asarray(Y), ONES, rounds=2).translation[0]
    ),
    "Jacobian of a covariance": jax.jacfwd(
        lambda x: jaxreg.pose_uncertainty(IDENTITY, x, jnp.asarray(Y)).covariance
    ),
    "gradient of normals": jax.grad(lambda x: jaxreg.normals(x, jaxreg.knn(x, 4))[0, 0]),
    "loss of idam": peer_loss("idam"),
    "loss of rpmnet": peer_loss("rpmnet"),
    "loss of fmr": peer_loss("fmr"),
}


@pytest.mark.loose
@pytest.mark.parametrize(
    "name", members(DERIVATIVES, slow=["gradient of a pose graph", "loss of rpmnet"])
)
def test_no_derivative_of_a_batch_calls_lapack(name):
    batch_of_clouds = jax.ShapeDtypeStruct((2, N, 3), np.float32)
    mapped = jax.vmap(DERIVATIVES[name], axis_name=BATCH_AXIS)
    text = jax.jit(mapped).lower(batch_of_clouds).as_text()
    assert "lapack" not in text


THREADS = """
import sys, threading
import jax, numpy as np
sys.path.insert(0, {root!r})
from tests.kinds import test_pipelines as here
function, arguments = here.IN_THREADS[sys.argv[1]]
batch = jax.tree.map(lambda x: np.stack([x] * 256), arguments)
call = jax.jit(jax.vmap(function))
want = jax.block_until_ready(call(*batch))
same = []
def work():
    for _ in range(4):
        found = jax.block_until_ready(call(*batch))
        same.append(all(map(np.array_equal, jax.tree.leaves(found), jax.tree.leaves(want))))
threads = [threading.Thread(target=work) for _ in range(3)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
assert len(same) == 12 and all(same)
"""
IN_THREADS = {
    "point_to_plane": (lambda x, y: jaxreg.point_to_plane(x, y, config=FEW).transform, (X, Y)),
    "robust_procrustes": (lambda x, y: jaxreg.robust_procrustes(x, y, ONES, rounds=3), (X, Y)),
    "pose_uncertainty": (lambda t, x, y: jaxreg.pose_uncertainty(t, x, y).covariance, (IDENTITY, X, Y)),
    "optimize_poses": (optimized, (X[:4],)),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", members(IN_THREADS))
def test_three_threads_share_a_batched_program(name):
    code = THREADS.format(root=str(Path(__file__).parents[2]))
    subprocess.run([sys.executable, "-c", code, name], check=True, timeout=150)


def contour(count, seed):
    t = np.random.default_rng(seed).uniform(0, 2 * np.pi, count)
    radius = 3 + np.cos(2 * t) + 0.5 * np.sin(3 * t)
    return np.c_[radius * np.cos(t), (2 + 0.5 * np.cos(t)) * np.sin(t)]


def scans_of_many_kinds():
    """Targets and plans; no two pairs of one size."""
    rng = np.random.default_rng(0)
    pairs = [(p, p[::-1] @ TRUTH.rotation.T + 5) for p in rng.normal(size=(3, 12, 3)) * 9]
    return [*pairs, (contour(200, 0), contour(300, 1))]


def test_threads_of_the_host_find_what_one_finds():
    sources, references = zip(*scans_of_many_kinds(), strict=True)
    expected = list(map(jaxreg.register, sources, references))
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        found = list(pool.map(jaxreg.register, sources, references, timeout=100))
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.transformation, other.transformation)


@pytest.mark.slow
def test_spawned_workers_find_what_one_process_finds():
    sources, references = zip(*scans_of_many_kinds(), strict=True)
    expected = list(map(jaxreg.register, sources, references))
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(2, mp_context=spawn) as pool:
        found = list(pool.map(jaxreg.register, sources, references, timeout=100))
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one.transformation, other.transformation, atol=1e-6)


# --- D15: silently wrong -----------------------------------------------------------------------------


def test_neighbours_that_do_not_exist_are_refused_or_left_out():
    """A k-d tree of scipy gives n where fewer than k lie within the radius; `knn` gives the point."""
    found = cKDTree(X).query(X, 6, distance_upper_bound=0.9)[1][:, 1:].astype(np.int32)
    assert 0.1 < np.mean(found == N) < 0.9
    filled = np.where(found == N, np.arange(N)[:, None], found)
    try:
        normals = jaxreg.normals(jnp.asarray(X), jnp.asarray(found))
    except ValueError:
        return
    expected = jaxreg.normals(jnp.asarray(X), jnp.asarray(filled))
    np.testing.assert_allclose(normals, expected, atol=1e-5)


def rotations():
    return {
        "zeros": np.zeros((3, 3)), "mirror": np.diag([1.0, 1, -1]), "twice": 2 * np.eye(3),
        "a fifth larger": 1.2 * np.eye(3), "sheared": np.eye(3) + np.eye(3, k=1) * 0.3,
        "of half precision": np.asarray(TRUTH.rotation, np.float16).astype(float),
    }  # fmt: skip


NO_ROTATIONS = {
    f"{method} from {name}": (method, name)
    for method in ("icp", "point_to_plane", "gicp")
    for name in rotations()
}


@pytest.mark.parametrize("name", members(NO_ROTATIONS))
def test_a_start_that_is_no_rotation_is_refused_or_does_no_harm(name):
    method, kind = NO_ROTATIONS[name]
    start = RigidTransform(rotations()[kind].astype(np.float32), np.zeros(3, np.float32))
    try:
        found = _refined(method)(X, Y, start)
    except ValueError:
        return
    np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-5)
    assert np.linalg.det(found.rotation) == pytest.approx(1, abs=1e-4)


def _refined(method):
    if method not in _REFINED:
        function = getattr(jaxreg, method)
        _REFINED[method] = jax.jit(lambda x, y, start: function(x, y, initial=start))
    return _REFINED[method]


_REFINED = {}


LEFT_OUT = {
    "a negative weight": (lambda x, y, w: (x.at[0].add(9), y, w.at[0].set(-5))),
    "no weight": (lambda x, y, w: (x, y.at[0].add(9), w.at[0].set(0))),
    "no weight, NaN in the source": (lambda x, y, w: (x.at[0].set(jnp.nan), y, w.at[0].set(0))),
    "no weight, infinity in the reference": (
        lambda x, y, w: (x, y.at[0].set(jnp.inf), w.at[0].set(0))
    ),
}


@pytest.mark.parametrize("name", members(LEFT_OUT))
def test_a_row_without_weight_changes_nothing(name):
    arrays = LEFT_OUT[name](jnp.asarray(X), jnp.asarray(Y), jnp.asarray(ONES))
    found = jaxreg.weighted_procrustes(*arrays)
    np.testing.assert_allclose(found.rotation, TRUTH.rotation, atol=1e-6)
    np.testing.assert_allclose(found.translation, TRUTH.translation, atol=1e-6)


@pytest.mark.slow
def test_similarities_of_a_network_that_diverged_are_not_valid():
    found = jax.jit(jaxreg.register_global)(X, Y, similarity=jnp.full((N, N), jnp.nan))
    assert not found.valid
    np.testing.assert_array_equal(found.transformation, np.eye(4))


@pytest.mark.slow
def test_features_of_a_network_that_diverged_are_not_valid():
    network = dict(jaxreg.load_features())
    network["near_edge"] = np.full_like(network["near_edge"], np.nan)
    assert not jax.jit(jaxreg.register_global)(X, Y, network=network).valid


@pytest.mark.parametrize("name", ["paper", *LEARNED])
def test_a_network_whose_weights_diverged_finds_nothing_valid(name):
    config = Config(network=name, model=SMALL)

    def run(x, y):
        variables = by_name.init_variables(jax.random.key(0), config)
        diverged = jax.tree.map(lambda w: w * jnp.nan, variables["params"])
        return by_name.register(variables | {"params": diverged}, x, y, config=config)

    found = jax.jit(run)(X, Y)
    assert not found.valid
    np.testing.assert_array_equal(found.transformation, np.eye(4))


SOLVED = {
    "fixed by their numbers": (lambda g, p: {"fixed": [0]}, "fixed"),
    "too few fixed": (lambda g, p: {"fixed": np.array([True])}, "fixed"),
    "trusted by their numbers": (lambda g, p: {"trusted": np.array([0]), "robust": True}, "trusted"),
    "weights for a mask": (lambda g, p: {"graph": g._replace(mask=np.full(4, 0.5))}, "mask"),
    "a mask that is too short": (lambda g, p: {"graph": g._replace(mask=np.ones(1, bool))}, "mask"),
    "one information for all": (
        lambda g, p: {"graph": g._replace(information=np.eye(6)[None])}, "information",
    ),
    "rotations alone informed": (
        lambda g, p: {"graph": g._replace(information=g.information[:, :3, :3])}, "information",
    ),
    "transforms for other edges": (
        lambda g, p: {"graph": g._replace(transform=jax.tree.map(lambda x: x[:2], g.transform))},
        "transform",
    ),
    "matrices for poses": (lambda g, p: {"initial": np.tile(np.eye(4), (5, 1, 1))}, "initial"),
    "poses of two lengths": (lambda g, p: {"initial": p._replace(rotation=p.rotation[:3])}, "initial"),
    "an edge to nowhere": (lambda g, p: {"graph": g._replace(source=np.full(4, 7))}, "source"),
    "not finite": (
        lambda g, p: {"initial": p._replace(translation=p.translation * np.nan)}, "not finite",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", members(SOLVED))
def test_poses_on_the_host_are_not_solved_of_wrong_arrays(name):
    """`optimize_poses` refuses all of these (tests/graph/test_optimize.py, tests/test_arguments.py)."""
    change, told = SOLVED[name]
    graph, poses = jax.tree.map(np.asarray, chain(jnp.asarray(X)))
    given = {"graph": graph, "initial": poses} | change(graph, poses)
    with pytest.raises(ValueError, match=told):
        jaxreg.solve_poses(given.pop("graph"), given.pop("initial"), **given)


def test_integers_for_a_mask_of_poses_are_refused_or_count_as_they_say():
    graph, poses = jax.tree.map(np.asarray, chain(jnp.asarray(X)))
    graph = graph._replace(mask=np.array([1, 1, 0, 1], np.uint8))
    try:
        found = jaxreg.solve_poses(graph, poses)
    except ValueError as error:
        assert "mask must be bool" in str(error)  # noqa: PT017 - either outcome is right
    else:
        expected = np.array([np.zeros(3), X[0], X[0] + X[1]])
        np.testing.assert_allclose(found.poses.translation[:3], expected, atol=1e-6)


def shape(*sizes, dtype=np.float32):
    return jax.ShapeDtypeStruct(sizes, dtype)


WRONG_FOR_PEERS = {
    "half precision": ((shape(N, 3, dtype=np.float16), None), "source has dtype float16"),
    "integers": ((shape(N, 3, dtype=np.int32), None), "source has dtype int32"),
    "a batch": ((shape(2, N, 3), None), "vmap"),
    "homogeneous": ((shape(N, 4), None), r"\(n, 3\)"),
    "a mask of integers": ((shape(N, 3), shape(N, dtype=np.int32)), "source_mask must be bool"),
    "a mask of another length": ((shape(N, 3), shape(N - 1, dtype=bool)), "source_mask must be bool"),
    "a mask in a column": ((shape(N, 3), shape(N, 1, dtype=bool)), "source_mask must be bool"),
    "parameters alone": ((shape(N, 3), None), "variables|load_"),
}  # fmt: skip
WITH_PEERS = {f"{peer}, {what}": (peer, what) for peer in LEARNED for what in WRONG_FOR_PEERS}


@pytest.mark.parametrize("name", members(WITH_PEERS))
def test_other_networks_refuse_wrong_arrays(name):
    peer, what = WITH_PEERS[name]
    config = Config(network=peer)
    (source, mask), told = WRONG_FOR_PEERS[what]

    def run(source, mask):
        variables = by_name.init_variables(jax.random.key(0), config)
        if what == "parameters alone":
            variables = variables["params"]
        return LEARNED[peer].register(
            variables, source, jnp.asarray(Y), config=getattr(config, peer), source_mask=mask
        )

    with pytest.raises(ValueError, match=told):
        jax.eval_shape(run, source, mask)


@pytest.mark.parametrize("name", members(["idam", "rpmnet", "fmr"]))
def test_a_loss_outside_of_a_batch_works_or_says_what_to_do(name):
    try:
        jax.eval_shape(peer_loss(name), shape(N, 3))
    except ValueError as error:
        assert "vmap" in str(error)  # noqa: PT017 - either outcome is right


# --- D16: numbers of every kind ----------------------------------------------------------------------

BOTH = {
    "icp": lambda x, y: jaxreg.icp(x, y, config=FEW).transformation,
    "knn": lambda x, y: jaxreg.knn(x, 5),
    "normals": lambda x, y: jaxreg.normals(x, jaxreg.knn(x, 5)),
    "robust_procrustes": lambda x, y: jaxreg.to_matrix(
        jaxreg.robust_procrustes(x, y, jnp.ones(N, x.dtype), rounds=2)
    ),
    "pose_uncertainty": lambda x, y: jaxreg.pose_uncertainty(IDENTITY, x, y).information,
    "optimize_poses": lambda x, y: optimized(x[:4]),
}


@pytest.mark.parametrize("name", members(BOTH, slow=["optimize_poses"]))
def test_float32_is_the_same_whatever_the_flag_says_and_float64_is_finer(name):
    function = BOTH[name]
    free = np.asarray(jax.jit(function)(X, Y))
    with jax.enable_x64(True):
        narrow = np.asarray(jax.jit(lambda x, y: function(x, y))(X, Y))
        wide = np.asarray(jax.jit(lambda x, y: function(x, y))(*map(np.float64, (X, Y))))
    again = np.asarray(jax.jit(lambda x, y: function(x, y))(X, Y))
    assert narrow.dtype == free.dtype
    assert wide.dtype == (np.float64 if free.dtype == np.float32 else free.dtype)
    np.testing.assert_array_equal(again, free)
    np.testing.assert_allclose(narrow, free, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(wide, free, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", members(LEARNED, slow=["idam"]))
def test_fresh_weights_are_the_same_whatever_the_flag_says(name):
    config = Config(network=name)
    free = jax.jit(lambda: by_name.init_variables(jax.random.key(3), config))()
    with jax.enable_x64(True):
        wide = jax.jit(lambda: by_name.init_variables(jax.random.key(3), config))()
    jax.tree.map(np.testing.assert_array_equal, free, wide)
    assert {x.dtype for x in jax.tree.leaves(wide)} == {np.dtype(np.float32)}


MIXED = {
    "information of numpy": lambda g, p: (g._replace(information=np.tile(np.eye(6), (4, 1, 1))), p),
    "float64 starts": lambda g, p: (g, jax.tree.map(np.float64, p)),
    "half information": lambda g, p: (g._replace(information=g.information.astype(np.float16)), p),
    "whole information": lambda g, p: (g._replace(information=g.information.astype(np.int32)), p),
    "half transforms": lambda g, p: (
        g._replace(transform=jax.tree.map(lambda x: x.astype(np.float16), g.transform)), p,
    ),
    "whole starts": lambda g, p: (g, jax.tree.map(lambda x: x.astype(np.int32), p)),
}  # fmt: skip


@pytest.mark.loose
@pytest.mark.parametrize("name", members(MIXED))
def test_numbers_of_two_kinds_in_a_pose_graph_are_refused_by_name(name):
    with jax.enable_x64(True):
        graph, poses = MIXED[name](*jax.tree.map(np.asarray, chain(jnp.asarray(X))))
        with pytest.raises(ValueError, match=r"dtype.*float|float.*dtype"):
            jax.eval_shape(lambda g, p: jaxreg.optimize_poses(g, p, iterations=2), graph, poses)


STREAMS = {
    "half precision": ([X.astype(np.float16)], [Y], "float16"),
    "integers": ([X.astype(np.int32)], [Y], r"sources\[0\].*int"),
    "a second cloud of integers": ([X, X.astype(np.int64)], [Y, Y], r"sources\[1\].*int"),
    "one point per column": ([X.T], [Y], r"sources\[0\] has shape \(3, 40\)"),
    "one cloud in place of many": (X, Y, r"sources\[0\] has shape \(3,\)"),
    "more sources": ([X, X], [Y], r"references\[1\]"),
}


@pytest.mark.parametrize("name", members(STREAMS))
def test_streams_of_wrong_clouds_are_refused_by_number(name):
    sources, references, told = STREAMS[name]
    variables = jax.eval_shape(lambda: jaxreg.init_variables(jax.random.key(0), SMALL))
    variables = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), variables)
    with pytest.raises(ValueError, match=told):
        list(jaxreg.register_batch(variables, sources, references, config=SMALL))


# --- D17: composition --------------------------------------------------------------------------------


def by_scan(frames):
    def step(pose, frame):
        found = jaxreg.icp(frame, Y, initial=pose, config=FEW)
        return found.transform, found.translation

    return jax.lax.scan(step, IDENTITY, frames)[1]


def by_loop(frames):
    pose, told = IDENTITY, []
    for frame in frames:
        pose = jaxreg.icp(frame, Y, initial=pose, config=FEW).transform
        told.append(pose.translation)
    return jnp.stack(told)


FRAMES = np.stack([X, X + np.float32(0.02), X + np.float32(0.04)])
MASKS = np.arange(N)[None] < np.array([[N], [25], [0]])


def moved(shift):
    return jaxreg.icp(X + jnp.broadcast_to(shift, X.shape), Y, config=FEW).translation


def stepped(pose):
    return jaxreg.icp(X, Y, initial=pose, config=FEW).transform


COMPOSED = {
    "scan over frames": (by_scan, by_loop, (FRAMES,)),
    "while_loop": (
        lambda x: jax.lax.while_loop(
            lambda c: c[1] < 2, lambda c: (stepped(c[0]), c[1] + 1), (IDENTITY, 0)
        )[0].translation + 0 * x,
        lambda x: stepped(stepped(IDENTITY)).translation,
        (np.float32(0),),
    ),
    "cond under vmap": (
        jax.vmap(lambda go: jax.lax.cond(go, lambda: moved(0.0), lambda: jnp.zeros(3, np.float32))),
        lambda go: jnp.stack([moved(0.0), jnp.zeros(3, np.float32)]),
        (np.array([True, False]),),
    ),
    "vmap over masks": (
        jax.vmap(lambda m: jaxreg.icp(jnp.where(m[:, None], X, jnp.nan), Y, source_mask=m, config=FEW)
                 .translation),
        lambda masks: jnp.stack([
            jaxreg.icp(X[:n], Y, config=FEW).translation if n else jnp.zeros(3, np.float32)
            for n in (N, 25, 0)]),
        (MASKS,),
    ),
    "vmap over starts": (
        jax.vmap(lambda t: stepped(RigidTransform(IDENTITY.rotation, t)).translation),
        lambda shifts: jnp.stack([
            stepped(RigidTransform(IDENTITY.rotation, t)).translation for t in shifts]),
        (np.array([[0, 0, 0], [0.05, 0, 0]], np.float32),),
    ),
    "vmap over distances": (
        jax.vmap(lambda d: jaxreg.gicp(X, Y, max_correspondence_distance=d, config=FEW).inliers),
        lambda distances: jnp.array([0, N], jnp.int32),
        (np.array([1e-6, 50], np.float32),),
    ),
    "checkpoint": (
        jax.grad(lambda s: jax.checkpoint(moved)(s).sum()), jax.grad(lambda s: moved(s).sum()),
        (np.zeros(3, np.float32),),
    ),
    "linearize": (
        lambda s: jax.linearize(moved, s)[1](jnp.ones_like(s)),
        lambda s: jax.jvp(moved, (s,), (jnp.ones_like(s),))[1], (np.zeros(3, np.float32),),
    ),
    "vmapped cotangents": (
        lambda s: jax.vmap(jax.vjp(moved, s)[1])(jnp.eye(3, dtype=np.float32))[0], jax.jacfwd(moved),
        (np.zeros(3, np.float32),),
    ),
    "map_pairs of a named argument": (
        lambda f: jaxreg.map_pairs(lambda a, m: jaxreg.icp(a, Y, source_mask=m, config=FEW).inliers)(
            f, m=jnp.asarray(MASKS)),
        lambda f: jnp.array([N, 25, 0], jnp.int32), (FRAMES,),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", members(COMPOSED))
def test_a_composition_gives_what_plain_calls_give(name):
    composed, plain, inputs = COMPOSED[name]
    inputs = jax.tree.map(jnp.asarray, inputs)
    found, expected = jax.jit(composed)(*inputs), jax.jit(plain)(*inputs)
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_the_second_derivative_of_a_pose_is_the_difference_of_the_first():
    with jax.enable_x64(True):
        x, y, _ = two_clouds(dtype=np.float64)

        def loss(shift):
            scaled = x * (1 + shift[0]) + shift[None, :] * x[:, ::-1]
            found = jaxreg.robust_procrustes(scaled, y, np.ones(N), rounds=1)
            return jnp.sum(jnp.sin(found.rotation)) + jnp.sum(found.translation**2)

        at = jnp.array([0.1, -0.2, 0.3])
        gradient = jax.jit(jax.grad(loss))
        steps = 1e-5 * np.eye(3)
        expected = np.stack([(gradient(at + h) - gradient(at - h)) / 2e-5 for h in steps])
        np.testing.assert_allclose(jax.jit(jax.hessian(loss))(at), expected, atol=1e-6)


MESHED = {
    "normals": lambda x, y: jaxreg.normals(x, jaxreg.knn(x, 5)),
    "robust_procrustes": lambda x, y: jaxreg.robust_procrustes(x, y, ONES, rounds=2).rotation,
    "point_to_plane": lambda x, y: jaxreg.point_to_plane(x, y, config=FEW).rotation,
    "pose_uncertainty": lambda x, y: jaxreg.pose_uncertainty(IDENTITY, x, y).information,
    "gradient of icp": jax.grad(lambda x, y: jaxreg.icp(x, y, config=FEW).translation[0]),
    "gradient of implicit gicp": jax.grad(lambda x, y: jaxreg.gicp(x, y, config=IMPLICIT).residual),
    "optimize_poses": lambda x, y: optimized(x[:4]),
} | {
    name: lambda x, y, name=name: by_name.register(
        by_name.init_variables(jax.random.key(0), Config(network=name)), x, y,
        config=Config(network=name),
    ).rotation
    for name in LEARNED
}  # fmt: skip
PAIRS = PartitionSpec("pairs")


@pytest.mark.loose
@pytest.mark.parametrize("name", members(MESHED))
def test_shard_map_with_its_check_is_traced(name):
    """Types are checked on a mesh of one device as on one of many."""
    mesh = jax.make_mesh((1,), ("pairs",), axis_types=(AxisType.Auto,))
    one = jax.shard_map(jax.vmap(MESHED[name]), mesh=mesh, in_specs=PAIRS, out_specs=PAIRS)
    clouds = shape(2, N, 3)
    assert jax.eval_shape(jax.jit(one), clouds, clouds).shape[0] == 2


@pytest.mark.loose
@pytest.mark.parametrize("name", members(MESHED))
def test_a_mesh_of_explicit_axes_is_traced(name):
    mesh = jax.make_mesh((1,), ("pairs",))
    clouds = jax.ShapeDtypeStruct((2, N, 3), np.float32, sharding=NamedSharding(mesh, PAIRS))
    with jax.set_mesh(mesh):
        found = jax.eval_shape(jax.jit(jax.vmap(MESHED[name])), clouds, clouds)
    assert found.shape[0] == 2


DEVICES = """
import sys
import jax, numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec
sys.path.insert(0, {root!r})
from tests.kinds import test_pipelines as here
clouds = np.stack([here.X, here.Y]), np.stack([here.Y, here.X])
mesh = jax.make_mesh((2,), ("pairs",), axis_types=(AxisType.Auto,))
placed = [jax.device_put(x, NamedSharding(mesh, here.PAIRS)) for x in clouds]
for name in sys.argv[1].split(","):
    one = jax.vmap(here.MESHED[name])
    want = jax.jit(one)(*clouds)
    forms = {{
        "shard_map": jax.jit(jax.shard_map(one, mesh=mesh, in_specs=here.PAIRS, out_specs=here.PAIRS)),
        "pmap": jax.pmap(here.MESHED[name]),
        "sharded": lambda *_: jax.jit(one)(*placed),
    }}
    for form, call in forms.items():
        found = call(*clouds)
        np.testing.assert_allclose(found, want, rtol=1e-4, atol=1e-4, err_msg=f"{{name}} {{form}}")
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "names", ["normals,robust_procrustes,point_to_plane", "pose_uncertainty,dcp"]
)
def test_on_two_devices_there_is_what_vmap_gives(names):
    flags = "--xla_force_host_platform_device_count=2 --xla_backend_optimization_level=0"
    code = DEVICES.format(root=str(Path(__file__).parents[2]))
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", code, names], env=environment, check=True, timeout=300)


EXPORTED = {
    "point_to_plane": (lambda x, y: jaxreg.point_to_plane(x, y, config=FEW), (X, Y)),
    "gradient of icp": (MESHED["gradient of icp"], (X, Y)),
    "pair": (lambda x, m: Pair(PointCloud(x, m), PointCloud(x, m), IDENTITY), (X, MASKS[0])),
    "pose_uncertainty": (lambda x, y: jaxreg.pose_uncertainty(IDENTITY, x, y), (X, Y)),
    "optimize_poses": (lambda x: jaxreg.optimize_poses(*chain(x), iterations=2), (X[:4],)),
    "search_poses": (jaxreg.search_poses, (X, Y)),
}


@pytest.mark.parametrize("name", members(EXPORTED))
def test_programs_that_return_our_records_are_saved(name):
    pytest.importorskip("flatbuffers", reason="jax.export saves programs with flatbuffers")
    function, inputs = EXPORTED[name]
    program = export.export(jax.jit(function))(*inputs)
    again = export.deserialize(program.serialize())
    assert again.out_tree == program.out_tree


def test_a_program_of_symbolic_sizes_finds_the_pose_at_two_of_them():
    n, m = export.symbolic_shape("n, m", constraints=["n >= 16", "m >= 16", "n <= 99", "m <= 99"])
    clouds = shape(n, 3), shape(m, 3)
    program = export.export(jax.jit(lambda x, y: jaxreg.icp(x, y).transformation))(*clouds)
    call = export.deserialize(program.serialize()).call
    expected = jaxreg.to_matrix(jax.tree.map(jnp.asarray, TRUTH))
    for rows in (N, 30):
        np.testing.assert_allclose(call(X[:rows], np.tile(Y, (2, 1))), expected, atol=1e-5)


UNDER = {
    "vmap": lambda call, x: jax.eval_shape(jax.vmap(lambda a: call(a, x).rotation), shape(2, N, 3)),
    "grad": lambda call, x: jax.eval_shape(jax.grad(lambda a: call(a, x).rotation[0, 0]), x),
    "jit": lambda call, x: jax.eval_shape(lambda a: call(a, x).rotation, x),
    "scan": lambda call, x: jax.eval_shape(
        lambda a: jax.lax.map(lambda b: call(b, x).rotation, a), shape(2, N, 3)
    ),
}


@pytest.mark.parametrize("name", members(UNDER))
def test_a_loaded_program_composes_or_says_what_to_do(name):
    call = jaxreg.load_exported(PROGRAM)
    try:
        UNDER[name](call, jnp.asarray(X))
    except ValueError as error:
        assert re.search("map_pairs|lax.map|jaxreg export|register_global", str(error))  # noqa: PT017


def test_a_batch_of_a_loaded_program_is_what_its_copy_gives_pair_by_pair():
    program = jaxreg.load_exported(PROGRAM)
    again = pickle.loads(pickle.dumps(program))
    found = jax.vmap(program, in_axes=(0, None))(FRAMES, Y)
    for frame, transformation in zip(FRAMES, found.transformation, strict=True):
        np.testing.assert_allclose(again(frame, Y).transformation, transformation, atol=1e-5)


def test_records_settings_and_prepared_scans_survive_pickling():
    targets = np.random.default_rng(0).normal(size=(9, 3))
    records = [
        jaxreg.icp(X, Y, config=FEW),
        jaxreg.solve_poses(*jax.tree.map(np.asarray, chain(jnp.asarray(X)))),
        jaxreg.register(targets, targets + 1),
        jaxreg.prepare(targets),
        jaxreg.RegisterConfig(),
        jaxreg.SearchConfig(),
        FEW,
    ]
    for record in records:
        again = pickle.loads(pickle.dumps(record))
        assert type(again) is type(record)
        assert_same(again, record)


def assert_same(one, other):
    """Records, and what is in them, are alike."""
    if dataclasses.is_dataclass(one):
        one, other = vars(one), vars(other)
    if isinstance(one, dict):
        one, other = tuple(one.values()), tuple(other.values())
    if isinstance(one, tuple):
        for part, like in zip(one, other, strict=True):
            assert_same(part, like)
    else:
        np.testing.assert_array_equal(one, other)


def test_a_loaded_program_goes_to_a_worker_or_says_how():
    program = jaxreg.load_exported(PROGRAM)
    try:
        again = pickle.loads(pickle.dumps(program))
    except (TypeError, ValueError) as error:
        assert "load_exported" in str(error)  # noqa: PT017 - either outcome is right
    else:
        assert again.points == program.points


KEYS = {
    "old": lambda: jax.random.PRNGKey(7),
    "numbers": lambda: np.asarray(jax.random.key_data(jax.random.key(7))),
    "new": lambda: jax.random.key(7, impl="threefry2x32"),
}


@pytest.mark.parametrize("name", members(KEYS))
def test_keys_of_every_kind_draw_the_same(name):
    config = jaxreg.PairConfig(points=N, kept=30)
    expected = jaxreg.make_pair(jax.random.key(7), X, config)
    found = jaxreg.make_pair(KEYS[name](), X, config)
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    one, other = (jaxreg.init_variables(key, SMALL) for key in (KEYS[name](), jax.random.key(7)))
    jax.tree.map(np.testing.assert_array_equal, one, other)


# --- D18: training and evaluating by others' habits --------------------------------------------------

TOML = """
[model]
channels = [4, 8]
width = 8
n_inliers = 12
iterations = 2
k = 3
[pairs]
points = 32
kept = 24
[data]
name = "shapes"
train_shapes = 8
test_shapes = 4
[train]
steps = 400
batch = 2
validate_every = 400
validation_pairs = 2
"""


class Began(Exception):
    """The first step of a training."""


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys):
    """`jaxreg ARGUMENTS` beside c.toml: exit status, output, error output; trainings only begin."""

    def began(*_, **__):
        raise Began

    monkeypatch.setattr(process, "enable_compilation_cache", lambda **_: None)
    monkeypatch.setattr(process, "restart_with_huge_pages", lambda: None)
    monkeypatch.setattr(training, "_train_step_jit", began)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "c.toml").write_text(TOML)

    def run(*arguments):
        try:
            status = main([str(part) for part in arguments])
        except SystemExit as end:
            status = end.code
        return status, *capsys.readouterr()

    return run


MISTYPED = {
    "another's name of an option": (["c.toml", "--train.lr", "0.1"], None, "train.lr"),
    "a section": (["c.toml", "--trian.steps", "3"], None, "trian.steps"),
    "a float for a count": (["c.toml", "--train.steps", "1e3"], None, "train.steps"),
    "a choice": (["c.toml", "--model.one-nn", "gathr"], None, "one-nn"),
    "not a number": (["c.toml", "--pairs.rotation-max-deg", "nan"], None, "rotation_max_deg"),
    "a section of the file": (["d.toml"], TOML.replace("[train]", "[trian]"), "mean 'train'"),
    "a field of the file": (["d.toml"], TOML.replace("steps =", "step ="), "mean 'steps'"),
    "quotes around a number": (["d.toml"], TOML.replace("400\nb", '"400"\nb'), "steps.*must be int"),
    "a section twice": (["d.toml"], TOML + "[train]\nema = 0.5\n", "not valid TOML"),
    "a number for a section": (["d.toml"], "model = 3\n", "'model' is a section"),
    "weights": (["c.toml", "--weights", "nothing"], None, "'nothing'"),
    "more test points kept than there are": (["c.toml", "--test-pairs.kept", "40"], None, "kept"),
    "fewer test points kept than inliers": (["c.toml", "--test-pairs.kept", "10"], None, "inliers"),
}  # fmt: skip


@pytest.mark.loose
@pytest.mark.parametrize("name", members(MISTYPED))
def test_what_is_mistyped_is_refused_before_the_training(tmp_path, shell, name):
    arguments, content, told = MISTYPED[name]
    if content:
        (tmp_path / "d.toml").write_text(content)
    status, _, err = shell("train", *arguments)
    assert status == 2
    assert re.search(told, err)
    assert "Traceback" not in err


@pytest.mark.loose
def test_a_configuration_with_a_byte_order_mark_trains(tmp_path, shell):
    (tmp_path / "d.toml").write_bytes(b"\xef\xbb\xbf" + TOML.encode())
    with pytest.raises(Began):
        shell("train", "d.toml")


def truth_of(toml):
    config = jaxreg.load_config(toml)
    batches = score.pair_stream(config, root=None).batches()
    pairs = [jax.tree.map(lambda x, n=n: np.asarray(x)[:n], p.transform) for p, n in batches]
    return jax.tree.map(lambda *x: np.concatenate(x), *pairs)


def matrices(rotation, translation):
    whole = np.tile(np.eye(4, dtype=rotation.dtype), (len(rotation), 1, 1))
    whole[:, :3, :3], whole[:, :3, 3] = rotation, translation
    return whole


def inverted(rotation, translation):
    back = np.linalg.inv(matrices(rotation, translation).astype(float))
    return {"rotation": back[:, :3, :3], "translation": back[:, :3, 3]}


POSES = {
    "right": (lambda r, t: {"rotation": r, "translation": t}, 0, ""),
    "right, in single files' order": (
        lambda r, t: {"translation": t.astype(float), "rotation": r.astype(float)}, 0, "",
    ),
    "for row vectors": (
        lambda r, t: {"rotation": r.swapaxes(1, 2), "translation": t}, 0, "row vectors",
    ),
    "inverse": (inverted, 0, "from reference to source"),
    "matrices": (lambda r, t: {"rotation": matrices(r, t), "translation": t}, 2, r"\(4, 3, 3\)"),
    "a matrix beside a name": (lambda r, t: {"transformation": matrices(r, t)}, 2, "rotation"),
    "mirrored": (lambda r, t: {"rotation": -r, "translation": t}, 2, "rotation"),
    "scaled": (lambda r, t: {"rotation": 1.1 * r, "translation": t}, 2, "rotation"),
    "not finite": (lambda r, t: {"rotation": r * np.nan, "translation": t}, 2, "finite|NaN"),
    "one missing": (lambda r, t: {"rotation": r[1:], "translation": t[1:]}, 2, "4 pairs need"),
    "columns": (lambda r, t: {"rotation": r, "translation": t[..., None]}, 2, r"\(4, 3\)"),
    "angles": (
        lambda r, t: {"rotation": Rotation.from_matrix(r).as_rotvec(), "translation": t}, 2,
        r"\(4, 3, 3\)",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", members(POSES))
def test_poses_of_another_program_are_scored_or_named(tmp_path, shell, name):
    change, expected, told = POSES[name]
    np.savez(tmp_path / "t.npz", **change(*truth_of(tmp_path / "c.toml")))
    status, out, err = shell("evaluate", "c.toml", "--transforms", "t.npz", "--json", "r.json")
    assert status == expected
    if expected:
        assert re.search(told, err)
        assert len(err.strip().splitlines()) == 1
    else:
        said = " ".join((out + err).split())
        assert (told in said) if told else ("transposed" not in said)


# --- D19: cost ---------------------------------------------------------------------------------------


def clouds_of(n, m):
    return shape(n, 3), shape(m, 3)


C = jaxreg.RefineConfig
MEMORY = {
    "point_to_plane": (lambda x, y: jaxreg.point_to_plane(x, y, config=FEW), clouds_of(30_000, 30_000)),
    "pose_uncertainty": (
        lambda x, y: jaxreg.pose_uncertainty(IDENTITY, x, y), clouds_of(30_000, 30_000),
    ),
    "both directions": (
        lambda x, y: jaxreg.gicp(x, y, config=C(iterations=3, both_directions=True)),
        clouds_of(30_000, 30_000),
    ),
    "trimmed": (
        lambda x, y: jaxreg.icp(x, y, config=C(iterations=3, trim=0.7)), clouds_of(30_000, 30_000),
    ),
    "normals": (lambda x, y: jaxreg.normals(x, jaxreg.knn(x, 20)), clouds_of(30_000, 1)),
    "map_pairs": (
        jaxreg.map_pairs(lambda x, y: jaxreg.icp(x, y, config=FEW)), (shape(4, 8192, 3),) * 2,
    ),
    "a submap in a map": (lambda x, y: jaxreg.icp(x, y, config=FEW), clouds_of(2048, 200_000)),
    "normals of a map": (lambda x, y: jaxreg.normals(x, jaxreg.knn(x, 20)), clouds_of(200_000, 1)),
}  # fmt: skip


@pytest.mark.parametrize("name", members(MEMORY))
def test_memory_of_large_clouds_stays_below_a_gigabyte(name):
    function, arguments = MEMORY[name]
    compiled = jax.jit(function).lower(*arguments).compile()
    assert compiled.memory_analysis().temp_size_in_bytes < 2**30


def compilations(caplog, calls):
    caplog.clear()
    with jax.log_compiles():
        for call in calls:
            call()
    return [text for text in caplog.messages if text.startswith("Compiling")]


RNG = np.random.default_rng(11)
COUNTS = {
    "targets": (lambda n: jaxreg.register(p := RNG.normal(size=(5 + n % 55, 3)), p + 1), 12, 1),
    "plans": (lambda n: jaxreg.register(contour(n, n), contour(n + 99, 7)), 6, 12),
    "refinements on the host": (
        lambda n: refine_on_host(*(RNG.normal(size=(n + 300, 3)) for _ in range(2)), config=FEW), 8, 12,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", members(COUNTS, slow=["refinements on the host", "plans"]))
def test_a_handful_of_programs_serve_clouds_of_every_size(caplog, name):
    function, calls, most = COUNTS[name]
    sizes = np.random.default_rng(1).integers(100, 3000, calls)
    found = compilations(caplog, [lambda n=int(n): function(n) for n in sizes])
    assert len(found) <= most


def test_a_stream_of_pairs_of_every_size_needs_thirty_programs(monkeypatch):
    seen = set()

    def run(_, part, together, config):
        seen.update(tuple(map(len, pair.clouds)) for pair in part)
        return {pair.number: pair.number for pair in part}

    monkeypatch.setattr(batch, "_run", run)
    sizes = np.random.default_rng(0).integers(300, 3000, (400, 2))
    streams = ([np.zeros((n, 3), np.float32) for n in column] for column in sizes.T)
    assert list(jaxreg.register_batch({}, *streams, config=SMALL)) == list(range(400))
    assert len(seen) <= 30
