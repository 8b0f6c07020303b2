"""Tables with one row per scan: any delimiter, decimal sign, unit and convention of angles gives the same log."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.recordings import refused

from jaxsonar import Ring, load_log
from jaxsonar.recordings.input_options import LENGTH_UNITS, TIME_UNITS, InputOptions, TableFormat

TIME = np.array([0.0, 0.1, 0.25])
POSE = np.array([[0.0, 0.5, 0.0], [0.25, 0.5, 1.0], [0.25, -0.75, -2.0]])
RANGES = np.array([[1.0, np.nan, 0.25], [1.5, 2.5, 0.75], [np.nan, 3.5, 0.5]])
COLUMNS = TableFormat(time="time", pose="x,y,heading", ranges="s*")
NAMES = ("time", "x", "y", "heading", "s_a", "s_b", "s_c")


def load(folder, text, form=COLUMNS, **options):
    """The log of a table, and the notes."""
    notes = []
    (folder / "table.txt").write_text(text)
    chosen = InputOptions(format="table", table=form, **options)
    return load_log(folder / "table.txt", options=chosen, on_note=notes.append), notes


def table(
    *, time=TIME, pose=POSE, ranges=RANGES, header=True, delimiter=",", missing="", comma=False, comment="", quote=""
):
    """Text of a table."""
    rows = np.column_stack([time, pose, ranges]).tolist()
    lines = [[missing if np.isnan(value) else repr(value) for value in row] for row in rows]
    lines = [[field.replace(".", ",") if comma else field for field in line] for line in lines]
    names = [f"{quote}{name}{quote}" for name in NAMES]
    return "".join(
        f"{comment * (k == 0)}{delimiter.join(line)}\n" for k, line in enumerate([names, *lines][not header :])
    )


def check(log, *, time=TIME, pose=POSE, ranges=RANGES):
    """Check that a log holds these values, with a silent reading where there is no range."""
    scans, sensors = ranges.shape
    np.testing.assert_allclose(log.stamp, time, atol=1e-9)
    np.testing.assert_allclose(log.pose, pose, atol=1e-9)
    np.testing.assert_allclose(log.range.reshape(scans, sensors), ranges, rtol=1e-12)
    np.testing.assert_array_equal(log.tx, np.tile(np.arange(sensors), scans))
    np.testing.assert_array_equal(log.rx, log.tx)
    assert not len(log.asked)


@pytest.mark.parametrize("comma", [False, True])
@pytest.mark.parametrize("header", [False, True])
@pytest.mark.parametrize("delimiter", [",", ";", "\t", " ", "  ", ", "])
def test_delimiter_decimal_sign_and_header_are_found_out(tmp_path, delimiter, comma, header):
    if comma and "," in delimiter:
        pytest.skip("commas cannot be both")
    form = COLUMNS if header else TableFormat(time="1", pose="2-4", ranges="5-7")
    text = table(delimiter=delimiter, comma=comma, header=header, missing="nan")
    log, notes = load(tmp_path, text, form)
    check(log)
    assert ("decimal commas" in notes[-1]) == comma


@pytest.mark.parametrize("missing", ["", "nan", "NaN", "inf", "-inf", "NA", "None", "-"])
def test_fields_without_a_value_are_silent(tmp_path, missing):
    check(load(tmp_path, table(missing=missing))[0])


def test_comments_empty_lines_line_ends_and_quotes_do_not_matter(tmp_path):
    check(load(tmp_path, table(comment="# "))[0])
    check(load(tmp_path, "% made by hand\n\n" + table(quote='"').replace("\n", "\r\n\r\n"))[0])


@given(unit=st.sampled_from(sorted(LENGTH_UNITS)), round_trip=st.booleans(), pose=st.sampled_from(sorted(LENGTH_UNITS)))
def test_lengths_have_units(tmp_path_factory, unit, round_trip, pose):
    ranges, positions = RANGES * (2 if round_trip else 1) / LENGTH_UNITS[unit], POSE.copy()
    positions[:, :2] /= LENGTH_UNITS[pose]
    form = TableFormat(time="time", pose="x,y,heading", ranges="s*", unit=unit, round_trip=round_trip, pose_unit=pose)
    check(load(tmp_path_factory.mktemp("t"), table(ranges=ranges, pose=positions), form)[0])


def test_time_of_flight_is_out_and_back(tmp_path):
    microseconds = 2 * RANGES / 343.2 * 1e6
    form = TableFormat(time="time", pose="x,y,heading", ranges="s*", unit="us")
    check(load(tmp_path, table(ranges=microseconds), form)[0])


@pytest.mark.parametrize("unit", TIME_UNITS)
def test_times_have_units(tmp_path, unit):
    form = TableFormat(time="time", pose="x,y,heading", ranges="s*", time_unit=unit)
    check(load(tmp_path, table(time=TIME / TIME_UNITS[unit]), form)[0])


def test_times_can_be_dates(tmp_path):
    lines = table(header=False).splitlines()
    dates = ("2024-02-29 23:59:59.5", "2024-02-29T23:59:59.6", "2024-03-01 00:00:00")
    text = "".join(f"{date},{line.partition(',')[2]}\n" for date, line in zip(dates, lines, strict=True))
    log, _ = load(tmp_path, text, TableFormat(time="1", ranges="5-7"))
    np.testing.assert_allclose(np.diff(log.stamp), [0.1, 0.4], atol=1e-6)
    assert np.isnan(log.pose).all()
    message = refused(load, tmp_path, text.replace("59.6", "x"), TableFormat(time="1", ranges="5-7"))
    assert "row 2, column 1: '2024-02-29T23:59:x' came; allowed is a number (s), or a date and time" in message


@pytest.mark.parametrize("zone", ["UTC", "America/New_York"])
def test_dates_without_a_zone_are_in_utc(tmp_path, monkeypatch, zone):
    """Wherever the machine is; there is no jump where its clock changes."""
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    dates = ("2024-03-10 01:59:59", "2024-03-10 03:00:00", "2024-03-10 05:00:00+02:00")
    text = "".join(f"{date},1.0\n" for date in dates)
    log, _ = load(tmp_path, text, TableFormat(time="1", ranges="2"))
    monkeypatch.undo()
    time.tzset()
    assert log.stamp.tolist() == [1710035999.0, 1710039600.0, 1710039600.0]


ANGLES = {
    "towards the y axis": (lambda x, y, theta: (x, y, theta), {}),
    "clockwise": (lambda x, y, theta: (x, y, -theta), {"clockwise": True}),
    "compass": (lambda x, y, theta: (x, y, np.pi / 2 - theta), {"compass": True}),
    "x north, y east": (lambda x, y, theta: (x, -y, -theta), {"y_right": True}),
}


@pytest.mark.parametrize("unit", ["rad", "deg"])
@pytest.mark.parametrize("convention", ANGLES)
def test_headings_have_conventions(tmp_path, convention, unit):
    written, options = ANGLES[convention]
    x, y, heading = written(*POSE.T)
    pose = np.column_stack([x, y, np.degrees(heading) if unit == "deg" else heading])
    form = TableFormat(time="time", pose="x,y,heading", ranges="s*", angle_unit=unit, **options)
    check(load(tmp_path, table(pose=pose), form)[0])


def test_values_that_mean_no_echo_are_in_the_unit_of_the_table(tmp_path):
    ranges = np.where(np.isnan(RANGES), [[0, 511, 0], [0, 0, 0], [-1, 0, 0]], RANGES * 100)
    form = TableFormat(time="time", pose="x,y,heading", ranges="s*", unit="cm")
    log, notes = load(tmp_path, table(ranges=ranges), form, no_echo=(511.0, -1.0))
    check(log)
    assert len(notes) == 1
    log, notes = load(tmp_path, table(ranges=ranges), form, no_echo=(511.0,))
    check(log)
    assert notes[0] == "1 ranges that are not above 0 (-1) mean no echo"


def test_columns_are_named_in_any_order(tmp_path):
    log, notes = load(tmp_path, table(), TableFormat(ranges="s_c,5,s_b"))
    check(log, time=np.full(3, np.nan), pose=np.full((3, 3), np.nan), ranges=RANGES[:, [2, 0, 1]])
    assert "'s_c' = sensor 0, 's_a' = sensor 1, 's_b' = sensor 2 (m)" in notes[0]
    for form, sensors in ((COLUMNS, {"s_c": 0, "s_a": 1, "s_b": 2}), (TableFormat(), {"7": 0, "5": 1, "s_b": 2})):
        log, _ = load(tmp_path, table(), form, sensors=sensors)
        order = np.lexsort((log.tx, log.echo_scan))
        np.testing.assert_array_equal(log.range[order].reshape(3, 3), RANGES[:, [2, 0, 1]])


@pytest.mark.parametrize(
    ("change", "form", "options", "message"),
    [
        (
            (),
            TableFormat(),
            {},
            "no column with ranges was named; the columns are time, x, y, heading, s_a, s_b, s_c",
        ),
        (
            (),
            TableFormat(ranges="5-8"),
            {},
            "--range-columns 5-8: no such column; allowed are time, x, y, heading",
        ),
        ((), TableFormat(ranges="r*"), {}, "--range-columns r*: no such column"),
        ((), TableFormat(ranges="0"), {}, "--range-columns 0: no such column"),
        ((), TableFormat(ranges="s*,5"), {}, "--range-columns: column 's_a' came twice"),
        ((), TableFormat(ranges="s*", time="clock"), {}, "--time-column clock: no such column"),
        ((), TableFormat(ranges="s*", time="x,y"), {}, "--time-column x,y: 2 columns; allowed is 1"),
        (
            (),
            TableFormat(ranges="s*", pose="x,y"),
            {},
            "--pose-columns x,y: 2 columns; allowed are 3: x, y",
        ),
        ((), TableFormat(ranges="s*", unit="km"), {}, "--unit km came; allowed are m, cm, mm, in, ft, us"),
        ((), TableFormat(ranges="s*", angle_unit="grad"), {}, "--angle-unit grad came; allowed are rad, deg"),
        ((), TableFormat(ranges="s*", time_unit="h"), {}, "--time-unit h came; allowed are s, ms, us, ns"),
        ((), TableFormat(ranges="s*", clockwise=True, compass=True), {}, "--clockwise and --compass came"),
        ((), COLUMNS, {"sensors": {"s_a": 0}}, "column 's_b' has no sensor; allowed is --sensor for all or none"),
        ((), TableFormat(), {"sensors": {"s_a": 1, "s_b": 1}}, "--sensor: two columns of one sensor came"),
        (("1.5", "far 9"), COLUMNS, {}, "row 3, column 's_a': 'far 9' came; allowed is a number with a decimal point"),
        ((",0.75\n", ",0.75,9\n"), COLUMNS, {}, "row 3: 8 columns came; allowed are 7"),
    ],
)
def test_errors_name_what_came(tmp_path, change, form, options, message):
    text = table()
    assert not change or change[0] in text
    text = text.replace(*change) if change else text
    assert f"table.txt: {message}" in refused(load, tmp_path, text, form, **options)


def test_a_table_needs_rows_and_a_ring_with_enough_sensors(tmp_path):
    assert "no row came" in refused(load, tmp_path, "# nothing\n\n")
    assert len(load(tmp_path, ",".join(NAMES) + "\n")[0]) == 0
    (tmp_path / "table.txt").write_text(table())
    message = refused(
        load_log,
        tmp_path / "table.txt",
        ring=Ring.circular(count=2, neighbors=0),
        options=InputOptions(format="table", table=COLUMNS),
    )
    assert "3 columns with ranges came, up to sensor 2; the ring has the sensors 0 to 1" in message


@pytest.mark.parametrize(
    ("text", "columns", "expected"),
    [
        ('a,b\n"1,5","2,25"\n"1,6","2,35"\n', "a,b", [[1.5, 2.25], [1.6, 2.35]]),
        ('a,b,note\n1.5,2,"x, y"\n1.25,3,"a ""b"" c"\n', "a,b", [[1.5, 2.0], [1.25, 3.0]]),
        ('a;b;note\n1,5;2;"x; y\nz"\n1,25;3;\n', "1-2", [[1.5, 2.0], [1.25, 3.0]]),
        ('"s 1" "s 2"\n1.5 2\n1.25 3\n', "s*", [[1.5, 2.0], [1.25, 3.0]]),
        ("sep=;\na;b\n1,5;2\n1,25;3\n", "a,b", [[1.5, 2.0], [1.25, 3.0]]),
        ('"SEP=|"\r\n1.5|2\r\n1.25|3\r\n', "1-2", [[1.5, 2.0], [1.25, 3.0]]),
        ("1.5,out of range\n#N/A,2\nno echo,out of range\n", "1-2", [[1.5, np.nan], [np.nan, 2.0], [np.nan, np.nan]]),
        ("a,b\n#DIV/0!,--\nout of range,Error!\n1,2\n", "a,b", [[np.nan, np.nan], [np.nan, np.nan], [1.0, 2.0]]),
    ],
)
def test_quotes_texts_and_separator_lines_are_those_of_spreadsheets(tmp_path, text, columns, expected):
    log, notes = load(tmp_path, text, TableFormat(ranges=columns))
    np.testing.assert_array_equal(log.range.reshape(len(log), -1), expected)
    assert any("fields with a text ('" in note for note in notes) == ("out of" in text)


@pytest.mark.parametrize("field", ["1.2.3", "12cm", ">400", "1,5"])
def test_a_text_with_digits_is_not_silence(tmp_path, field):
    text = f'a,b\n1.5,"{field}"\n1.25,2.5\n'
    assert f"row 2, column 'b': '{field}' came" in refused(load, tmp_path, text, TableFormat(ranges="a,b"))


@pytest.mark.parametrize(
    ("form", "message"),
    [
        (
            TableFormat(ranges="*", time="time"),
            "column 'time' came in --range-columns or --sensor and in --time-column",
        ),
        (TableFormat(ranges="s*,4", pose="x,y,heading"), "column 'heading' came in --range-columns or --sensor and in"),
        (TableFormat(ranges="s*", time="x", pose="x,y,heading"), "column 'x' came in --time-column and in --pose-col"),
        (TableFormat(ranges=""), "--range-columns '': no column came"),
        (TableFormat(ranges=" , "), "--range-columns ' , ': no column came"),
        (TableFormat(ranges="s*", unit="us", round_trip=True), "--unit us and --round-trip came; allowed is one of"),
        (TableFormat(ranges="s*", delimiter="::"), "--delimiter '::' came; allowed is one character"),
    ],
)
def test_options_that_contradict_are_rejected(tmp_path, form, message):
    assert message in refused(load, tmp_path, table(), form)


def test_columns_with_one_name_are_told_apart_by_number(tmp_path):
    text = "a,a,b\n1.0,2.0,3.0\n"
    for wanted in ("a", "a,b", "*"):
        assert "2 columns have the name 'a'; use their numbers 1, 2" in refused(
            load, tmp_path, text, TableFormat(ranges=wanted)
        )
    np.testing.assert_array_equal(load(tmp_path, text, TableFormat(ranges="1-3"))[0].range, [1, 2, 3])


@pytest.mark.parametrize(("factor", "said"), [(1.0, ""), (100.0, "above 50 m"), (1e-3, "below 5 mm")])
def test_a_wrong_unit_gives_a_warning(tmp_path, factor, said):
    ranges = factor * np.linspace(0.8, 4, 30).reshape(10, 3)
    text = "s_a,s_b,s_c\n" + "".join(",".join(map(repr, row)) + "\n" for row in ranges.tolist())
    _, notes = load(tmp_path, text, TableFormat(ranges="s*"))
    warned = [note for note in notes if note.startswith("warning: ")]
    assert len(warned) == bool(said)
    assert all(f"100% of the ranges are {said}" in note and "--unit" in note for note in warned)


def test_a_value_for_no_echo_that_never_came_is_reported(tmp_path):
    _, notes = load(tmp_path, table(), no_echo=(4.0,))
    assert notes[0] == "--no-echo 4: no range has this value"
