"""Reading and writing of scan logs; the suffix of the file determines the format."""

import os

from jaxsonar.hardware.recorder_base import recording_marker
from jaxsonar.scans.scan_log import Log, log_format


def load_log(filename: str | os.PathLike[str]) -> Log:
    """Load a scan log from a ``.csv`` or ``.parquet`` file.

    Args:
        filename: the file; its suffix, in either case, determines the format. If a ``.recording`` file beside it shows
            that the recording process was killed, all complete scans are loaded, with a warning if any is incomplete.

    Raises:
        SonarError: the file cannot be read or is invalid; the message names file, row, column and allowed values.
    """
    if recording_marker(filename).exists():
        from jaxsonar.scans.recording_journal import recover_recording

        return recover_recording(filename)
    if log_format(filename) == "csv":
        from jaxsonar.scans.csv_log import read_csv

        return read_csv(filename)
    from jaxsonar.scans.parquet_log import read_parquet

    return read_parquet(filename)


def save_log(log: Log, filename: str | os.PathLike[str]) -> None:
    """Write a scan log as ``.csv`` or ``.parquet``; both formats are lossless.

    Args:
        log: the scans.
        filename: the file; its suffix, in either case, determines the format. An existing file is replaced only after
            the new one is complete.

    Raises:
        SonarError: another suffix, or the file cannot be written.
    """
    if log_format(filename) == "csv":
        from jaxsonar.scans.csv_log import write_csv

        write_csv(log, filename)
    else:
        from jaxsonar.scans.parquet_log import write_parquet

        write_parquet(log, filename)
