"""Recorders: scan logs as CSV here, raw messages in ``mcap_recorder``.

A scan is handed to the operating system as soon as it is complete. A killed process loses at most the scan that it was
writing. While a log is being recorded, a marker file lies beside it (``recording_marker``, suffix ``.recording``). It
holds the number of bytes of the log that are complete scans. Readers of a log evaluate a marker that is left over.
"""

import os
from pathlib import Path

import numpy as np

from .errors import SonarError, shown
from .recorder_base import Recorder, recording_marker
from .scan_assembler import RawScan
from .transport_base import OnEvent, Source, Url

HEADER = "scan,stamp,x,y,theta,tx,rx,range,amplitude,t\n"
"""Columns of a scan log."""


def open_recorder(filename: str | os.PathLike[str]) -> Recorder:
    """Start a recording. The suffix selects the format.

    ``.csv``: a scan log. ``.mcap``: all messages with host and device clock, and the link events (extra ``live``).

    Args:
        filename: the file; an existing one is replaced at once.

    Raises:
        SonarError: another suffix, a file that cannot be written, or a missing extra.
    """
    suffix = Path(filename).suffix.lower()
    if suffix == ".csv":
        return CsvRecorder(filename, marker=recording_marker(filename))
    if suffix == ".mcap":
        from .mcap_recorder import McapRecorder

        return McapRecorder(filename)
    came = f"suffix '{shown(suffix)}'" if suffix else "no suffix"
    raise SonarError(f"{shown(filename)}: {came} came; allowed for a record is .csv, .parquet or .mcap")


class CsvRecorder(Recorder):
    """Records a scan log as CSV. Each complete scan is one write to the operating system."""

    def __init__(self, filename: str | os.PathLike[str], *, marker: Path):
        """Create the log and its marker.

        Args:
            filename: the log; an existing one is replaced at once.
            marker: marker file, kept until ``close``; holds the number of bytes that are complete scans.

        Raises:
            SonarError: a file cannot be written.
        """
        self._filename, self._marker = filename, marker
        self._size = 0
        self._descriptors: list[int] = []
        try:
            for name in (marker, filename):  # the marker first: a log without one counts as complete
                self._descriptors.append(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666))
            self._write(HEADER.encode())
        except OSError as failure:
            for descriptor in self._descriptors:
                os.close(descriptor)
            marker.unlink(missing_ok=True)
            allowed = "a file that you may write"
            raise SonarError(f"{shown(filename)}: cannot write: {failure.strerror}; allowed is {allowed}") from None

    def scan(self, scan: RawScan) -> None:
        """See ``Recorder``."""
        try:
            self._write(csv_rows(scan).encode())
        except OSError as failure:
            needed = "enough disk space for the recording"
            raise SonarError(f"{shown(self._filename)}: {failure.strerror}; needed is {needed}") from None

    def close(self) -> None:
        """See ``Recorder``."""
        if self._descriptors:
            for descriptor in self._descriptors:
                os.close(descriptor)
            self._descriptors = []
            self._marker.unlink(missing_ok=True)

    def _write(self, data: bytes) -> None:
        marker, log = self._descriptors
        remaining = memoryview(data)
        while remaining:
            remaining = remaining[os.write(log, remaining) :]
        self._size += len(data)
        os.pwrite(marker, f"{self._size:20d}\n".encode(), 0)


def csv_rows(scan: RawScan) -> str:
    """The CSV rows of one scan, each with its line end: echoes, then paths that heard nothing."""
    has_pose = np.isfinite(scan.pose).all()
    pose = ",".join(map(repr, scan.pose.tolist())) if has_pose else ",,"
    head = f"{scan.scan},{scan.stamp!r},{pose},"
    end = [f",{time!r}\n" if time else ",\n" for time in scan.group_time.tolist()]
    echoes = scan.echoes
    columns = (echoes["tx"], echoes["rx"], scan.ranges, echoes["amplitude"], scan.group)
    rows = [
        f"{head}{tx},{rx},{range_!r},{'' if amplitude != amplitude else repr(amplitude)}{end[group]}"  # NaN != NaN
        for tx, rx, range_, amplitude, group in zip(*(column.tolist() for column in columns), strict=True)
    ]
    silent = [] if scan.silent is None else scan.silent.tolist()
    rows += [f"{head}{tx},{rx},,{end[group]}" for group, tx, rx in silent]
    return "".join(rows) or f"{head},,,,\n"


def open_recording(url: Url, *, on_event: OnEvent, reconnect: bool, silence: float) -> Source:
    """Opener of ``file:RECORD.mcap?speed=1``: replays a raw recording. See ``open_source``.

    Args:
        url: option ``speed`` is the playback speed, 0 for as fast as possible.
        on_event: never called; a file has no link events.
        reconnect: ignored.
        silence: ignored.

    Raises:
        SonarError: no such file, or another suffix.
    """
    if Path(url.path).suffix.lower() != ".mcap":
        raise url.error(f"'{shown(Path(url.path).name)}' came", "a .mcap record (for scan logs use jaxsonar.stream)")
    from .mcap_recorder import play_mcap

    return play_mcap(url, speed=playback_speed(url))


def playback_speed(url: Url) -> float:
    """The option ``speed`` of a ``file:`` URL, 1 by default.

    Raises:
        SonarError: not a number in range, another option, a host, or no filename.
    """
    url.check_options("speed")
    if url.host or url.port is not None or not url.path:
        raise url.error("no filename came", "file:LOG?speed=1")
    return url.number("speed", 1.0, 0.0, 1e6)
