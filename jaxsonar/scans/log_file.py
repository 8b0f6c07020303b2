"""Reading and writing of scan logs as CSV and Parquet."""

import os
from collections.abc import Callable, Sequence

import numpy as np

from jaxsonar.hardware.recorder_base import recording_marker
from jaxsonar.scans.readings import explicit_log
from jaxsonar.scans.scan_log import Log, log_format

PARQUET_MAGIC = b"PAR1"
"""First bytes of a Parquet file."""


def load_scan_log(filename: str | os.PathLike[str], *, no_echo: Sequence[float] = ()) -> Log:
    """Load a scan log in CSV or Parquet. Its content decides which, not its suffix.

    Args:
        filename: the file. If a ``.recording`` file beside it shows that the recording process was killed, all complete
            scans are loaded, with a warning if any is incomplete.
        no_echo: ranges that mean no echo, metres; those that are no valid ranges, such as 0, become
            ``no_echo_values.as_range`` in the log.

    Raises:
        SonarError: the file cannot be read or is invalid; the message names file, row, column and allowed values.
    """
    if recording_marker(filename).exists():
        from jaxsonar.scans.recording_journal import recover_recording

        return recover_recording(filename)
    if _is_parquet(filename):
        from jaxsonar.scans.parquet_log import read_parquet

        return read_parquet(filename, no_echo=no_echo)
    from jaxsonar.scans.csv_log import read_csv

    return read_csv(filename, no_echo=no_echo)


def save_log(log: Log, filename: str | os.PathLike[str], *, on_note: Callable[[str], None] | None = None) -> None:
    """Write a scan log as ``.csv`` or ``.parquet``; both formats are lossless.

    Args:
        log: the scans.
        filename: the file; its suffix, in either case, determines the format. An existing file is replaced only after
            the new one is complete.
        on_note: called with a warning if the file cannot hold what the log measured (``unmarked_paths``).

    Raises:
        SonarError: another suffix, or the file cannot be written.
    """
    if on_note is not None and (count := unmarked_paths(log)):
        on_note(f"warning: {unmarked_warning(count)}")
    if log_format(filename) == "csv":
        from jaxsonar.scans.csv_log import write_csv

        write_csv(log, filename)
    else:
        from jaxsonar.scans.parquet_log import write_parquet

        write_parquet(log, filename)


def unmarked_paths(log: Log) -> int:
    """Number of paths, counted in every scan, that the log did not measure but that are silent in its file.

    A file without any silent reading is implicit: all pairs heard anywhere in it count as measured by every scan. So
    an explicit log that holds echoes only is another one after it is saved and loaded.
    """
    if len(log.asked) or np.isnan(log.range).any():
        return 0
    loaded = Log.from_echoes(log.echo_scan, log.tx, log.rx, log.range, stamp=log.stamp, pose=log.pose)
    return len(explicit_log(loaded).tx) - len(log.tx)


def unmarked_warning(count: int) -> str:
    """A warning about paths that are silent in a file: what, likely cause, what to do."""
    what = f"{count} paths of scans were not measured, but count as silent in the file, which holds echoes only"
    cause = "the device probably does not report what it measured without hearing anything"
    return f"{what}; {cause}; use the recording itself, or record silent readings, too"


def _is_parquet(filename: str | os.PathLike[str]) -> bool:
    try:
        with open(filename, "rb") as file:
            return file.read(len(PARQUET_MAGIC)) == PARQUET_MAGIC
    except (OSError, ValueError):
        return log_format(filename) == "parquet"  # the reader reports the error
