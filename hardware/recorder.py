"""What a device said, on disk while it says it: scan logs here, raw messages in ``recording_mcap``.

A scan is handed to the operating system as soon as it is whole, so that a process that is killed loses what it was
writing just then. While a log is being written there is a small file beside it, named like it with ``.recording``
behind (``mark_of``), that says how many of its bytes are whole scans. If it is still there, readers go by it.
"""

import os
from pathlib import Path

import numpy as np

from .errors import SonarError
from .recorder_base import Recorder, mark_of
from .scan_assembler import RawScan
from .transport_base import OnEvent, Source, Url, shown

HEADER = "scan,stamp,x,y,theta,tx,rx,range,amplitude\n"
"""Columns of a scan log."""


def open_recorder(path: str | os.PathLike[str]) -> Recorder:
    """Begin a record; the suffix decides what is kept.

    ``.csv``: a scan log. ``.mcap``: all messages with both clocks, each group's pose and temperature, and what became
    of the link (extra ``live``).

    Args:
        path: the file, replaced at once.

    Raises:
        SonarError: another suffix, a place that cannot be written, a missing extra.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".csv":
        return CsvRecorder(path, mark=mark_of(path))
    if suffix == ".mcap":
        from .mcap_recorder import McapRecorder

        return McapRecorder(path)
    came = f"suffix '{shown(suffix)}'" if suffix else "no suffix"
    raise SonarError(f"{shown(path)}: {came} came; allowed for a record is .csv, .parquet or .mcap")


class CsvRecorder(Recorder):
    """A scan log as CSV, scan by scan: each is handed to the operating system in one piece, when it is whole."""

    def __init__(self, path: str | os.PathLike[str], *, mark: Path):
        """Begin a log.

        Args:
            path: the file, replaced at once.
            mark: kept beside it until ``close``: how many bytes are whole scans.

        Raises:
            SonarError: it cannot be written.
        """
        self._path, self._mark = path, mark
        self._size = 0
        self._files: list[int] = []
        try:
            for name in (mark, path):  # the mark first: a log without one is whole
                self._files.append(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666))
            self._write(HEADER.encode())
        except OSError as failure:
            for file in self._files:
                os.close(file)
            mark.unlink(missing_ok=True)
            allowed = "a file that you may write"
            raise SonarError(f"{shown(path)}: cannot write: {failure.strerror}; allowed is {allowed}") from None

    def scan(self, scan: RawScan) -> None:
        """See ``Recorder``."""
        try:
            self._write(scan_rows(scan).encode())
        except OSError as failure:
            raise SonarError(f"{shown(self._path)}: {failure.strerror}; needed is room for the record") from None

    def close(self) -> None:
        """See ``Recorder``."""
        if self._files:
            for file in self._files:
                os.close(file)
            self._files = []
            self._mark.unlink(missing_ok=True)

    def _write(self, data: bytes) -> None:
        mark, log = self._files
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(log, rest) :]
        self._size += len(data)
        os.pwrite(mark, f"{self._size:20d}\n".encode(), 0)


def scan_rows(scan: RawScan) -> str:
    """The rows of one scan in a CSV log, with their line ends."""
    known = np.isfinite(scan.pose).all()
    pose = ",".join(map(repr, scan.pose.tolist())) if known else ",,"
    head = f"{scan.scan},{scan.stamp!r},{pose},"
    if not len(scan.echoes):
        return f"{head},,,\n"
    echoes = scan.echoes
    columns = (echoes["tx"].tolist(), echoes["rx"].tolist(), scan.ranges.tolist(), echoes["amplitude"].tolist())
    return "".join(
        f"{head}{tx},{rx},{reach!r},{'' if loud != loud else repr(loud)}\n"  # NaN is not itself
        for tx, rx, reach, loud in zip(*columns, strict=True)
    )


def open_file(url: Url, *, on_event: OnEvent, reconnect: bool, silence: float) -> Source:
    """``file:RECORD.mcap?speed=1``: a raw record as if live. See ``open_source``.

    Args:
        url: ``speed`` is how many times as fast as it was recorded, 0 as fast as it goes.
        on_event: told of nothing: a file is always there.
        reconnect: of no use.
        silence: of no use.

    Raises:
        SonarError: no such file, another suffix.
    """
    if Path(url.path).suffix.lower() != ".mcap":
        raise url.fail(f"'{shown(Path(url.path).name)}' came", "a .mcap record (scan logs need jaxsonar.streaming)")
    from .mcap_recorder import McapPlayer

    return McapPlayer(url, speed=speed_of(url))


def speed_of(url: Url) -> float:
    """The option ``speed`` of a file's URL; 1 without it.

    Raises:
        SonarError: it is no such number, or there is another option, a host or no path.
    """
    url.check_options("speed")
    if url.host or url.port is not None or not url.path:
        raise url.fail("no path of a file came", "file:LOG?speed=1")
    return url.number("speed", 1.0, 0.0, 1e6)
