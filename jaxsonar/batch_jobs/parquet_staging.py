"""Staging: Parquet copies of inputs that cannot be read in parts (bags, raw recordings, large row groups)."""

import os
import warnings
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from itertools import islice

from jaxsonar.batch_jobs.inputs import Input
from jaxsonar.fileio.atomic_files import atomic_write, reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.mcap_recorder import MESSAGES, PROFILE, read_mcap
from jaxsonar.hardware.protocol import Decoder
from jaxsonar.hardware.scan_assembler import ScanAssembler
from jaxsonar.scans.log_file import load_log
from jaxsonar.scans.parquet_log import open_parquet, write_parquet_chunks
from jaxsonar.scans.raw_scans import scan_from_raw
from jaxsonar.scans.scan_log import Log, Scan

MCAP_MAGIC = b"\x89MCAP0\r\n"


def check_extras(logs: Iterable[Input]) -> None:
    """Check that the extras are installed that the inputs need.

    Raises:
        SonarError: an extra is missing.
    """
    for log in logs:
        is_raw = log.format == "mcap" and _is_raw_recording(log.filename)
        if log.format in ("mcap", "bag") and find_spec("mcap" if is_raw else "rosbags") is None:
            what, extra = ("records", "live") if is_raw else ("bags", "ros")
            raise SonarError(f"{shown(log.source)}: {what} need the extra {extra}: pip install 'jaxsonar[{extra}]'")


def stage_as_parquet(log: Input, filename: str, *, sensors: int, rows: int) -> None:
    """Write an input as a Parquet log with small row groups. Memory is bounded by one row group.

    Args:
        log: the input.
        filename: the copy.
        sensors: number of sensors of the ring.
        rows: maximum number of rows in a row group.

    Raises:
        SonarError: the input cannot be read, or an extra is missing.
    """
    if log.format == "parquet":
        _regroup(log, filename, rows)
    elif log.format == "recording":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scans = load_log(log.filename)
        write_parquet_chunks([scans], filename)
    elif log.format == "mcap" and _is_raw_recording(log.filename):
        write_parquet_chunks(_row_groups(_raw_recording_scans(log.filename, log.source, sensors), rows), filename)
    else:
        from jaxsonar.scans.rosbag_log import read_bag_scans

        write_parquet_chunks(_row_groups(read_bag_scans(log.filename, name=log.source), rows), filename)


def _regroup(log: Input, filename: str, rows: int) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = open_parquet(log.filename, name=log.source)
    try:
        with atomic_write(filename, binary=True) as sink, pq.ParquetWriter(sink, file.schema_arrow) as writer:
            for batch in file.iter_batches(batch_size=rows):
                writer.write_batch(batch)
    except pa.ArrowException as failure:
        raise SonarError(f"{shown(log.source)}: {reason(failure)}; needed is a whole Parquet file") from None


def _is_raw_recording(filename: str | os.PathLike[str]) -> bool:
    """Whether an MCAP file is a raw recording of ``jaxsonar stream --record``, by the profile in its header."""
    try:
        with open(filename, "rb") as file:
            head = file.read(64)
    except OSError:
        return False  # the error is reported when the file is read
    # magic, opcode 1, length of the record (8 bytes), length of the profile (4 bytes), profile
    profile = PROFILE.encode()
    return head.startswith(MCAP_MAGIC) and head[21 : 21 + len(profile)] == profile


def _raw_recording_scans(filename: str, name: str, sensors: int) -> Iterator[Scan]:
    """The scans of a raw recording, each at the pose of its last firing group."""
    decoder, assembler = Decoder(sensors=sensors), ScanAssembler(sensors=sensors)
    for topic, received, frame in read_mcap(filename):
        if topic == MESSAGES:
            for message in decoder.feed(frame):
                assembler.unknown_messages = decoder.counts.unknown + decoder.counts.newer > 0
                yield from map(scan_from_raw, assembler.push(message, received))
            if decoder.counts.out_of_ring:
                raise SonarError(f"{shown(name)}: an unknown sensor came; allowed is 0 to {sensors - 1}")
    yield from map(scan_from_raw, assembler.flush())


def _row_groups(scans: Iterator[Scan], rows: int) -> Iterator[Log]:
    while group := list(islice(scans, rows)):
        yield Log.from_scans(group)
