"""Scan logs as CSV and in memory: lossless round trips, and errors that name file, row and column."""

import csv
import itertools
import math
import subprocess
import sys
import tempfile
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.logs import HEADER, SMALL, SMALL_CSV, any_scans, log_of, read, refused

from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans import csv_log as logs_csv
from jaxsonar.scans.asked_pairs import AskedPairs
from jaxsonar.scans.log_file import load_scan_log, save_log
from jaxsonar.scans.readings import is_repeated, unique_readings
from jaxsonar.scans.scan_log import Log


def test_every_column_is_read_into_its_own_field(small_csv):
    assert small_csv.read_text() == SMALL_CSV
    assert load_scan_log(small_csv) == SMALL


def test_one_scan():
    scan = SMALL[0]
    assert (scan.scan, scan.stamp) == (7, 0.5)
    np.testing.assert_array_equal(scan.pose, [1.25, -2.5, 0.75])
    np.testing.assert_array_equal(scan.tx, [0, 2])
    np.testing.assert_array_equal(scan.rx, [1, 3])
    np.testing.assert_array_equal(scan.range, [1.5, 0.1])
    np.testing.assert_array_equal(scan.amplitude, [10.0, math.nan])


def test_scans_can_be_indexed_like_a_list():
    assert [scan.scan for scan in SMALL] == [7, 3, 9]
    assert SMALL[-1].scan == SMALL[2].scan == 9
    assert SMALL[np.int64(1)].scan == 3
    for i in (3, -4):
        with pytest.raises(IndexError, match="3 scans"):
            SMALL[i]


def rows_of(log, column):
    """The recorded readings of each scan."""
    return [getattr(log, column)[begin:end] for begin, end in itertools.pairwise(log.start.tolist())]


@given(any_scans)
def test_repetitions_are_found_in_stamps_and_ages_of_any_size(scans):
    log = log_of(scans)
    assert not is_repeated(log)[log.age == 0].any()
    once = np.isfinite(log.range) & ~is_repeated(log)
    assert unique_readings(log).echo_count == sum(scan.echo_count for scan in log) == once.sum()


@pytest.mark.slow
@given(any_scans, st.slices(5))
def test_a_slice_of_a_log_contains_the_scans_of_the_slice(scans, part):
    log = log_of(scans)
    cut = log[part]
    assert cut.scan.tolist() == log.scan[part].tolist()
    for name in ("range", "age", "t", "tx", "rx"):
        assert [row.tobytes() for row in rows_of(cut, name)] == [row.tobytes() for row in rows_of(log, name)[part]]
    assert np.array_equal(cut.asked, log.asked)  # what a scan measured does not depend on the part


@given(any_scans)
def test_echo_scan_is_the_scan_of_every_echo(scans):
    log = log_of(scans)
    expected = [i for i, count in enumerate(np.diff(log.start)) for _ in range(count)]
    assert log.echo_scan.tolist() == expected
    again = Log.from_echoes(
        log.echo_scan,
        log.tx,
        log.rx,
        log.range,
        amplitude=log.amplitude,
        t=log.t,
        age=log.age,
        stamp=log.stamp,
        pose=log.pose,
        scan=log.scan,
    )
    assert again == log


