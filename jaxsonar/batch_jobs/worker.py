"""One shard from the file to the bytes of its tables: the same function, whoever calls it, wherever it runs.

Nothing here loads JAX before a shard comes, so that a process can be told before how many threads to use.
"""

import json
import os
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from jaxsonar.batch_jobs.shards import Shard
from jaxsonar.fileio.atomic_files import reason, shown
from jaxsonar.hardware.errors import SonarError

if TYPE_CHECKING:
    import numpy as np

    from jaxsonar.kernels import HoughSettings
    from jaxsonar.scans.scan_log import Log
    from jaxsonar.sensors.ring import Ring

REASONS = 20
"""Bad scans of a shard that are named; the others are counted."""
ONE_THREAD = {
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "NPROC": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
}
"""Environment of a worker: there is one for every core, so each keeps to one thread."""
KEPT_MEMORY = {"MALLOC_MMAP_THRESHOLD_": str(32 << 20), "MALLOC_TRIM_THRESHOLD_": str(256 << 20)}
"""Environment of a worker, read by glibc as it starts: what one step frees is there for the next one."""


@dataclass(frozen=True)
class Result:
    """What came of a shard: its tables, or why there are none."""

    tables: dict[str, bytes] = field(default_factory=dict)
    """Parquet files, by name."""
    counts: dict[str, int] = field(default_factory=dict)
    """What is in them."""
    bad: int = 0
    """Scans set aside."""
    reasons: list[str] = field(default_factory=list)
    """Why, of the first ones."""
    failure: str = ""
    """Why the whole shard was set aside; empty if it was not."""


