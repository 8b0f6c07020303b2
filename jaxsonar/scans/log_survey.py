"""What a first pass through a log finds out about its readings, block by block, in bounded memory."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.scans.asked_pairs import AskedPairs
from jaxsonar.scans.csv_log import NUMBER, fields_of, integers_of
from jaxsonar.scans.scan_log import LARGEST_SENSOR


class LogSurvey:
    """What a first pass through a file finds out about its readings. Invalid rows are skipped."""

    def __init__(self):
        self.asked = AskedPairs()
        self.times, self.age = False, 0.0
        """Readings have times of their own; largest age of a reading, seconds."""
        self._scans = 0
        self._stamps: list[np.ndarray] = []
        """Stamps of all scans, kept only for logs with ages."""

    def stamp(self, row: int) -> float:
        """Stamp of a scan, seconds; NaN if unknown."""
        self._stamps = [np.concatenate(self._stamps)]
        return float(self._stamps[0][row])

    def add_rows(self, columns: tuple[str, ...], block: bytes, starts: Int[np.ndarray, " scans"]) -> None:
        """Add complete rows of a CSV log, and the bytes at which scans start."""
        begin, end = _fields(block, len(columns))

        def text(name: str) -> np.ndarray:
            column = columns.index(name)
            return fields_of(block, begin[:, column], end[:, column])

        if len(begin):
            tx, rx = _sensors(text("tx")), _sensors(text("rx"))
            valid = (tx >= 0) & (rx >= 0)
            scan = self._scans - 1 + np.searchsorted(starts, begin[valid, 0], side="right")
            self.asked.add(scan, tx[valid], rx[valid], text("range")[valid] == b"")
            self.times = self.times or ("t" in columns and bool((text("t") != b"").any()))
            if "age" in columns:
                self.age = max(self.age, float(np.max(_numbers_of(np.unique(text("age"))))))
        if "age" in columns:
            stamp = np.full(len(starts), np.nan)
            row = np.searchsorted(begin[:, 0], starts)
            whole = row < len(begin)
            whole[whole] = begin[row[whole], 0] == starts[whole]
            if whole.any():
                stamp[whole] = _numbers_of(text("stamp")[row[whole]], missing=np.nan)
            self._stamps.append(stamp)
        self._scans += len(starts)

    def add_batch(self, pa: Any, batch: Any, fields: set[str]) -> None:
        """Add rows of a Parquet log, whose readings have these fields."""
        lists = batch.column("echoes")
        counts = np.nan_to_num(lists.value_lengths().cast(pa.float64()).to_numpy(zero_copy_only=False)).astype(int)
        readings = lists.flatten()

        def column(name: str) -> np.ndarray:
            return readings.field(name).cast(pa.float64()).to_numpy(zero_copy_only=False)

        scan = self._scans + np.repeat(np.arange(len(batch)), counts)
        tx, rx = column("tx"), column("rx")
        valid = (np.minimum(tx, rx) >= 0) & (np.maximum(tx, rx) <= LARGEST_SENSOR)
        tx, rx = tx[valid].astype(np.int64), rx[valid].astype(np.int64)
        self.asked.add(scan[valid], tx, rx, np.isnan(column("range"))[valid])
        self.times = self.times or ("t" in fields and bool((np.nan_to_num(column("t")) != 0).any()))
        if "age" in fields:
            self.age = max(self.age, float(np.nan_to_num(column("age")).max(initial=0.0)))
            self._stamps.append(batch.column("stamp").cast(pa.float64()).to_numpy(zero_copy_only=False))
        self._scans += len(batch)


def _sensors(text: np.ndarray) -> Int[np.ndarray, " texts"]:
    """Sensor indices; -1 for fields that hold no sensor index."""
    given = text != b""
    try:
        number = integers_of(text[given])
    except (ValueError, OverflowError):
        number = np.nan_to_num(_numbers_of(text[given], missing=-1.0), posinf=-1.0)
        number = np.where((number == np.floor(number)) & (number <= LARGEST_SENSOR), number, -1).astype(np.int64)
    sensor = np.full(len(text), -1)
    sensor[given] = np.where((number >= 0) & (number <= LARGEST_SENSOR), number, -1)
    return sensor


def _numbers_of(text: np.ndarray, *, missing: float = 0.0) -> Float[np.ndarray, " texts"]:
    """Numbers of fields; ``missing`` for fields that hold no number."""
    return np.array([float(one) if NUMBER.fullmatch(one) else missing for one in text.tolist()])


def _fields(block: bytes, columns: int) -> tuple[Int[np.ndarray, "rows columns"], Int[np.ndarray, "rows columns"]]:
    """First and last byte (exclusive) of the fields of all rows that have this number of columns."""
    buffer = np.frombuffer(block, dtype=np.uint8)
    end = np.flatnonzero(buffer == ord("\n"))
    start = np.concatenate([[0], end[:-1] + 1])
    comma = np.flatnonzero(buffer == ord(","))
    first = np.searchsorted(comma, start)
    whole = np.diff(first, append=len(comma)) == columns - 1
    start, end, first = start[whole], end[whole], first[whole]
    end = end - (buffer[np.maximum(end - 1, 0)] == ord("\r"))
    commas = comma[first[:, None] + np.arange(columns - 1)] if len(first) else np.zeros((0, columns - 1), np.int64)
    return np.column_stack([start, commas + 1]), np.column_stack([commas, end])
