"""Scan logs as CSV: one row an echo, ``scan,stamp,x,y,theta,tx,rx,range`` and optionally ``amplitude``.

Good files are read column by column with NumPy. Only once something does not fit are rows looked at one by one, to say
which. Row numbers are lines of the file; the header is row 1.
"""

import os
import re
from collections.abc import Iterator
from typing import NamedTuple, NoReturn

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from numpy.lib.stride_tricks import sliding_window_view

from jaxsonar.fileio.atomic_files import DECIMAL, atomic_write, read_bytes, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.scan_log import ALLOWED, LARGEST_SENSOR, Log, LogFault

COLUMNS = ("scan", "stamp", "x", "y", "theta", "tx", "rx", "range")
OPTIONAL = "amplitude"
FIRST_ECHO_COLUMN = 5  # what stands before it is the scan's, and repeats in every row of the scan

BLOCK = 1 << 20  # bytes parsed at once: small enough for the cache and for long logs, large enough for NumPy
SCANS_AT_ONCE = 8192  # written at once, for the same reasons
LONGEST = 64  # characters of one number; rows are parsed as tables of letters, as wide as their longest
ALPHABET = b"0123456789+-.eE,\n"
NUMBER = re.compile(DECIMAL.encode())


class _Rows(NamedTuple):
    """The rows of a file; NaN where a field is empty."""

    scan: Int[np.ndarray, " rows"]
    pose: Float[np.ndarray, "rows 4"]  # stamp, x, y, theta
    echo: Float[np.ndarray, "rows fields"]  # tx, rx, range and amplitude if there is one


def read_csv(path: str | os.PathLike[str]) -> Log:
    """A scan log from CSV.

    UTF-8 with or without byte order mark, lines ending in LF or CRLF; the last line may do without.

    Args:
        path: the file.

    Raises:
        SonarError: the file cannot be read or is no scan log; one line with file, row, column, value and what is
            allowed.
    """
    return read_csv_text(path, read_bytes(path, what="a scan log (CSV)"))


def read_csv_text(path: str | os.PathLike[str], text: bytes) -> Log:
    """As ``read_csv``, from what was read of the file already; ``path`` is for messages."""
    text = text.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in text:
        text = text.replace(b"\r\n", b"\n")
    header, _, body = text.partition(b"\n")
    if body and not body.endswith(b"\n"):
        body += b"\n"
    return read_csv_rows(path, csv_header(path, header), body)


def read_csv_rows(path: str | os.PathLike[str], columns: tuple[str, ...], body: bytes, *, first: int = 2) -> Log:
    """As ``read_csv``, from whole rows of a file.

    Args:
        path: for messages.
        columns: what ``csv_header`` found.
        body: rows, each with its LF.
        first: row of the file that the first of them is; the header is row 1.
    """
    source = _Source(path, columns, body, first)
    return source.log(source.rows())


def csv_header(path: str | os.PathLike[str], line: bytes) -> tuple[str, ...]:
    """The columns that the first row of a file names, without byte order mark and line end.

    Raises:
        SonarError: these are not the columns of a scan log.
    """
    wanted = f"allowed is {','.join(COLUMNS)} and optionally ,{OPTIONAL}"
    if not line:
        raise SonarError(f"{shown(path)}: row 1: no header came; {wanted}")
    text = line.decode(errors="replace")
    if "\ufffd" in text or "\0" in text:
        raise SonarError(f"{shown(path)}: row 1: this is no text; {wanted}")
    names = tuple(text.split(","))
    for k, name in enumerate(names):
        if name not in (*COLUMNS, OPTIONAL):
            raise SonarError(f"{shown(path)}: row 1: unknown column '{shown(name, 40)}'; {wanted}")
        if name in names[:k]:
            raise SonarError(f"{shown(path)}: row 1: column '{name}' came twice; {wanted}")
    for name in COLUMNS:
        if name not in names:
            raise SonarError(f"{shown(path)}: row 1: column '{name}' is missing; {wanted}")
    if names not in (COLUMNS, (*COLUMNS, OPTIONAL)):
        raise SonarError(f"{shown(path)}: row 1: columns in the order {','.join(names)}; {wanted}")
    return names


