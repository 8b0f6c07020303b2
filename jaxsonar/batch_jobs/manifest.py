"""The output folder of a batch and its manifest, the crash-safe record of what is done.

``manifest.jsonl`` has one JSON object per line: the run, the inputs, the shards. Lines are appended during a batch.
The line of a shard is appended after its files are complete. At the end the lines are sorted by input, so that the
manifest does not depend on the order in which the shards were done.
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
from jaxsonar.batch_jobs.shard import Shard
from jaxsonar.batch_jobs.worker import ShardResult
from jaxsonar.fileio.atomic_files import atomic_write, make_folder, reason, shown
from jaxsonar.hardware.errors import SonarError

MANIFEST_NAME = "manifest.jsonl"
STAGING_NAME = ".copies"
"""Temporary folder, in the output folder, for staged copies of inputs."""

Record = dict[str, Any]
"""A line of the manifest."""


class Manifest:
    """The manifest of one output folder; created by ``open_manifest``."""

    def __init__(self, folder: Path, run: Record, records: Iterable[Record]):
        self.folder, self.run = folder, run
        self.inputs: dict[str, Record] = {}
        """Records of inputs, by name of the log."""
        self.shards: dict[str, Record] = {}
        """Records of shards, by key."""
        for record in records:
            self._store(record)
        self._file: IO[bytes] | None = None

    def add_input(self, source: str, record: Record) -> None:
        """Record an input.

        Args:
            source: name of the log.
            record: its fingerprint, and the numbers of its scans and shards, or the reason why it was set aside.

        Raises:
            SonarError: the log has changed since its first shard was done.
        """
        before = self.inputs.get(source)
        if before is not None and "reason" not in before and before["sha256"] != record.get("sha256"):
            allowed = "the log as it was, or another folder for -o"
            raise SonarError(f"{shown(source)}: changed since {shown(self.folder)} was begun; allowed is {allowed}")
        record = {"input": source, **record}
        if record != before:
            self._append(record)

    def check_inputs(self, sources: Iterable[str]) -> None:
        """Check that all inputs of earlier runs are inputs of this run.

        Raises:
            SonarError: there are results of a log that is not an input.
        """
        missing = set(self.inputs) - set(sources)
        for source in [source for source in missing if "reason" in self.inputs[source]]:
            del self.inputs[source]  # it has no results
        if missing := sorted(missing & set(self.inputs)):
            others = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
            raise SonarError(
                f"{shown(self.folder)} has results of {shown(missing[0])}{others}, which did not come; "
                "allowed are the logs of before, with new ones or not, or another folder"
            )

    def is_done(self, shard: Shard) -> bool:
        """Whether all files of a shard exist with their recorded content."""
        record = self.shards.get(shard.key)
        if record is None or record["state"] != "done":
            return False
        try:
            return all(
                _sha256(self._table_file(name, shard.key).read_bytes()) == record["sha256"][name] for name in TABLES
            )
        except OSError:
            return False

    def add_shard(self, shard: Shard, result: ShardResult) -> Record:
        """Write the tables of a shard, then record it. Returns the record."""
        scans = {"source": shard.source, "first_row": shard.chunk.first, "scans": shard.chunk.scans}
        if result.failure:
            record = {"shard": shard.key, "state": "set aside", **scans, "reason": result.failure}
        else:
            for name, data in result.tables.items():
                with atomic_write(self._table_file(name, shard.key), binary=True) as file:
                    file.write(data)
            bad = {"bad_scans": result.bad_scans, "reasons": result.reasons} if result.bad_scans else {}
            digests = {name: _sha256(data) for name, data in result.tables.items()}
            record = {"shard": shard.key, "state": "done", **scans, **result.counts, **bad, "sha256": digests}
        self._append(record)
        return record

    def finish(self, shards: Iterable[Shard]) -> None:
        """Sort the records by input. Records of shards that no longer exist are dropped."""
        if self._file is not None:
            self._file.close()
            self._file = None
        records = [self.run, *(self.inputs[source] for source in sorted(self.inputs))]
        records += [self.shards[shard.key] for shard in shards if shard.key in self.shards]
        with atomic_write(self.folder / MANIFEST_NAME, binary=True) as file:
            file.writelines(map(_encode, records))

    def _table_file(self, name: str, key: str) -> Path:
        return self.folder / name / f"{key}.parquet"

    def _store(self, record: Record) -> None:
        if "input" in record:
            self.inputs[record["input"]] = record
        elif "shard" in record:
            self.shards[record["shard"]] = record

    def _append(self, record: Record) -> None:
        if self._file is None:
            self._file = open(self.folder / MANIFEST_NAME, "ab")  # noqa: SIM115  closed by finish() and close()
        self._store(record)
        self._file.write(_encode(record))
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file without sorting it."""
        if self._file is not None:
            self._file.close()
            self._file = None


