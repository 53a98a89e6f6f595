"""What the compiler made of it: the traps of SPEED, searched for in the program, not with a clock.

Every guard has a twin that must be caught, so that a change in how XLA writes its programs down
cannot make the guards blind. The programs are compiled for the CPU.
"""

import functools
import itertools
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.paper import transcription
from jaxreg import training
from jaxreg.config import from_dict
from jaxreg.evaluation import methods
from jaxreg.geometry import clouds, neighbors
from jaxreg.network import inliers, matching
from jaxreg.network.model import init_variables, register_pair
from jaxreg.types import Pair, PointCloud, RigidTransform
from tests.compiled import AS_USERS

READ = AS_USERS | {"xla_backend_optimization_level": 0}
"""LLVM comes after the text that is read here."""

# Sizes that tell the arrays apart: N x M x K exceeds whatever the networks or a stack over the
# iterations hold, and the number of iterations is the trip count of no other loop.
BATCH, N, M, K, ITERATIONS = 2, 144, 120, 6, 4
CONFIG = from_dict(
    {
        "model": {
            "k": K,
            "k_matching": K,
            "channels": [4, 8],
            "width": 8,
            "inlier_width": 2,
            "n_inliers": 32,
            "iterations": ITERATIONS,
        },
        "pairs": {"points": 192, "kept": N},
        "train": {"batch": BATCH},
    }
)

pytestmark = [
    pytest.mark.float32,
    pytest.mark.loose,
    pytest.mark.skipif(jax.default_backend() != "cpu", reason="the traps are those of XLA:CPU"),
]


def compiled(function, *inputs) -> str:
    """The text of the compiled program; `function` is jitted."""
    return function.lower(*inputs).compile(READ).as_text()


def array(*shape, dtype=jnp.float32):
    return jax.ShapeDtypeStruct(shape, dtype)


def sizes(text: str) -> list[int]:
    """Elements of every array that `text` names."""
    found = re.findall(r"\b(?:f32|f64|s32|u32|pred|bf16|s64|u64)\[([\d,]+)\]", text)
    return [math.prod(map(int, shape.split(","))) for shape in found]


def results(text: str, operation: str) -> list[str]:
    """What every `operation` of the program returns."""
    found = re.findall(rf"= (.+?) {operation}\(", text)
    return [x for x in found if "=" not in x]


def row_sorts(text: str) -> list[str]:
    """Sorts of more than one list of neighbours a cloud.

    Allowed are the lexicographic order of the n points in `knn` (which settles ties), the order of
    the n k entries of a graph in `incidence`, and permutations of a cloud: n log n, once a cloud.
    """
    return [x for x in results(text, "sort") if max(sizes(x)) > BATCH * N * K]


def fused_products(text: str, least: int) -> list[str]:
    """Results, of at least so many elements, of kernels of a product and what surrounds it."""
    bodies = dict(re.findall(r"^%?(\S+) \(.*?\) -> [^\n]*\{\n(.*?)^\}", text, re.M | re.S))
    called = re.findall(r"= (\S+) fusion\([^\n]*calls=%?([\w.-]+)[^\n]*__ynn_fusion", text)
    return [x for x, body in called if max(sizes(x)) >= least and is_fused_product(bodies[body])]


def is_fused_product(body: str) -> bool:
    operations = re.findall(r"= \S+ ([a-z-]+)\(", body)
    return "dot" in operations and set(operations) - {"dot", "parameter", "bitcast"} != set()


def wide_scatters(text: str, least: int) -> list[str]:
    """Scatters into arrays of at least so many elements."""
    return [x for x in results(text, "scatter") if max(sizes(x)) >= least]


def loops(text: str, trips: int) -> int:
    """Loops of the program that run so many times."""
    return len(re.findall(rf'"known_trip_count":{{"n":"{trips}"}}', text))


@pytest.fixture(scope="module")
def forward() -> str:
    variables = jax.eval_shape(lambda: init_variables(jax.random.key(0), CONFIG.model))
    one = functools.partial(register_pair, config=CONFIG)
    many = jax.jit(jax.vmap(one, in_axes=(None, 0, 0)))
    return compiled(many, variables, array(BATCH, N, 3), array(BATCH, M, 3))


@pytest.fixture(scope="module")
def evaluated() -> str:
    """A batch as `evaluate.py` takes it."""
    variables = jax.eval_shape(lambda: init_variables(jax.random.key(0), CONFIG.model))
    clouds = (PointCloud(array(BATCH, n, 3), array(BATCH, n, dtype=bool)) for n in (N, M))
    pair = Pair(*clouds, RigidTransform(array(BATCH, 3, 3), array(BATCH, 3)))
    run = functools.partial(methods._register_batch, config=CONFIG, padded=True)
    return compiled(jax.jit(run), variables, pair)


@pytest.fixture(scope="module")
def step() -> str:
    state = jax.eval_shape(lambda: training.create_train_state(CONFIG))
    run = jax.jit(functools.partial(training.train_step, config=CONFIG), donate_argnums=0)
    return compiled(run, state, array(3, 192, 3))


@pytest.fixture(params=["forward", "evaluated", "step"])
def program(request) -> str:
    return request.getfixturevalue(request.param)


