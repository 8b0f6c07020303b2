"""Conversion between scan log formats, and import of recorded data sets."""

import os

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.datasets import read_corridor8, read_scitos24, read_sew_amr
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.csv_log import read_csv
from jaxsonar.scans.log_file import save_log
from jaxsonar.scans.parquet_log import read_parquet
from jaxsonar.scans.scan_log import Log, log_format

DATASET_READERS = {"corridor8": read_corridor8, "scitos24": read_scitos24, "sew-amr": read_sew_amr}
"""Readers of recorded data sets, by format name."""
LOG_READERS = {"csv": read_csv, "parquet": read_parquet}
"""Readers of scan logs, by format name."""


def convert(source: str | os.PathLike[str], destination: str | os.PathLike[str], *, from_: str | None = None) -> Log:
    """Read scans in one format and write them as a scan log.

    Args:
        source: a scan log, or the file or folder of a recorded data set.
        destination: the log to write; its suffix, ``.csv`` or ``.parquet``, determines the format.
        from_: format of the source: corridor8, scitos24, sew-amr, csv or parquet; from its suffix if omitted.

    Returns:
        The log that was written.

    Raises:
        SonarError: an unknown format, a source that cannot be read, or a destination that cannot be written.
    """
    log_format(destination)  # fail before a long read
    log = read_scans(source, from_=from_)
    save_log(log, destination)
    return log


def read_scans(source: str | os.PathLike[str], *, from_: str | None = None) -> Log:
    """The scans of a log or of a recorded data set; arguments and errors as ``convert``."""
    known = ", ".join((*DATASET_READERS, *LOG_READERS))
    if from_ is None:
        try:
            from_ = log_format(source)
        except SonarError as error:
            raise SonarError(f"{error}; for a recording name its format, one of {known}") from None
    if from_ in LOG_READERS:
        return LOG_READERS[from_](source)
    if from_ not in DATASET_READERS:
        raise SonarError(f"{shown(source)}: format '{shown(from_)}' came; allowed are {known}")
    echoes = DATASET_READERS[from_](source)
    return Log.from_echoes(
        echoes.scan_index,
        echoes.tx,
        echoes.rx,
        echoes.range,
        amplitude=echoes.amplitude,
        stamp=echoes.stamp,
        pose=echoes.pose,
    )
