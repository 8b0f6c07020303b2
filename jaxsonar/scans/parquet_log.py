"""Scan logs as Parquet: one row a scan, its echoes a list. Needs the extra ``parquet``.

Row numbers in messages count scans from 1, echoes within a row from 0.
"""

import os
from collections.abc import Iterable, Iterator
from typing import Any, NoReturn

import numpy as np

from jaxsonar.fileio.atomic_files import atomic_write, read_bytes, reason, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.scan_log import ALLOWED, Log, LogFault

SCANS_AT_ONCE = 8192  # a row group; keeps 32-bit list offsets and memory far from their limits

SCAN_COLUMNS = ("scan", "stamp", "x", "y", "theta", "echoes")
ECHO_COLUMNS = ("tx", "rx", "range", "amplitude")
WHOLE = ("scan", "tx", "rx")
MAY_BE_ABSENT = ("stamp", "x", "y", "theta", "amplitude")


def read_parquet(path: str | os.PathLike[str]) -> Log:
    """A scan log from Parquet.

    Columns may stand in any order and be of any integer or floating type; null and NaN both mean that there is no such
    value. ``amplitude`` may be left out.

    Args:
        path: the file.

    Raises:
        SonarError: the file cannot be read or is no scan log; one line with file, row, column and what is allowed; or
            the extra is missing.
    """
    pa, pq = _pyarrow(path)
    data = read_bytes(path, what="a scan log (Parquet)")
    try:
        file = pq.ParquetFile(pa.BufferReader(data))
        _check_schema(path, pa, file.schema_arrow)
        parts, row = [], 0
        for batch in file.iter_batches(batch_size=SCANS_AT_ONCE):
            parts.append(_batch(path, pa, batch, row))
            row += len(batch)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as failure:  # the last from column names
        raise SonarError(f"{shown(path)}: {reason(failure)}; needed is a scan log as a whole Parquet file") from None
    return _log(path, parts)


def read_batch(path: str | os.PathLike[str], batch: Any, row: int) -> Log:
    """As ``read_parquet``, from a record batch of a file whose schema was checked (``open_parquet``).

    Args:
        path: for messages.
        batch: rows of the file.
        row: row of the file that the first of them is, from 0.
    """
    pa, _ = _pyarrow(path)
    return _log(path, [_batch(path, pa, batch, row)], row)


def open_parquet(path: str | os.PathLike[str], *, name: str | None = None) -> Any:
    """A ``pyarrow.parquet.ParquetFile`` of a scan log, for those who read it in parts.

    Args:
        path: the file.
        name: what messages call it; the path if left out.

    Raises:
        SonarError: as ``read_parquet``.
    """
    name = os.fspath(path) if name is None else name
    pa, pq = _pyarrow(name)
    try:
        file = pq.ParquetFile(path)
        _check_schema(name, pa, file.schema_arrow)
    except (pa.ArrowException, OSError, UnicodeDecodeError) as failure:
        raise SonarError(f"{shown(name)}: {reason(failure)}; needed is a scan log as a whole Parquet file") from None
    return file


def _log(path: str | os.PathLike[str], parts: list[dict[str, np.ndarray]], row: int = 0) -> Log:
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
        )
    except LogFault as fault:
        name = fault.column if fault.echo is None else f"echoes[{fault.echo - start[fault.scan]}].{fault.column}"
        name = "x, y, theta" if name == "pose" else name
        _fail(path, row + fault.scan, name, str(fault.value), ALLOWED[fault.column])


def write_parquet(log: Log, path: str | os.PathLike[str]) -> None:
    """Write a scan log as Parquet.

    Args:
        log: the scans.
        path: the file, replaced only once all is written.

    Raises:
        SonarError: the place cannot be written, or the extra is missing.
    """
    write_parquet_parts([log], path)


def write_parquet_parts(parts: Iterable[Log], path: str | os.PathLike[str]) -> None:
    """As ``write_parquet``, from logs that follow each other, each written before the next one is asked for."""
    pa, pq = _pyarrow(path)
    number = pa.float64()
    echo = pa.struct(
        [
            pa.field("tx", pa.int32(), nullable=False),
            pa.field("rx", pa.int32(), nullable=False),
            pa.field("range", number, nullable=False),
            pa.field("amplitude", number),
        ]
    )
    echoes = pa.list_(pa.field("element", echo, nullable=False))
    schema = pa.schema(
        [
            pa.field("scan", pa.int64(), nullable=False),
            *(pa.field(name, number) for name in ("stamp", "x", "y", "theta")),
            pa.field("echoes", echoes, nullable=False),
        ]
    )
    with atomic_write(path, binary=True) as file, pq.ParquetWriter(file, schema) as writer:
        for part in _blocks(parts):
            values = pa.StructArray.from_arrays(
                [
                    pa.array(part.tx.astype(np.int32)),
                    pa.array(part.rx.astype(np.int32)),
                    pa.array(part.range),
                    pa.array(part.amplitude, from_pandas=True),  # NaN becomes null
                ],
                fields=list(echo),
            )
            columns = [
                pa.array(part.scan),
                *(pa.array(column, from_pandas=True) for column in (part.stamp, *part.pose.T)),
                pa.ListArray.from_arrays(pa.array(part.start.astype(np.int32)), values, type=echoes),
            ]
            writer.write_batch(pa.RecordBatch.from_arrays(columns, schema=schema))


