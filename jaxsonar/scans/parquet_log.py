"""Scan logs as Parquet: one row per scan, with a list of readings. Needs the extra ``parquet``.

The list is the column ``echoes``. A null range is a path that fired and heard nothing. Error messages count rows
(scans) from 1 and readings within a row from 0.
"""

import os
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Int

from jaxsonar.fileio.atomic_files import atomic_write, read_bytes, reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.no_echo_values import no_echo_hint, with_valid_ranges
from jaxsonar.scans.scan_log import ALLOWED, InvalidLogValue, Log

SCANS_PER_GROUP = 8192
"""Scans of a row group; keeps memory and the 32-bit list offsets far below their limits."""

SCAN_COLUMNS = ("scan", "stamp", "x", "y", "theta", "echoes")
ECHO_COLUMNS = ("tx", "rx", "range", "amplitude", "age", "t")
OPTIONAL_COLUMNS = ("amplitude", "age", "t")
"""Fields of a reading that a file may omit."""
INTEGER_COLUMNS = ("scan", "tx", "rx")
OPTIONAL_VALUES = ("stamp", "x", "y", "theta", "range", "amplitude", "age", "t")
"""Values that may be null."""


def read_parquet(filename: str | os.PathLike[str], *, no_echo: Sequence[float] = ()) -> Log:
    """Read a scan log from Parquet.

    Columns may have any order and any integer or floating type. Null and NaN both mean a missing value. The fields
    ``amplitude``, ``age`` and ``t`` are optional; a missing ``age`` or ``t`` is 0.

    Args:
        filename: the file.
        no_echo: as in ``load_scan_log``.

    Raises:
        SonarError: the file cannot be read or is no scan log, or the extra is missing; the message names file, row,
            column and allowed values.
    """
    pa, pq = _pyarrow(filename)
    data = read_bytes(filename, what="a scan log (Parquet)")
    try:
        file = pq.ParquetFile(pa.BufferReader(data))
        _check_schema(filename, pa, file.schema_arrow)
        parts, row = [], 0
        for batch in file.iter_batches(batch_size=SCANS_PER_GROUP):
            parts.append(_batch(filename, pa, batch, row))
            row += len(batch)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as failure:  # the last from column names
        raise SonarError(
            f"{shown(filename)}: {reason(failure)}; needed is a scan log as a whole Parquet file"
        ) from None
    for part in parts:
        part["range"] = with_valid_ranges(part["range"], no_echo)
    return _log(filename, parts)


def read_batch(
    filename: str | os.PathLike[str], batch: Any, row: int, *, asked: Int[np.ndarray, "pairs 2"] | None = None
) -> Log:
    """As ``read_parquet``, from a record batch of a file with a valid schema (``open_parquet``).

    Args:
        filename: the file, for error messages.
        batch: rows of the file.
        row: index of the first of them in the file, from 0.
        asked: ``Log.asked`` of the whole file; derived from these rows if omitted.
    """
    pa, _ = _pyarrow(filename)
    return _log(filename, [_batch(filename, pa, batch, row)], row, asked)


def open_parquet(filename: str | os.PathLike[str], *, name: str | None = None) -> Any:
    """A ``pyarrow.parquet.ParquetFile`` of a scan log with a valid schema, for reading in parts.

    Args:
        filename: the file.
        name: name of the file in error messages; the filename if omitted.

    Raises:
        SonarError: as ``read_parquet``.
    """
    name = os.fspath(filename) if name is None else name
    pa, pq = _pyarrow(name)
    try:
        file = pq.ParquetFile(filename)
        _check_schema(name, pa, file.schema_arrow)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as failure:
        raise SonarError(f"{shown(name)}: {reason(failure)}; needed is a scan log as a whole Parquet file") from None
    return file


