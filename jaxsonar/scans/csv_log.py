"""Scan logs as CSV: one row per reading, ``scan,stamp,x,y,theta,tx,rx,range`` and optionally ``amplitude,age,t``.

A row with ``tx`` and ``rx`` but without ``range`` is a path that fired and heard nothing. A scan without any reading
has one row without all three. The optional columns may have any order; an empty ``age`` or ``t`` is 0.

NumPy parses all rows of a block at once. Only if a block is invalid are its rows examined one by one, to find the first
invalid field. Row numbers are lines of the file; the header is row 1.
"""

import os
import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple, NoReturn

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from numpy.lib.stride_tricks import sliding_window_view

from jaxsonar.fileio.atomic_files import DECIMAL, atomic_write, read_bytes, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.no_echo_values import no_echo_hint, with_valid_ranges
from jaxsonar.scans.scan_log import ALLOWED, LARGEST_SENSOR, InvalidLogValue, Log

COLUMNS = ("scan", "stamp", "x", "y", "theta", "tx", "rx", "range")
OPTIONAL = ("amplitude", "age", "t")
"""Optional columns after the others, in the order in which they are written."""
UNUSED = {
    "amplitude": "nothing, in a row without an echo",
    "age": "nothing, in a row without a path",
    "t": "nothing, in a row without a path",
}
"""Allowed in the optional columns of a row that cannot hold their value."""
FIRST_ECHO_COLUMN = 5
"""First column that belongs to an echo; the columns before it belong to the scan and repeat in all of its rows."""

BLOCK = 1 << 20
"""Bytes that are parsed at once: small enough for the cache, large enough for NumPy."""
SCANS_PER_WRITE = 8192
"""Scans that are formatted at once, for the same reasons."""
MAX_NUMBER_LENGTH = 64
"""Characters of one number: fields are parsed as arrays of characters, as wide as the longest field."""
ALPHABET = b"0123456789+-.eE,\n"
"""Characters of valid rows."""
NUMBER = re.compile(DECIMAL.encode())
"""A decimal number."""


class _Rows(NamedTuple):
    """Parsed rows of a file; NaN for an empty field."""

    scan: Int[np.ndarray, " rows"]
    """Scan number."""
    pose: Float[np.ndarray, "rows 4"]
    """Stamp, x, y, theta."""
    echo: Float[np.ndarray, "rows fields"]
    """tx, rx, range, and the optional columns of the file, in its order."""


def read_csv(filename: str | os.PathLike[str], *, no_echo: Sequence[float] = ()) -> Log:
    """Read a scan log from CSV.

    The text is UTF-8 with or without byte order mark. Lines end with LF or CRLF, the last one optionally.

    Args:
        filename: the file.
        no_echo: ranges that mean no echo, metres; those that are no valid ranges become ``as_range``.

    Raises:
        SonarError: the file cannot be read or is no scan log; the message names file, row, column, value and allowed
            values.
    """
    return read_csv_text(filename, read_bytes(filename, what="a scan log (CSV)"), no_echo=no_echo)


def read_csv_text(filename: str | os.PathLike[str], text: bytes, *, no_echo: Sequence[float] = ()) -> Log:
    """As ``read_csv``, from the content of the file; ``filename`` is used in error messages only."""
    text = text.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in text:
        text = text.replace(b"\r\n", b"\n")
    header, _, body = text.partition(b"\n")
    is_cut = bool(body) and not body.endswith(b"\n")
    columns = csv_header(filename, header)
    return read_csv_rows(filename, columns, body + b"\n" * is_cut, is_cut=is_cut, no_echo=no_echo)


def read_csv_rows(
    filename: str | os.PathLike[str],
    columns: tuple[str, ...],
    body: bytes,
    *,
    first: int = 2,
    asked: Int[np.ndarray, "pairs 2"] | None = None,
    is_cut: bool = False,
    no_echo: Sequence[float] = (),
) -> Log:
    """As ``read_csv``, from complete rows of a file.

    Args:
        filename: the file, for error messages.
        columns: columns that ``csv_header`` returned.
        body: rows, each with its LF.
        first: row number of the first of them in the file; the header is row 1.
        asked: ``Log.asked`` of the whole file; derived from these rows if omitted.
        is_cut: the last row had no line end in the file, so that it may be incomplete.
        no_echo: as in ``read_csv``.
    """
    source = _CsvBody(filename, columns, body, first, is_cut=is_cut)
    rows = source.rows()
    rows.echo[:, 2] = with_valid_ranges(rows.echo[:, 2], no_echo)
    return source.log(rows, asked)


