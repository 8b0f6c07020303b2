"""Copies as Parquet of inputs that cannot be read in parts: bags, raw records, recordings, huge row groups."""

import os
import warnings
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from itertools import islice

from jaxsonar.batch_jobs.inputs import Input
from jaxsonar.fileio.atomic_files import atomic_write, reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.protocol import Decoder
from jaxsonar.hardware.scan_assembler import Assembler, RawScan
from jaxsonar.scans.log_file import load_log
from jaxsonar.scans.parquet_log import open_parquet, write_parquet_parts
from jaxsonar.scans.scan_log import Log, Scan

MCAP_MAGIC = b"\x89MCAP0\r\n"
OURS = b"jaxsonar"
"""Profile in the header of our own raw records."""


def check_extras(logs: Iterable[Input]) -> None:
    """Complain before the work.

    Raises:
        SonarError: an extra is missing that one of the inputs needs.
    """
    for one in logs:
        ours = one.kind == "mcap" and _is_ours(one.path)
        if one.kind in ("mcap", "bag") and find_spec("mcap" if ours else "rosbags") is None:
            what, extra = ("records", "live") if ours else ("bags", "ros")
            raise SonarError(f"{shown(one.source)}: {what} need the extra {extra}: pip install 'jaxsonar[{extra}]'")


def copy(one: Input, path: str, *, sensors: int, rows: int) -> None:
    """Write an input as a Parquet log with small row groups, holding no more than one of them.

    Args:
        one: the input.
        path: the copy.
        sensors: of the ring that was recorded.
        rows: of a row group, at most.

    Raises:
        SonarError: it cannot be read, or an extra is missing.
    """
    if one.kind == "parquet":
        _regroup(one, path, rows)
    elif one.kind == "recording":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            log = load_log(one.path)
        write_parquet_parts([log], path)
    elif one.kind == "mcap" and _is_ours(one.path):
        write_parquet_parts(_logs(_recorded(one.path, one.source, sensors), rows), path)
    else:
        from jaxsonar.scans.rosbag_log import bag_scans

        write_parquet_parts(_logs(bag_scans(one.path, name=one.source), rows), path)


def _regroup(one: Input, path: str, rows: int) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = open_parquet(one.path, name=one.source)
    try:
        with atomic_write(path, binary=True) as sink, pq.ParquetWriter(sink, file.schema_arrow) as writer:
            for batch in file.iter_batches(batch_size=rows):
                writer.write_batch(batch)
    except pa.ArrowException as failure:
        raise SonarError(f"{shown(one.source)}: {reason(failure)}; needed is a whole Parquet file") from None


def _is_ours(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a raw record of ``jaxsonar stream --record``, by the profile in its header."""
    try:
        with open(path, "rb") as file:
            head = file.read(64)
    except OSError:
        return False  # said when it is read
    # magic, opcode 1, length of the record (8 bytes), length of the profile (4 bytes), profile
    return head.startswith(MCAP_MAGIC) and head[21 : 21 + len(OURS)] == OURS


def _recorded(path: str, name: str, sensors: int) -> Iterator[Scan]:
    """The scans of a raw record, each at the pose of its last group."""
    from jaxsonar.hardware.mcap_recorder import MESSAGES, read_mcap

    decoder, assembler = Decoder(sensors=sensors), Assembler(sensors=sensors)
    for topic, received, frame in read_mcap(path):
        if topic == MESSAGES:
            for message in decoder.feed(frame):
                assembler.skipped = decoder.counts.unknown + decoder.counts.newer > 0
                yield from map(_scan, assembler.push(message, received))
            if decoder.counts.out_of_ring:
                raise SonarError(f"{shown(name)}: a sensor beyond the ring came; allowed is 0 to {sensors - 1}")
    yield from map(_scan, assembler.flush())


def _scan(raw: RawScan) -> Scan:
    echoes = raw.echoes
    return Scan(
        scan=raw.scan,
        stamp=raw.stamp,
        pose=raw.pose,
        tx=echoes["tx"].astype(int),
        rx=echoes["rx"].astype(int),
        range=raw.ranges,
        amplitude=echoes["amplitude"].astype(float),
    )


def _logs(scans: Iterator[Scan], rows: int) -> Iterator[Log]:
    while some := list(islice(scans, rows)):
        yield Log.from_scans(some)