def test_logs_are_immutable():
    with pytest.raises(ValueError, match="read-only"):
        SMALL.range[0] = -1.0
    ranges = np.array([1.0])
    Log.from_echoes(np.array([0]), np.array([0]), np.array([0]), ranges, stamp=np.zeros(1), pose=np.zeros((1, 3)))
    ranges[0] = 2.0  # the caller's array stays writable


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"range": [1.0, -2.0]}, r"scans\[1\], echoes\[1\], range: -2.0 came; allowed is a finite number of metres"),
        ({"range": [math.inf, 2.0]}, r"scans\[0\], echoes\[0\], range: inf"),
        (
            {"range": [1.0, math.nan]},
            r"scans\[1\], echoes\[1\], amplitude: 2.0 came; .* nothing if the path heard nothing",
        ),
        ({"t": [0.0, -1.0]}, r"scans\[1\], echoes\[1\], t: -1.0 came; allowed is seconds, 0 or more"),
        ({"age": [math.nan, 0.0]}, r"scans\[0\], echoes\[0\], age: nan came"),
        ({"tx": [0, -1]}, r"scans\[1\], echoes\[1\], tx: -1 came"),
        ({"rx": [2**31, 0]}, r"scans\[0\], echoes\[0\], rx: 2147483648 came"),
        ({"amplitude": [1.0, math.inf]}, "amplitude: inf came"),
        ({"stamp": [0.0, math.inf]}, r"scans\[1\], stamp: inf came"),
        ({"pose": [[0.0, 0.0, 0.0], [1.0, math.nan, 2.0]]}, r"scans\[1\], pose: \[1.0, nan, 2.0\] came"),
        ({"scan": [4, 4]}, r"scans\[1\], scan: 4 came; allowed is a whole number that no earlier scan has"),
        ({"scan": [1.5, 2.5]}, "scan holds float64"),
        ({"tx": [0]}, r"scan_index has shape \(2,\); allowed is that of tx, \(1,\)"),
        ({"scan_index": [1, 0]}, "scan_index must not fall"),
        ({"scan_index": [0, 2]}, "within 0 to 1"),
    ],
)
def test_invalid_values_raise_an_error(change, message, monkeypatch):
    # Without the shape checks of the test run, which would fail first.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    columns = {
        "scan_index": [0, 1],
        "tx": [0, 1],
        "rx": [0, 1],
        "range": [1.0, 2.0],
        "amplitude": [1.0, 2.0],
        "stamp": [0.0, 1.0],
        "pose": [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]],
        "scan": [0, 1],
    }
    arrays = {name: np.array(value) for name, value in {**columns, **change}.items()}
    with pytest.raises(SonarError, match=message):
        Log.from_echoes(**arrays)


# ---- round trips


@settings(deadline=None)
@given(any_scans)
def test_csv_round_trip(scans):
    log = log_of(scans)
    with tempfile.TemporaryDirectory() as folder:
        save_log(log, f"{folder}/a.csv")
        again = load_scan_log(f"{folder}/a.csv")
        assert again == log
        assert again.range.tobytes() == log.range.tobytes()
        assert np.signbit(again.pose).tolist() == np.signbit(log.pose).tolist()  # -0.0 is not 0.0


@pytest.mark.slow
@settings(deadline=None)
@given(any_scans)
def test_csv_to_parquet_to_csv_gives_the_same_file(scans):
    log = log_of(scans)
    pytest.importorskip("pyarrow")
    with tempfile.TemporaryDirectory() as folder:
        save_log(log, f"{folder}/a.csv")
        save_log(load_scan_log(f"{folder}/a.csv"), f"{folder}/b.parquet")
        again = load_scan_log(f"{folder}/b.parquet")
        assert again == log
        save_log(again, f"{folder}/c.csv")
        assert Path(f"{folder}/c.csv").read_bytes() == Path(f"{folder}/a.csv").read_bytes()


@settings(deadline=None)
@given(any_scans.filter(len))
def test_csv_agrees_with_the_standard_library(scans):
    log = log_of(scans)
    with tempfile.TemporaryDirectory() as folder:
        save_log(log, f"{folder}/a.csv")
        with open(f"{folder}/a.csv", newline="") as file:
            rows = list(csv.DictReader(file))
    expected = []
    for k in range(len(log)):
        head = [str(log.scan[k]), *("" if math.isnan(v) else float(v) for v in (log.stamp[k], *log.pose[k]))]
        part = slice(log.start[k], log.start[k + 1])
        if part.start == part.stop:
            expected.append([*head, "", "", ""])
        for t, r, m in zip(log.tx[part].tolist(), log.rx[part].tolist(), log.range[part].tolist(), strict=True):
            expected.append([*head, str(t), str(r), "" if math.isnan(m) else m])
    floats = ("stamp", "x", "y", "theta", "range")
    found = [[float(row[c]) if c in floats and row[c] else row[c] for c in HEADER.split(",")] for row in rows]
    assert found == expected