def _log(
    filename: str | os.PathLike[str],
    parts: list[dict[str, np.ndarray]],
    row: int = 0,
    asked: Int[np.ndarray, "pairs 2"] | None = None,
) -> Log:
    """The log of some record batches; ``row`` is the index of the first scan in the file."""
    none = {"scan": np.zeros(0, np.int64), "tx": np.zeros(0, np.int64), "rx": np.zeros(0, np.int64)}
    column = {
        name: np.concatenate([none.get(name, np.zeros(0)), *(part[name] for part in parts)])
        for name in (*SCAN_COLUMNS[:-1], *ECHO_COLUMNS)
    }
    lengths = np.concatenate([np.zeros(1, np.int64), *(part["echoes"] for part in parts)])
    start = np.cumsum(lengths)
    try:
        return Log(
            scan=column["scan"],
            stamp=column["stamp"],
            pose=np.stack([column["x"], column["y"], column["theta"]], axis=-1),
            start=start,
            **{name: column[name] for name in ECHO_COLUMNS},
            **({} if asked is None else {"asked": asked}),
        )
    except InvalidLogValue as fault:
        name = fault.column if fault.echo is None else f"echoes[{fault.echo - start[fault.scan]}].{fault.column}"
        name = "x, y, theta" if name == "pose" else name
        _fail(filename, row + fault.scan, name, str(fault.value), fault.allowed + no_echo_hint(fault))


def write_parquet(log: Log, filename: str | os.PathLike[str]) -> None:
    """Write a scan log as Parquet.

    Args:
        log: the scans.
        filename: the file; an existing one is replaced only after the new one is complete.

    Raises:
        SonarError: the file cannot be written, or the extra is missing.
    """
    needed = {"range": bool(np.isnan(log.range).any()), "age": bool(log.age.any()), "t": bool(log.t.any())}
    _write_parts([log], filename, needed)


def write_parquet_chunks(parts: Iterable[Log], filename: str | os.PathLike[str]) -> None:
    """As ``write_parquet``, from consecutive parts of a log, each written before the next one is requested.

    The file has all optional fields, because later parts may need them.
    """
    _write_parts(parts, filename, {"range": True, "age": True, "t": True})


def _write_parts(parts: Iterable[Log], filename: str | os.PathLike[str], needed: dict[str, bool]) -> None:
    """Write parts of a log; ``needed`` states whether a range may be null, and whether there are ages and times."""
    pa, pq = _pyarrow(filename)
    number = pa.float64()
    fields = [
        pa.field("tx", pa.int32(), nullable=False),
        pa.field("rx", pa.int32(), nullable=False),
        pa.field("range", number, nullable=needed["range"]),
        pa.field("amplitude", number),
        *(pa.field(name, number) for name in ("age", "t") if needed[name]),
    ]
    echoes = pa.list_(pa.field("element", pa.struct(fields), nullable=False))
    schema = pa.schema(
        [
            pa.field("scan", pa.int64(), nullable=False),
            *(pa.field(name, number) for name in ("stamp", "x", "y", "theta")),
            pa.field("echoes", echoes, nullable=False),
        ]
    )
    with atomic_write(filename, binary=True) as file, pq.ParquetWriter(file, schema) as writer:
        for part in _row_groups(parts):
            readings = {"tx": part.tx.astype(np.int32), "rx": part.rx.astype(np.int32), "range": part.range}
            readings |= {"amplitude": part.amplitude, "age": part.age, "t": part.t}
            values = pa.StructArray.from_arrays(
                [pa.array(readings[field.name], from_pandas=True) for field in fields],  # NaN becomes null
                fields=fields,
            )
            columns = [
                pa.array(part.scan),
                *(pa.array(column, from_pandas=True) for column in (part.stamp, *part.pose.T)),
                pa.ListArray.from_arrays(pa.array(part.start.astype(np.int32)), values, type=echoes),
            ]
            writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema))


def _row_groups(parts: Iterable[Log]) -> Iterator[Log]:
    """Parts of a log, cut into row groups."""
    for log in parts:
        for begin in range(0, len(log), SCANS_PER_GROUP):
            yield log[begin : begin + SCANS_PER_GROUP]


