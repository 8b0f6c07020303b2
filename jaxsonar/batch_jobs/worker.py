"""The work of one shard: read it, compute its tables, encode them. The same function for all executors.

JAX is not imported before the first shard, so that a process can be limited to one thread before.
"""

import json
import os
import signal
import threading
from dataclasses import asdict, dataclass, field, fields
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from jaxsonar.batch_jobs.shard import Shard
from jaxsonar.batch_jobs.worker_environment import use_single_thread
from jaxsonar.fileio.atomic_files import reason, shown
from jaxsonar.hardware.errors import SonarError

if TYPE_CHECKING:
    from jaxsonar.kernels import HoughSettings
    from jaxsonar.sensors.ring import Ring

MAX_REASONS = 20
"""Number of unusable scans of a shard whose reasons are recorded. The others are only counted."""


COUNTS = ("lines", "points", "undecided", "left_out", "echoes", "in_range")
"""Columns of the table of scans whose sums are recorded for each shard."""


@dataclass(frozen=True)
class ShardResult:
    """The tables of a shard, or the reason why there are none."""

    tables: dict[str, bytes] = field(default_factory=dict)
    """Parquet files, by name of the table."""
    counts: dict[str, int] = field(default_factory=dict)
    """Sums over the scans, by the names in ``COUNTS``."""
    bad_scans: int = 0
    """Number of scans that were set aside."""
    reasons: list[str] = field(default_factory=list)
    """Reasons for the first of them."""
    failure: str = ""
    """Reason why the whole shard was set aside; empty if it was not."""


def job_spec(ring: "Ring", *, method: str, settings: "HoughSettings", sigma: float | None) -> str:
    """The parameters of a batch as JSON. Equal parameters give equal text; any process can decode it."""
    values = {one.name: getattr(ring, one.name) for one in fields(ring)}
    plain = {name: value.tolist() if hasattr(value, "tolist") else value for name, value in values.items()}
    return json.dumps({"ring": plain, "method": method, "sigma": sigma, "settings": asdict(settings)}, sort_keys=True)


def run_shard(job: str, shard: Shard) -> ShardResult:
    """Read a shard, compute its tables, and encode them in memory.

    A scan that cannot be used is set aside, and the others are processed. If none can be read, the shard is set aside.

    Args:
        job: from ``job_spec``.
        shard: the scans.
    """
    use_single_thread()
    try:
        return _shard_tables(job, shard)
    except SonarError as error:
        return ShardResult(failure=str(error))
    except MemoryError:
        return ShardResult(failure=f"{shown(shard.source)}: not enough memory")
    except Exception as error:  # one shard must not end a run of thousands
        return ShardResult(failure=f"{shown(shard.source)}: {type(error).__name__}: {reason(error)}")


def _shard_tables(job: str, shard: Shard) -> ShardResult:
    import numpy as np

    from jaxsonar.batch_jobs.parquet_tables import encode_parquet
    from jaxsonar.batch_jobs.scan_tables import scan_tables
    from jaxsonar.batch_jobs.shard_reader import read_shard

    ring, method, settings, sigma = _decode_job(job)
    log, rows, reasons = read_shard(shard, ring)
    tables = scan_tables(
        ring, log, rows + shard.chunk.first, source=shard.source, method=method, settings=settings, sigma=sigma
    )
    counts = {name: int(np.sum(tables["scans"][name])) for name in COUNTS}
    encoded = {name: encode_parquet(name, columns) for name, columns in tables.items()}
    return ShardResult(encoded, counts, len(reasons), [reasons[row] for row in sorted(reasons)[:MAX_REASONS]])


@lru_cache(maxsize=4)
def _decode_job(job: str) -> "tuple[Ring, str, HoughSettings, float | None]":
    import numpy as np

    from jaxsonar.fileio.compilation_cache import use_compilation_cache
    from jaxsonar.kernels import HoughSettings
    from jaxsonar.sensors.ring import Ring

    use_compilation_cache()
    spec: dict[str, Any] = json.loads(job)
    ring: dict[str, Any] = {
        name: np.array(value) if isinstance(value, list) and name != "names" else value
        for name, value in spec["ring"].items()
    }
    settings = spec["settings"] | {"smoothing": tuple(spec["settings"]["smoothing"])}
    return Ring(**ring), spec["method"], HoughSettings(**settings), spec["sigma"]


def worker_loop(descriptor: int) -> None:
    """Main function of a worker process: receive a job, then shards, and return their results.

    The process ends when its parent closes the socket.

    Args:
        descriptor: file descriptor of the socket.
    """
    from multiprocessing.connection import Connection
    from queue import SimpleQueue

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent
    connection, shards = Connection(descriptor), SimpleQueue()

    def receive() -> None:
        while True:
            try:
                shards.put(connection.recv())
            except (EOFError, OSError):
                os._exit(0)  # the parent is gone; nobody needs the result

    job = connection.recv()
    threading.Thread(target=receive, daemon=True).start()
    # Import JAX before reporting readiness: if that fails, no shard is the cause.
    import jaxsonar.batch_jobs.scan_tables  # noqa: F401

    connection.send("ready")
    while True:
        connection.send(run_shard(job, shards.get()))
