"""Every public function of the numerical rooms under every transform of JAX.

The table below names each one with generic and degenerate inputs. For every row: jit equals eager,
vmap equals a loop, forward mode equals reverse mode, both are finite, and on generic inputs they equal
central differences in float64. A public function that is not in the table fails the test.
"""

import functools
import importlib
import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxreg
from tests.compiled import AS_USERS
from tests.transforms.core_rows import core_rows
from tests.transforms.judge_rows import judge_rows
from tests.transforms.network_rows import network_and_model_rows
from tests.transforms.refine_rows import refine_rows
from tests.transforms.rows import Row
from tests.transforms.search_rows import search_rows

HOST = {
    "config.load_config",
    "weights.released.available_weights",
    "weights.released.load_pretrained",
}
HOST |= {"scans.pair.register", "geometry.frame.check_clouds", "refine.config.check_options"}
HOST |= {"refine.uncertainty.weak_directions", "refine.uncertainty.about"}
HOST |= {"refine.gicp.generalized", "refine.methods.method_of"}
HOST |= {"geometry.rigid.rotation_angle_deg", "geometry.rigid.nearest_rotation"}
HOST |= {"geometry.frame.measure"}
HOST |= {"search.learned.load_features", "search.learned.feature_config"}
HOST |= {"search.learned.check_network", "search.description.check_cloud"}
HOST |= {"search.stages.check_transform"}
HOST |= {"search.learned.init_network"}
HOST |= {
    "io.read_cloud",
    "io.writing.write_cloud",
    "view.page.write_page",
    "view.pictures.plot_pair",
}
HOST |= {"view.page.write_registration_page", "scans.prepare.prepare", "training.train"}
HOST |= {"peers.rienet.load_rienet", "weights.checkpoint.load_checkpoint"}
HOST |= {"data.procedural.shapes.sample_shape", "refine.config.RefineConfig"}
"""No transform applies to what reads files, numpy arrays on the host, shapes alone or a random key."""
ELSEWHERE = {"batching.map_pairs", "data.pairs.make_pair"}
"""Transformed in their own tests: tests/test_batching.py and tests/data/test_pairs.py."""
OF_JAXLIE = {"geometry.rigid.to_jaxlie", "geometry.rigid.from_jaxlie"}
"""Need a package that may be missing: tests/geometry/test_rigid.py transforms them where it is."""
HALVES = {"network.matching.gather_rows", "network.matching.collect_rows"}
"""Of `neighborhood_sum` and of its transpose, which knows one as the derivative of the other."""
ROOMS = (
    "geometry.numerics",
    "geometry.eigen3x3",
    "geometry.rigid",
    "geometry.neighbors",
    "geometry.procrustes",
    "network.features",
    "network.matching",
    "network.matching_blocks",
    "network.invariants",
    "network.inliers",
    "network.model",
    "network.losses",
    "geometry.frame",
    "refine.config",
    "refine.cost",
    "refine.gauss_newton",
    "refine.solve",
    "refine.methods",
    "refine.gicp",
    "refine.point_to_point",
    "geometry.normals",
    "refine.correspondences",
    "refine.point_to_plane",
    "refine.uncertainty",
    "refine.robust",
    "judge.evidence",
    "judge.odds",
    "judge.surface",
    "search.alignment",
    "search.candidates",
    "search.compatibility",
    "search.description",
    "search.descriptors",
    "search.hypotheses",
    "search.learned",
    "search.nearest",
    "search.pipeline",
    "search.ranking",
    "search.stages",
    "search.surface",
)

TABLE = core_rows() | network_and_model_rows() | refine_rows() | search_rows() | judge_rows()