@pytest.mark.slow
@settings(deadline=None)
@given(any_scans, st.integers(1, 300))
def test_parsing_does_not_depend_on_the_block_size(scans, block):
    log = log_of(scans)
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        save_log(log, f"{folder}/a.csv")
        patch.setattr(logs_csv, "BLOCK", block)
        patch.setattr(logs_csv, "SCANS_PER_WRITE", 2)
        save_log(log, f"{folder}/b.csv")
        assert load_scan_log(f"{folder}/b.csv") == log
        assert Path(f"{folder}/a.csv").read_bytes() == Path(f"{folder}/b.csv").read_bytes()


def test_a_log_without_scans():
    assert len(read(f"{HEADER}\n")) == 0
    assert len(read(HEADER)) == 0


@pytest.mark.parametrize(
    "dialect",
    [
        lambda text: b"\xef\xbb\xbf" + text,
        lambda text: text.replace(b"\n", b"\r\n"),
        lambda text: b"\xef\xbb\xbf" + text.replace(b"\n", b"\r\n"),
        lambda text: text.replace(b"7,0.5", b"7.0,5e-1"),  # as a spreadsheet may write it
        lambda text: text.replace(b"7,0.5", b"+07,.5", 1),  # the same numbers in another notation within a scan
    ],
)
def test_other_csv_dialects_of_the_same_log(dialect):
    assert read(dialect(SMALL_CSV.encode())) == SMALL


def test_upper_case_suffixes():
    assert read(SMALL_CSV, "LOG.CSV") == SMALL


# ---- errors

GOOD = "0,0.5,1,2,3,4,5,1.5"
BAD_ROWS = [
    ("0,0.5,1,2,3,4,5,-1.5", "range", "'-1.5'", "a finite number of metres above 0"),
    ("0,0.5,1,2,3,4,5,0", "range", "'0'", "above 0"),
    ("0,0.5,1,2,3,4,5,nan", "range", "'nan'", "above 0"),
    ("0,0.5,1,2,3,4,5,inf", "range", "'inf'", "above 0"),
    ("0,0.5,1,2,3,4,5,1e999", "range", "'1e999'", "above 0"),
    ("0,0.5,1,2,3,4,5,1_5", "range", "'1_5'", "above 0"),
    ("0,0.5,1,2,3,4,5, 1.5", "range", "' 1.5'", "above 0"),
    ('0,0.5,1,2,3,4,5,"1.5"', "range", "'\"1.5\"'", "above 0"),
    ("0,0.5,1,2,3,4,5,0x10", "range", "'0x10'", "above 0"),
    ("0,0.5,1,2,3,4,5,1\r5", "range", r"'1\r5'", "above 0"),
    ("0,0.5,1,2,3,4,5,1." + "3" * 70, "range", "'1.3333", "at most 64 characters"),
    ("0,0.5,1,2,3,,5,1.5", "tx", "nothing", "tx and rx with or without a range, or none of them"),
    ("0,0.5,1,2,3,4,,1.5", "rx", "nothing", "tx and rx with or without a range, or none of them"),
    ("0,0.5,1,2,3,,,1.5", "tx", "nothing", "tx and rx with or without a range, or none of them"),
    ("0,0.5,1,2,3,4,,", "rx", "nothing", "tx and rx with or without a range, or none of them"),
    ("0,0.5,1,2,3,-4,5,1.5", "tx", "'-4'", "a whole number from 0 to 2147483647"),
    ("0,0.5,1,2,3,4.5,5,1.5", "tx", "'4.5'", "a whole number from 0"),
    ("0,0.5,1,2,3,4,2147483648,1.5", "rx", "'2147483648'", "a whole number from 0"),
    ("0,0.5,1,2,3,4,1e300,1.5", "rx", "'1e300'", "a whole number from 0"),
    ("0,0.5,1,2,3,four,5,1.5", "tx", "'four'", "a whole number from 0"),
    ("0,half,1,2,3,4,5,1.5", "stamp", "'half'", "a finite number of seconds, or nothing"),
    ("0,NaN,1,2,3,4,5,1.5", "stamp", "'NaN'", "or nothing"),
    ("0,0.5,1-,2,3,4,5,1.5", "x", "'1-'", "x, y (m) and theta (rad), all three or none"),
    ("0,0.5,1,,3,4,5,1.5", "y", "nothing", "all three or none"),
    ("0,0.5,1,2,,4,5,1.5", "theta", "nothing", "all three or none"),
    (",0.5,1,2,3,4,5,1.5", "scan", "nothing", "a whole number"),
    ("0.5,0.5,1,2,3,4,5,1.5", "scan", "'0.5'", "a whole number"),
    ("9223372036854775808,0.5,1,2,3,4,5,1.5", "scan", "'9223372036854775808'", "a whole number of 64 bits"),
    ("1e18,0.5,1,2,3,4,5,1.5", "scan", "'1e18'", "a whole number of 64 bits"),
]


