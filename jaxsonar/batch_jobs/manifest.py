"""What a batch has done: the folder of its results and the manifest in it, which outlives any end of the process.

``manifest.jsonl`` is a JSON object a line: the run, the inputs, the shards. While a batch runs, lines are added at the
end, and a line stands there only once the files that it tells of are whole; at its end the lines are put in the order
of the inputs, so that they do not show who was done when.
"""

import fcntl
import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from jaxsonar.batch_jobs.parquet_tables import TABLES
from jaxsonar.batch_jobs.shards import Shard
from jaxsonar.batch_jobs.worker import Result
from jaxsonar.fileio.atomic_files import atomic_write, make_folder, reason, shown
from jaxsonar.hardware.errors import SonarError

NAME = "manifest.jsonl"
COPIES = ".copies"
"""Folder in the results for copies of inputs while a batch runs."""

Line = dict[str, Any]


class Manifest:
    """The state of one folder of results; made by ``opened``."""

    def __init__(self, folder: Path, run: Line, lines: Iterable[Line]):
        self.folder, self.run = folder, run
        self.inputs: dict[str, Line] = {}
        """By name of the log."""
        self.shards: dict[str, Line] = {}
        """By key."""
        for line in lines:
            self._know(line)
        self._file: IO[bytes] | None = None

    def take(self, source: str, line: Line) -> None:
        """Note an input.

        Args:
            source: its name.
            line: its fingerprint, and the number of its scans and shards or, where it was set aside, the reason.

        Raises:
            SonarError: it is not what it was when its first shard was done.
        """
        before = self.inputs.get(source)
        if before is not None and "reason" not in before and before["sha256"] != line.get("sha256"):
            allowed = "the log as it was, or another folder for -o"
            raise SonarError(f"{shown(source)}: changed since {shown(self.folder)} was begun; allowed is {allowed}")
        line = {"input": source, **line}
        if line != before:
            self._add(line)

    def check_all_came(self, sources: Iterable[str]) -> None:
        """Complain about inputs of before that are not there any more.

        Raises:
            SonarError: there are results of a log that was not given.
        """
        not_given = set(self.inputs) - set(sources)
        for source in [source for source in not_given if "reason" in self.inputs[source]]:
            del self.inputs[source]  # nothing came of it
        if gone := sorted(not_given & set(self.inputs)):
            others = f" and {len(gone) - 1} more" if len(gone) > 1 else ""
            raise SonarError(
                f"{shown(self.folder)} has results of {shown(gone[0])}{others}, which did not come; "
                "allowed are the logs of before, with new ones or not, or another folder"
            )

    def is_done(self, shard: Shard) -> bool:
        """Whether all files of a shard are there and hold what they held."""
        line = self.shards.get(shard.key)
        if line is None or line["state"] != "done":
            return False
        try:
            return all(_sha256(self._table(name, shard.key).read_bytes()) == line["sha256"][name] for name in TABLES)
        except OSError:
            return False

    def add(self, shard: Shard, came: Result) -> Line:
        """Write the tables of a shard, whole, and then note it. Returns the line."""
        scans = {"source": shard.source, "first_row": shard.part.first, "scans": shard.part.scans}
        if came.failure:
            line = {"shard": shard.key, "state": "set aside", **scans, "reason": came.failure}
        else:
            for name, data in came.tables.items():
                with atomic_write(self._table(name, shard.key), binary=True) as file:
                    file.write(data)
            bad = {"bad_scans": came.bad, "reasons": came.reasons} if came.bad else {}
            digests = {name: _sha256(data) for name, data in came.tables.items()}
            line = {"shard": shard.key, "state": "done", **scans, **came.counts, **bad, "sha256": digests}
        self._add(line)
        return line

    def finish(self, shards: Iterable[Shard]) -> None:
        """Put the lines in the order of the inputs; those of shards that a log no longer has are left out."""
        if self._file is not None:
            self._file.close()
            self._file = None
        lines = [self.run, *(self.inputs[source] for source in sorted(self.inputs))]
        lines += [self.shards[shard.key] for shard in shards if shard.key in self.shards]
        with atomic_write(self.folder / NAME, binary=True) as file:
            file.writelines(map(_text, lines))

    def _table(self, name: str, key: str) -> Path:
        return self.folder / name / f"{key}.parquet"

    def _know(self, line: Line) -> None:
        if "input" in line:
            self.inputs[line["input"]] = line
        elif "shard" in line:
            self.shards[line["shard"]] = line

    def _add(self, line: Line) -> None:
        if self._file is None:
            self._file = open(self.folder / NAME, "ab")  # noqa: SIM115  closed by finish() and opened()
        self._know(line)
        self._file.write(_text(line))
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file as it is."""
        if self._file is not None:
            self._file.close()
            self._file = None


@contextmanager
def opened(folder: str | os.PathLike[str], run: Line) -> Iterator[Manifest]:
    """The manifest of a folder of results, for this process alone.

    Args:
        folder: made if it is not there.
        run: what is being done, a line of JSON; another one than before is refused.

    Raises:
        SonarError: the folder cannot be written to, holds something else, or another process is at work in it.
    """
    folder = Path(folder)
    make_folder(folder)
    with _alone(folder):
        lines = _lines(folder)
        if not lines and any((folder / name).exists() and any((folder / name).iterdir()) for name in TABLES):
            raise SonarError(f"{shown(folder)}: tables without a {NAME} lie there; allowed is a new folder for -o")
        if not any("shard" in line for line in lines):
            lines = []  # begun, but nothing came of it: there is nothing to go on with
        if lines:
            _check_same(folder, lines[0], run)
        for name in TABLES:
            make_folder(folder / name)
            for left in (folder / name).glob(".*.tmp"):  # of a process that was killed
                left.unlink()
        with atomic_write(folder / NAME, binary=True) as file:  # without a last line that is not whole
            file.writelines(map(_text, lines or [run]))
        manifest = Manifest(folder, run, lines)
        try:
            yield manifest
        finally:
            manifest.close()
            _remove(folder / COPIES)


def _check_same(folder: Path, before: Line, run: Line) -> None:
    for key, value in run.items():
        other = before.get(key)
        if other != value:
            if key == "settings" and isinstance(other, dict):
                key = next(name for name in value | other if value.get(name) != other.get(name))
                value, other = value.get(key), other.get(key)
            came, was = (shown(json.dumps(one), 60) for one in (value, other))
            what = "another ring" if key == "ring" else f"{key} {came}, before {was},"
            allowed = "to go on as it was begun, or another folder for -o"
            raise SonarError(f"{shown(folder)}: {what} came; allowed is {allowed}")


def _lines(folder: Path) -> list[Line]:
    """What a manifest says; a last line that is not whole says nothing."""
    try:
        text = (folder / NAME).read_bytes()
    except FileNotFoundError:
        return []
    except OSError as failure:
        raise SonarError(f"{shown(folder / NAME)}: {reason(failure)}; needed is the manifest of a batch") from None
    whole = text[: text.rfind(b"\n") + 1].splitlines()
    try:
        lines = [json.loads(line) for line in whole]
        good = all(isinstance(line, dict) for line in lines) and (not lines or "batch" in lines[0])
    except ValueError:
        good, lines = False, []
    if not good or (text and not lines):
        raise SonarError(f"{shown(folder / NAME)}: this is no manifest of a batch; allowed is another folder for -o")
    return lines


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the folder for this process; the system lets go of it however the process ends."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise SonarError(f"{shown(folder)}: another batch is at work there; allowed is one at a time") from None
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(handle)


def _remove(folder: Path) -> None:
    with suppress(OSError):
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()


def _text(line: Line) -> bytes:
    return json.dumps(line, ensure_ascii=False).encode() + b"\n"


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