def _pyarrow(filename: str | os.PathLike[str]) -> tuple[Any, Any]:
    """The modules pyarrow and pyarrow.parquet; a SonarError if the extra is missing."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        extra = "pip install 'jaxsonar[parquet]'"
        raise SonarError(f"{shown(filename)}: Parquet needs the parquet extra: {extra}") from None
    return pyarrow, pyarrow.parquet


def _fail(filename: str | os.PathLike[str], row: int, column: str, came: str, allowed: str) -> NoReturn:
    raise SonarError(f"{shown(filename)}: row {row + 1}, column {column}: {shown(came, 80)} came; allowed is {allowed}")


def _check_schema(filename: str | os.PathLike[str], pa: Any, schema: Any) -> None:
    """Raise a SonarError for a schema that is not that of a scan log."""
    _check_names(filename, schema.names, SCAN_COLUMNS, "")
    for name in SCAN_COLUMNS[:-1]:
        _check_type(filename, pa, name, name, schema.field(name).type)
    echoes = schema.field("echoes").type
    if not ((pa.types.is_list(echoes) or pa.types.is_large_list(echoes)) and pa.types.is_struct(echoes.value_type)):
        wanted = f"a list of struct<{', '.join(ECHO_COLUMNS)}>"
        raise SonarError(f"{shown(filename)}: column echoes: type {shown(str(echoes), 80)} came; allowed is {wanted}")
    fields = {field.name: field.type for field in echoes.value_type}
    names = [field.name for field in echoes.value_type]
    omitted = [name for name in OPTIONAL_COLUMNS if name not in names]
    _check_names(filename, [*names, *omitted], ECHO_COLUMNS, "echoes.")
    for name, kind in fields.items():
        _check_type(filename, pa, name, f"echoes.{name}", kind)


def _check_names(filename: str | os.PathLike[str], names: list[str], wanted: tuple[str, ...], prefix: str) -> None:
    for name in wanted:
        if names.count(name) != 1:
            what = "came twice" if name in names else "is missing"
            raise SonarError(
                f"{shown(filename)}: column {prefix}{name} {what}; allowed are {', '.join(wanted)}, each once"
            )
    for name in names:
        if name not in wanted:
            raise SonarError(
                f"{shown(filename)}: unknown column {prefix}{shown(name, 40)}; allowed are {', '.join(wanted)}"
            )


def _check_type(filename: str | os.PathLike[str], pa: Any, name: str, shown_name: str, kind: Any) -> None:
    if pa.types.is_integer(kind) or (name in OPTIONAL_VALUES and pa.types.is_null(kind)):
        return
    if name in INTEGER_COLUMNS or not pa.types.is_floating(kind):
        wanted = "an integer type" if name in INTEGER_COLUMNS else "a floating or integer type"
        raise SonarError(
            f"{shown(filename)}: column {shown_name}: type {shown(str(kind), 80)} came; allowed is {wanted}"
        )


def _batch(filename: str | os.PathLike[str], pa: Any, batch: Any, row: int) -> dict[str, np.ndarray]:
    """Arrays of a record batch: the scan columns, the number of echoes of each scan, the echo columns."""
    lists = batch.column("echoes")
    missing = _nulls(lists)
    if missing.any():
        _fail(filename, row + int(np.argmax(missing)), "echoes", "null", "a list, empty where nothing was heard")
    column = {"echoes": np.asarray(lists.value_lengths().cast(pa.int64()))}
    for name in SCAN_COLUMNS[:-1]:
        values = batch.column(name)
        missing = _nulls(values) if name == "scan" else np.zeros(0, bool)
        if missing.any():
            _fail(filename, row + int(np.argmax(missing)), name, "null", ALLOWED[name])
        column[name] = _array(pa, name, values)

    structs = lists.flatten()
    place = np.repeat(np.arange(len(batch)), column["echoes"])
    first = np.cumsum(column["echoes"]) - column["echoes"]
    fields = dict(zip((field.name for field in structs.type), structs.flatten(), strict=True))
    column |= {"amplitude": np.full(len(structs), np.nan), "age": np.zeros(len(structs)), "t": np.zeros(len(structs))}
    for name, values in fields.items():
        missing = _nulls(values) if name not in OPTIONAL_VALUES else _nulls(structs)
        if missing.any():
            echo = int(np.argmax(missing))
            i = int(place[echo])
            _fail(filename, row + i, f"echoes[{echo - first[i]}].{name}", "null", ALLOWED[name])
        column[name] = _array(pa, name, values)
    for name in ("age", "t"):
        column[name] = np.where(np.isnan(column[name]), 0.0, column[name])
    return column


def _nulls(values: Any) -> np.ndarray:
    return values.is_null().to_numpy(zero_copy_only=False)


def _array(pa: Any, name: str, values: Any) -> np.ndarray:
    kind = pa.int64() if name in INTEGER_COLUMNS else pa.float64()
    return values.cast(kind).to_numpy(zero_copy_only=False)
