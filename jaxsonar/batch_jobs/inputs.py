"""The logs that a batch job reads: where they are, what format they have, their fingerprints."""

import hashlib
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxsonar.fileio.atomic_files import reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.recorder_base import mark_of

KINDS = {".csv": "csv", ".parquet": "parquet", ".mcap": "mcap", ".bag": "bag", ".db3": "bag"}
"""How an input is read, by its suffix; a folder with a ``metadata.yaml`` is a bag, too."""


@dataclass(frozen=True)
class Input:
    """One log."""

    source: str
    """What tables and manifest call it: its name, or its path within the folder that was given."""
    path: str
    """Where it is."""
    kind: str
    """csv, parquet, mcap, bag, or recording: one that has not ended."""

    @property
    def key(self) -> str:
        """As ``source``, but fit for the name of a file that no reader of tables skips."""
        plain = re.sub(r"[^A-Za-z0-9.-]+", "_", self.source).strip("._")
        digest = hashlib.sha256(self.source.encode()).hexdigest()
        return plain if plain == self.source[:100] else f"{plain[:100]}-{digest[:8]}"


def find_inputs(paths: Iterable[str | os.PathLike[str]]) -> list[Input]:
    """The logs that were asked for, sorted by name; those of a folder are the logs that lie in it.

    Raises:
        SonarError: nothing there, a suffix that no log has, a folder without logs, or two logs of one name.
    """
    found: dict[str, Input] = {}
    for path in {os.fspath(path): None for path in paths}:
        inputs = _in_folder(path) if os.path.isdir(path) and not _is_bag(path) else [_input(path, Path(path).name)]
        for one in inputs:
            other = found.setdefault(one.source, one)
            if os.path.realpath(other.path) != os.path.realpath(one.path):
                both = f"{shown(other.path)} and {shown(one.path)}"
                raise SonarError(f"{both}: two logs of one name came; allowed are logs with different names")
    if not found:
        raise SonarError("no input came; needed are logs, or folders of logs")
    return [found[source] for source in sorted(found)]


def fingerprint(one: Input) -> dict[str, int | str]:
    """Size and SHA-256 of an input; of a bag that is a folder, of what lies in it.

    Raises:
        SonarError: it cannot be read.
    """
    try:
        if not os.path.isdir(one.path):
            return {"bytes": os.path.getsize(one.path), "sha256": _sha256(one.path)}
        files = sorted(path for path in Path(one.path).iterdir() if path.is_file())
        digests = "".join(f"{path.name}\0{_sha256(path)}\n" for path in files)
        size = sum(path.stat().st_size for path in files)
        return {"bytes": size, "sha256": hashlib.sha256(os.fsencode(digests)).hexdigest()}
    except OSError as failure:
        raise SonarError(f"{shown(one.source)}: {reason(failure)}; needed is a readable log") from None


def _in_folder(folder: str) -> Sequence[Input]:
    try:
        entries = sorted(Path(folder).iterdir())
    except OSError as failure:
        raise SonarError(f"{shown(folder)}: {reason(failure)}; needed is a readable folder of logs") from None
    logs = [
        _input(os.fspath(path), path.name)
        for path in entries
        if not path.name.startswith(".")
        and not path.name.endswith(".recording.csv")  # the journal of a recording beside it
        and (_is_bag(path) if path.is_dir() else path.is_file() and path.suffix.lower() in KINDS)
    ]
    if not logs:
        raise SonarError(f"{shown(folder)}: no log in this folder; allowed are {', '.join(KINDS)}")
    return logs


def _input(path: str, name: str) -> Input:
    if "\0" in path or not os.path.exists(path):
        raise SonarError(f"{shown(path)}: no such file or folder; needed is a log, or a folder of logs")
    if not name:  # "." and "/"
        name = Path(path).resolve().name
    kind = "bag" if _is_bag(path) else KINDS.get(Path(path).suffix.lower())
    if kind is None:
        suffix = Path(path).suffix
        came = f"suffix '{shown(suffix)}'" if suffix else "no suffix"
        raise SonarError(f"{shown(path)}: {came} came; allowed for a log is {', '.join(KINDS)}, or a folder of logs")
    if not os.path.isfile(path) and not _is_bag(path):
        raise SonarError(f"{shown(path)}: this is no file, and would be read more than once; needed is a log")
    if kind in ("csv", "parquet") and mark_of(path).exists():
        kind = "recording"
    return Input(name.encode("utf-8", "surrogateescape").decode("utf-8", "replace"), path, kind)


def _is_bag(path: str | os.PathLike[str]) -> bool:
    return (Path(path) / "metadata.yaml").is_file() if "\0" not in os.fspath(path) else False


def _sha256(path: str | os.PathLike[str]) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