def public_functions() -> set[str]:
    """Functions and networks that the numerical rooms define under a public name."""
    names = set()
    for room in ROOMS:
        module = importlib.import_module(f"jaxreg.{room}")
        for name, value in vars(module).items():
            record = inspect.isclass(value) and issubclass(value, tuple)
            if name.startswith("_") or not callable(value) or record:
                continue
            if getattr(value, "__module__", None) == module.__name__:
                names.add(f"{room}.{name}")
    for name in jaxreg.__all__:
        value = getattr(jaxreg, name)
        if inspect.isfunction(value):
            names.add(f"{value.__module__.removeprefix('jaxreg.')}.{name}")
    return names - HOST - HALVES - ELSEWHERE - OF_JAXLIE


def test_every_public_function_is_in_the_table():
    missing, gone = public_functions() - set(TABLE), set(TABLE) - public_functions()
    assert not missing, f"give {sorted(missing)} a row in the table of tests/transforms"
    assert not gone, f"take {sorted(gone)} out of the table of tests/transforms"


@pytest.fixture
def row(request):
    """A row of the table, with JAX's promotion as it asks for."""
    row = TABLE[request.param]
    if row.loose:
        jax.config.update("jax_numpy_dtype_promotion", "standard")
    return row


def rows(names, *, slow=()):
    marked = [pytest.param(n, n, marks=pytest.mark.slow if n in slow else ()) for n in names]
    return pytest.mark.parametrize(("name", "row"), marked, indirect=["row"])


each_row = rows(sorted(name for name, row in TABLE.items() if row.generic and not row.parts))


def is_float(x: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


def floating(row: Row, inputs: tuple):
    """The function of its floating inputs and outputs alone, as lists of arrays, and its inputs."""
    leaves, tree = jax.tree.flatten(inputs)
    where = [i for i, leaf in enumerate(leaves) if is_float(leaf)]

    def function(values, leaves):
        leaves = list(leaves)
        for i, value in zip(where, values, strict=True):
            leaves[i] = value
        outputs = jax.tree.leaves(row.function(*jax.tree.unflatten(tree, leaves)))
        return [x for x in outputs if is_float(x)]

    return function, [leaves[i] for i in where], leaves


@functools.cache
def compiled(name: str) -> tuple[Callable, Callable]:
    """The value, and both derivatives along directions, of a row; one compilation for each shape."""
    row = TABLE[name]

    @functools.partial(jax.jit, static_argnums=0)
    def both_modes(shape, values, leaves, direction, cotangent):
        function, *_ = floating(row, jax.tree.unflatten(shape, leaves))

        def of_values(values):
            return function(values, leaves)

        outputs, tangent = jax.jvp(of_values, (values,), (direction,))
        _, pull = jax.vjp(of_values, values)
        return outputs, tangent, pull(cotangent)[0]

    return both_modes


def assert_close(a, b, tolerance):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        x, y = np.asarray(x), np.asarray(y)
        scale = max(1.0, np.abs(np.where(np.isfinite(y), y, 0)).max(initial=0))
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance * scale)


def arrays(inputs):
    return jax.tree.map(jnp.asarray, inputs)


@functools.cache
def jitted(name: str) -> Callable:
    return jax.jit(TABLE[name].function)


@each_row
def test_jit_equals_eager(name, row):
    for inputs in (row.generic, *row.degenerate[:1]):
        assert_close(jitted(name)(*inputs), row.function(*arrays(inputs)), row.rounding)


@each_row
def test_vmap_equals_a_loop(name, row):
    leaves, tree = jax.tree.flatten(row.generic)
    batch = [
        np.stack([x, 0.9 * x, x[::-1] if np.ndim(x) else x]) if is_float(x) else np.stack([x] * 3)
        for x in leaves
    ]
    together = jax.jit(jax.vmap(row.function))(*jax.tree.unflatten(tree, batch))
    for i in range(3):
        one = jitted(name)(*jax.tree.unflatten(tree, [x[i] for x in batch]))
        assert_close(jax.tree.map(lambda x, i=i: x[i], together), one, 10 * row.rounding)


