"""Scan logs as Parquet: columns, files of other programs, and errors that name file, row and column."""

import io
import math
import sys

import numpy as np
import pytest
from support.logs import SMALL, SMALL_CSV, read, refused

from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.log_file import load_log, save_log

STRUCT = {"tx": 4, "rx": 5, "range": 1.5, "amplitude": 2.5}
ROW = {"scan": 1, "stamp": 0.5, "x": 1.0, "y": 2.0, "theta": 3.0, "echoes": [STRUCT]}


def parquet(rows, **types):
    pa = pytest.importorskip("pyarrow")
    table = pa.Table.from_pylist(rows)
    for name, kind in types.items():
        table = table.set_column(table.schema.get_field_index(name), name, table[name].cast(kind))
    sink = io.BytesIO()
    pa.parquet.write_table(table, sink)
    return sink.getvalue()


@pytest.fixture
def pa():
    pytest.importorskip("pyarrow.parquet")
    import pyarrow

    return pyarrow


def test_parquet_columns_are_the_documented_ones(pa, tmp_path):
    save_log(SMALL, tmp_path / "small.parquet")
    table = pa.parquet.read_table(tmp_path / "small.parquet")
    kinds = {field.name: str(field.type) for field in table.schema}
    struct = "struct<tx: int32 not null, rx: int32 not null, range: double not null, amplitude: double>"
    assert kinds.pop("echoes") == f"list<element: {struct} not null>"
    assert kinds == {"scan": "int64", "stamp": "double", "x": "double", "y": "double", "theta": "double"}
    none = dict.fromkeys(("stamp", "x", "y", "theta"))
    assert table.to_pylist() == [
        {
            **{"scan": 7, "stamp": 0.5, "x": 1.25, "y": -2.5, "theta": 0.75},
            "echoes": [
                {"tx": 0, "rx": 1, "range": 1.5, "amplitude": 10.0},
                {"tx": 2, "rx": 3, "range": 0.1, "amplitude": None},
            ],
        },
        {"scan": 3, **none, "echoes": []},
        {
            **{"scan": 9, "stamp": 2.0, "x": 3.5, "y": 4.5, "theta": -3.0},
            "echoes": [{"tx": 4, "rx": 5, "range": 2.25, "amplitude": 20.0}],
        },
    ]


def test_parquet_files_of_other_programs(pa):
    nothing = dict.fromkeys(("stamp", "x", "y", "theta"))
    struct = {"range": 1.5, "rx": 5, "tx": 4}
    log = read(parquet([{"echoes": [struct, struct], **nothing, "scan": 3}], scan=pa.uint8()), "log.parquet")
    assert log.scan.tolist() == [3]
    assert np.isnan(log.pose).all()
    assert np.isnan(log.amplitude).all()
    assert (log.tx.tolist(), log.rx.tolist(), log.range.tolist()) == ([4, 4], [5, 5], [1.5, 1.5])


def without(mapping, key):
    return {k: v for k, v in mapping.items() if k != key}


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([without(ROW, "theta")], "column theta is missing; allowed are scan, stamp, x, y, theta, echoes"),
        ([{**ROW, "w": 1}], "unknown column w; allowed are scan, stamp"),
        ([{**ROW, "scan": 1.5}], "column scan: type double came; allowed is an integer type"),
        ([{**ROW, "stamp": "now"}], "column stamp: type string came; allowed is a floating or integer type"),
        (
            [{**ROW, "echoes": 3}],
            "column echoes: type int64 came; allowed is a list of struct<tx, rx, range, amplitude>",
        ),
        ([{**ROW, "echoes": [without(STRUCT, "rx")]}], "column echoes.rx is missing; allowed are tx, rx, range"),
        ([{**ROW, "echoes": [{**STRUCT, "w": 1}]}], "unknown column echoes.w; allowed are tx, rx, range"),
        ([{**ROW, "echoes": [{**STRUCT, "tx": 1.5}]}], "column echoes.tx: type double came; allowed is an integer"),
        ([ROW, {**ROW, "scan": None}], "row 2, column scan: null came; allowed is a whole number"),
        ([ROW, ROW], "row 2, column scan: 1 came; allowed is a whole number that no earlier scan has"),
        ([{**ROW, "echoes": None}, {**ROW, "scan": 2}], "row 1, column echoes: null came; allowed is a list, empty"),
        ([{**ROW, "echoes": [STRUCT, None]}], "row 1, column echoes[1].tx: null came"),
        ([{**ROW, "x": None}], "row 1, column x, y, theta: [nan, 2.0, 3.0] came; allowed is finite x, y (m)"),
        ([{**ROW, "stamp": math.inf}], "row 1, column stamp: inf came"),
        (
            [{**ROW, "scan": 0}, {**ROW, "echoes": [STRUCT, {**STRUCT, "range": -1.0}]}],
            "row 2, column echoes[1].range: -1.0 came; allowed is a finite number of metres above 0",
        ),
        ([{**ROW, "echoes": [{**STRUCT, "range": None}, STRUCT]}], "row 1, column echoes[0].range: null came"),
        ([{**ROW, "echoes": [{**STRUCT, "range": math.nan}]}], "row 1, column echoes[0].range: nan came"),
        ([{**ROW, "echoes": [{**STRUCT, "tx": -1}]}], "row 1, column echoes[0].tx: -1 came; allowed is a sensor index"),
        ([{**ROW, "echoes": [{**STRUCT, "rx": 2**31}]}], "row 1, column echoes[0].rx: 2147483648 came"),
    ],
)
def test_invalid_parquet_values_are_named(pa, rows, message):
    assert message in refused(parquet(rows), "log.parquet")


def test_invalid_parquet_files_raise_an_error(pa, tmp_path):
    save_log(SMALL, tmp_path / "small.parquet")
    whole = (tmp_path / "small.parquet").read_bytes()
    for garbage in (
        b"",
        b"PAR1",
        SMALL_CSV.encode(),
        whole[:-1],
        whole[: len(whole) // 2],
        whole.replace(b"theta", b"th\xffta"),
    ):
        assert "needed is a scan log as a whole Parquet file" in refused(garbage, "log.parquet")


def test_a_missing_parquet_extra_is_explained(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    file = tmp_path / "log.parquet"
    for call in (lambda: load_log(file), lambda: save_log(SMALL, file)):
        with pytest.raises(SonarError) as caught:
            call()
        expected = "Parquet needs the parquet extra: pip install 'jaxsonar[parquet]'"
        assert str(caught.value) == f"{file}: {expected}"
    assert not list(tmp_path.iterdir())
