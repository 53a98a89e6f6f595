"""What many processes cost: one run of two processes against two runs of one, a core each.

    python -m benchmarks.speed.parallel [--batch 4] [--rounds 3] [--seconds 30]

Both are `train.py` as a user starts it, with the same batch a core; the two kinds take turns, and every
process is held to a core of its own. What is timed begins when all processes have done some steps, so
that nothing compiles. In between, what a step sends is read from its compiled program and timed alone.
Linux only, because of the cores.
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import tyro

from benchmarks import record
from benchmarks.speed import processes

_LIMIT_SECONDS = 600


@dataclasses.dataclass(frozen=True)
class Options:
    """What to measure."""

    config: str = "configs/modelnet40_unseen_objects.toml"
    """The training, on procedural shapes in place of its data."""
    batch: int = 4
    """Pairs a core and step."""
    rounds: int = 3
    """Turns of both."""
    seconds: float = 30.0
    """Timed seconds of each."""
    cores: tuple[int, ...] = (0, 1)
    """A core for each process."""
    record: bool = True
    """Write the table to benchmarks/results/."""


def training(options: Options, batch: int) -> list[str]:
    """The arguments of `train.py` for a run that is ended before it validates."""
    sections = {
        "data.name": "shapes",
        "data.train-shapes": 64,
        "data.test-shapes": 8,
        "train.batch": batch,
        "train.steps": 100_000,
        "train.validate-every": 100_000,
    }
    return [options.config, *(word for k, v in sections.items() for word in (f"--{k}", str(v)))]


def free_port() -> int:
    """A port of this machine that nobody listens at."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@contextlib.contextmanager
def started(commands: list[list[str]], options: Options, cache: str) -> Iterator[list]:
    """Processes of `train.py`, each on its core; killed at the end, for they would train for days."""
    environment = os.environ | {"XDG_CACHE_HOME": cache}
    running = [
        subprocess.Popen(
            [sys.executable, "train.py", *command],
            cwd=processes.ROOT,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            preexec_fn=functools.partial(os.sched_setaffinity, 0, {core}),
        )
        for command, core in zip(commands, options.cores, strict=True)
    ]
    try:
        yield running
    finally:
        for process in running:
            process.kill()
            process.communicate()


def steps(log: Path) -> int:
    """How many steps a run has logged."""
    return log.read_bytes().count(b"\n") if log.exists() else 0


def processor_seconds(running: list) -> float:
    """What the processes have used, all threads."""
    stats = [Path(f"/proc/{process.pid}/stat").read_text() for process in running]
    ticks = sum(int(x) for stat in stats for x in stat.rpartition(")")[2].split()[11:13])
    return ticks / os.sysconf("SC_CLK_TCK")


class Rate(NamedTuple):
    """Steps a second of all runs together, and processor seconds of all processes a step."""

    steps: float
    processor: float


def rate(logs: list[Path], running: list, seconds: float, *, after: int = 5) -> Rate:
    """Of runs over the same time, each from its first to its last step in it."""
    begin = time.monotonic()
    while any(steps(log) < after for log in logs):
        failed = [process for process in running if process.poll() is not None]
        if failed or time.monotonic() - begin > _LIMIT_SECONDS:
            raise RuntimeError(failed[0].stderr.read().decode() if failed else "no step in time")
        time.sleep(0.1)
    seen = [[] for _ in logs]
    begun = counts = [steps(log) for log in logs]
    used, counts = processor_seconds(running), list(counts)
    end = time.monotonic() + seconds
    while (now := time.monotonic()) < end:
        for number, log in enumerate(logs):
            if (count := steps(log)) > counts[number]:
                seen[number].append((now, count))
                counts[number] = count
        time.sleep(0.01)
    used = processor_seconds(running) - used
    spans = [(times[0], times[-1]) for times in seen]
    return Rate(
        sum((last[1] - first[1]) / (last[0] - first[0]) for first, last in spans),
        used / (sum(counts) - sum(begun)),
    )


def turn(kind: str, options: Options, cache: str) -> dict[str, float]:
    """Pairs a second of both cores: `apart`, two runs, or `together`, one run of two processes."""
    count = len(options.cores)
    with tempfile.TemporaryDirectory() as folder:
        workdirs = [Path(folder) / (str(i) if kind == "apart" else "0") for i in range(count)]
        batch = options.batch * (1 if kind == "apart" else count)
        commands = [[*training(options, batch), "--workdir", f"{path}"] for path in workdirs]
        if kind == "together":
            many = ["--coordinator", f"127.0.0.1:{free_port()}", "--processes", f"{count}"]
            commands = [
                [*command, *many, "--process-id", f"{i}"] for i, command in enumerate(commands)
            ]
        logs = [path / "metrics.jsonl" for path in dict.fromkeys(workdirs)]
        with started(commands, options, cache) as running:
            found = rate(logs, running, options.seconds)
    return {"pairs": batch * found.steps, "processor_ms": 1e3 * found.processor / batch}


def sent(options: Options, cache: str) -> dict[str, float]:
    """What a step sends and how long that takes alone (`processes.all_reduces`)."""
    count = len(options.cores)
    arguments = {
        "arguments": training(options, count * options.batch),
        "address": f"127.0.0.1:{free_port()}",
        "count": count,
    }
    with concurrent.futures.ThreadPoolExecutor(count) as pool:
        found = [
            pool.submit(processes.run, "all_reduces", cache=cache, **arguments, rank=i, core=core)
            for i, core in enumerate(options.cores)
        ]
        return found[0].result()


def write(
    taken: dict[str, list[dict[str, float]]], told: dict[str, float], options: Options
) -> Path:
    """The record `parallel`: a row each, the ratio of turns, and what is sent."""
    labels = {"apart": "two runs of one process", "together": "one run of two processes"}
    pairs = {kind: [turn["pairs"] for turn in turns] for kind, turns in taken.items()}
    work = {
        kind: statistics.median(turn["processor_ms"] for turn in turns)
        for kind, turns in taken.items()
    }
    rows = {
        kind: {
            "label": labels[kind],
            "median": statistics.median(values),
            "best": max(values),
            "least": min(values),
            "processor": work[kind],
        }
        for kind, values in pairs.items()
    }
    ratios = [b / a for a, b in zip(pairs["apart"], pairs["together"], strict=True)]
    setting = {
        "ratio": round(statistics.median(ratios), 2),
        "least_ratio": round(min(ratios), 2),
        "processor_ratio": round(work["apart"] / work["together"], 2),
        "rounds": options.rounds,
        "batch": options.batch,
        "load": round(os.getloadavg()[2], 1),
    } | {key: value for key, value in told.items() if key != "process_s"}
    return record.write(
        "parallel",
        question="What does training in many processes cost?",
        command=record.command("benchmarks.speed.parallel"),
        columns={
            "median": "pairs/s, median",
            "best": "best turn",
            "least": "worst turn",
            "processor": "processor ms a pair",
        },
        rows=rows,
        setting=setting,
    )


def main() -> None:
    """Both kinds in turns, then what is sent."""
    options = tyro.cli(Options, description=__doc__)
    taken = {"apart": [], "together": []}
    with tempfile.TemporaryDirectory() as cache:
        for number in range(options.rounds):
            for kind, values in taken.items():
                values.append(turn(kind, options, cache))
                print(f"turn {number + 1}, {kind}:", values[-1], flush=True)
        told = sent(options, cache)
    print(told)
    if options.record:
        print(write(taken, told, options))


if __name__ == "__main__":
    main()
