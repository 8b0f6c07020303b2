"""Published data sets as logs."""

import os

from jaxsonar.hardware.datasets import read_corridor8, read_scitos24, read_sew_amr
from jaxsonar.scans.scan_log import Log

DATASET_READERS = {"corridor8": read_corridor8, "scitos24": read_scitos24, "sew-amr": read_sew_amr}
"""Readers of published data sets, by format name."""


def load_dataset(filename: str | os.PathLike[str], format: str) -> Log:
    """A published data set as a log, with all of its readings.

    Args:
        filename: file or folder of the data set.
        format: a key of ``DATASET_READERS``.

    Raises:
        SonarError: the data set cannot be read.
    """
    recording = DATASET_READERS[format](filename)
    return Log.from_echoes(
        recording.scan_index,
        recording.tx,
        recording.rx,
        recording.range,
        age=recording.age,
        stamp=recording.stamp,
        pose=recording.pose,
    )
