"""Taking times on a machine that others use, too: all contestants in turn, ratios within a round."""

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
    """Something to be timed, and how many scans one run of it takes."""

    run: Run
    scans: int


def round_robin(
    contestants: Mapping[str, Contestant], *, rounds: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, Float[np.ndarray, " rounds"]]:
    """Seconds a scan of every contestant in every round, after one run of each to warm up.

    The order alternates, so that nobody always runs in the cache that the same neighbor left.
    """
    for one in contestants.values():
        one.run()
    taken = {name: np.zeros(rounds) for name in contestants}
    for k in range(rounds):
        order = list(contestants.items())
        for name, (run, scans) in order if k % 2 == 0 else order[::-1]:
            start = clock()
            run()
            taken[name][k] = (clock() - start) / scans
    return taken


def ratio(numerator: Float[np.ndarray, " rounds"], denominator: Float[np.ndarray, " rounds"]) -> float:
    """Median over the rounds of the ratio within each: whoever else uses the machine slows both sides of it."""
    return float(np.median(numerator / denominator))


def cores(count: int) -> list[int]:
    """Numbers of so many cores that this process may use; fewer if there are none, or if they cannot be chosen."""
    return sorted(os.sched_getaffinity(0))[:count] if hasattr(os, "sched_setaffinity") else []


def process(module: str, *arguments: str, core: int | None = None, **options: Any) -> subprocess.Popen[str]:
    """A Python process that runs a module, on one core alone if that is given."""
    pin = [] if core is None else ["benchmarks.speed.pinned", str(core)]
    call = [sys.executable, "-m", *pin, module, *arguments]
    root = Path(__file__).resolve().parents[2]
    return subprocess.Popen(call, stdout=subprocess.PIPE, text=True, cwd=root, **options)


def result(of: subprocess.Popen[str], *, limit: float = 1800) -> Any:
    """The JSON that a process writes last.

    Raises:
        RuntimeError: it failed.
    """
    told, _ = of.communicate(timeout=limit)
    if of.returncode:
        raise RuntimeError(f"{of.args}: exit code {of.returncode}")
    return json.loads(told.splitlines()[-1])


def written(pipe: IO[str] | None, line: str) -> None:
    """One line to a process."""
    assert pipe is not None
    pipe.write(f"{line}\n")
    pipe.flush()


def read(pipe: IO[str] | None) -> str:
    """One line from a process.

    Raises:
        RuntimeError: it has ended.
    """
    assert pipe is not None
    line = pipe.readline()
    if not line:
        raise RuntimeError("the measured process has ended")
    return line.strip()
