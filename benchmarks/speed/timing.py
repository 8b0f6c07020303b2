"""Timing on a machine with other load: all contestants in turn, ratios within a round."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from jaxtyping import Float

Run = Callable[[], object]


class Contestant(NamedTuple):
    """A function to be timed, and the number of scans that one call processes."""

    run: Run
    scans: int


def round_robin(
    contestants: Mapping[str, Contestant], *, rounds: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, Float[np.ndarray, " rounds"]]:
    """Seconds per scan of each contestant in each round, after one call of each to warm up.

    The order alternates, so that the cache is not always left by the same predecessor.
    """
    for one in contestants.values():
        one.run()
    seconds_of = {name: np.zeros(rounds) for name in contestants}
    for k in range(rounds):
        order = list(contestants.items())
        for name, (run, scans) in order if k % 2 == 0 else order[::-1]:
            start = clock()
            run()
            seconds_of[name][k] = (clock() - start) / scans
    return seconds_of


def ratio(numerator: Float[np.ndarray, " rounds"], denominator: Float[np.ndarray, " rounds"]) -> float:
    """Median over the rounds of the ratio within each round: other load slows down both sides."""
    return float(np.median(numerator / denominator))


def cores(count: int) -> list[int]:
    """Up to ``count`` cores that this process may use; none if cores cannot be chosen."""
    return sorted(os.sched_getaffinity(0))[:count] if hasattr(os, "sched_setaffinity") else []


def process(module: str, *arguments: str, core: int | None = None, **options: Any) -> subprocess.Popen[str]:
    """Start a Python process that runs a module, pinned to a core if one is given."""
    pin = [] if core is None else ["benchmarks.speed.pinned", str(core)]
    call = [sys.executable, "-m", *pin, module, *arguments]
    root = Path(__file__).resolve().parents[2]
    return subprocess.Popen(call, stdout=subprocess.PIPE, text=True, cwd=root, **options)


def result(child: subprocess.Popen[str], *, limit: float = 1800) -> Any:
    """The JSON in the last line of a process's output.

    Raises:
        RuntimeError: the process failed.
    """
    output, _ = child.communicate(timeout=limit)
    if child.returncode:
        raise RuntimeError(f"{child.args}: exit code {child.returncode}")
    return json.loads(output.splitlines()[-1])


def write_line(pipe: IO[str] | None, line: str) -> None:
    """Write one line to a process."""
    assert pipe is not None
    pipe.write(f"{line}\n")
    pipe.flush()


def read_line(pipe: IO[str] | None) -> str:
    """Read one line from a process.

    Raises:
        RuntimeError: the process has ended.
    """
    assert pipe is not None
    line = pipe.readline()
    if not line:
        raise RuntimeError("the measured process has ended")
    return line.strip()