@pytest.mark.parametrize("before", [0, 3])
@pytest.mark.parametrize(("row", "column", "came", "allowed"), BAD_ROWS)
def test_an_invalid_value_is_named(row, column, came, allowed, before):
    earlier = "".join(f"{k},0.5,1,2,3,4,5,1.5\n" for k in range(100, 100 + before))
    message = refused(f"{HEADER}\n{earlier}{row}\n200,0.5,1,2,3,4,5,1.5\n")
    assert f": row {2 + before}, column {column}: {came}" in message
    assert "came; allowed is" in message
    assert allowed in message


@pytest.mark.parametrize(
    ("rows", "place", "allowed"),
    [
        (["0,,,,,1,1,1.5", "1,,,,,1,1,1.5", "0,,,,,2,2,1.5"], "row 4, column scan: '0'", "no earlier scan has"),
        (["0,1,,,,1,1,1.5", "0,2,,,,2,2,1.5"], "row 3, column stamp: '2'", "the same in every row of a scan"),
        (["0,1,,,,1,1,1.5", "0,,,,,2,2,1.5"], "row 3, column stamp: nothing", "the same in every row of a scan"),
        (["0,1,1,2,3,1,1,1.5", "0,1,1,2,4,2,2,1.5"], "row 3, column theta: '4'", "the same in every row of a scan"),
        (["0,1,1,2,3,1,1,1.5", "0,1,,,,2,2,1.5"], "row 3, column x: nothing", "the same in every row of a scan"),
        (["0,,,,,1,1,1.5", "0,,,,,,,"], "row 3, column tx: nothing", "the only one of its scan"),
        (["0,,,,,,,", "0,,,,,1,1,1.5"], "row 3, column tx: '1'", "the only one of its scan"),
        (["0,,,,,,,", "0,,,,,,,"], "row 3, column tx: nothing", "the only one of its scan"),
        (["0,,,,,1,1,1.5", "0,,,,,1,1"], "row 3: 7 columns", "allowed are 8, scan,stamp,x,y,theta,tx,rx,range"),
        (["0,,,,,1,1,1.5", "0,,,,,1,1,1.5,3"], "row 3: 9 columns", "allowed are 8"),
        (["0,,,,,1,1", "0,,,,,1,1,1.5,3"], "row 2: 7 columns", "allowed are 8"),  # the right total number
        (["0,,,,,1,1,1.5", "", "1,,,,,1,1,1.5"], "row 3: no columns", "allowed are 8"),
        (["0,,,,,1,1,1.5", "\0\1\2"], "row 3: this is no text", "allowed are 8 numbers"),
    ],
)
def test_inconsistent_rows_are_named(rows, place, allowed):
    message = refused("\n".join([HEADER, *rows, ""]))
    assert place in message
    assert allowed in message


READINGS = """scan,stamp,x,y,theta,tx,rx,range,t,age,amplitude
5,0.5,,,,4,5,1.5,0.25,,7
5,0.5,,,,4,5,1.75,0.25,,
5,0.5,,,,5,5,,,2.5,
6,0.75,,,,,,,,,
8,1.0,,,,1,2,2.5,0,0,8
"""