class _Source:
    """The body of one file: how its rows are parsed, grouped to scans, and named when they are wrong."""

    def __init__(self, path: str | os.PathLike[str], columns: tuple[str, ...], body: bytes, first: int):
        self.path, self.columns, self.body, self.first = path, columns, body, first

    def rows(self) -> _Rows:
        """Every field as a number."""
        parts, begin = [_Rows(np.zeros(0, np.int64), np.zeros((0, 4)), np.zeros((0, len(self.columns) - 5)))], 0
        while begin < len(self.body):
            end = self.body.rfind(b"\n", begin, begin + BLOCK) + 1
            if end == 0:  # no line end within a block: this is no row
                end = self.body.find(b"\n", begin) + 1
            part = _parse(self.body[begin:end], len(self.columns))
            if part is None:
                self.refuse_text(begin)
            parts.append(part)
            begin = end
        return _Rows(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def log(self, rows: _Rows) -> Log:
        """Rows grouped to scans."""
        tx, rx, reported = rows.echo[:, :3].T
        amplitude = rows.echo[:, 3] if len(self.columns) > len(COLUMNS) else np.full(len(tx), np.nan)
        for name, column in (("tx", tx), ("rx", rx)):
            is_sensor = (column == np.floor(column)) & (column >= 0) & (column <= LARGEST_SENSOR)
            self.refuse(~is_sensor, name, ALLOWED[name], unless=np.isnan(column))

        silent = np.all(np.isnan(rows.echo[:, :3]), axis=1)
        for name, column in (("tx", tx), ("rx", rx), ("range", reported)):
            self.refuse(np.isnan(column), name, "tx, rx and range, all three or none of them", unless=silent)
        self.refuse(silent & ~np.isnan(amplitude), OPTIONAL, "nothing, in a row without an echo")
        unknown = np.isnan(rows.pose[:, 1:])
        for k, name in enumerate(("x", "y", "theta")):
            self.refuse(unknown[:, k], name, ALLOWED["pose"], unless=np.all(unknown, axis=1))

        follows = rows.scan[1:] == rows.scan[:-1]  # row k + 1 is of the same scan as row k
        same = (rows.pose[1:] == rows.pose[:-1]) | (np.isnan(rows.pose[1:]) & np.isnan(rows.pose[:-1]))
        for k, name in enumerate(("stamp", "x", "y", "theta")):
            self.refuse(_second(follows & ~same[:, k]), name, "the same in every row of a scan")
        alone = "tx, rx and range, unless the row is the only one of its scan"
        self.refuse(_second(follows & (silent[1:] | silent[:-1])), "tx", alone)

        first = np.flatnonzero(~_second(follows))[: len(tx)]
        heard = np.flatnonzero(~silent)
        try:
            return Log(
                scan=rows.scan[first],
                stamp=rows.pose[first, 0],
                pose=rows.pose[first, 1:],
                start=np.searchsorted(heard, np.append(first, len(tx))),
                tx=tx[heard].astype(np.int64),
                rx=rx[heard].astype(np.int64),
                range=reported[heard],
                amplitude=amplitude[heard],
            )
        except LogFault as fault:
            row = first[fault.scan] if fault.echo is None else heard[fault.echo]
            self.fail(int(row), fault.column, ALLOWED[fault.column])

    def refuse(
        self,
        bad: Bool[np.ndarray, " rows"],
        column: str,
        allowed: str,
        *,
        unless: Bool[np.ndarray, " rows"] | None = None,
    ) -> None:
        """An error about the first bad row, if there is one."""
        bad = bad if unless is None else bad & ~unless
        if bad.any():
            self.fail(int(np.argmax(bad)), column, allowed)

    def fail(self, row: int, column: str, allowed: str) -> NoReturn:
        """An error about one field; ``row`` counts from 0 through the body."""
        field = self.body.split(b"\n", row + 1)[row].split(b",")[self.columns.index(column)]
        came = f"'{shown(field.decode(errors='backslashreplace'), 40)}'" if field else "nothing"
        place = f"{shown(self.path)}: row {row + self.first}"
        raise SonarError(f"{place}, column {column}: {came} came; allowed is {allowed}")

    def refuse_text(self, begin: int) -> NoReturn:
        """An error about the first row from ``begin`` on that is not the right number of decimal numbers."""
        lines = self.body[begin:].split(b"\n")[:-1]
        first = self.body.count(b"\n", 0, begin)
        for row, line in enumerate(lines, first):
            place = f"{shown(self.path)}: row {row + self.first}"
            fields = line.split(b",")
            if b"\0" in line:
                raise SonarError(f"{place}: this is no text; allowed are {len(self.columns)} numbers")
            if len(fields) != len(self.columns):
                wanted = f"{len(self.columns)}, {','.join(self.columns)}"
                raise SonarError(f"{place}: {len(fields) if line else 'no'} columns came; allowed are {wanted}")
            for column, field in zip(self.columns, fields, strict=True):
                if column == "scan" and not _is_scan_number(field):
                    self.fail(row, column, "a whole number of 64 bits")
                if field and not (NUMBER.fullmatch(field) and np.isfinite(float(field))):
                    self.fail(row, column, ALLOWED.get(column, ALLOWED["pose"]))
                if len(field) > LONGEST:
                    self.fail(row, column, f"a number of at most {LONGEST} characters")
        raise AssertionError("a block that did not parse holds a row that does not")


def _second(pairs: Bool[np.ndarray, " pairs"]) -> Bool[np.ndarray, " rows"]:
    """What was found of neighboring rows, as a mark on the later row of each pair."""
    return np.concatenate([[False], pairs])


def _is_scan_number(field: bytes) -> bool:
    if re.fullmatch(rb"[+-]?\d+", field):
        return -(2**63) <= int(field) < 2**63
    return bool(NUMBER.fullmatch(field)) and float(field).is_integer() and abs(float(field)) < 2**53


def _parse(block: bytes, columns: int) -> _Rows | None:
    """Whole lines to numbers, all at once; None where any of them is not what it should be."""
    buffer = np.frombuffer(block, dtype=np.uint8)
    end = np.flatnonzero((buffer == ord(",")) | (buffer == ord("\n")))
    if block.translate(None, ALPHABET) or not block.endswith(b"\n") or len(end) % columns:
        return None
    end = end.reshape(-1, columns)
    if (buffer[end[:, -1]] != ord("\n")).any() or (buffer[end[:, :-1]] != ord(",")).any():
        return None
    begin = np.empty_like(end)
    begin[:, 1:] = end[:, :-1] + 1
    begin[0, 0] = 0
    begin[1:, 0] = end[:-1, -1] + 1
    if (end - begin).max() > LONGEST:
        return None

    # Scan, stamp and pose stand in every row of a scan, usually to the letter: parse them where the letters change.
    head = _fields(block, begin[:, 0], end[:, FIRST_ECHO_COLUMN - 1])
    first = np.concatenate([[True], head[1:] != head[:-1]])
    which = np.cumsum(first) - 1
    try:
        scan = _whole(_fields(block, begin[first, 0], end[first, 0]))
        pose = np.stack([_numbers(_fields(block, begin[first, k], end[first, k])) for k in range(1, 5)], axis=-1)
        echo = np.stack([_numbers(_fields(block, begin[:, k], end[:, k])) for k in range(5, columns)], axis=-1)
    except (ValueError, OverflowError):
        return None
    if np.isinf(pose).any() or np.isinf(echo).any():
        return None
    return _Rows(scan[which], pose[which], echo)


def _fields(
    block: bytes, begin: Int[np.ndarray, " rows"], end: Int[np.ndarray, " rows"]
) -> Shaped[np.ndarray, " rows"]:
    """The texts block[begin:end], as one array of fixed-width byte strings."""
    length = end - begin
    width = max(int(length.max()), 1)
    padded = np.frombuffer(block + bytes(width), dtype=np.uint8)
    letters = sliding_window_view(padded, width)[begin]
    letters *= np.arange(width) < length[:, None]
    return letters.view(f"S{width}")[:, 0]


def _numbers(text: Shaped[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
    """Correctly rounded float64; NaN for an empty text. ValueError where one is no number."""
    empty = text == b""
    if not empty.any():
        return text.astype(np.float64)
    number = np.full(len(text), np.nan)
    number[~empty] = text[~empty].astype(np.float64)
    return number


def _whole(text: Shaped[np.ndarray, " rows"]) -> Int[np.ndarray, " rows"]:
    """int64, exact beyond the 53 bits of a float; ``7.0`` is whole too. ValueError where one is not."""
    try:
        return text.astype(np.int64)
    except ValueError:
        number = text.astype(np.float64)
        if not ((number == np.floor(number)) & (np.abs(number) < 2**53)).all():
            raise
        return number.astype(np.int64)


def write_csv(log: Log, path: str | os.PathLike[str]) -> None:
    """Write a scan log as CSV; the shortest digits that read back as the same number.

    The column ``amplitude`` is there only if any echo has one.

    Args:
        log: the scans.
        path: the file, replaced only once all is written.

    Raises:
        SonarError: the place cannot be written.
    """
    with atomic_write(path) as file:
        file.writelines(csv_lines(log))


def csv_lines(log: Log) -> Iterator[str]:
    """The rows of a scan log as CSV, header first, each with its line end."""
    amplitudes = not np.isnan(log.amplitude).all()
    yield ",".join((*COLUMNS, OPTIONAL) if amplitudes else COLUMNS) + "\n"
    silent = ",,,,\n" if amplitudes else ",,,\n"
    for begin in range(0, len(log), SCANS_AT_ONCE):
        part = log[begin : begin + SCANS_AT_ONCE]
        heads = map(",".join, zip(*map(_texts, (part.scan, part.stamp, *part.pose.T)), strict=True))
        echoes = (part.tx, part.rx, part.range, part.amplitude) if amplitudes else (part.tx, part.rx, part.range)
        tails = list(map(",".join, zip(*map(_texts, echoes), strict=True)))
        start = part.start.tolist()
        for head, first, last in zip(heads, start, start[1:], strict=False):
            if first == last:
                yield head + silent
            else:
                yield from [f"{head},{tail}\n" for tail in tails[first:last]]


def _texts(column: Int[np.ndarray, " rows"] | Float[np.ndarray, " rows"]) -> list[str]:
    """The shortest digits of each number, as ``repr`` finds them but ten times as fast; NaN becomes nothing."""
    if not len(column):
        return []
    return msgspec.json.encode(column.tolist()).decode()[1:-1].replace("null", "").split(",")
