"""Chunks of scan logs: location of the scans in a file of any size, and reading of any run of them.

What the scans of a chunk measured does not depend on the split: every chunk has ``Log.asked`` of its file. A chunk
whose readings have times or ages of their own is read with the scans around it, for the motion of the robot and the
originals of repeated readings.
"""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from jaxsonar.fileio.atomic_files import reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.csv_log import (
    BLOCK,
    MAX_NUMBER_LENGTH,
    csv_header,
    fields_of,
    integers_of,
    is_scan_number,
    read_csv_rows,
)
from jaxsonar.scans.log_parts import concatenate, readable_runs
from jaxsonar.scans.log_survey import LogSurvey
from jaxsonar.scans.parquet_log import open_parquet, read_batch
from jaxsonar.scans.scan_log import Log


@dataclass(frozen=True)
class ChunkSettings:
    """Constants of chunks. Chosen by hand."""

    scans_around: int = 16
    """Scans on each side of a chunk between whose poses the motion is interpolated, if readings have own times."""


SETTINGS = ChunkSettings()
ROWS_PER_READ = 65536
"""Rows of a Parquet file whose scan numbers are read at once."""
NO_NUMBER = -(2**63)
"""Placeholder for a missing scan number; such scans are rejected when they are read."""


@dataclass(frozen=True)
class LogChunk:
    """A run of complete scans of one file."""

    first: int
    """Row of the first scan in the log, from 0."""
    scans: int
    """Number of scans."""
    begin: int = 0
    """CSV: byte offset of the first scan in the file."""
    end: int = 0
    """CSV: byte offset of the end."""
    line: int = 0
    """CSV: line number of the first scan in the file; the header is line 1."""
    repeated: tuple[int, ...] = ()
    """Rows, counted from ``first``, of scans whose number already occurred in the file."""
    asked: tuple[tuple[int, int], ...] = ()
    """``Log.asked`` of the whole file."""
    in_turn: bool = False
    """Every scan of the file holds the firings of one transmitter; ``single_firings.group_firings`` merges them."""
    around: tuple[int, int, int, int] | None = None
    """First scan, scans, CSV: begin and end in bytes, of this chunk with the scans around it that it needs; None: it
    needs none."""

    @property
    def with_surroundings(self) -> "LogChunk | None":
        """The chunk of the scans in ``around``."""
        if self.around is None:
            return None
        first, scans, begin, end = self.around
        return LogChunk(first, scans, begin, end, asked=self.asked)


class _ScanStarts(NamedTuple):
    """Starts of consecutive scans in a file; columns of equal length."""

    number: Int[np.ndarray, " scans"]
    offset: Int[np.ndarray, " scans"]
    line: Int[np.ndarray, " scans"]


def csv_chunks(filename: str | os.PathLike[str], *, name: str, scans: int) -> list[LogChunk]:
    """Chunks of a CSV log with this number of scans, by one pass through the file with 1 MB of memory.

    A row belongs to the scan of the previous row if both have the same number, or if either number is unreadable.

    Args:
        filename: the file.
        name: name of the file in error messages.
        scans: number of scans of every chunk but the last one.

    Raises:
        SonarError: the file cannot be read, or its header is not that of a scan log.
    """
    size = os.stat(filename).st_size
    chunks: list[LogChunk] = []
    survey = LogSurvey()
    offsets: dict[int, int] = {}
    count = 0
    for starts in _csv_scans(filename, name, survey):
        for k in range(-count % scans, len(starts.number), scans):
            chunks.append(LogChunk(count + k, scans, int(starts.offset[k]), size, int(starts.line[k])))
        for margin in (-SETTINGS.scans_around, SETTINGS.scans_around):
            for k in range((margin - count) % scans, len(starts.number), scans):
                offsets[count + k] = int(starts.offset[k])
        count += len(starts.number)
    ends = [*(chunk.begin for chunk in chunks[1:]), size][: len(chunks)]
    numbers = lambda: (starts.number for starts in _csv_scans(filename, name))  # noqa: E731
    return _complete_chunks(chunks, ends, count, numbers, survey, offsets)


def parquet_chunks(filename: str | os.PathLike[str], *, name: str, scans: int) -> list[LogChunk]:
    """Chunks of a Parquet log with this number of scans, by one pass over the scan numbers.

    Args:
        filename: the file.
        name: name of the file in error messages.
        scans: number of scans of every chunk but the last one.

    Raises:
        SonarError: the file cannot be read or is no scan log, or the parquet extra is missing.
    """
    file = open_parquet(filename, name=name)
    count = file.metadata.num_rows
    chunks = [LogChunk(first, scans) for first in range(0, count, scans)]
    survey = _parquet_survey(file, name)
    return _complete_chunks(chunks, [0] * len(chunks), count, lambda: _parquet_numbers(file, name), survey, {})