def test_silent_paths_ages_and_times_in_any_order_of_the_columns():
    """A row without a range is a path that heard nothing; an empty age or t is 0."""
    none = (math.nan,) * 3
    expected = log_of(
        [
            (
                5,
                0.5,
                none,
                [(4, 5, 1.5, 7.0, 0.25, 0.0), (4, 5, 1.75, math.nan, 0.25, 0.0), (5, 5, *none[:2], 0.0, 2.5)],
            ),
            (6, 0.75, none, []),
            (8, 1.0, none, [(1, 2, 2.5, 8.0, 0.0, 0.0)]),
        ]
    )
    log = read(READINGS)
    assert log == expected
    assert (log.echo_count, len(log.asked)) == (3, 0)  # explicit: only what has a reading was measured
    lines = [row.split(",") for row in READINGS.splitlines()]
    swapped = "\n".join(",".join([*row[:8], row[10], row[8], row[9]]) for row in lines)
    assert read(swapped) == expected
    with tempfile.TemporaryDirectory() as folder:
        save_log(log, f"{folder}/a.csv")
        assert Path(f"{folder}/a.csv").read_text().splitlines()[:4] == [
            f"{HEADER},amplitude,age,t",
            "5,0.5,,,,4,5,1.5,7.0,,0.25",
            "5,0.5,,,,4,5,1.75,,,0.25",
            "5,0.5,,,,5,5,,,2.5,",
        ]


