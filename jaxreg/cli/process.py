"""The process of a command: a program cache on disk, and memory pages; not for a library to set."""

import contextlib
import os
import sys
from contextlib import AbstractContextManager
from pathlib import Path

import jax

from jaxreg import _traced


def enable_compilation_cache(*, least_seconds: float = 0.3) -> None:
    """Keep programs that took `least_seconds` to compile on disk, for this user's next process.

    Used by the command line tools only; a library must not change a program's configuration. A cache
    that others could write to would run their code, so the directory is private (0700). Set
    JAX_COMPILATION_CACHE_DIR to choose another. If it cannot be made, nothing is kept.
    """
    if not cache_directory():
        directory = _own_directory() / "xla"
        try:
            directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError:
            return
        jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", least_seconds)


def _own_directory() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxreg"


def traced_programs_kept() -> AbstractContextManager[None]:
    """Traced programs are kept beside the compiled ones, where these are in our own directory."""
    if cache_directory() != str(_own_directory() / "xla"):
        return contextlib.nullcontext()
    return _traced.kept_in(_own_directory() / "traced")


def cache_directory() -> str | None:
    """The directory in which JAX keeps compiled programs; None if it keeps none."""
    return getattr(jax.config, "jax_compilation_cache_dir")  # noqa: B009 - a name made at run time


_HUGE_PAGES = "glibc.malloc.hugetlb"


def restart_with_huge_pages() -> None:
    """Restart this program with memory pages of 2 MB, if it runs on Linux without them.

    A training step works in half a gigabyte that XLA:CPU requests again each time; the kernel hands
    it out in 130,000 pages of 4 KB, which takes an eighth of the step. The C library reads its
    setting once, when a process starts. Called by train.py before anything else; does nothing if
    GLIBC_TUNABLES already sets it either way.
    """
    tunables = os.environ.get("GLIBC_TUNABLES", "")
    if sys.platform == "linux" and _HUGE_PAGES not in tunables:
        os.environ["GLIBC_TUNABLES"] = ":".join(filter(None, [tunables, f"{_HUGE_PAGES}=1"]))
        os.execv(sys.executable, sys.orig_argv)