def test_no_row_is_sorted(program):
    assert not row_sorts(program)
    # Both graphs and the choice of the inliers.
    assert program.count('custom_call_target="TopK"') >= 3


def sliced_top_k(points):
    """What `knn` would be without its barrier."""
    idx = jax.lax.top_k(-neighbors.squared_distances(points, points), K)[1]
    return idx[:, 1:], idx[:, 0]


@pytest.mark.parametrize(
    "search", [sliced_top_k, functools.partial(transcription.neighborhoods, k=K)]
)
def test_a_sort_of_rows_would_be_seen(search):
    assert row_sorts(compiled(jax.jit(jax.vmap(search)), array(BATCH, N, 3)))


def test_searches_are_one_selection_each():
    text = compiled(jax.jit(lambda x: neighbors.knn(x, K)), array(N, 3))
    assert text.count('custom_call_target="TopK"') == 1
    text = compiled(jax.jit(lambda w: inliers.select_inliers(w, 32)), array(N))
    assert text.count('custom_call_target="TopK"') == 1
    assert not results(text, "sort")


def test_the_product_that_makes_the_map_is_a_kernel_of_its_own():
    def squared_distance(a, b):
        product = a @ b.T
        return jnp.sum(a * a, axis=1)[:, None] - 2 * product + jnp.sum(b * b, axis=1)[None, :]

    # XLA fuses a product only from about a million multiplications on.
    features = array(N, 64), array(M, 64)
    assert fused_products(compiled(jax.jit(squared_distance), *features), N * M)
    library = jax.jit(matching.squared_feature_distance)
    assert not fused_products(compiled(library, *features), N * M)
    assert "__ynn_fusion" in compiled(library, *features)


def test_nothing_is_as_large_as_the_maps_times_the_neighbours(program):
    assert max(sizes(program)) < BATCH * N * M * K


def exponentials(text: str) -> int:
    """Size of the largest array whose exponential is taken: that of the matching maps."""
    return max(max(sizes(x)) for x in results(text, "exponential"))


def test_training_and_evaluation_match_one_pair_at_a_time(evaluated, step):
    assert exponentials(evaluated) == N * M
    assert exponentials(step) == N * N


def test_the_maps_of_a_whole_batch_would_be_seen(forward):
    assert exponentials(forward) == BATCH * N * M


def test_an_array_over_maps_and_neighbours_would_be_seen():
    graphs = array(N, K, dtype=jnp.int32), array(M, K, dtype=jnp.int32)
    text = compiled(jax.jit(transcription.neighborhood_sum), array(N, M), *graphs)
    assert max(sizes(text)) >= N * M * K


def test_iterations_are_a_loop(forward, step):
    assert loops(forward, ITERATIONS) == 1
    assert loops(step, ITERATIONS) >= 2  # Forward, and back.


def test_iterations_written_out_would_be_seen():
    def unrolled(x):
        for _ in range(ITERATIONS):
            x = jnp.sin(x @ x)
        return x

    def scanned(x):
        return jax.lax.scan(lambda x, _: (jnp.sin(x @ x), None), x, length=ITERATIONS)[0]

    assert loops(compiled(jax.jit(unrolled), array(N, N)), ITERATIONS) == 0
    assert loops(compiled(jax.jit(scanned), array(N, N)), ITERATIONS) == 1


def derivative(of_sum):
    """Gradient of a neighbourhood sum whose graphs are known."""
    return jax.jit(jax.grad(lambda scores, p, q: jnp.sum(of_sum(scores, p, q) ** 2)))


def test_no_derivative_scatters_into_a_map(step):
    assert not wide_scatters(step, N * N)
    graphs = (jax.eval_shape(matching.incidence, array(n, K, dtype=jnp.int32)) for n in (N, M))
    text = compiled(derivative(matching.neighborhood_sum), array(N, M), *graphs)
    assert not results(text, "scatter")


def test_a_scatter_into_a_map_would_be_seen():
    graphs = array(N, K, dtype=jnp.int32), array(M, K, dtype=jnp.int32)
    text = compiled(derivative(transcription.neighborhood_sum), array(N, M), *graphs)
    assert wide_scatters(text, N * M)


def test_ten_sizes_in_one_bucket_compile_once(caplog, seed):
    """T23."""
    rng = np.random.default_rng(seed)
    config = from_dict({"model": {"k": 3, "k_matching": 3, "channels": [4], "width": 4}})
    variables = jax.jit(lambda: init_variables(jax.random.key(0), config.model))()
    register = jax.jit(functools.partial(register_pair, config=config))

    def compilations(size):
        points, masks = zip(
            *(
                clouds.padded(rng.normal(size=(n, 3)), clouds.padded_size(n, smallest=256))
                for n in (size, size - 3)
            ),
            strict=True,
        )
        caplog.clear()
        with jax.log_compiles():
            register(variables, *points, source_mask=masks[0], reference_mask=masks[1])
        return [x for x in caplog.messages if x.startswith("Compiling")]

    assert len(compilations(300)) == 1
    again = itertools.chain.from_iterable(compilations(size) for size in range(310, 500, 20))
    assert not list(again)
    assert len(compilations(600)) == 1, "another bucket is seen"