@contextmanager
def open_manifest(folder: str | os.PathLike[str], run: Record) -> Iterator[Manifest]:
    """Open the manifest of an output folder, exclusively for this process.

    Args:
        folder: output folder; created if it does not exist.
        run: parameters of the batch. A folder that was started with other parameters is refused.

    Raises:
        SonarError: a folder that cannot be written to, holds something else, or is in use by another process.
    """
    folder = Path(folder)
    is_new = not folder.exists()
    make_folder(folder)
    if (folder / STAGING_NAME).is_symlink():
        raise SonarError(f"{shown(folder / STAGING_NAME)}: a symbolic link came; allowed is a folder of the batch")
    with _locked(folder):
        records = _read_records(folder)
        if not records and any((folder / name).exists() and any((folder / name).iterdir()) for name in TABLES):
            raise SonarError(
                f"{shown(folder)}: tables without a {MANIFEST_NAME} lie there; allowed is a new folder for -o"
            )
        if not any("shard" in record for record in records):
            records = []  # started without any result: nothing to resume
        if records:
            _check_same_run(folder, records[0], run)
        for name in TABLES:
            make_folder(folder / name)
            for temporary in (folder / name).glob(".*.tmp"):  # left by a killed process
                temporary.unlink()
        with atomic_write(folder / MANIFEST_NAME, binary=True) as file:  # drops an incomplete last line
            file.writelines(map(_encode, records or [run]))
        manifest = Manifest(folder, run, records)
        try:
            yield manifest
        except SonarError:
            manifest.close()
            if is_new and not manifest.shards:  # refused before the first result
                (folder / MANIFEST_NAME).unlink(missing_ok=True)
                for left in (folder / STAGING_NAME, *(folder / name for name in TABLES), folder):
                    _remove(left)
            raise
        finally:
            manifest.close()
            _remove(folder / STAGING_NAME)


def _check_same_run(folder: Path, before: Record, run: Record) -> None:
    for key, value in run.items():
        other = before.get(key)
        if other != value:
            if key == "settings" and isinstance(other, dict):
                key = next(name for name in value | other if value.get(name) != other.get(name))
                value, other = value.get(key), other.get(key)
            came, was = (shown(json.dumps(one), 60) for one in (value, other))
            what = "another ring" if key == "ring" else f"{key} {came}, before {was},"
            allowed = "the ring and the settings of the first run, or another folder for -o"
            raise SonarError(f"{shown(folder)}: {what} came; allowed is {allowed}")


def _read_records(folder: Path) -> list[Record]:
    """The records of a manifest; an incomplete last line is dropped."""
    try:
        text = (folder / MANIFEST_NAME).read_bytes()
    except FileNotFoundError:
        return []
    except OSError as failure:
        raise SonarError(
            f"{shown(folder / MANIFEST_NAME)}: {reason(failure)}; needed is the manifest of a batch"
        ) from None
    lines = text[: text.rfind(b"\n") + 1].splitlines()
    try:
        records = [json.loads(line) for line in lines]
        valid = all(isinstance(record, dict) for record in records) and (not records or "batch" in records[0])
    except ValueError:
        valid, records = False, []
    if not valid or (text and not records):
        raise SonarError(
            f"{shown(folder / MANIFEST_NAME)}: this is no manifest of a batch; allowed is another folder for -o"
        )
    return records


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock the folder for this process. The system releases the lock when the process ends."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise SonarError(f"{shown(folder)}: another batch is running there; allowed is one at a time") from None
        except OSError:
            pass  # the file system has no locks
        yield
    finally:
        os.close(handle)


def _remove(folder: Path) -> None:
    with suppress(OSError):
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()


def _encode(record: Record) -> bytes:
    return json.dumps(record, ensure_ascii=False).encode() + b"\n"


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