def csv_header(filename: str | os.PathLike[str], line: bytes) -> tuple[str, ...]:
    """Column names from the first row of a file, given without byte order mark and line end.

    Raises:
        SonarError: these are not the columns of a scan log.
    """
    wanted = f"allowed is {','.join(COLUMNS)} and optionally {', '.join(OPTIONAL)}"
    if not line:
        raise SonarError(f"{shown(filename)}: row 1: no header came; {wanted}")
    text = line.decode(errors="replace")
    if "\ufffd" in text or "\0" in text:
        raise SonarError(f"{shown(filename)}: row 1: this is no text; {wanted}")
    names = tuple(text.split(","))
    if len(names) == 1 and (found := re.search("[;\t]", text)):
        came = "tabs" if found[0] == "\t" else "semicolons"
        raise SonarError(
            f"{shown(filename)}: row 1: {came} between the columns came; allowed are commas between columns and "
            f"points, not decimal commas, in numbers (save the table in an English format); {wanted}"
        )
    for k, name in enumerate(names):
        if name not in COLUMNS + OPTIONAL:
            raise SonarError(f"{shown(filename)}: row 1: unknown column '{shown(name, 40)}'; {wanted}")
        if name in names[:k]:
            raise SonarError(f"{shown(filename)}: row 1: column '{name}' came twice; {wanted}")
    for name in COLUMNS:
        if name not in names:
            raise SonarError(f"{shown(filename)}: row 1: column '{name}' is missing; {wanted}")
    if names[: len(COLUMNS)] != COLUMNS:
        raise SonarError(f"{shown(filename)}: row 1: columns in the order {','.join(names)}; {wanted}")
    return names


