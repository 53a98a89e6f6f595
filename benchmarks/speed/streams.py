"""Pairs in a stream through `register_batch` or `register`, and the memory of the process meanwhile."""

import collections
import dataclasses
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np

import jaxreg

_COMPILED = "backend_compile_duration"


def measure(kind: str, pairs: int, points: list[int]) -> dict:
    """A stream of so many pairs: (pairs done, seconds, resident MB) at 51 places, and programs compiled.

    `kind` is `register_batch`, or `executor` for `register` on the threads of one.
    """
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: compiled.append(event) if event.endswith(_COMPILED) else None
    )
    results = {"register_batch": _network_results, "executor": _executor_results}[kind]
    curve, begin = [], time.perf_counter()
    for done, _ in enumerate(results(pairs, points), start=1):
        if done % (pairs // 50) == 0 or done == 1:
            curve.append((done, time.perf_counter() - begin, resident_mb()))
    return {"curve": curve, "programs": len(compiled)}


def resident_mb() -> float:
    """Resident memory of this process now, in MB (1e6 bytes); Linux only."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _network_results(pairs: int, points: list[int]) -> Iterator:
    def clouds(seed: int) -> Iterator[np.ndarray]:
        draws = np.random.default_rng(seed)
        for _ in range(pairs):
            count = int(draws.integers(points[0], points[1] + 1))
            yield draws.uniform(-0.5, 0.5, (count, 3)).astype(np.float32)

    variables, config = jaxreg.load_pretrained("modelnet40")
    # A cloud must have as many points as inliers are chosen.
    model = dataclasses.replace(config.model, n_inliers=96)
    return jaxreg.register_batch(variables, clouds(0), clouds(1), config=model)


def _executor_results(pairs: int, points: list[int]) -> Iterator:
    """Twice as many pairs in flight as there are cores, as `Executor.map` would put all in at once."""
    cores = len(os.sched_getaffinity(0))

    def scans(number: int) -> tuple[np.ndarray, np.ndarray]:
        draws = np.random.default_rng(number)
        whole = jaxreg.sample_shape(0, number % 50, points=2 * points[1])
        return tuple(
            half[: draws.integers(points[0], points[1] + 1)] for half in (whole[::2], whole[1::2])
        )

    with ThreadPoolExecutor(cores) as pool:
        waiting = collections.deque()
        for number in range(pairs):
            waiting.append(pool.submit(lambda n: jaxreg.register(*scans(n)), number))
            if len(waiting) == 2 * cores:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
