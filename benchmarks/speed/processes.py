"""What only a fresh process can tell: peak memory, compile time, time to the first result.

Run as `python -m benchmarks.speed.processes TASK`, with the options as JSON on the standard input, it does
one task and prints its findings as JSON; `measure` and `first_result` start such processes.
"""

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]


def peak_mb() -> float:
    """Largest resident memory of this process so far, in MB (1e6 bytes).

    Where Linux tells it, by the program's own high-water mark: that of `getrusage` begins at the size
    of the process that started this one.
    """
    status = Path("/proc/self/status")
    if status.exists():
        line = next(x for x in status.read_text().splitlines() if x.startswith("VmHWM"))
        return int(line.split()[1]) * 1024 / 1e6
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


class Finished(NamedTuple):
    """What a process wrote on its standard output, and how long it took by the clock."""

    output: str
    seconds: float


def finished(
    command: Sequence[str],
    *,
    environment: Mapping[str, str],
    given: str = "",
    folder: Path | None = None,
) -> Finished:
    """A command from its start to its end, with the text `given` on its standard input.

    Raises:
      RuntimeError: the process failed; the message ends with what it wrote.
    """
    begin = time.perf_counter()
    process = subprocess.run(
        command,
        input=given,
        capture_output=True,
        text=True,
        cwd=folder,
        env=environment,
        check=False,
    )
    seconds = time.perf_counter() - begin
    if process.returncode:
        wrote = (process.stdout + process.stderr)[-2000:]
        raise RuntimeError(f"{' '.join(command)} failed with {given or 'no input'}:\n{wrote}")
    return Finished(process.stdout, seconds)


def run(task: str, *, cache: str = "", huge_pages: bool = False, **options) -> dict:
    """The findings of a fresh process.

    `cache` is the folder that it takes for the user's caches; `huge_pages` gives it the memory pages
    that train.py asks for.

    Raises:
      RuntimeError: the process failed; the message ends with what it wrote.
    """
    left_out = "JAX_COMPILATION_CACHE_DIR", "GLIBC_TUNABLES"
    environment = {k: v for k, v in os.environ.items() if k not in left_out}
    if cache:
        environment["XDG_CACHE_HOME"] = cache
    if huge_pages:
        environment["GLIBC_TUNABLES"] = "glibc.malloc.hugetlb=1"
    command = [sys.executable, "-m", "benchmarks.speed.processes", task]
    done = finished(command, environment=environment, given=json.dumps(options), folder=ROOT)
    return json.loads(done.output.splitlines()[-1]) | {"process_s": done.seconds}


def first_results(task: str, **options) -> tuple[dict, dict]:
    """Findings of a process that finds an empty compilation cache, and of the next one."""
    with TemporaryDirectory() as cache:
        return run(task, cache=cache, **options), run(task, cache=cache, **options)


def train(points: int, batch: int, rounds: int, seconds: float) -> dict:
    """The candidates of the training step, in turns."""
    from benchmarks.speed import candidates

    return {"rows": candidates.train(points, batch=batch, rounds=rounds, seconds=seconds)}


def register_pair(points: int) -> dict:
    """First result of the network: import, released weights, compile, run."""
    begin = time.perf_counter()
    import jax
    import numpy as np

    import jaxreg
    from jaxreg.cli import process

    process.enable_compilation_cache()
    imported = time.perf_counter()
    variables, config = jaxreg.load_pretrained("modelnet40")
    clouds = np.random.default_rng(0).uniform(-0.5, 0.5, (2, points, 3)).astype(np.float32)
    compiled = jax.jit(lambda v, x, y: jaxreg.register_pair(v, x, y, config=config))
    jax.block_until_ready(compiled(variables, *clouds))
    return {"import_s": imported - begin, "result_s": time.perf_counter() - imported}


def register(points: int) -> dict:
    """First result of `jaxreg.register` on two crops of a procedural shape, with the tool's cache."""
    begin = time.perf_counter()
    import numpy as np

    import jaxreg
    from jaxreg.cli import process

    process.enable_compilation_cache()
    imported = time.perf_counter()
    cloud = jaxreg.sample_shape(0, 7, points=points)
    cloud = cloud[np.argsort(cloud[:, 0])]
    jaxreg.register(cloud[: 3 * points // 4], cloud[points // 4 :] + 0.1)
    return {"import_s": imported - begin, "result_s": time.perf_counter() - imported}


def measure(
    program: str,
    points: int,
    batch: int,
    implementation: str = "jaxreg",
    rounds: int = 1,
    limit_mb: float = 0,
    cached: bool = False,
) -> dict:
    """Seconds to trace and to compile, seconds and peak memory of running.

    Nothing is taken from a compilation cache unless `cached`, where the command line tools' is used.
    `program` is `forward`, `gradient` or `step`. Where the compiled program says that it needs more
    than `limit_mb` it is not run, and `needs_mb` says how much.
    """
    import jax

    from benchmarks.speed import timing
    from jaxreg.cli import process

    if cached:
        process.enable_compilation_cache()
    else:
        jax.config.update("jax_enable_compilation_cache", False)
    function, inputs = _program(program, points, batch, implementation)
    before, begin = peak_mb(), time.perf_counter()
    lowered = function.lower(*inputs)
    traced = time.perf_counter()
    compiled = lowered.compile()
    found = {"before_mb": before, "trace_s": traced - begin}
    found["compile_s"] = time.perf_counter() - traced
    memory = compiled.memory_analysis()
    found["temporary_mb"] = memory.temp_size_in_bytes / 1e6
    found["needs_mb"] = before + found["temporary_mb"] + memory.output_size_in_bytes / 1e6
    if limit_mb and found["needs_mb"] > limit_mb:
        return found
    state = list(inputs)

    def call(_: int) -> object:
        result = compiled(*state)
        if program == "step":  # The state is donated, so that the next step takes the new one.
            state[0] = result[0]
        return result

    taken = timing.alternate({"run": call}, rounds=rounds)["run"]
    return found | {"seconds": taken.minimum, "median_s": taken.median, "peak_mb": peak_mb()}


def _program(program: str, points: int, batch: int, implementation: str) -> tuple[Callable, tuple]:
    """The compiled function and its inputs, on the device."""
    import jax
    import jax.numpy as jnp

    from benchmarks.speed import workload
    from jaxreg import training

    if program == "step":
        config = workload.training_config(points, batch)
        shapes = workload.draw(config.pairs.points, 1).sources
        state = training.create_train_state(config)
        return workload.training_step(config), (state, jnp.asarray(shapes))
    drawn = workload.draw(points, batch)
    clouds = jax.tree.map(jnp.asarray, drawn[:2])
    variables, config = workload.released()
    if program == "gradient":
        function, inputs = (
            workload.gradient(implementation, config),
            (
                variables["params"],
                variables["batch_stats"],
            ),
        )
        return function, (*inputs, *workload.loss_inputs(implementation, drawn))
    if batch == 1:
        clouds = tuple(x[0] for x in clouds)
    return workload.registration(implementation, batched=batch > 1), (variables, *clouds)


def all_reduces(core: int, **options) -> dict:
    """What a training step sends, as one of the processes that share it, on this core."""
    os.sched_setaffinity(0, {core})
    from benchmarks.speed import sends

    return sends.measure(**options)


def stream(**options) -> dict:
    """Memory along a stream of pairs."""
    from benchmarks.speed import streams

    return streams.measure(**options)


if __name__ == "__main__":
    tasks = (measure, train, register_pair, register, all_reduces, stream)
    task = {task.__name__: task for task in tasks}[sys.argv[1]]
    print(json.dumps(task(**json.load(sys.stdin))))
