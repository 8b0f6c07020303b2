"""Scan logs in parts: where the scans of a file stand, found without holding it, and any run of them read alone."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from jaxsonar.fileio.atomic_files import reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.csv_log import BLOCK, LONGEST, _fields, _is_scan_number, _whole, csv_header, read_csv_rows
from jaxsonar.scans.parquet_log import open_parquet, read_batch
from jaxsonar.scans.scan_log import Log

AT_ONCE = 65536
"""Rows of a Parquet file whose scan numbers are looked at at once."""
NO_NUMBER = -(2**63)
"""Stands for the number of a scan that has none; such scans are refused when they are read."""


@dataclass(frozen=True)
class Part:
    """A run of whole scans of one file."""

    first: int
    """Row of the first scan in the log, from 0."""
    scans: int
    """How many there are."""
    begin: int = 0
    """CSV: byte of the file that they begin at."""
    end: int = 0
    """CSV: byte that they end before."""
    line: int = 0
    """CSV: line of the file that the first one begins at; the header is line 1."""
    repeated: tuple[int, ...] = ()
    """Rows, from ``first`` on, of scans whose number an earlier scan of the file has."""


class _Begun(NamedTuple):
    """Where scans begin in a file, some of them after another; columns of one length."""

    number: Int[np.ndarray, " scans"]
    offset: Int[np.ndarray, " scans"]
    line: Int[np.ndarray, " scans"]


def csv_parts(path: str | os.PathLike[str], *, name: str, scans: int) -> list[Part]:
    """The scans of a CSV log in runs of ``scans``, by one pass through the file that holds 1 MB of it.

    A row belongs to the scan of the row above it if it has its number, and where the number of either cannot be read.

    Args:
        path: the file.
        name: what messages call it.
        scans: in every part but the last one.

    Raises:
        SonarError: the file cannot be read, or its header is not that of a scan log.
    """
    size = os.stat(path).st_size
    parts: list[Part] = []
    count = 0
    for begun in _csv_scans(path, name):
        for k in range(-count % scans, len(begun.number), scans):
            parts.append(Part(count + k, scans, int(begun.offset[k]), size, int(begun.line[k])))
        count += len(begun.number)
    ends = [*(part.begin for part in parts[1:]), size][: len(parts)]
    numbers = lambda: (begun.number for begun in _csv_scans(path, name))  # noqa: E731
    return _finished(parts, ends, count, numbers)


def parquet_parts(path: str | os.PathLike[str], *, name: str, scans: int) -> list[Part]:
    """The scans of a Parquet log in runs of ``scans``, by one pass over their numbers alone.

    Args:
        path: the file.
        name: what messages call it.
        scans: in every part but the last one.

    Raises:
        SonarError: the file cannot be read or is no scan log, or the extra is missing.
    """
    file = open_parquet(path, name=name)
    count = file.metadata.num_rows
    parts = [Part(first, scans) for first in range(0, count, scans)]
    return _finished(parts, [0] * len(parts), count, lambda: _parquet_numbers(file, name))


def csv_reader(path: str | os.PathLike[str], part: Part, *, name: str) -> Callable[[int, int], Log]:
    """What reads some scans of a part of a CSV log: ``read(a, b)`` are those from a up to b, counted from its first."""
    with _opened(path, name) as file:
        columns = csv_header(name, _header_line(file))
        file.seek(part.begin)
        text = file.read(part.end - part.begin)
    if not text.endswith(b"\n"):
        text += b"\n"
    first, lines = next(_begun(name, iter([text]), 0))[1:]
    offset, line = np.append(first, len(text)), lines + part.line
    if len(first) != part.scans:
        raise SonarError(f"{shown(name)}: changed since it was looked at; needed is a log that stays as it is")

    def read(begin: int, end: int) -> Log:
        body = text[offset[begin] : offset[end]]
        body = body.replace(b"\r\n", b"\n") if b"\r" in body else body
        return read_csv_rows(name, columns, body, first=int(line[begin]))

    return read


def parquet_reader(path: str | os.PathLike[str], part: Part, *, name: str) -> Callable[[int, int], Log]:
    """The same of a Parquet log; only the row groups that the part touches are read."""
    import pyarrow as pa

    file = open_parquet(path, name=name)
    sizes = [file.metadata.row_group(k).num_rows for k in range(file.metadata.num_row_groups)]
    ends = np.cumsum(sizes)
    last = part.first + part.scans
    touched = np.flatnonzero((ends > part.first) & (ends - sizes < last)).tolist()
    row, taken = int(ends[touched[0]] - sizes[touched[0]]), []
    try:
        for batch in file.iter_batches(batch_size=8192, row_groups=touched):
            begin, end = max(part.first - row, 0), min(last - row, len(batch))
            if begin < end:
                taken.append(batch.slice(begin, end - begin))
            row += len(batch)
        (rows,) = pa.Table.from_batches(taken).combine_chunks().to_batches()
    except (pa.ArrowException, OSError, ValueError) as failure:
        raise SonarError(f"{shown(name)}: {reason(failure)}; needed is a scan log as a whole Parquet file") from None
    return lambda begin, end: read_batch(name, rows.slice(begin, end - begin), part.first + begin)


def _finished(parts: list[Part], ends: list[int], count: int, numbers: Callable[[], Iterator[Any]]) -> list[Part]:
    """Parts with their ends, the last one with what is left, and the repeated scans of each."""
    again = _repeated(numbers)
    finished = []
    for part, end in zip(parts, ends, strict=True):
        scans = min(part.scans, count - part.first)
        own = again[np.searchsorted(again, part.first) : np.searchsorted(again, part.first + scans)] - part.first
        finished.append(Part(part.first, scans, part.begin, end, part.line, tuple(own.tolist())))
    return finished


def _repeated(numbers: Callable[[], Iterator[Int[np.ndarray, " scans"]]]) -> Int[np.ndarray, " repeated"]:
    """Rows of scans whose number came before. Where numbers rise, as they mostly do, nothing is held."""
    last = NO_NUMBER
    for some in numbers():
        some = some[some != NO_NUMBER]
        if len(some) and (some[0] <= last or (np.diff(some) <= 0).any()):
            break
        last = int(some[-1]) if len(some) else last
    else:
        return np.zeros(0, np.int64)
    every = np.concatenate(list(numbers()))
    order = np.argsort(every, kind="stable")
    came = order[1:][np.diff(every[order]) == 0]
    return np.sort(came[every[came] != NO_NUMBER])


def _parquet_numbers(file: Any, name: str) -> Iterator[Int[np.ndarray, " scans"]]:
    import pyarrow as pa

    try:
        for batch in file.iter_batches(batch_size=AT_ONCE, columns=["scan"]):
            yield batch.column("scan").cast(pa.int64()).fill_null(NO_NUMBER).to_numpy(zero_copy_only=False)
    except (pa.ArrowException, OSError) as failure:
        raise SonarError(f"{shown(name)}: {reason(failure)}; needed is a scan log as a whole Parquet file") from None


def _csv_scans(path: str | os.PathLike[str], name: str) -> Iterator[_Begun]:
    """Where the scans of a CSV log begin, block by block."""
    with _opened(path, name) as file:
        header = _header_line(file)
        csv_header(name, header)
        here = file.tell()
        for begun in _begun(name, iter(lambda: file.read(BLOCK), b""), here):
            yield _Begun(begun.number, begun.offset, begun.line + 2)


def _opened(path: str | os.PathLike[str], name: str) -> Any:
    try:
        return open(path, "rb")
    except OSError as failure:
        raise SonarError(f"{shown(name)}: {reason(failure)}; needed is a readable file with a scan log (CSV)") from None


def _header_line(file: Any) -> bytes:
    """The first row of a file, as ``csv_header`` takes it; no more than a block of what is no text."""
    return file.readline(BLOCK).removeprefix(b"\xef\xbb\xbf").rstrip(b"\n").removesuffix(b"\r")


def _begun(name: str, blocks: Iterator[bytes], here: int) -> Iterator[_Begun]:
    """Where scans begin in rows that come in blocks; ``here`` is the offset of the first, whose line is 0."""
    left, line, state = b"", 0, None
    for block in blocks:
        block = left + block
        whole = block.rfind(b"\n") + 1
        if whole == 0 and len(block) > BLOCK:
            raise SonarError(f"{shown(name)}: row {line + 2}: more than 1 MB came; allowed are rows of numbers")
        left = block[whole:]
        if whole:
            begun, lines, state = _first_rows(block[:whole], state)
            yield _Begun(begun.number, begun.offset + here, begun.line + line)
            here, line = here + whole, line + lines
    if left:
        begun, _, _ = _first_rows(left + b"\n", state)
        yield _Begun(begun.number, begun.offset + here, begun.line + line)


def _first_rows(block: bytes, before: tuple[int, bool] | None) -> tuple[_Begun, int, tuple[int, bool]]:
    """Rows of a block that begin a scan; ``before`` is the number of the row above, and whether it could be read."""
    buffer = np.frombuffer(block, dtype=np.uint8)
    end = np.flatnonzero(buffer == ord("\n"))
    start = np.concatenate([[0], end[:-1] + 1])
    comma = np.append(np.flatnonzero(buffer == ord(",")), len(block))
    stop = np.minimum(np.minimum(comma[np.searchsorted(comma, start)], end), start + LONGEST)
    text = _fields(block, start, stop)
    other = np.concatenate([[True], text[1:] != text[:-1]])
    number, known = _numbers(text[other])
    which = np.cumsum(other) - 1
    number, known = number[which], known[which]
    above = np.concatenate([[number[0] if before is None else before[0]], number[:-1]])
    above_known = np.concatenate([[True if before is None else before[1]], known[:-1]])
    begins = known & above_known & (number != above)
    begins[0] |= before is None
    rows = np.flatnonzero(begins)
    return _Begun(number[rows], start[rows], rows), len(start), (int(number[-1]), bool(known[-1]))


def _numbers(text: np.ndarray) -> tuple[Int[np.ndarray, " texts"], Bool[np.ndarray, " texts"]]:
    """Scan numbers, and which texts are one."""
    try:
        return _whole(text), np.ones(len(text), bool)
    except (ValueError, OverflowError):
        known = np.array([_is_scan_number(one) for one in text.tolist()])
        number = np.full(len(text), NO_NUMBER)
        number[known] = [int(one) if one.lstrip(b"+-").isdigit() else int(float(one)) for one in text[known].tolist()]
        return number, known