def csv_chunk_reader(filename: str | os.PathLike[str], chunk: LogChunk, *, name: str) -> Callable[[int, int], Log]:
    """A function ``read(a, b)`` that reads the scans a to b (exclusive) of a chunk of a CSV log."""
    return _with_surroundings(_csv_reader, filename, chunk, name)


def parquet_chunk_reader(filename: str | os.PathLike[str], chunk: LogChunk, *, name: str) -> Callable[[int, int], Log]:
    """As ``csv_chunk_reader`` for a Parquet log; only the row groups of the chunk are read."""
    return _with_surroundings(_parquet_reader, filename, chunk, name)


def _with_surroundings(
    reader: Callable[[str | os.PathLike[str], LogChunk, str], Callable[[int, int], Log]],
    filename: str | os.PathLike[str],
    chunk: LogChunk,
    name: str,
) -> Callable[[int, int], Log]:
    """Reader of a chunk; its scans come from a log that also holds the readable scans around it."""
    plain, wider = reader(filename, chunk, name), chunk.with_surroundings
    if wider is None:
        return plain
    from jaxsonar.scans.readings import unique_readings

    before = chunk.first - wider.first
    runs, _ = readable_runs(reader(filename, wider, name), wider.scans)
    runs = _without_repeated_scans(runs, {before + row for row in chunk.repeated})
    log = unique_readings(concatenate([run for _, run in runs]))
    place = np.full(wider.scans, -1)
    place[_rows(runs)] = np.arange(len(log))
    place = place[before : before + chunk.scans]

    def read(begin: int, end: int) -> Log:
        if (place[begin:end] >= 0).all():
            return log[place[begin] : place[begin] + end - begin]
        alone = plain(begin, end)  # reports unreadable scans
        if end - begin == 1:
            return replace(alone, asked=log.asked)
        middle = (begin + end) // 2
        return concatenate([read(begin, middle), read(middle, end)])

    return read


def _rows(runs: list[tuple[int, Log]]) -> Int[np.ndarray, " scans"]:
    """Rows of the scans of runs that begin at these rows."""
    return np.concatenate([np.zeros(0, np.int64), *(first + np.arange(len(run)) for first, run in runs)])


def _without_repeated_scans(runs: list[tuple[int, Log]], repeated: set[int]) -> list[tuple[int, Log]]:
    """Runs of scans with different numbers: the first scan of each number, without the rows ``repeated``."""
    row = _rows(runs)
    number = np.concatenate([np.zeros(0, np.int64), *(run.scan for _, run in runs)])
    known = np.flatnonzero(~np.isin(row, list(repeated)))
    kept = set(row[known[np.unique(number[known], return_index=True)[1]]].tolist())
    if len(kept) == len(row):
        return runs
    return [(first + k, run[k : k + 1]) for first, run in runs for k in range(len(run)) if first + k in kept]


def _csv_reader(filename: str | os.PathLike[str], chunk: LogChunk, name: str) -> Callable[[int, int], Log]:
    """Reader of a chunk of a CSV log by itself."""
    with _open(filename, name) as file:
        columns = csv_header(name, _header_line(file))
        file.seek(chunk.begin)
        text = file.read(chunk.end - chunk.begin)
    if not text.endswith(b"\n"):
        text += b"\n"
    first, lines = next(_find_starts(name, iter([text]), 0))[1:]
    offset, line = np.append(first, len(text)), lines + chunk.line
    if len(first) != chunk.scans:
        raise SonarError(f"{shown(name)}: the file changed during processing; needed is a log that does not change")
    asked = np.array(chunk.asked, np.int64).reshape(-1, 2)

    def read(begin: int, end: int) -> Log:
        body = text[offset[begin] : offset[end]]
        body = body.replace(b"\r\n", b"\n") if b"\r" in body else body
        return read_csv_rows(name, columns, body, first=int(line[begin]), asked=asked)

    return read