def _blocks(parts: Iterable[Log]) -> Iterator[Log]:
    for log in parts:
        for begin in range(0, len(log), SCANS_AT_ONCE):
            yield log[begin : begin + SCANS_AT_ONCE]


def _pyarrow(path: str | os.PathLike[str]) -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        extra = "pip install 'jaxsonar[parquet]'"
        raise SonarError(f"{shown(path)}: Parquet needs the parquet extra: {extra}") from None
    return pyarrow, pyarrow.parquet


def _fail(path: str | os.PathLike[str], row: int, column: str, came: str, allowed: str) -> NoReturn:
    raise SonarError(f"{shown(path)}: row {row + 1}, column {column}: {shown(came, 80)} came; allowed is {allowed}")


def _check_schema(path: str | os.PathLike[str], pa: Any, schema: Any) -> None:
    _check_names(path, schema.names, SCAN_COLUMNS, "")
    for name in SCAN_COLUMNS[:-1]:
        _check_type(path, pa, name, name, schema.field(name).type)
    echoes = schema.field("echoes").type
    if not ((pa.types.is_list(echoes) or pa.types.is_large_list(echoes)) and pa.types.is_struct(echoes.value_type)):
        wanted = f"a list of struct<{', '.join(ECHO_COLUMNS)}>"
        raise SonarError(f"{shown(path)}: column echoes: type {shown(str(echoes), 80)} came; allowed is {wanted}")
    fields = {field.name: field.type for field in echoes.value_type}
    names = [field.name for field in echoes.value_type]
    _check_names(path, names if "amplitude" in names else [*names, "amplitude"], ECHO_COLUMNS, "echoes.")
    for name, kind in fields.items():
        _check_type(path, pa, name, f"echoes.{name}", kind)


def _check_names(path: str | os.PathLike[str], names: list[str], wanted: tuple[str, ...], prefix: str) -> None:
    for name in wanted:
        if names.count(name) != 1:
            what = "came twice" if name in names else "is missing"
            raise SonarError(f"{shown(path)}: column {prefix}{name} {what}; allowed are {', '.join(wanted)}, each once")
    for name in names:
        if name not in wanted:
            raise SonarError(
                f"{shown(path)}: unknown column {prefix}{shown(name, 40)}; allowed are {', '.join(wanted)}"
            )


def _check_type(path: str | os.PathLike[str], pa: Any, name: str, shown_name: str, kind: Any) -> None:
    if pa.types.is_integer(kind) or (name in MAY_BE_ABSENT and pa.types.is_null(kind)):
        return
    if name in WHOLE or not pa.types.is_floating(kind):
        wanted = "an integer type" if name in WHOLE else "a floating or integer type"
        raise SonarError(f"{shown(path)}: column {shown_name}: type {shown(str(kind), 80)} came; allowed is {wanted}")


def _batch(path: str | os.PathLike[str], pa: Any, batch: Any, row: int) -> dict[str, np.ndarray]:
    """Some scans as arrays: the scan columns, the number of echoes of each scan, the echo columns."""
    lists = batch.column("echoes")
    missing = _nulls(lists)
    if missing.any():
        _fail(path, row + int(np.argmax(missing)), "echoes", "null", "a list, empty where nothing was heard")
    column = {"echoes": np.asarray(lists.value_lengths().cast(pa.int64()))}
    for name in SCAN_COLUMNS[:-1]:
        values = batch.column(name)
        missing = _nulls(values) if name == "scan" else np.zeros(0, bool)
        if missing.any():
            _fail(path, row + int(np.argmax(missing)), name, "null", ALLOWED[name])
        column[name] = _array(pa, name, values)

    structs = lists.flatten()
    place = np.repeat(np.arange(len(batch)), column["echoes"])
    first = np.cumsum(column["echoes"]) - column["echoes"]
    fields = dict(zip((field.name for field in structs.type), structs.flatten(), strict=True))
    column["amplitude"] = np.full(len(structs), np.nan)
    for name, values in fields.items():
        missing = _nulls(values) if name not in MAY_BE_ABSENT else _nulls(structs)
        if missing.any():
            echo = int(np.argmax(missing))
            i = int(place[echo])
            _fail(path, row + i, f"echoes[{echo - first[i]}].{name}", "null", ALLOWED[name])
        column[name] = _array(pa, name, values)
    return column


def _nulls(values: Any) -> np.ndarray:
    return values.is_null().to_numpy(zero_copy_only=False)


def _array(pa: Any, name: str, values: Any) -> np.ndarray:
    kind = pa.int64() if name in WHOLE else pa.float64()
    return values.cast(kind).to_numpy(zero_copy_only=False)
