"""Loading of recordings of any kind as a log: the content of the file decides how it is read."""

import os
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.recorder_base import recording_marker
from jaxsonar.recordings.file_content import DESCRIPTIONS, FileContent, check_suffix, file_content, interrupted_content
from jaxsonar.recordings.input_options import FORMATS, InputOptions
from jaxsonar.scans.log_file import load_scan_log
from jaxsonar.scans.no_echo_values import as_range, without_no_echo_values
from jaxsonar.scans.readings import counts_from_one
from jaxsonar.scans.recording_journal import TruncatedRecording
from jaxsonar.scans.scan_log import Log

if TYPE_CHECKING:
    from jaxsonar.sensors.ring import Ring

UNMISTAKABLE = ("csv", "parquet", "record", "bag", "beesoft", "player")
"""Formats that are read without being named."""


def load_log(
    filename: str | os.PathLike[str],
    *,
    ring: "Ring | None" = None,
    options: InputOptions = InputOptions(),  # noqa: B008  immutable
    on_note: Callable[[str], None] | None = None,
) -> Log:
    """Load a recording: a scan log (CSV, Parquet), a raw recording (MCAP), a ROS bag, or what ``options.format`` names.

    The content of the file decides, not its suffix. Beesoft and Player logs are recognized, too.

    Args:
        filename: the file, or the folder of a ROS 2 bag or of a data set. If a ``.recording`` file beside it shows that
            the recording process was killed, all complete scans are loaded, with a warning if any is incomplete.
        ring: the sensors; a bag may need their names, and a raw recording or a table is checked against them.
        options: what the file does not say itself.
        on_note: called with one line for each choice that was made; None: the notes are dropped.

    Raises:
        SonarError: the file cannot be read, is no recording, or needs an option; the message names what came.
    """
    note = on_note or _no_note
    if options.format not in (None, *FORMATS):
        raise SonarError(
            f"{shown(filename)}: format '{shown(options.format, 40)}' came; allowed are {', '.join(FORMATS)}"
        )
    is_interrupted = recording_marker(filename).exists()
    content = interrupted_content(filename) if is_interrupted else file_content(filename)
    if options.format is not None:
        _check_named_format(filename, options.format, content)
    else:
        check_content(filename, content)
        if (text := check_suffix(filename, content)) is not None:
            note(text)
    log = _read(filename, options.format or str(content.format), ring, options, note)
    _check_numbering(filename, log, ring)
    if options.format == "table":
        return log
    for value in {as_range(value): value for value in options.no_echo}.values():
        if (marked := without_no_echo_values(log, [as_range(value)])) is log:
            note(f"--no-echo {value:g}: no range has this value")
        log = marked
    return log


def load_log_with_warnings(
    filename: str | os.PathLike[str], *, ring: "Ring | None", options: InputOptions, on_note: Callable[[str], None]
) -> Log:
    """As ``load_log`` for a command: an interrupted or damaged recording is a note, not a Python warning."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", TruncatedRecording)
        log = load_log(filename, ring=ring, options=options, on_note=on_note)
    for one in caught:
        if issubclass(one.category, TruncatedRecording):
            on_note(f"warning: {one.message}; the recording was interrupted; its complete scans are used")
        else:
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    return log


def _read(
    filename: str | os.PathLike[str],
    format: str,
    ring: "Ring | None",
    options: InputOptions,
    note: Callable[[str], None],
) -> Log:
    """Read a file in a format."""
    if format in ("csv", "parquet"):
        return load_scan_log(filename, no_echo=options.no_echo)
    if format == "record":
        from jaxsonar.recordings.mcap_records import recorded_scans

        return Log.from_scans(list(recorded_scans(filename, ring=ring)))
    if format == "bag":
        from jaxsonar.recordings.rosbag_log import read_bag

        return read_bag(filename, ring=ring, options=options, on_note=note)
    if format == "table":
        from jaxsonar.recordings.table_log import load_table

        return load_table(filename, ring=ring, options=options, on_note=note)
    if format == "beesoft":
        from jaxsonar.recordings.beesoft_log import load_beesoft

        return load_beesoft(filename, on_note=note)
    if format == "player":
        from jaxsonar.recordings.player_log import load_player

        return load_player(filename, options=options, on_note=note)
    from jaxsonar.recordings.published_datasets import load_dataset

    return load_dataset(filename, format)


def _check_named_format(filename: str | os.PathLike[str], named: str, content: FileContent) -> None:
    """Raise an error if a file cannot have the format that was named.

    Text can be a table or a data set; their readers report what is wrong with it.
    """
    fits = content.format == named
    if named not in UNMISTAKABLE:
        fits |= content.format not in UNMISTAKABLE if named != "table" else content.is_text
    elif named == "csv":
        fits |= content.is_text and content.format not in UNMISTAKABLE
    if not fits:
        wanted = DESCRIPTIONS.get(named, "a data set")
        raise SonarError(f"{shown(filename)}: this is {content.description}, not {wanted}, which --from {named} needs")


def check_content(filename: str | os.PathLike[str], content: FileContent) -> None:
    """Raise an error if a file is no recording, or one whose format must be named."""
    if content.format is None:
        allowed = "a scan log (CSV, Parquet), a raw recording (MCAP), a ROS bag, or what --from names"
        raise SonarError(f"{shown(filename)}: this is {content.description}; allowed is {allowed}")
    if content.format not in UNMISTAKABLE:
        raise SonarError(
            f"{shown(filename)}: this is {content.description}; name its format, if it is one: --from {content.format}"
        )


def _check_numbering(filename: str | os.PathLike[str], log: Log, ring: "Ring | None") -> None:
    """Raise an error if the sensors of a log are counted from 1."""
    if ring is None or not len(log.tx):
        return
    first = min(int(log.tx.min()), int(log.rx.min()))
    last = max(int(log.tx.max()), int(log.rx.max()))
    if counts_from_one(log.tx, log.rx, ring.count):
        came = f"the sensors {first} to {last} came, so the log seems to count from 1"
        raise SonarError(f"{shown(filename)}: {came}; allowed are 0 to {ring.count - 1}, the sensors of '{ring.name}'")


def _no_note(text: str) -> None:
    """Drop a note."""
