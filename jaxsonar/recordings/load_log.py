"""Loading of recordings of any kind as a log: the content of the file decides how it is read."""

import os
from collections.abc import Callable

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.recorder_base import recording_marker
from jaxsonar.recordings.file_content import DESCRIPTIONS, check_suffix, file_content
from jaxsonar.recordings.input_options import FORMATS, InputOptions
from jaxsonar.scans.log_file import load_scan_log
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


def load_log(
    filename: str | os.PathLike[str],
    *,
    ring: Ring | None = None,
    options: InputOptions = InputOptions(),  # noqa: B008  immutable
    on_note: Callable[[str], None] | None = None,
) -> Log:
    """Load a recording: a scan log (CSV or Parquet), a raw recording (MCAP), or a ROS bag.

    The content of the file decides, not its suffix.

    Args:
        filename: the file, or the folder of a ROS 2 bag. If a ``.recording`` file beside it shows that the recording
            process was killed, all complete scans are loaded, with a warning if any is incomplete.
        ring: the sensors; a bag may need their names, and a raw recording is checked against them.
        options: what the file does not say itself.
        on_note: called with one line for each choice that was made; None: the notes are dropped.

    Raises:
        SonarError: the file cannot be read, is no recording, or needs an option; the message names what came.
    """
    note = on_note or _no_note
    if options.format not in (None, *FORMATS):
        allowed = ", ".join(FORMATS)
        raise SonarError(f"{shown(filename)}: format '{shown(options.format, 40)}' came; allowed are {allowed}")
    if recording_marker(filename).exists():
        return load_scan_log(filename)
    content = file_content(filename)
    if options.format is None:
        if (warning := check_suffix(filename, content)) is not None:
            note(warning)
    elif content != options.format:
        raise SonarError(f"{shown(filename)}: this is {DESCRIPTIONS[content]}, not {DESCRIPTIONS[options.format]}")
    if content in ("csv", "parquet"):
        return load_scan_log(filename)
    if content == "record":
        from jaxsonar.recordings.mcap_records import recorded_scans

        return Log.from_scans(list(recorded_scans(filename, ring=ring)))
    if content == "bag":
        from jaxsonar.scans.rosbag_log import read_bag_scans

        return Log.from_scans(list(read_bag_scans(filename, name=os.fspath(filename))))
    raise SonarError(f"{shown(filename)}: this is {DESCRIPTIONS[content]}; name its format: --from {content}")


def _no_note(text: str) -> None:
    """Drop a note."""
