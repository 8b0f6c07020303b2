"""Splits inputs into shards. The split depends on the inputs alone."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from jaxsonar.batch_jobs.inputs import Input
from jaxsonar.batch_jobs.parquet_staging import regroup, stage_whole
from jaxsonar.batch_jobs.shard import Shard
from jaxsonar.batch_jobs.shard_reader import read_shard
from jaxsonar.fileio.atomic_files import reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.plausibility.prepared_log import prepared_log
from jaxsonar.recordings.input_options import InputOptions
from jaxsonar.scans.log_chunks import csv_chunks, parquet_chunks
from jaxsonar.scans.log_parts import concatenate
from jaxsonar.sensors.ring import Ring

SHARD_SCANS = 2048
"""Scans per shard: some seconds of work, so that a lost process costs little, and not too many files."""
MAX_ROW_GROUP = 32 * SHARD_SCANS
"""Maximum number of rows in a Parquet row group. A log with larger ones is staged in small row groups; otherwise every
shard would read all of a group."""
HEAD_SCANS = 512
"""Number of scans at the beginning of a log that decide whether it must be prepared as a whole."""


def split_input(
    log: Input,
    *,
    staging: Path,
    ring: Ring,
    scans: int = SHARD_SCANS,
    options: InputOptions = InputOptions(),  # noqa: B008  immutable
    on_note: Callable[[str], None] = lambda text: None,
) -> list[Shard]:
    """Split an input into shards.

    CSV and Parquet logs are split in bounded memory. Logs that only make sense as a whole are loaded, prepared
    (``prepared_log``) and copied: other formats, recordings that have not ended, and logs whose first scans need more
    than the ring to be understood, such as marks for no echo or firings that are scans of their own.

    Args:
        log: the input.
        staging: folder for copies; created if needed.
        ring: the sensors.
        scans: scans per shard.
        options: how the input is read.
        on_note: called with one line for each choice and each warning about the input, as in ``prepared_log``.

    Raises:
        SonarError: the input cannot be read, or is not a log.
    """

    def copy() -> str:
        staging.mkdir(exist_ok=True)
        return os.fspath(staging / f"{log.key}.parquet")

    if log.format in ("csv", "parquet") and not log.recording and options.format in (None, log.format):
        filename = log.filename
        if log.format == "parquet" and _largest_row_group(log) > MAX_ROW_GROUP:
            regroup(log, filename := copy(), rows=scans)
        shards = _split(log, filename, log.format, scans)
        if not options.no_echo and _head_is_prepared(shards, ring, on_note):
            return shards
    staged = stage_whole(log, filename := copy(), ring=ring, rows=scans, options=options, on_note=on_note)
    shards = _split(log, filename, "parquet", scans)
    return [
        replace(shard, odometry=staged.odometry, chunk=replace(shard.chunk, asked=staged.asked)) for shard in shards
    ]


def _split(log: Input, filename: str, format_: str, scans: int) -> list[Shard]:
    """The shards of a CSV or Parquet file."""
    try:
        status = os.stat(filename)
    except OSError as failure:
        raise SonarError(f"{shown(log.source)}: {reason(failure)}; needed is a readable log") from None
    chunks = (csv_chunks if format_ == "csv" else parquet_chunks)(filename, name=log.source, scans=scans)
    return [
        Shard(f"{log.key}-{k:06d}", log.source, filename, format_, status.st_size, status.st_mtime_ns, chunk)
        for k, chunk in enumerate(chunks)
    ]


def _head_is_prepared(shards: list[Shard], ring: Ring, on_note: Callable[[str], None]) -> bool:
    """Whether the first scans of a log need no preparation; only then its warnings are reported here."""
    if not shards:
        return True
    if shards[0].chunk.in_turn:
        return False
    needed = -(-HEAD_SCANS // shards[0].chunk.scans)
    head = concatenate([read_shard(shard, ring)[0] for shard in shards[:needed]])[:HEAD_SCANS]
    notes: list[str] = []
    if prepared_log(ring, head, on_note=notes.append) is not head:
        return False
    for text in notes:
        on_note(text)
    return True


def _largest_row_group(log: Input) -> int:
    from jaxsonar.scans.parquet_log import open_parquet

    file = open_parquet(log.filename, name=log.source).metadata
    return max((file.row_group(k).num_rows for k in range(file.num_row_groups)), default=0)