def _parquet_reader(filename: str | os.PathLike[str], chunk: LogChunk, name: str) -> Callable[[int, int], Log]:
    """Reader of a chunk of a Parquet log by itself."""
    import pyarrow as pa

    file = open_parquet(filename, name=name)
    sizes = [file.metadata.row_group(k).num_rows for k in range(file.metadata.num_row_groups)]
    ends = np.cumsum(sizes)
    last = chunk.first + chunk.scans
    touched = np.flatnonzero((ends > chunk.first) & (ends - sizes < last)).tolist()
    row, batches = int(ends[touched[0]] - sizes[touched[0]]), []
    try:
        for batch in file.iter_batches(batch_size=8192, row_groups=touched):
            begin, end = max(chunk.first - row, 0), min(last - row, len(batch))
            if begin < end:
                batches.append(batch.slice(begin, end - begin))
            row += len(batch)
        (rows,) = pa.Table.from_batches(batches).combine_chunks().to_batches()
    except (pa.ArrowException, OSError, ValueError) as failure:
        raise SonarError(f"{shown(name)}: {reason(failure)}; needed is a scan log as a whole Parquet file") from None
    asked = np.array(chunk.asked, np.int64).reshape(-1, 2)
    return lambda begin, end: read_batch(name, rows.slice(begin, end - begin), chunk.first + begin, asked=asked)


def _complete_chunks(
    chunks: list[LogChunk],
    ends: list[int],
    count: int,
    numbers: Callable[[], Iterator[Any]],
    survey: LogSurvey,
    offsets: dict[int, int],
) -> list[LogChunk]:
    """Chunks with their ends, the number of scans of the last one, the repeated scans of each, and the survey."""
    repeated = _repeated_rows(numbers)
    asked = tuple((tx, rx) for tx, rx in survey.asked.pairs().tolist())
    complete = []
    for chunk, end in zip(chunks, ends, strict=True):
        scans = min(chunk.scans, count - chunk.first)
        first, last = np.searchsorted(repeated, [chunk.first, chunk.first + scans])
        rows = tuple((repeated[first:last] - chunk.first).tolist())
        around = _surroundings(chunk, scans, chunks, ends, count, survey, offsets)
        complete.append(
            replace(
                chunk, scans=scans, end=end, repeated=rows, asked=asked, in_turn=survey.asked.in_turn, around=around
            )
        )
    return complete


def _surroundings(
    chunk: LogChunk,
    scans: int,
    chunks: list[LogChunk],
    ends: list[int],
    count: int,
    survey: LogSurvey,
    offsets: dict[int, int],
) -> tuple[int, int, int, int] | None:
    """``LogChunk.around``: some scans on each side, and all chunks before that may hold the originals of readings."""
    if not (survey.times or survey.age) or scans == count:
        return None
    first = max(chunk.first - SETTINGS.scans_around, 0)
    last = min(chunk.first + scans + SETTINGS.scans_around, count)
    begin = offsets.get(first, chunks[0].begin)
    end = offsets.get(last, ends[-1])
    if survey.age:
        oldest = survey.stamp(chunk.first) - survey.age
        k = chunk.first // chunk.scans
        while k and (chunks[k].first > first or not survey.stamp(chunks[k].first) < oldest):
            k -= 1
        first, begin = chunks[k].first, chunks[k].begin
    return first, last - first, begin, end


def _repeated_rows(numbers: Callable[[], Iterator[Int[np.ndarray, " scans"]]]) -> Int[np.ndarray, " repeated"]:
    """Rows of scans whose number already occurred. Needs no memory for increasing numbers, the usual case."""
    last = NO_NUMBER
    for block in numbers():
        known = block[block != NO_NUMBER]
        if len(known) and (known[0] <= last or (np.diff(known) <= 0).any()):
            break
        last = int(known[-1]) if len(known) else last
    else:
        return np.zeros(0, np.int64)
    every = np.concatenate(list(numbers()))
    order = np.argsort(every, kind="stable")
    repeated = order[1:][np.diff(every[order]) == 0]
    return np.sort(repeated[every[repeated] != NO_NUMBER])


def _parquet_numbers(file: Any, name: str) -> Iterator[Int[np.ndarray, " scans"]]:
    """Scan numbers of a Parquet log, block by block."""
    import pyarrow as pa

    try:
        for batch in file.iter_batches(batch_size=ROWS_PER_READ, columns=["scan"]):
            yield batch.column("scan").cast(pa.int64()).fill_null(NO_NUMBER).to_numpy(zero_copy_only=False)
    except (pa.ArrowException, OSError) as failure:
        raise SonarError(f"{shown(name)}: {reason(failure)}; needed is a scan log as a whole Parquet file") from None


