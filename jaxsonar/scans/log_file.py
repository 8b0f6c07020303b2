"""Read and write scan logs; the suffix of the file chooses the format."""

import os

from jaxsonar.hardware.recorder_base import recording_marker
from jaxsonar.scans.scan_log import Log, log_format


def load_log(path: str | os.PathLike[str]) -> Log:
    """A scan log from a ``.csv`` or ``.parquet`` file.

    Args:
        path: the file; its suffix, in either case, decides how it is read. Of a recording whose process was killed
            (there is a ``.recording`` file beside it) everything that is whole, with a warning if anything is not.

    Raises:
        SonarError: the file cannot be read or holds what no log can; one line with file, row, column and what is
            allowed.
    """
    if recording_marker(path).exists():
        from jaxsonar.scans.recording_journal import load_cut_short

        return load_cut_short(path)
    if log_format(path) == "csv":
        from jaxsonar.scans.csv_log import read_csv

        return read_csv(path)
    from jaxsonar.scans.parquet_log import read_parquet

    return read_parquet(path)


def save_log(log: Log, path: str | os.PathLike[str]) -> None:
    """Write a scan log as ``.csv`` or ``.parquet``; both carry the same, without loss.

    Args:
        log: the scans.
        path: the file; its suffix, in either case, decides the format. It is replaced only once all is written.

    Raises:
        SonarError: another suffix, or a place that cannot be written.
    """
    if log_format(path) == "csv":
        from jaxsonar.scans.csv_log import write_csv

        write_csv(log, path)
    else:
        from jaxsonar.scans.parquet_log import write_parquet

        write_parquet(log, path)
