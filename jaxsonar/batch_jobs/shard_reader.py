"""Reads the scans of a shard. Scans that cannot be read or used are left out and reported."""

import os
from dataclasses import replace

import numpy as np
from jaxtyping import Int

from jaxsonar.batch_jobs.shard import Shard
from jaxsonar.fileio.atomic_files import reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.log_chunks import csv_chunk_reader, parquet_chunk_reader
from jaxsonar.scans.log_parts import concatenate, readable_runs
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


def read_shard(shard: Shard, ring: Ring) -> tuple[Log, Int[np.ndarray, " scans"], dict[int, str]]:
    """Read the usable scans of a shard.

    Args:
        shard: the scans to read.
        ring: the sensors; echoes of other sensor numbers make a scan unusable.

    Returns:
        The usable scans, their rows in the shard, and for each unusable row the reason.

    Raises:
        SonarError: the file is missing, or has changed since the shard was planned.
    """
    try:
        status = os.stat(shard.filename)
    except OSError as failure:
        raise SonarError(f"{shown(shard.source)}: {reason(failure)}; needed is a readable log") from None
    if (status.st_size, status.st_mtime_ns) != (shard.size, shard.modified_ns):
        raise SonarError(f"{shown(shard.source)}: changed during the batch; needed is a log that does not change")
    reader = csv_chunk_reader if shard.format == "csv" else parquet_chunk_reader
    read = reader(shard.filename, shard.chunk, name=shard.source)

    runs, reasons = readable_runs(read, shard.chunk.scans)
    logs, rows = [], [np.zeros(0, np.int64)]
    for first_row, log in runs:
        unusable = _unusable_scans(shard, ring, first_row, log)
        usable = np.setdiff1d(np.arange(len(log)), np.array(list(unusable), np.int64))
        reasons |= {first_row + k: why for k, why in unusable.items()}
        logs.append(log._part(usable) if unusable else log)
        rows.append(first_row + usable)
    log = concatenate(logs)
    if shard.odometry:
        log = replace(log, odometry=np.load(shard.odometry, mmap_mode="r"))
    return log, np.concatenate(rows), reasons


def _unusable_scans(shard: Shard, ring: Ring, first_row: int, log: Log) -> dict[int, str]:
    """Readable scans that cannot be used, by row in ``log``: unknown sensors, or repeated scan numbers."""
    name, scan = shown(shard.source), log.echo_scan
    unknown = np.flatnonzero(np.maximum(log.tx, log.rx) >= ring.count)
    _, first = np.unique(scan[unknown], return_index=True)
    reasons = {}
    for echo in unknown[first].tolist():
        sensors = (
            f"tx {log.tx[echo]}, rx {log.rx[echo]}; allowed are 0 to {ring.count - 1}, the sensors of {ring.name!r}"
        )
        reasons[int(scan[echo])] = f"{name}: scan {log.scan[scan[echo]]}: echo of sensors {sensors}"
    for row in shard.chunk.repeated:
        if first_row <= row < first_row + len(log):
            number = log.scan[row - first_row]
            reasons[row - first_row] = f"{name}: scan {number} came again; allowed is each scan number once"
    return reasons
