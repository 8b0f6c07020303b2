"""Logs that are recorded live, and what a killed process left of them."""

import os
import warnings
from pathlib import Path

from jaxsonar.fileio.atomic_files import read_bytes, shown
from jaxsonar.hardware.recorder import CsvRecorder, open_recorder
from jaxsonar.hardware.recorder_base import Recorder, recording_marker
from jaxsonar.scans.scan_log import Log, log_format


class CutShort(UserWarning):
    """A recording was not finished: its process was killed, or is still writing."""


class ParquetRecorder(CsvRecorder):
    """A scan log as Parquet by way of a journal beside it, a CSV log.

    Of a Parquet file nothing can be read before its end is written; of the journal everything can, at any time.
    """

    def __init__(self, path: str | os.PathLike[str]):
        """Begin a log.

        Raises:
            SonarError: it cannot be written, or the extra is missing.
        """
        from jaxsonar.scans.parquet_log import write_parquet

        self._target = Path(path)
        # An empty log first: a missing extra or folder shows now, and what was there before is gone.
        write_parquet(Log.from_scans([]), path)
        super().__init__(journal_of(path), marker=recording_marker(path))

    def close(self) -> None:
        """Turn the journal into Parquet, and take it away."""
        if not self._descriptors:
            return
        from jaxsonar.scans.csv_log import read_csv
        from jaxsonar.scans.parquet_log import write_parquet

        journal = journal_of(self._target)
        write_parquet(read_csv(journal), self._target)
        super().close()
        journal.unlink()


def journal_of(path: str | os.PathLike[str]) -> Path:
    """The CSV log beside a Parquet file that is being recorded."""
    return Path(f"{os.fspath(path)}.recording.csv")


def open_record(path: str | os.PathLike[str]) -> Recorder:
    """Begin a record: ``.csv``, ``.parquet`` or ``.mcap``; see ``hardware.recording.open_recorder``.

    Raises:
        SonarError: another suffix, a place that cannot be written, a missing extra.
    """
    return ParquetRecorder(path) if Path(path).suffix.lower() == ".parquet" else open_recorder(path)


def load_cut_short(path: str | os.PathLike[str]) -> Log:
    """What is whole of a log that is being recorded, or was when its process was killed.

    ``CutShort`` is warned of where anything is left out, or had to be taken from a journal.

    Raises:
        SonarError: as ``load_log``.
    """
    from jaxsonar.scans.csv_log import read_csv_text
    from jaxsonar.scans.parquet_log import read_parquet

    parquet = log_format(path) == "parquet"
    source = journal_of(path) if parquet else path
    if parquet and _later(path, source):
        return read_parquet(path)  # only the journal was left to be taken away
    text = read_bytes(source, what="a scan log (CSV)")
    said = read_bytes(recording_marker(path), what="the size of a log").strip()
    size = int(said) if said.isdigit() else 0
    whole = text[:size] if len(text) >= size else _without_last_scan(text)
    log = read_csv_text(source, whole) if b"\n" in whole else Log.from_scans([])
    if parquet or len(whole) < len(text):
        taken = f", taken from {shown(source)}" if parquet else "; a last one is not whole"
        text = f"{shown(path)}: the recording was cut short: {len(log)} scans{taken}"
        warnings.warn(text, CutShort, stacklevel=3)
    return log


def _later(path: str | os.PathLike[str], other: str | os.PathLike[str]) -> bool:
    try:
        return os.stat(path).st_mtime_ns >= os.stat(other).st_mtime_ns
    except OSError:
        return os.path.exists(path)


def _without_last_scan(text: bytes) -> bytes:
    """The rows before the last scan: of a file that is shorter than it should be, it may lack some."""
    rows = text.splitlines(keepends=True)
    if rows and not rows[-1].endswith(b"\n"):
        rows.pop()
    last = rows[-1].partition(b",")[0] if rows else b""
    while len(rows) > 1 and rows[-1].partition(b",")[0] == last:
        rows.pop()
    return b"".join(rows)