def derivatives(name, row, inputs, rng):
    """A random direction, outputs, both derivatives, and a function of a step along the direction.

    The inner products of the forward and of the reverse derivative with a random cotangent, which
    must be equal, come last.
    """
    _, values, leaves = floating(row, inputs)
    direction = [rng.normal(size=np.shape(x)) for x in values]
    tree = jax.tree.structure(inputs)
    shapes = jax.eval_shape(floating(row, inputs)[0], values, leaves)
    cotangent = [rng.normal(size=x.shape) for x in shapes]

    def at(step):
        moved = [x + step * d for x, d in zip(values, direction, strict=True)]
        return compiled(name)(tree, moved, leaves, direction, cotangent)

    outputs, tangent, gradient = at(0.0)
    forward = sum(np.sum(c * t) for c, t in zip(cotangent, tangent, strict=True))
    reverse = sum(np.sum(d * g) for d, g in zip(direction, gradient, strict=True))
    return outputs, tangent, gradient, at, (forward, reverse)


DIFFERENTIABLE = sorted(name for name, row in TABLE.items() if row.generic)


WHOLE_SEARCHES = [
    name for name in DIFFERENTIABLE if name.startswith(("search.pipe", "search.stag"))
]


@rows(DIFFERENTIABLE, slow=WHOLE_SEARCHES)
def test_derivatives_at_generic_inputs(name, row, seed):
    rng = np.random.default_rng(seed)
    _, tangent, gradient, at, products = derivatives(name, row, row.generic, rng)
    for x in (*tangent, *gradient):
        assert np.isfinite(x).all()
    np.testing.assert_allclose(*products, rtol=1e-9, atol=1e-10)
    if not row.smooth:
        return
    step = 1e-6
    for t, a, b in zip(tangent, at(step)[0], at(-step)[0], strict=True):
        difference = (np.asarray(a) - np.asarray(b)) / (2 * step)
        scale = max(1.0, np.abs(difference).max(initial=0))
        np.testing.assert_allclose(t, difference, rtol=1e-6, atol=1e-7 * scale)


@pytest.mark.slow
@rows([name for name in DIFFERENTIABLE if TABLE[name].degenerate])
def test_derivatives_are_finite_and_modes_agree_at_degenerate_inputs(name, row, seed):
    rng = np.random.default_rng(seed)
    for number, inputs in enumerate(row.degenerate):
        outputs, tangent, gradient, _, (forward, reverse) = derivatives(name, row, inputs, rng)
        for x in (*outputs, *tangent, *gradient):
            assert np.isfinite(x).all(), f"degenerate input {number}"
        size = max(1.0, abs(forward))
        if row.kinks:
            assert max(abs(forward), abs(reverse)) < 1e6, f"degenerate input {number}"
        else:
            message = f"degenerate input {number}"
            np.testing.assert_allclose(reverse, forward, atol=1e-7 * size, err_msg=message)


@pytest.mark.slow
@rows(["network.losses.step_losses"])
def test_derivatives_hold_in_optimised_kernels_too(name, row, seed):
    """The other tests compile without LLVM's optimisation, which may round a repeated computation
    differently."""
    function, values, leaves = floating(row, row.generic)
    rng = np.random.default_rng(seed)
    direction = [rng.normal(size=np.shape(x)) for x in values]

    def both(values, direction):
        outputs, tangent = jax.jvp(lambda x: function(x, leaves), (values,), (direction,))
        _, pull = jax.vjp(lambda x: function(x, leaves), values)
        return outputs, tangent, pull([jnp.ones_like(x) for x in outputs])[0]

    outputs, tangent, gradient = jax.jit(both, compiler_options=AS_USERS)(values, direction)
    forward = sum(np.sum(t) for t in tangent)
    reverse = sum(np.sum(d * g) for d, g in zip(direction, gradient, strict=True))
    assert all(np.isfinite(x).all() for x in outputs)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)


@pytest.mark.untyped
@pytest.mark.parametrize(
    "row",
    ["geometry.neighbors.knn", "geometry.numerics.included_angle", "geometry.rigid.apply"],
    indirect=True,
)
def test_numpy_arrays_are_welcome(row):
    assert_close(row.function(*row.generic), row.function(*arrays(row.generic)), 1e-12)
