"""Staging: Parquet copies of inputs that cannot be read in parts."""

from collections.abc import Callable, Iterable
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np

from jaxsonar.batch_jobs.inputs import Input
from jaxsonar.fileio.atomic_files import atomic_write, reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.plausibility.prepared_log import prepared_log
from jaxsonar.recordings.input_options import InputOptions
from jaxsonar.recordings.load_log import load_log_with_warnings
from jaxsonar.scans.parquet_log import open_parquet, write_parquet_chunks
from jaxsonar.scans.readings import unique_readings
from jaxsonar.sensors.ring import Ring


class Staged(NamedTuple):
    """What a Parquet copy does not hold of its log."""

    odometry: str
    """NumPy file with the motion of the robot (``Log.motion``), beside the copy; empty if there is none."""
    asked: tuple[tuple[int, int], ...]
    """``Log.asked``."""


def check_extras(logs: Iterable[Input]) -> None:
    """Check that the extras are installed that the inputs need.

    Raises:
        SonarError: an extra is missing.
    """
    for log in logs:
        is_raw = log.format == "record"
        if log.format in ("record", "bag") and find_spec("mcap" if is_raw else "rosbags") is None:
            what, extra = ("records", "live") if is_raw else ("bags", "ros")
            raise SonarError(f"{shown(log.source)}: {what} need the extra {extra}: pip install 'jaxsonar[{extra}]'")


def stage_whole(
    log: Input, filename: str, *, ring: Ring, rows: int, options: InputOptions, on_note: Callable[[str], None]
) -> Staged:
    """Load and prepare an input, and write it as a Parquet log with small row groups.

    Args:
        log: the input.
        filename: the copy.
        ring: the sensors.
        rows: number of rows in a row group.
        options: how the input is read.
        on_note: as in ``prepared_log``.

    Raises:
        SonarError: the input cannot be read, or an extra is missing.
    """
    whole = load_log_with_warnings(log.filename, ring=ring, options=options, on_note=on_note)
    whole = unique_readings(prepared_log(ring, whole, on_note=on_note))
    write_parquet_chunks((whole[k : k + rows] for k in range(0, len(whole), rows)), filename)
    asked = tuple((tx, rx) for tx, rx in whole.asked.tolist())
    if whole.motion is None:
        return Staged("", asked)
    odometry = f"{filename}.odometry.npy"
    np.save(odometry, whole.motion)
    return Staged(odometry, asked)


def regroup(log: Input, filename: str, *, rows: int) -> None:
    """Copy a Parquet log with small row groups. Memory is bounded by one row group.

    Raises:
        SonarError: the input cannot be read.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = open_parquet(log.filename, name=log.source)
    try:
        with atomic_write(filename, binary=True) as sink, pq.ParquetWriter(sink, file.schema_arrow) as writer:
            for batch in file.iter_batches(batch_size=rows):
                writer.write_batch(batch)
    except pa.ArrowException as failure:
        raise SonarError(f"{shown(log.source)}: {reason(failure)}; needed is a whole Parquet file") from None
