"""What a batch reads: its inputs, and the shards that they are cut into, by the inputs alone."""

import os
from dataclasses import dataclass
from pathlib import Path

from jaxsonar.batch_jobs.inputs import Input
from jaxsonar.fileio.atomic_files import reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.log_chunks import Part, csv_parts, parquet_parts

SHARD_SCANS = 2048
"""Scans of one shard: some seconds of work, so that little is lost with a process, and few enough files."""
LARGEST_GROUP = 32 * SHARD_SCANS
"""Rows of a Parquet row group; of larger ones a copy in small groups is made, or every shard would read all of it."""


@dataclass(frozen=True)
class Shard:
    """A run of whole scans of one log: one task, one file in each table."""

    key: str
    """Name of its files, without suffix."""
    source: str
    """Name of the log."""
    path: str
    """File to read: the log, or a copy of it as Parquet."""
    kind: str
    """csv or parquet."""
    size: int
    """Bytes of that file, and the time of its last change in ns: how it was when it was cut into shards."""
    changed: int
    part: Part
    """Which of its scans."""


def shards_of(one: Input, *, copies: Path, sensors: int, scans: int = SHARD_SCANS) -> list[Shard]:
    """An input in shards, without holding it.

    Args:
        one: the input.
        copies: folder for a copy of what cannot be read in parts; it is made if it is needed.
        sensors: of the ring, for what devices recorded.
        scans: of a shard.

    Raises:
        SonarError: it cannot be read, or is no log.
    """
    path, kind = one.path, one.kind
    if kind not in ("csv", "parquet") or (kind == "parquet" and _largest_group(one) > LARGEST_GROUP):
        from jaxsonar.batch_jobs.parquet_staging import copy

        path, kind = os.fspath(copies / f"{one.key}.parquet"), "parquet"
        copies.mkdir(exist_ok=True)
        copy(one, path, sensors=sensors, rows=scans)
    try:
        seen = os.stat(path)
    except OSError as failure:
        raise SonarError(f"{shown(one.source)}: {reason(failure)}; needed is a readable log") from None
    parts = (csv_parts if kind == "csv" else parquet_parts)(path, name=one.source, scans=scans)
    return [
        Shard(f"{one.key}-{k:06d}", one.source, path, kind, seen.st_size, seen.st_mtime_ns, part)
        for k, part in enumerate(parts)
    ]


def _largest_group(one: Input) -> int:
    from jaxsonar.scans.parquet_log import open_parquet

    file = open_parquet(one.path, name=one.source).metadata
    return max((file.row_group(k).num_rows for k in range(file.num_row_groups)), default=0)
