"""How every test runs.

Precision. x64 is on, so the dtype of the inputs chooses the lane: a test that makes float64 arrays
(numpy's default) runs in float64 with tight tolerances, one that makes float32 arrays runs in
float32, and `@pytest.mark.parametrize("dtype", ["float32", "float64"])` runs both. Mark a test (or
a module, by `pytestmark`) with `pytest.mark.float32` to turn x64 off as in a user's process: for
networks, training and the command line, where arrays are made without a dtype.

Promotion. Mixing dtypes silently is an error (`jax_numpy_dtype_promotion = "strict"`), and so is
mixing ranks (`jax_numpy_rank_promotion = "raise"`): `weights * points` would pass where n happens
to be 3, so that an axis is added by hand, `points - centroid[None, :]`. optax adds Python floats to
its int32 counter of steps: tests that run an optimiser or a schedule are marked
`pytest.mark.loose`, which lets dtypes be promoted. No third party needs ranks to be.

Types. The jaxtyping hook has beartype check every signature of jaxreg: when traced under jit, so
compiled code is as fast as without it. It sees a wrong shape before the function does; mark a test
of the function's own `ValueError` with `pytest.mark.untyped`.

Compilation. The tests compile thousands of programs that run for a millisecond, so LLVM optimises
nothing here, and XLA writes its fusions by the emitter that compiles in half the time; its other
passes run as ever, and the processes that some tests start (the README, examples, the command line)
compile as a user's do. Functions that tests call plainly are in tests/compiled.py. A module runs in
one process (`--dist loadfile`), which compiles once what its tests share. Traced programs are many
small objects that stay: looking among them for garbage took an eighth of the time.

Seeds. A random test takes the `seed` fixture. It is the same in every run unless `--seed N` (or
`--seed random`) says otherwise, and it is printed with the failure.
"""

import gc
import os
import random
import zlib
from pathlib import Path

import jax
import jaxtyping
import matplotlib as mpl
import pytest
from hypothesis import HealthCheck, settings

mpl.use("Agg")
gc.set_threshold(200_000, 50, 100)
with pytest.MonkeyPatch.context() as patch:
    flags = [os.environ.get("XLA_FLAGS", ""), "--xla_backend_optimization_level=0"]
    if jax.__version_info__ < (0, 11):  # XLA ends a process that names a flag it does not know.
        flags.append("--xla_cpu_use_fusion_emitters=false")
    patch.setenv("XLA_FLAGS", " ".join(flags))
    jax.devices()  # reads the flags, once

# With the numeric tower an int is a float, as every type checker has it.
jaxtyping.install_import_hook(
    "jaxreg", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"
)

# The first example of a test compiles, so that no deadline and no example count near hypothesis'
# own default suits JAX.
settings.register_profile(
    "quick",
    deadline=None,
    max_examples=20,
    derandomize=True,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.register_profile(
    "fuzz", settings.get_profile("quick"), max_examples=500, derandomize=False
)
settings.load_profile("quick")


_MOST_REGIONS = 40_000


def pytest_addoption(parser):
    parser.addoption("--seed", default="", help="seed of the random tests: a number, or 'random'")


def pytest_configure(config):
    if config.getoption("--seed") == "random":
        config.option.seed = str(random.SystemRandom().randrange(2**31))


def pytest_collection_modifyitems(items):
    """The longest test begins first: at the end a worker would be alone with it."""
    items.sort(key=lambda item: "test_readme" not in item.nodeid)


def pytest_report_header(config):
    seed = config.getoption("--seed") or "one of each test's name"
    return f"seed: {seed}; data: {_data() or 'none'}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Sets the lane before any fixture of the test is made."""
    jax.config.update("jax_enable_x64", item.get_closest_marker("float32") is None)
    loose = item.get_closest_marker("loose") is not None
    jax.config.update("jax_numpy_dtype_promotion", "standard" if loose else "strict")
    jax.config.update("jax_numpy_rank_promotion", "raise")
    jaxtyping.config.update("jaxtyping_disable", item.get_closest_marker("untyped") is not None)
    return (yield)


def pytest_runtest_setup(item):
    if item.get_closest_marker("modelnet") and not _modelnet():
        pytest.skip("no ModelNet40: set JAXREG_DATA to the folder that holds modelnet40_ply_hdf5_*")
    if item.get_closest_marker("peers") and not _peers().is_dir():
        pytest.skip("no folder `peers` beside $JAXREG_DATA with RIENet's released weights")


def _data() -> Path | None:
    root = os.environ.get("JAXREG_DATA")
    return Path(root) if root and Path(root).is_dir() else None


def _modelnet() -> list[Path]:
    root = _data()
    return sorted(root.glob("modelnet40_ply_hdf5_*")) if root else []


def _peers() -> Path:
    return Path(os.environ.get("JAXREG_DATA", "data")).resolve().parent / "peers"


@pytest.fixture(scope="module", autouse=True)
def _few_compiled_programs():
    """Forgets compiled programs before they are too many.

    Linux allows a process 65,530 mapped regions, every program takes several, and where no more are
    to be had the compiler crashes.
    """
    yield
    regions = Path("/proc/self/maps")
    if regions.exists() and regions.read_text().count("\n") > _MOST_REGIONS:
        jax.clear_caches()


@pytest.fixture
def seed(request) -> int:
    """A seed for `numpy.random.default_rng` or `jax.random.key`; printed, so it can be given."""
    given = request.config.getoption("--seed")
    value = int(given) if given else zlib.crc32(request.node.nodeid.encode()) % 2**31
    print(f"seed = {value}")
    return value


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder $JAXREG_DATA names; skips the test where there is none."""
    root = _data()
    if root is None:
        pytest.skip("JAXREG_DATA names no folder with data sets")
    return root


@pytest.fixture(scope="session")
def peers_root() -> Path:
    """The folder of RIENet's released weights; skips the test where there is none."""
    if not _peers().is_dir():
        pytest.skip("no folder `peers` beside $JAXREG_DATA with RIENet's released weights")
    return _peers()
