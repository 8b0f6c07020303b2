"""The input logs of a batch: search, format, and fingerprint."""

import hashlib
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxsonar.fileio.atomic_files import reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.recorder_base import recording_marker

FORMATS = {".csv": "csv", ".parquet": "parquet", ".mcap": "mcap", ".bag": "bag", ".db3": "bag"}
"""Format by suffix. A folder with a ``metadata.yaml`` is a bag, too."""


@dataclass(frozen=True)
class Input:
    """An input log."""

    source: str
    """Name in tables and manifest: the name of the file."""
    filename: str
    """The file, or the folder of a bag."""
    format: str
    """csv, parquet, mcap, bag, or recording (a log whose recording has not ended)."""

    @property
    def key(self) -> str:
        """``source`` as part of a filename: only characters that every reader of data sets accepts."""
        plain = re.sub(r"[^A-Za-z0-9.-]+", "_", self.source).strip("._")
        digest = hashlib.sha256(self.source.encode()).hexdigest()
        return plain if plain == self.source[:100] else f"{plain[:100]}-{digest[:8]}"


def find_inputs(filenames: Iterable[str | os.PathLike[str]]) -> list[Input]:
    """Find the input logs, sorted by name. A folder stands for the logs in it.

    Raises:
        SonarError: a missing file, an unknown suffix, a folder without logs, or two logs of one name.
    """
    found: dict[str, Input] = {}
    for name in {os.fspath(name): None for name in filenames}:
        inputs = _folder_inputs(name) if os.path.isdir(name) and not _is_bag(name) else [_input(name, Path(name).name)]
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
        _input(os.fspath(path), path.name)
        for path in entries
        if not path.name.startswith(".")
        and not path.name.endswith(".recording.csv")  # the journal of a Parquet recording
        and (_is_bag(path) if path.is_dir() else path.is_file() and path.suffix.lower() in FORMATS)
    ]
    if not logs:
        raise SonarError(f"{shown(folder)}: no log in this folder; allowed are {', '.join(FORMATS)}")
    return logs


def _input(filename: str, name: str) -> Input:
    if "\0" in filename or not os.path.exists(filename):
        raise SonarError(f"{shown(filename)}: no such file or folder; needed is a log, or a folder of logs")
    if not name:  # "." and "/"
        name = Path(filename).resolve().name
    format_ = "bag" if _is_bag(filename) else FORMATS.get(Path(filename).suffix.lower())
    if format_ is None:
        suffix = Path(filename).suffix
        came = f"suffix '{shown(suffix)}'" if suffix else "no suffix"
        raise SonarError(
            f"{shown(filename)}: {came} came; allowed for a log is {', '.join(FORMATS)}, or a folder of logs"
        )
    if not os.path.isfile(filename) and not _is_bag(filename):
        raise SonarError(f"{shown(filename)}: not a regular file, but a log is read more than once; needed is a log")
    if format_ in ("csv", "parquet") and recording_marker(filename).exists():
        format_ = "recording"
    return Input(name.encode("utf-8", "surrogateescape").decode("utf-8", "replace"), filename, format_)


def _is_bag(filename: str | os.PathLike[str]) -> bool:
    return (Path(filename) / "metadata.yaml").is_file() if "\0" not in os.fspath(filename) else False


def _sha256(filename: str | os.PathLike[str]) -> str:
    with open(filename, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
