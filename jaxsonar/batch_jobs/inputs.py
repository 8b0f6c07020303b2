"""The input logs of a batch: search, format, and fingerprint. The content of a file decides, not its suffix."""

import hashlib
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxsonar.fileio.atomic_files import reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.recorder_base import recording_marker
from jaxsonar.recordings.file_content import SUFFIXES, file_content
from jaxsonar.recordings.load_log import check_content

UNREADABLE = "unreadable"
"""Format of a file in a folder that is no recording although its suffix is that of one."""


@dataclass(frozen=True)
class Input:
    """An input log."""

    source: str
    """Name in tables and manifest: the name of the file."""
    filename: str
    """The file, or the folder of a bag or a data set."""
    format: str
    """What the file holds (``recordings.file_content``), or ``UNREADABLE``."""
    recording: bool = False
    """The recording of this log has not ended."""

    @property
    def key(self) -> str:
        """``source`` as part of a filename: only characters that every reader of data sets accepts."""
        plain = re.sub(r"[^A-Za-z0-9.-]+", "_", self.source).strip("._")
        digest = hashlib.sha256(self.source.encode()).hexdigest()
        return plain if plain == self.source[:100] else f"{plain[:100]}-{digest[:8]}"


def find_inputs(filenames: Iterable[str | os.PathLike[str]], *, format: str | None = None) -> list[Input]:
    """Find the input logs, sorted by name. A folder stands for the logs in it.

    Args:
        filenames: logs, and folders of logs.
        format: format of all logs (``InputOptions.format``); None: the content of each decides.

    Raises:
        SonarError: a missing file, a file that is no recording, a folder without logs, or two logs of one name.
    """
    found: dict[str, Input] = {}
    for name in {os.fspath(name): None for name in filenames}:
        is_folder = "\0" not in name and os.path.isdir(name) and not _is_recording(name)
        inputs = _folder_inputs(name) if is_folder else [_input(name, Path(name).name, format)]
        for one in inputs:
            other = found.setdefault(one.source, one)
            if os.path.realpath(other.filename) != os.path.realpath(one.filename):
                both = f"{shown(other.filename)} and {shown(one.filename)}"
                raise SonarError(f"{both}: two logs of one name came; allowed are logs with different names")
    if not found:
        raise SonarError("no input came; needed are logs, or folders of logs")
    return [found[source] for source in sorted(found)]


def fingerprint(log: Input) -> dict[str, int | str]:
    """Size and SHA-256 of an input; of a bag folder, over all its files.

    Raises:
        SonarError: the input cannot be read.
    """
    try:
        if not os.path.isdir(log.filename):
            return {"bytes": os.path.getsize(log.filename), "sha256": _sha256(log.filename)}
        files = sorted(path for path in Path(log.filename).iterdir() if path.is_file())
        digests = "".join(f"{path.name}\0{_sha256(path)}\n" for path in files)
        size = sum(path.stat().st_size for path in files)
        return {"bytes": size, "sha256": hashlib.sha256(os.fsencode(digests)).hexdigest()}
    except OSError as failure:
        raise SonarError(f"{shown(log.source)}: {reason(failure)}; needed is a readable log") from None


def _folder_inputs(folder: str) -> Sequence[Input]:
    try:
        entries = sorted(Path(folder).iterdir())
    except OSError as failure:
        raise SonarError(f"{shown(folder)}: {reason(failure)}; needed is a readable folder of logs") from None
    logs = [
        _input(os.fspath(path), path.name, _folder_entry_format(path))
        for path in entries
        if not path.name.startswith(".")
        and not path.name.endswith(".recording.csv")  # the journal of a Parquet recording
        and (_is_recording(path) if path.is_dir() else path.is_file() and path.suffix.lower() in SUFFIXES)
    ]
    if not logs:
        raise SonarError(f"{shown(folder)}: no log in this folder; allowed are {', '.join(SUFFIXES)}")
    return logs


def _folder_entry_format(filename: Path) -> str:
    """Format of a file in a folder; a bad file must not keep the others from being processed."""
    try:
        return file_content(filename).format or UNREADABLE
    except SonarError:
        return UNREADABLE


def _input(filename: str, name: str, format: str | None) -> Input:
    if "\0" in filename or not os.path.exists(filename):
        raise SonarError(f"{shown(filename)}: no such file or folder; needed is a log, or a folder of logs")
    if not name:  # "." and "/"
        name = Path(filename).resolve().name
    if not os.path.isfile(filename) and not os.path.isdir(filename):
        raise SonarError(f"{shown(filename)}: not a regular file, but a log is read more than once; needed is a log")
    is_recording = recording_marker(filename).exists()
    if format is None and not is_recording:
        check_content(filename, content := file_content(filename))
        format = content.format
    name = name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    return Input(name, filename, format or "csv", recording=is_recording)


def _is_recording(filename: str | os.PathLike[str]) -> bool:
    """Whether a file or folder is one that ``load_log`` reads."""
    return recording_marker(filename).exists() or _folder_entry_format(Path(filename)) != UNREADABLE


def _sha256(filename: str | os.PathLike[str]) -> str:
    with open(filename, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