def _parquet_survey(file: Any, name: str) -> LogSurvey:
    """What the readings of a Parquet log are, from one pass through the file."""
    import pyarrow as pa

    survey = LogSurvey()
    fields = {field.name for field in file.schema_arrow.field("echoes").type.value_type}
    try:
        for batch in file.iter_batches(batch_size=ROWS_PER_READ // 8, columns=["scan", "stamp", "echoes"]):
            survey.add_batch(pa, batch, fields)
    except (pa.ArrowException, OSError) as failure:
        raise SonarError(f"{shown(name)}: {reason(failure)}; needed is a scan log as a whole Parquet file") from None
    return survey


def _csv_scans(filename: str | os.PathLike[str], name: str, survey: LogSurvey | None = None) -> Iterator[_ScanStarts]:
    """Starts of the scans of a CSV log, block by block; a survey gets all rows."""
    with _open(filename, name) as file:
        columns = csv_header(name, _header_line(file))
        add_rows = None if survey is None else partial(survey.add_rows, columns)
        for starts in _find_starts(name, iter(lambda: file.read(BLOCK), b""), file.tell(), add_rows):
            yield _ScanStarts(starts.number, starts.offset, starts.line + 2)


def _open(filename: str | os.PathLike[str], name: str) -> Any:
    """A CSV log, opened for reading."""
    try:
        return open(filename, "rb")
    except OSError as failure:
        raise SonarError(f"{shown(name)}: {reason(failure)}; needed is a readable file with a scan log (CSV)") from None


def _header_line(file: Any) -> bytes:
    """The first row of a file as an argument of ``csv_header``; at most one block, in case this is no text."""
    return file.readline(BLOCK).removeprefix(b"\xef\xbb\xbf").rstrip(b"\n").removesuffix(b"\r")


def _find_starts(
    name: str,
    blocks: Iterator[bytes],
    offset: int,
    add_rows: Callable[[bytes, Int[np.ndarray, " scans"]], None] | None = None,
) -> Iterator[_ScanStarts]:
    """Starts of scans in blocks of rows; ``offset`` is that of the first block, whose first line is 0.

    ``add_rows`` is called with complete rows and the bytes at which scans start in them.
    """
    rest, line, state = b"", 0, None
    for read in blocks:
        block = rest + read
        complete = block.rfind(b"\n") + 1
        if complete == 0 and len(block) > BLOCK:
            raise SonarError(f"{shown(name)}: row {line + 2}: more than 1 MB came; allowed are rows of numbers")
        rest = block[complete:]
        if complete:
            starts, lines, state = _starts_in_block(block[:complete], state)
            if add_rows is not None:
                add_rows(block[:complete], starts.offset)
            yield _ScanStarts(starts.number, starts.offset + offset, starts.line + line)
            offset, line = offset + complete, line + lines
    if rest:
        starts, _, _ = _starts_in_block(rest + b"\n", state)
        if add_rows is not None:
            add_rows(rest + b"\n", starts.offset)
        yield _ScanStarts(starts.number, starts.offset + offset, starts.line + line)


def _starts_in_block(block: bytes, previous: tuple[int, bool] | None) -> tuple[_ScanStarts, int, tuple[int, bool]]:
    """Starts of scans in complete rows, the number of rows, and the state for the next block.

    The state ``previous`` is the scan number of the previous row, and whether that number was readable.
    """
    buffer = np.frombuffer(block, dtype=np.uint8)
    end = np.flatnonzero(buffer == ord("\n"))
    start = np.concatenate([[0], end[:-1] + 1])
    comma = np.append(np.flatnonzero(buffer == ord(",")), len(block))
    stop = np.minimum(np.minimum(comma[np.searchsorted(comma, start)], end), start + MAX_NUMBER_LENGTH)
    text = fields_of(block, start, stop)
    changes = np.concatenate([[True], text[1:] != text[:-1]])
    number, known = _scan_numbers(text[changes])
    which = np.cumsum(changes) - 1
    number, known = number[which], known[which]
    above = np.concatenate([[number[0] if previous is None else previous[0]], number[:-1]])
    above_known = np.concatenate([[True if previous is None else previous[1]], known[:-1]])
    begins = known & above_known & (number != above)
    begins[0] |= previous is None
    rows = np.flatnonzero(begins)
    return _ScanStarts(number[rows], start[rows], rows), len(start), (int(number[-1]), bool(known[-1]))


def _scan_numbers(text: np.ndarray) -> tuple[Int[np.ndarray, " texts"], Bool[np.ndarray, " texts"]]:
    """Scan numbers, and which fields are valid ones."""
    try:
        return integers_of(text), np.ones(len(text), bool)
    except (ValueError, OverflowError):
        known = np.array([is_scan_number(one) for one in text.tolist()])
        number = np.full(len(text), NO_NUMBER)
        number[known] = [int(one) if one.lstrip(b"+-").isdigit() else int(float(one)) for one in text[known].tolist()]
        return number, known