@pytest.mark.parametrize(("change", "columns"), [({}, ""), ({"t": [0.5]}, ",t"), ({"age": [0.5]}, ",age")])
def test_optional_columns_are_written_only_if_needed(change, columns, tmp_path):
    log = Log.from_echoes(
        np.array([0]),
        np.array([1]),
        np.array([2]),
        np.array([1.5]),
        stamp=np.zeros(1),
        pose=np.zeros((1, 3)),
        **{name: np.array(value) for name, value in change.items()},
    )
    save_log(log, tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text().splitlines()[0] == HEADER + columns


@given(any_scans)
def test_the_measured_pairs_of_a_log_do_not_depend_on_how_it_is_added(scans):
    """One by one, the scans give the pairs of the whole log; the definition is the oracle."""
    log = log_of(scans)
    pairs = AskedPairs()
    for k in range(len(log)):
        part = slice(log.start[k], log.start[k + 1])
        pairs.add(log.echo_scan[part], log.tx[part], log.rx[part], np.isnan(log.range[part]))
    assert np.array_equal(pairs.pairs(), log.asked)
    heard = sorted(set(zip(log.tx.tolist(), log.rx.tolist(), strict=True)))
    assert not pairs.in_turn or all(len(set(scan.tx.tolist())) < 2 for scan in log)
    is_explicit = pairs.in_turn or np.isnan(log.range).any()
    assert log.asked.tolist() == ([] if is_explicit else [list(pair) for pair in heard])


@pytest.mark.parametrize(
    ("rows", "place", "allowed"),
    [
        (["0,,,,,1,1,1.5,,-1"], "row 2, column t: '-1'", "seconds, 0 or more, the same in all rows of a path"),
        (["0,,,,,1,1,1.5,-1,"], "row 2, column age: '-1'", "seconds, 0 or more"),
        (["0,,,,,1,1,1.5,,soon"], "row 2, column t: 'soon'", "seconds, 0 or more"),
        (["0,,,,,1,1,1.5,,1", "0,,,,,1,1,1.75,,2"], "row 3, column t: '2'", "the same in all rows of a path in a scan"),
        (["0,,,,,1,1,1.5,1,", "0,,,,,1,1,1.75,,"], "row 3, column age: nothing", "the same in all rows of a path"),
        (["0,,,,,1,1,,,", "0,,,,,1,2,1,,", "0,,,,,1,1,1,,"], "row 4, column rx: '1'", "one row without a range"),
        (["0,,,,,1,1,,,", "0,,,,,1,1,,,"], "row 3, column rx: '1'", "a path with one row without a range"),
        (["0,,,,,,,,,1"], "row 2, column t: '1'", "nothing, in a row without a path"),
        (["0,,,,,,,,1,"], "row 2, column age: '1'", "nothing, in a row without a path"),
    ],
)
def test_invalid_ages_times_and_silent_rows_are_named(rows, place, allowed):
    message = refused("\n".join([f"{HEADER},age,t", *rows, ""]))
    assert place in message
    assert allowed in message


def test_amplitudes_are_checked():
    with_amplitude = f"{HEADER},amplitude\n"
    assert "row 2, column amplitude: 'loud'" in refused(f"{with_amplitude}0,,,,,1,1,1.5,loud\n")
    message = refused(f"{with_amplitude}0,,,,,,,,3\n")
    assert "row 2, column amplitude: '3' came; allowed is nothing, in a row without an echo" in message
    message = refused(f"{with_amplitude}0,,,,,1,1,,3\n")
    assert "row 2, column amplitude: '3' came; allowed is nothing, in a row without an echo" in message


@pytest.mark.parametrize(
    ("header", "came"),
    [
        ("", "no header came"),
        (HEADER.replace("theta", "angle"), "unknown column 'angle'"),
        (HEADER.replace("theta", "Theta"), "unknown column 'Theta'"),
        (HEADER + ",", "unknown column ''"),
        (HEADER.replace("tx,", ""), "column 'tx' is missing"),
        (HEADER + ",range", "column 'range' came twice"),
        (HEADER + ",t,age,t", "column 't' came twice"),
        (HEADER.replace("range", "t,range"), "columns in the order scan,stamp,x,y,theta,tx,rx,t,range"),
        (HEADER.replace("tx,rx", "rx,tx"), "columns in the order scan,stamp,x,y,theta,rx,tx,range"),
        ("0,0.5,1,2,3,4,5,1.5", "unknown column '0'"),
        (HEADER.replace(",", ";"), "semicolons between the columns came; allowed are commas between columns"),
        (HEADER.replace(",", "\t"), "tabs between the columns came; allowed are commas between columns"),
    ],
)
def test_an_invalid_header_is_named(header, came):
    message = refused(f"{header}\n{GOOD}\n")
    assert f"row 1: {came}" in message
    assert f"allowed is {HEADER} and optionally amplitude, age, t" in message


@pytest.mark.parametrize("garbage", [b"", b"\x89PNG\r\n\x1a\n\0\0", HEADER.encode("utf-16"), b"\xff" * 100, b"\n\n"])
def test_invalid_csv_raises_an_error(garbage):
    assert "row 1: " in refused(garbage)


@given(st.binary(max_size=60) | st.text("0123456789.,-e\n\r", max_size=60).map(str.encode))
def test_arbitrary_bytes_give_a_log_or_a_one_line_error(garbage):
    for text in (garbage, HEADER.encode() + b"\n" + garbage, SMALL_CSV.encode() + garbage):
        try:
            read(text)
        except SonarError:
            refused(text)


def test_a_truncated_row_is_invalid_but_a_missing_last_line_end_is_not():
    whole = SMALL_CSV.encode()
    assert read(whole.rstrip(b"\n")) == read(whole)
    rows = whole.splitlines(keepends=True)
    for k in range(1, len(rows)):
        before = b"".join(rows[:k])
        for length in range(1, rows[k].rindex(b",")):  # columns are missing
            assert f"row {k + 1}: " in refused(before + rows[k][:length])


def test_missing_files_raise_an_error(tmp_path):
    for name in ("missing.csv", "missing.parquet"):
        with pytest.raises(SonarError, match="No such file"):
            load_scan_log(tmp_path / name)
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(SonarError, match=r"folder.csv: Is a directory; needed is a readable file with a scan log"):
        load_scan_log(tmp_path / "folder.csv")
    for name in ("log.txt", "log.csv.gz", "log", ".csv"):
        with pytest.raises(SonarError, match=r"allowed for a scan log is \.csv or \.parquet"):
            save_log(SMALL, tmp_path / name)
    assert not (tmp_path / "log.txt").exists()


def test_messages_have_one_line_for_any_filename(tmp_path):
    with pytest.raises(SonarError) as caught:
        load_scan_log(tmp_path / "two\nlines.csv")
    assert str(caught.value).isprintable()


def test_reading_and_writing_logs_does_not_import_jax(tmp_path):
    code = (
        "import sys; from jaxsonar.scans.log_file import load_scan_log, save_log; "
        "save_log(load_scan_log(sys.argv[1]), sys.argv[1]); "
        "sys.exit('jax' in sys.modules or 'pyarrow.lib' in sys.modules)"
    )
    file = tmp_path / "log.csv"
    save_log(SMALL, file)
    root = Path(logs_csv.__file__).parents[2]
    subprocess.run([sys.executable, "-c", code, str(file)], check=True, cwd=root)
