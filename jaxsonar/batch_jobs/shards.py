"""Splits inputs into shards. The split depends on the inputs alone."""

import os
from dataclasses import dataclass
from pathlib import Path

from jaxsonar.batch_jobs.inputs import Input
from jaxsonar.fileio.atomic_files import reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.log_chunks import LogChunk, csv_chunks, parquet_chunks

SHARD_SCANS = 2048
"""Scans per shard: some seconds of work, so that a lost process costs little, and not too many files."""
MAX_ROW_GROUP = 32 * SHARD_SCANS
"""Maximum number of rows in a Parquet row group. A log with larger ones is staged in small row groups; otherwise every
shard would read all of a group."""


@dataclass(frozen=True)
class Shard:
    """Consecutive scans of one log: one task, and one file per table."""

    key: str
    """Name of its files, without suffix."""
    source: str
    """Name of the log."""
    filename: str
    """File to read: the log, or its staged copy."""
    format: str
    """csv or parquet."""
    size: int
    """Size of that file when the shard was planned, bytes."""
    modified_ns: int
    """Modification time of that file when the shard was planned, nanoseconds."""
    chunk: LogChunk
    """The scans in that file."""


def split_input(log: Input, *, staging: Path, sensors: int, scans: int = SHARD_SCANS) -> list[Shard]:
    """Split an input into shards, in bounded memory.

    Args:
        log: the input.
        staging: folder for a Parquet copy of formats that cannot be read in parts; created if needed.
        sensors: number of sensors of the ring, for raw recordings.
        scans: scans per shard.

    Raises:
        SonarError: the input cannot be read, or is not a log.
    """
    filename, format_ = log.filename, log.format
    if format_ not in ("csv", "parquet") or (format_ == "parquet" and _largest_row_group(log) > MAX_ROW_GROUP):
        from jaxsonar.batch_jobs.parquet_staging import stage_as_parquet

        filename, format_ = os.fspath(staging / f"{log.key}.parquet"), "parquet"
        staging.mkdir(exist_ok=True)
        stage_as_parquet(log, filename, sensors=sensors, rows=scans)
    try:
        status = os.stat(filename)
    except OSError as failure:
        raise SonarError(f"{shown(log.source)}: {reason(failure)}; needed is a readable log") from None
    chunks = (csv_chunks if format_ == "csv" else parquet_chunks)(filename, name=log.source, scans=scans)
    return [
        Shard(f"{log.key}-{k:06d}", log.source, filename, format_, status.st_size, status.st_mtime_ns, chunk)
        for k, chunk in enumerate(chunks)
    ]


def _largest_row_group(log: Input) -> int:
    from jaxsonar.scans.parquet_log import open_parquet

    file = open_parquet(log.filename, name=log.source).metadata
    return max((file.row_group(k).num_rows for k in range(file.num_row_groups)), default=0)
