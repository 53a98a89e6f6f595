"""How this library compiles and runs on a CPU: compiler options, the cache on disk, memory pages."""

import functools
import os
import sys
from collections.abc import Callable
from pathlib import Path

import jax

# XLA:CPU fuses softmax -> products -> exp -> softmax into one kernel that runs several times slower
# than its parts (measured on jaxlib 0.10; benchmarks/ compares both on the machine at hand).
_CPU_OPTIONS = {"xla_cpu_experimental_ynn_fusion_type": ""}


def jit(function: Callable, **options) -> Callable:
    """`jax.jit` with the compiler options that the default backend wants; `options` are jit's.

    They are chosen when the result is first used: until then no backend is started, so that a
    program may import this library and configure JAX afterwards. JAX takes compiler options for whole
    programs only: the result is called as it is or under `jax.vmap`, and not within another `jax.jit`
    or under `jax.grad`; give those the function, and this what they return.
    """

    @functools.cache
    def jitted() -> Callable:
        chosen = _chosen_options() | options.get("compiler_options", {})
        return jax.jit(function, **options | {"compiler_options": chosen})

    @functools.wraps(function)
    def call(*arguments, **keywords):
        return jitted()(*arguments, **keywords)

    for name in ("lower", "trace", "eval_shape", "clear_cache", "_cache_size"):
        setattr(call, name, _method(jitted, name))
    return call


def _method(jitted: Callable[[], Callable], name: str) -> Callable:
    return lambda *arguments, **keywords: getattr(jitted(), name)(*arguments, **keywords)


def _chosen_options() -> dict[str, str]:
    if jax.default_backend() == "cpu" and _known(tuple(_CPU_OPTIONS.items())):
        return _CPU_OPTIONS
    return {}


@functools.cache
def _known(options: tuple[tuple[str, str], ...]) -> bool:
    """Whether XLA takes `options`, tried once on an empty program.

    XLA drops experimental options without notice, and would then compile nothing at all. Costs some
    9 ms of a start: most of what it takes, the first program would take instead.
    """
    try:
        with jax.log_compiles(False):  # One who counts programs looks for those of his own.
            jax.jit(lambda: None, compiler_options=dict(options)).lower().compile()
    except (jax.errors.JaxRuntimeError, ValueError):
        return False
    return True


def enable_compilation_cache(*, least_seconds: float = 0.3) -> None:
    """Keep programs that took `least_seconds` to compile on disk, for this user's next process.

    Used by the command line tools only; a library must not change a program's configuration. A cache
    that others could write to would run their code, so the directory is private (0700). Set
    JAX_COMPILATION_CACHE_DIR to choose another. Where none can be made, nothing is kept.
    """
    if not jax.config.jax_compilation_cache_dir:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        directory = root / "jaxreg" / "xla"
        try:
            directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError:
            return
        jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", least_seconds)


_HUGE_PAGES = "glibc.malloc.hugetlb"


def restart_with_huge_pages() -> None:
    """Start this program again with memory in pages of 2 MB, if it runs on Linux without them.

    A training step works in half a gigabyte that XLA:CPU asks for anew each time; the kernel hands it
    out in 130,000 pages of 4 KB, which takes an eighth of the step. The C library reads its setting
    once, when a process starts. Called by train.py before anything else is done, and where
    GLIBC_TUNABLES sets it either way nothing happens.
    """
    tunables = os.environ.get("GLIBC_TUNABLES", "")
    if sys.platform == "linux" and _HUGE_PAGES not in tunables:
        os.environ["GLIBC_TUNABLES"] = ":".join(filter(None, [tunables, f"{_HUGE_PAGES}=1"]))
        os.execv(sys.executable, sys.orig_argv)
