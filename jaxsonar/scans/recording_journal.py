"""Recording of scan logs, and recovery of a log whose recording process was killed.

A Parquet file cannot be read before its footer is written. Its scans are therefore recorded as a CSV journal beside it
and converted at the end. A marker file holds the number of bytes of complete scans.
"""

import os
import warnings
from pathlib import Path

from jaxsonar.fileio.atomic_files import read_bytes, shown
from jaxsonar.hardware.recorder import CsvRecorder, open_recorder
from jaxsonar.hardware.recorder_base import Recorder, recording_marker
from jaxsonar.scans.scan_log import Log, log_format

MAX_MARKER_DIGITS = 20
"""A marker with more digits is no size of a file."""


class TruncatedRecording(UserWarning):
    """A recording is incomplete: its process was killed or is still writing."""


class ParquetRecorder(CsvRecorder):
    """Recorder of a Parquet log by way of a CSV journal beside it."""

    def __init__(self, filename: str | os.PathLike[str]):
        """Start a log.

        Raises:
            SonarError: the file cannot be written, or the parquet extra is missing.
        """
        from jaxsonar.scans.parquet_log import write_parquet

        self._target = Path(filename)
        # Write an empty log first: a missing extra or folder is reported now, and an old log is replaced.
        write_parquet(Log.from_scans([]), filename)
        super().__init__(journal_filename(filename), marker=recording_marker(filename))

    def close(self) -> None:
        """Convert the journal to Parquet and delete it."""
        if not self._descriptors:
            return
        from jaxsonar.scans.csv_log import read_csv
        from jaxsonar.scans.parquet_log import write_parquet

        journal = journal_filename(self._target)
        write_parquet(read_csv(journal), self._target)
        super().close()
        journal.unlink()


def journal_filename(filename: str | os.PathLike[str]) -> Path:
    """Filename of the CSV journal of a Parquet log that is being recorded."""
    return Path(f"{os.fspath(filename)}.recording.csv")


def open_log_recorder(filename: str | os.PathLike[str]) -> Recorder:
    """Start a recording as ``.csv``, ``.parquet`` or ``.mcap``; see ``hardware.recorder.open_recorder``.

    Raises:
        SonarError: another suffix, a file that cannot be written, or a missing extra.
    """
    return ParquetRecorder(filename) if Path(filename).suffix.lower() == ".parquet" else open_recorder(filename)


def recover_recording(filename: str | os.PathLike[str]) -> Log:
    """The complete scans of a log that is being recorded, or whose recording process was killed.

    Warns with ``TruncatedRecording``, unless a Parquet log is complete.

    Raises:
        SonarError: as ``load_log``.
    """
    from jaxsonar.scans.csv_log import read_csv_text
    from jaxsonar.scans.parquet_log import read_parquet

    parquet = log_format(filename) == "parquet"
    source = journal_filename(filename) if parquet else filename
    if parquet and _is_newer(filename, source):
        return read_parquet(filename)  # complete; only the journal was not yet deleted
    text = read_bytes(source, what="a scan log (CSV)")
    marker = read_bytes(recording_marker(filename), what="the size of a log").strip()
    size = int(marker or b"0") if len(marker) < MAX_MARKER_DIGITS and (marker or b"0").isdigit() else len(text) + 1
    complete = text[:size] if len(text) >= size else _without_last_scan(text)
    log = read_csv_text(source, complete) if b"\n" in complete else Log.from_scans([])
    cut = ", the last one is truncated" if len(complete) < len(text) else ""
    detail = f" recovered from {shown(source)}" if parquet else f" recovered{cut}"
    message = f"{shown(filename)}: the recording is incomplete: {len(log)} scans{detail}"
    warnings.warn(message, TruncatedRecording, stacklevel=3)
    return log


def _is_newer(filename: str | os.PathLike[str], other: str | os.PathLike[str]) -> bool:
    """Whether a file exists and is not older than another one."""
    try:
        return os.stat(filename).st_mtime_ns >= os.stat(other).st_mtime_ns
    except OSError:
        return os.path.exists(filename)


def _without_last_scan(text: bytes) -> bytes:
    """The rows before the last scan, which may be incomplete in a file that is shorter than its marker states."""
    rows = text.splitlines(keepends=True)
    if rows and not rows[-1].endswith(b"\n"):
        rows.pop()
    last = rows[-1].partition(b",")[0] if rows else b""
    while len(rows) > 1 and rows[-1].partition(b",")[0] == last:
        rows.pop()
    return b"".join(rows)
