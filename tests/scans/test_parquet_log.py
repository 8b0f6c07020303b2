"""Scan logs as Parquet: columns, files of other programs, and errors that name file, row and column."""

import io
import math
import sys

import numpy as np
import pytest
from support.logs import SMALL, log_of, read, refused

from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.log_file import load_scan_log, save_log

STRUCT = {"tx": 4, "rx": 5, "range": 1.5, "amplitude": 2.5}
SILENT = {"tx": 4, "rx": 5, "range": None, "amplitude": None, "age": None, "t": None}
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


def test_silent_paths_have_a_null_range_and_optional_fields_are_written_only_if_needed(pa, tmp_path):
    scan = [(0, 1, 1.5, 10.0, 0.25, 0.0), (2, 3, math.nan, math.nan, 0.0, 3.5)]
    log = log_of([(7, 0.5, (1.25, -2.5, 0.75), scan)])
    save_log(log, tmp_path / "log.parquet")
    table = pa.parquet.read_table(tmp_path / "log.parquet")
    struct = "struct<tx: int32 not null, rx: int32 not null, range: double, amplitude: double, age: double, t: double>"
    assert str(table.schema.field("echoes").type) == f"list<element: {struct} not null>"
    assert table["echoes"].to_pylist() == [
        [
            {"tx": 0, "rx": 1, "range": 1.5, "amplitude": 10.0, "age": 0.0, "t": 0.25},
            {"tx": 2, "rx": 3, "range": None, "amplitude": None, "age": 3.5, "t": 0.0},
        ]
    ]
    assert load_scan_log(tmp_path / "log.parquet") == log
    save_log(log_of([(7, 0.5, (1.25, -2.5, 0.75), [one[:4] for one in scan])]), tmp_path / "log.parquet")
    fields = pa.parquet.read_table(tmp_path / "log.parquet").schema.field("echoes").type.value_type
    assert [field.name for field in fields] == ["tx", "rx", "range", "amplitude"]


def test_missing_ages_and_times_are_zero(pa):
    log = read(parquet([{**ROW, "echoes": [SILENT, {**STRUCT, "tx": 1, "t": math.nan, "age": 2.0}]}]), "log.parquet")
    assert np.isnan(log.range).tolist() == [True, False]
    assert (log.t.tolist(), log.age.tolist()) == ([0.0, 0.0], [0.0, 2.0])


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
            "column echoes: type int64 came; allowed is a list of struct<tx, rx, range, amplitude, age, t>",
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
        ([{**ROW, "echoes": [{**STRUCT, "range": math.inf}]}], "row 1, column echoes[0].range: inf came"),
        ([{**ROW, "echoes": [{**SILENT, "amplitude": 2.5}]}], "row 1, column echoes[0].amplitude: 2.5 came"),
        (
            [{**ROW, "echoes": [STRUCT, {**STRUCT, "t": -1.0}]}],
            "row 1, column echoes[1].t: -1.0 came; allowed is seconds",
        ),
        ([{**ROW, "echoes": [{**STRUCT, "age": math.inf}]}], "row 1, column echoes[0].age: inf came"),
        ([{**ROW, "echoes": [{**STRUCT, "age": "old"}]}], "column echoes.age: type string came"),
        ([{**ROW, "echoes": [STRUCT, SILENT]}], "row 1, column echoes[1].rx: 5 came; allowed is a path with one row"),
        ([{**ROW, "echoes": [{**STRUCT, "tx": -1}]}], "row 1, column echoes[0].tx: -1 came; allowed is a sensor index"),
        ([{**ROW, "echoes": [{**STRUCT, "rx": 2**31}]}], "row 1, column echoes[0].rx: 2147483648 came"),
    ],
)
def test_invalid_parquet_values_are_named(pa, rows, message):
    assert message in refused(parquet(rows), "log.parquet")


def test_invalid_parquet_files_raise_an_error(pa, tmp_path):
    save_log(SMALL, tmp_path / "small.parquet")
    whole = (tmp_path / "small.parquet").read_bytes()
    for garbage in (b"PAR1", whole[:-1], whole[: len(whole) // 2], whole.replace(b"theta", b"th\xffta")):
        assert "needed is a scan log as a whole Parquet file" in refused(garbage, "log.parquet")


def test_a_missing_parquet_extra_is_explained(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    file = tmp_path / "log.parquet"
    file.write_bytes(b"PAR1")
    for call in (lambda: load_scan_log(file), lambda: save_log(SMALL, file)):
        with pytest.raises(SonarError) as caught:
            call()
        expected = "Parquet needs the parquet extra: pip install 'jaxsonar[parquet]'"
        assert str(caught.value) == f"{file}: {expected}"
    assert file.read_bytes() == b"PAR1"
