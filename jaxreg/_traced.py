"""Programs as JAX traced them, on disk, so that the next process of the same command need not trace.

Tracing and lowering takes longer than anything else in a short run: three times as long as reading the
StableHLO that `jax.export` writes. XLA compiles that as it would the program, or reads what it compiled
from its own cache. Off until a command says where to keep them; whatever cannot be kept is traced.
"""

import contextlib
import functools
import hashlib
import os
import pickle
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent import futures
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer

_UNUSED_SECONDS = 30 * 86_400
"""Programs of another version that no process used for so long are removed."""
_lock = threading.RLock()  # a program that is traced may call another
_folder: Path | None = None
_programs: dict[Any, Callable[..., Any]] = {}
_ahead: dict[Path, futures.Future] = {}
_used: dict[Path, None] = {}  # in this order


@contextlib.contextmanager
def kept_in(folder: Path) -> Iterator[None]:
    """Keep programs in `folder` during the block; others must not be able to write there.

    What the files hold is run, as with XLA's cache. The programs that the last block used are loaded
    by another thread, while this one imports and reads.
    """
    global _folder
    before, _folder = _folder, folder / _version()
    used = _folder.with_suffix(".used")
    try:
        with futures.ThreadPoolExecutor(1) as loader:
            with contextlib.suppress(OSError):
                for name in used.read_text("utf-8").split():
                    _ahead[_folder / name] = loader.submit(_loaded, _folder / name)
            try:
                yield
            finally:
                loader.shutdown(cancel_futures=True)
        with contextlib.suppress(OSError):
            if names := [path.name for path in _used if path.parent == _folder]:
                _write(used, "\n".join(names).encode())
            _remove_old(folder)
    finally:
        _ahead.clear()
        _used.clear()
        _folder = before


def _remove_old(folder: Path) -> None:
    """Every version (of the library, of JAX, of settings) has a folder, and a list of what it used."""
    for used in folder.glob("*.used"):
        if time.time() - used.stat().st_mtime > _UNUSED_SECONDS:
            shutil.rmtree(used.with_suffix(""), ignore_errors=True)
            used.unlink()


def call(function: Callable[..., Any], told: tuple, arguments: tuple, static: dict) -> Any:
    """``function(*arguments, **static)``, a jitted one, from its kept program if there may be one.

    `told` is what the function closes over; one that closes over something and tells nothing is not
    kept.
    """
    if _folder is None or (_closes_over(function) and not told):
        return function(*arguments, **static)
    leaves, tree = jax.tree.flatten(arguments)
    if any(isinstance(leaf, Tracer) for leaf in leaves):
        return function(*arguments, **static)
    call = _Call(function, told, tuple(sorted(static.items())), tree, tuple(map(_form, leaves)))
    with _lock:
        program = _programs.get((_folder, call))
        if program is None:
            program = _programs[_folder, call] = _program(call, _folder)
    # A program with options of its own runs now, also where another is traced that closes over it.
    with jax.ensure_compile_time_eval():
        return program(*arguments, **static)


class _Call(NamedTuple):
    """All that a program follows from, besides `_version`."""

    function: Callable[..., Any]
    told: tuple
    static: tuple[tuple[str, Any], ...]
    tree: Any
    forms: tuple[tuple[tuple[int, ...], str, bool], ...]

    def name(self) -> str:
        """A name for it in any process."""
        words = self.function.__module__, self.function.__qualname__, *map(repr, self[1:])
        return hashlib.sha256(repr(words).encode()).hexdigest()


def _form(leaf: Any) -> tuple[tuple[int, ...], str, bool]:
    """Shape, dtype and whether it is weak, as that of a Python number is."""
    aval = jax.typeof(leaf)
    return aval.shape, str(aval.dtype), aval.weak_type


def _closes_over(function: Callable[..., Any]) -> bool:
    return bool(getattr(getattr(function, "__wrapped__", None), "__closure__", None))


def _program(call: _Call, folder: Path) -> Callable[..., Any]:
    """The kept program of a call; made and kept if there is none, and the function if that fails."""
    path = folder / call.name()
    _used[path] = None
    try:
        try:
            ahead = _ahead.get(path)
            run, outputs = _loaded(path) if ahead is None else ahead.result()
        except Exception:  # noqa: BLE001 - not there, or of a process that was killed
            _write(path, pickle.dumps(_exported(call)))
            run, outputs = _loaded(path)
    except Exception:  # noqa: BLE001 - no flatbuffers, no space, an operation that cannot be exported
        return call.function
    result = jax.tree.structure(outputs)
    return lambda *arguments, **_: jax.tree.unflatten(result, run(*jax.tree.leaves(arguments)))


def _loaded(path: Path) -> tuple[Callable[..., Any], Any]:
    """A kept program, compiled, and a tree of what it returns."""
    from jax import export

    written, outputs = pickle.loads(path.read_bytes())
    exported = export.deserialize(bytearray(written))
    forms = [
        jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=x.weak_type) for x in exported.in_avals
    ]
    return jax.jit(exported.call, compiler_options=_quick()).lower(*forms).compile(), outputs


@functools.cache
def _quick() -> dict[str, bool] | None:
    """Options with which XLA:CPU compiles these programs in two thirds of the time; they run as fast.

    What they name is a detail of XLA (jaxlib 0.10), which refuses names that it does not know.
    """
    options = {"xla_cpu_use_fusion_emitters": False}
    if jax.default_backend() != "cpu":
        return None
    try:
        jax.jit(lambda x: x, compiler_options=options).lower(0.0).compile()
    except Exception:  # noqa: BLE001 - another XLA
        return None
    return options


def _exported(call: _Call) -> tuple[bytes, Any]:
    """The program of a call from leaves to leaves, and a tree of what it returns.

    `jax.export` would have every record named to it that a program takes or returns.
    """
    from jax import export

    trees = []

    def flat(*leaves):
        arguments = jax.tree.unflatten(call.tree, leaves)
        found, structure = jax.tree.flatten(call.function(*arguments, **dict(call.static)))
        trees.append(structure)
        return found

    forms = [
        jax.ShapeDtypeStruct(shape, dtype, weak_type=weak) for shape, dtype, weak in call.forms
    ]
    written = bytes(export.export(jax.jit(flat))(*forms).serialize())
    return written, jax.tree.unflatten(trees[0], range(trees[0].num_leaves))


def _write(path: Path, content: bytes) -> None:
    """In one step, since other processes may read and write the same."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
        file.write(content)
    os.replace(file.name, path)


def _version() -> str:
    """A name for all that a program follows from besides the call: our files, JAX, and its settings."""
    root = Path(__file__).parent
    files = sorted(
        (str(path.relative_to(root)), stat.st_size, stat.st_mtime_ns)
        for path in root.rglob("*.*")
        if path.suffix != ".pyc" and (stat := path.stat())
    )
    settings = (
        jax.__version__,
        np.__version__,
        jax.default_backend(),
        jax.config.jax_enable_x64,  # pyright: ignore[reportAttributeAccessIssue]
        jax.config.jax_default_matmul_precision,  # pyright: ignore[reportAttributeAccessIssue]
    )
    return hashlib.sha256(repr((files, settings)).encode()).hexdigest()[:16]