def one_thread() -> dict[str, str]:
    """``ONE_THREAD``, with the flags of XLA that are set already before ours."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} {ONE_THREAD['XLA_FLAGS']}".strip()
    return ONE_THREAD | {"XLA_FLAGS": flags}


def job_of(ring: "Ring", *, method: str, settings: "HoughSettings", sigma: float | None) -> str:
    """What is to be done with every shard, as JSON: plain text that any process can take, and equal for equal jobs."""
    from dataclasses import asdict

    values = {one.name: getattr(ring, one.name) for one in fields(ring)}
    plain = {name: value.tolist() if hasattr(value, "tolist") else value for name, value in values.items()}
    return json.dumps({"ring": plain, "method": method, "sigma": sigma, "settings": asdict(settings)}, sort_keys=True)


def do(job: str, shard: Shard) -> Result:
    """Read a shard, compute its tables, write them into memory.

    A scan that cannot be read is set aside and the rest goes on; where nothing can be read, the shard is.

    Args:
        job: from ``job_of``.
        shard: which scans.
    """
    use_one_thread()
    try:
        return _done(job, shard)
    except SonarError as error:
        return Result(failure=str(error))
    except MemoryError:
        return Result(failure=f"{shown(shard.source)}: not enough memory")
    except Exception as error:  # one shard must not end a run of thousands
        return Result(failure=f"{shown(shard.source)}: {type(error).__name__}: {reason(error)}")


def _done(job: str, shard: Shard) -> Result:
    import numpy as np

    from jaxsonar.batch_jobs.parquet_tables import parquet
    from jaxsonar.batch_jobs.scan_tables import tables

    ring, method, settings, sigma = _understood(job)
    log, rows, bad = _read(shard, ring)
    found = tables(
        ring, log, rows + shard.part.first, source=shard.source, method=method, settings=settings, sigma=sigma
    )
    counted = ("lines", "points", "undecided", "left_out")
    counts = {name: int(np.sum(found["scans"][name])) for name in counted}
    made = {name: parquet(name, columns) for name, columns in found.items()}
    return Result(made, counts, len(bad), [bad[row] for row in sorted(bad)[:REASONS]])


@lru_cache(maxsize=4)
def _understood(job: str) -> "tuple[Ring, str, HoughSettings, float | None]":
    import numpy as np

    from jaxsonar.fileio.compilation_cache import use_compilation_cache
    from jaxsonar.kernels import HoughSettings
    from jaxsonar.sensors.ring import Ring

    use_compilation_cache()
    told: dict[str, Any] = json.loads(job)
    ring: dict[str, Any] = {
        name: np.array(value) if isinstance(value, list) else value for name, value in told["ring"].items()
    }
    settings = told["settings"] | {"smoothing": tuple(told["settings"]["smoothing"])}
    return Ring(**ring), told["method"], HoughSettings(**settings), told["sigma"]


def _read(shard: Shard, ring: "Ring") -> "tuple[Log, np.ndarray, dict[int, str]]":
    """The scans of a shard that can be used, their rows in it, and by row why the others cannot."""
    import numpy as np

    from jaxsonar.scans.log_chunks import csv_reader, parquet_reader

    try:
        seen = os.stat(shard.path)
    except OSError as failure:
        raise SonarError(f"{shown(shard.source)}: {reason(failure)}; needed is a readable log") from None
    if (seen.st_size, seen.st_mtime_ns) != (shard.size, shard.changed):
        raise SonarError(f"{shown(shard.source)}: changed since it was looked at; needed is a log that stays as it is")
    read = (csv_reader if shard.kind == "csv" else parquet_reader)(shard.path, shard.part, name=shard.source)

    runs, bad = _runs(read, shard.part.scans)
    logs, rows = [], [np.zeros(0, np.int64)]
    for begin, log in runs:
        wrong = _wrong(shard, ring, begin, log)
        good = np.setdiff1d(np.arange(len(log)), np.array(list(wrong), np.int64))
        bad |= {begin + k: why for k, why in wrong.items()}
        logs.append(log._part(good) if wrong else log)
        rows.append(begin + good)
    return _joined(logs), np.concatenate(rows), bad


def _runs(read: "Callable[[int, int], Log]", scans: int) -> "tuple[list[tuple[int, Log]], dict[int, str]]":
    """Runs of scans that can be read, each with its first row, by halving what cannot; and why single ones cannot."""
    runs, bad = [], {}
    left = [(0, scans)]
    while left:
        begin, end = left.pop()
        try:
            runs.append((begin, read(begin, end)))
        except SonarError as error:
            if end - begin == 1:
                bad[begin] = str(error)
            else:
                middle = (begin + end) // 2
                left += [(middle, end), (begin, middle)]
    return runs, bad


def _wrong(shard: Shard, ring: "Ring", begin: int, log: "Log") -> dict[int, str]:
    """Scans that can be read but not used, by row in ``log``: sensors beyond the ring, numbers that came before."""
    import numpy as np

    name, scan = shown(shard.source), log.echo_scan
    beyond = np.flatnonzero(np.maximum(log.tx, log.rx) >= ring.count)
    _, first = np.unique(scan[beyond], return_index=True)
    wrong = {}
    for echo in beyond[first].tolist():
        sensors = (
            f"tx {log.tx[echo]}, rx {log.rx[echo]}; allowed are 0 to {ring.count - 1}, the sensors of {ring.name!r}"
        )
        wrong[int(scan[echo])] = f"{name}: scan {log.scan[scan[echo]]}: echo of sensors {sensors}"
    for row in shard.part.repeated:
        if begin <= row < begin + len(log):
            number = log.scan[row - begin]
            wrong[row - begin] = f"{name}: scan {number} came again; allowed is each scan number once"
    return wrong


def _joined(logs: "list[Log]") -> "Log":
    """Logs one after another as one."""
    import numpy as np

    from jaxsonar.scans.scan_log import Log

    if len(logs) == 1:
        return logs[0]
    names = ("scan", "stamp", "pose", "tx", "rx", "range", "amplitude")
    none = Log.from_scans([])
    columns = {name: np.concatenate([getattr(log, name) for log in (none, *logs)]) for name in names}
    echoes = np.concatenate([np.zeros(1, np.int64), *(np.diff(log.start) for log in logs)])
    return Log(start=np.cumsum(echoes), **columns)


def use_one_thread() -> None:
    """Tell JAX, OpenCV and BLAS to use one thread, if they have not started."""
    if "jax" not in sys.modules:
        for name, value in ONE_THREAD.items():
            os.environ.setdefault(name, value)


def serve(link: int) -> None:
    """Work for a process that sends a job and then shards through a socket, until it is gone.

    Args:
        link: file descriptor of the socket.
    """
    from multiprocessing.connection import Connection
    from queue import SimpleQueue

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for whoever sends the shards
    connection, tasks = Connection(link), SimpleQueue()

    def listen() -> None:
        while True:
            try:
                tasks.put(connection.recv())
            except (EOFError, OSError):
                os._exit(0)  # nobody is left who would want a result

    job = connection.recv()
    threading.Thread(target=listen, daemon=True).start()
    from jaxsonar.batch_jobs import scan_tables as batch_found  # noqa: F401  JAX and all the rest: if that fails, no shard is to blame

    connection.send("ready")
    while True:
        connection.send(do(job, tasks.get()))
