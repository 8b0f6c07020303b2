"""From one file of scans to another, and from the formats of recorded devices to a scan log."""

import os

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.datasets import read_corridor8, read_scitos24, read_sew_amr
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.csv_log import read_csv
from jaxsonar.scans.log_file import save_log
from jaxsonar.scans.parquet_log import read_parquet
from jaxsonar.scans.scan_log import Log, log_format

RECORDINGS = {"corridor8": read_corridor8, "scitos24": read_scitos24, "sew-amr": read_sew_amr}
LOGS = {"csv": read_csv, "parquet": read_parquet}


def convert(source: str | os.PathLike[str], destination: str | os.PathLike[str], *, from_: str | None = None) -> Log:
    """Read scans in one format and write them as a scan log.

    Args:
        source: a scan log, or a recording: its file or folder.
        destination: the log to write; its suffix, ``.csv`` or ``.parquet``, decides the format.
        from_: format of the source: corridor8, scitos24, sew-amr, csv or parquet; its suffix decides where left out.

    Returns:
        What was written.

    Raises:
        SonarError: an unknown format, a source that cannot be read, or a destination that cannot be written.
    """
    log_format(destination)  # complain before a long read, not after it
    log = read_scans(source, from_=from_)
    save_log(log, destination)
    return log


def read_scans(source: str | os.PathLike[str], *, from_: str | None = None) -> Log:
    """The scans of a log or of a recording; see ``convert``."""
    known = ", ".join((*RECORDINGS, *LOGS))
    if from_ is None:
        try:
            from_ = log_format(source)
        except SonarError as error:
            raise SonarError(f"{error}; for a recording name its format, one of {known}") from None
    if from_ in LOGS:
        return LOGS[from_](source)
    if from_ not in RECORDINGS:
        raise SonarError(f"{shown(source)}: format '{shown(from_)}' came; allowed are {known}")
    heard = RECORDINGS[from_](source)
    return Log.from_echoes(
        heard.scan_index,
        heard.tx,
        heard.rx,
        heard.range,
        amplitude=heard.amplitude,
        stamp=heard.stamp,
        pose=heard.pose,
    )