class _CsvBody:
    """The rows of one file: parsing, grouping into scans, and error messages."""

    def __init__(
        self, filename: str | os.PathLike[str], columns: tuple[str, ...], body: bytes, first: int, *, is_cut: bool
    ):
        self.is_cut = is_cut
        self.filename, self.columns, self.body, self.first = filename, columns, body, first

    def rows(self) -> _Rows:
        """All fields as numbers."""
        parts, begin = [_Rows(np.zeros(0, np.int64), np.zeros((0, 4)), np.zeros((0, len(self.columns) - 5)))], 0
        while begin < len(self.body):
            end = self.body.rfind(b"\n", begin, begin + BLOCK) + 1
            if end == 0:  # no line end within a block, so this is no valid row
                end = self.body.find(b"\n", begin) + 1
            part = _parse(self.body[begin:end], len(self.columns))
            if part is None:
                self.fail_on_text(begin)
            parts.append(part)
            begin = end
        return _Rows(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def log(self, rows: _Rows, asked: Int[np.ndarray, "pairs 2"] | None) -> Log:
        """The log of parsed rows."""
        column = dict(zip(self.columns[FIRST_ECHO_COLUMN:], rows.echo.T, strict=True))
        tx, rx, reported = column["tx"], column["rx"], column["range"]
        for name in ("tx", "rx"):
            sensor = column[name]
            is_sensor = (sensor == np.floor(sensor)) & (sensor >= 0) & (sensor <= LARGEST_SENSOR)
            self.check(~is_sensor, name, ALLOWED[name], unless=np.isnan(sensor))
        empty = np.all(np.isnan(rows.echo[:, :3]), axis=1)
        for name in ("tx", "rx"):
            self.check(np.isnan(column[name]), name, "tx and rx with or without a range, or none of them", unless=empty)
        for name in self.columns[len(COLUMNS) :]:
            unused = empty | np.isnan(reported) if name == "amplitude" else empty
            self.check(unused & ~np.isnan(column[name]), name, UNUSED[name])
        unknown = np.isnan(rows.pose[:, 1:])
        for k, name in enumerate(("x", "y", "theta")):
            self.check(unknown[:, k], name, ALLOWED["pose"], unless=np.all(unknown, axis=1))

        follows = rows.scan[1:] == rows.scan[:-1]  # row k + 1 belongs to the same scan as row k
        same = (rows.pose[1:] == rows.pose[:-1]) | (np.isnan(rows.pose[1:]) & np.isnan(rows.pose[:-1]))
        for k, name in enumerate(("stamp", "x", "y", "theta")):
            self.check(_later_row(follows & ~same[:, k]), name, "the same in every row of a scan")
        alone = "tx, rx and range, unless the row is the only one of its scan"
        self.check(_later_row(follows & (empty[1:] | empty[:-1])), "tx", alone)

        first = np.flatnonzero(~_later_row(follows))[: len(tx)]
        echo = np.flatnonzero(~empty)
        optional = {name: column[name][echo] for name in self.columns[len(COLUMNS) :]}
        try:
            return Log(
                scan=rows.scan[first],
                stamp=rows.pose[first, 0],
                pose=rows.pose[first, 1:],
                start=np.searchsorted(echo, np.append(first, len(tx))),
                tx=tx[echo].astype(np.int64),
                rx=rx[echo].astype(np.int64),
                range=reported[echo],
                amplitude=optional.get("amplitude", np.full(len(echo), np.nan)),
                t=np.nan_to_num(optional.get("t", np.zeros(len(echo)))),
                age=np.nan_to_num(optional.get("age", np.zeros(len(echo)))),
                **({} if asked is None else {"asked": asked}),
            )
        except InvalidLogValue as fault:
            row = first[fault.scan] if fault.echo is None else echo[fault.echo]
            self.fail(int(row), fault.column, fault.allowed + no_echo_hint(fault))

    def check(
        self,
        bad: Bool[np.ndarray, " rows"],
        column: str,
        allowed: str,
        *,
        unless: Bool[np.ndarray, " rows"] | None = None,
    ) -> None:
        """Raise an error about the first bad row, if there is one."""
        bad = bad if unless is None else bad & ~unless
        if bad.any():
            self.fail(int(np.argmax(bad)), column, allowed)

    def fail(self, row: int, column: str, allowed: str) -> NoReturn:
        """Raise an error about one field; ``row`` is counted from 0 in the body."""
        field = self.body.split(b"\n", row + 1)[row].split(b",")[self.columns.index(column)]
        came = f"'{shown(field.decode(errors='backslashreplace'), 40)}'" if field else "nothing"
        place = f"{shown(self.filename)}: row {row + self.first}"
        raise SonarError(f"{place}, column {column}: {came} came; allowed is {allowed}")

    def fail_on_text(self, begin: int) -> NoReturn:
        """Raise an error about the first row after the byte ``begin`` that does not consist of the right numbers."""
        lines = self.body[begin:].split(b"\n")[:-1]
        first = self.body.count(b"\n", 0, begin)
        for row, line in enumerate(lines, first):
            place = f"{shown(self.filename)}: row {row + self.first}"
            fields = line.split(b",")
            if b"\0" in line:
                raise SonarError(f"{place}: this is no text; allowed are {len(self.columns)} numbers")
            if len(fields) != len(self.columns):
                wanted = f"{len(self.columns)}, {','.join(self.columns)}"
                last = self.is_cut and row == first + len(lines) - 1 and len(fields) < len(self.columns)
                cure = "; the file ends within this row: delete the rows of its last scan" if last else ""
                if len(fields) > len(self.columns):
                    cure = "; are these decimal commas? allowed are points in numbers"
                raise SonarError(f"{place}: {len(fields) if line else 'no'} columns came; allowed are {wanted}{cure}")
            for column, field in zip(self.columns, fields, strict=True):
                if column == "scan" and not is_scan_number(field):
                    self.fail(row, column, "a whole number of 64 bits")
                if field and not (NUMBER.fullmatch(field) and np.isfinite(float(field))):
                    self.fail(row, column, ALLOWED.get(column, ALLOWED["pose"]))
                if len(field) > MAX_NUMBER_LENGTH:
                    self.fail(row, column, f"a number of at most {MAX_NUMBER_LENGTH} characters")
        raise AssertionError("a block that did not parse holds a row that does not")


def _later_row(pairs: Bool[np.ndarray, " pairs"]) -> Bool[np.ndarray, " rows"]:
    """A mask of pairs of consecutive rows as a mask of the later row of each pair."""
    return np.concatenate([[False], pairs])


def is_scan_number(field: bytes) -> bool:
    """Whether a field is an integer of 64 bits; ``7.0`` is one, too."""
    if re.fullmatch(rb"[+-]?\d+", field):
        return -(2**63) <= int(field) < 2**63
    return bool(NUMBER.fullmatch(field)) and float(field).is_integer() and abs(float(field)) < 2**53


def _parse(block: bytes, columns: int) -> _Rows | None:
    """All fields of complete lines as numbers; None if any field is invalid."""
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
    if (end - begin).max() > MAX_NUMBER_LENGTH:
        return None

    # Scan, stamp and pose repeat in all rows of a scan, usually with the same characters: parse them only on a change.
    head = fields_of(block, begin[:, 0], end[:, FIRST_ECHO_COLUMN - 1])
    first = np.concatenate([[True], head[1:] != head[:-1]])
    which = np.cumsum(first) - 1
    try:
        scan = integers_of(fields_of(block, begin[first, 0], end[first, 0]))
        pose = np.stack([_numbers(fields_of(block, begin[first, k], end[first, k])) for k in range(1, 5)], axis=-1)
        echo = np.stack([_numbers(fields_of(block, begin[:, k], end[:, k])) for k in range(5, columns)], axis=-1)
    except (ValueError, OverflowError):
        return None
    if np.isinf(pose).any() or np.isinf(echo).any():
        return None
    return _Rows(scan[which], pose[which], echo)


def fields_of(
    block: bytes, begin: Int[np.ndarray, " rows"], end: Int[np.ndarray, " rows"]
) -> Shaped[np.ndarray, " rows"]:
    """The fields block[begin:end] as an array of fixed-width byte strings."""
    length = end - begin
    width = max(int(length.max()), 1)
    padded = np.frombuffer(block + bytes(width), dtype=np.uint8)
    characters = sliding_window_view(padded, width)[begin]
    characters *= np.arange(width) < length[:, None]
    return characters.view(f"S{width}")[:, 0]


def _numbers(text: Shaped[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
    """Correctly rounded float64; NaN for an empty field. Raises ValueError for a field that is no number."""
    empty = text == b""
    if not empty.any():
        return text.astype(np.float64)
    number = np.full(len(text), np.nan)
    number[~empty] = text[~empty].astype(np.float64)
    return number


def integers_of(text: Shaped[np.ndarray, " rows"]) -> Int[np.ndarray, " rows"]:
    """Exact int64; ``7.0`` is an integer, too. Raises ValueError for a field that is no integer."""
    try:
        return text.astype(np.int64)
    except ValueError:
        number = text.astype(np.float64)
        if not ((number == np.floor(number)) & (np.abs(number) < 2**53)).all():
            raise
        return number.astype(np.int64)


def write_csv(log: Log, filename: str | os.PathLike[str]) -> None:
    """Write a scan log as CSV, each number with the fewest digits that restore it exactly.

    The column ``amplitude`` is present only if any echo has an amplitude, ``age`` and ``t`` only if any is not 0.

    Args:
        log: the scans.
        filename: the file; an existing one is replaced only after the new one is complete.

    Raises:
        SonarError: the file cannot be written.
    """
    with atomic_write(filename) as file:
        file.writelines(csv_lines(log))


def csv_lines(log: Log) -> Iterator[str]:
    """The lines of a scan log as CSV, header first, each with its line end."""
    needed = {"amplitude": not np.isnan(log.amplitude).all(), "age": log.age.any(), "t": log.t.any()}
    optional = [name for name in OPTIONAL if needed[name]]
    yield ",".join((*COLUMNS, *optional)) + "\n"
    no_reading = "," * (len(COLUMNS) - FIRST_ECHO_COLUMN + len(optional)) + "\n"
    for begin in range(0, len(log), SCANS_PER_WRITE):
        part = log[begin : begin + SCANS_PER_WRITE]
        heads = map(",".join, zip(*map(_texts, (part.scan, part.stamp, *part.pose.T)), strict=True))
        zero_is_empty = {name: np.where(getattr(part, name) == 0, np.nan, getattr(part, name)) for name in ("age", "t")}
        columns = {"amplitude": part.amplitude, **zero_is_empty}
        echoes = (part.tx, part.rx, part.range, *(columns[name] for name in optional))
        tails = list(map(",".join, zip(*map(_texts, echoes), strict=True)))
        start = part.start.tolist()
        for head, first, last in zip(heads, start, start[1:], strict=False):
            if first == last:
                yield head + no_reading
            else:
                yield from [f"{head},{tail}\n" for tail in tails[first:last]]


def _texts(column: Int[np.ndarray, " rows"] | Float[np.ndarray, " rows"]) -> list[str]:
    """Each number with the fewest digits, as ``repr`` but ten times as fast; NaN becomes an empty text."""
    if not len(column):
        return []
    return msgspec.json.encode(column.tolist()).decode()[1:-1].replace("null", "").split(",")
