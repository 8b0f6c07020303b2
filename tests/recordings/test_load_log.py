"""Loading of recordings: the content decides how a file is read, and wrong content is named."""

import shutil
import sqlite3

import numpy as np
import pytest
from support.logs import HEADER, SMALL
from support.recordings import refused

from jaxsonar import load_log, save_log
from jaxsonar.hardware.recorder_base import recording_marker
from jaxsonar.recordings.input_options import FORMATS, InputOptions
from jaxsonar.scans.recording_journal import TruncatedRecording

BEESOFT = "@SENS 20-02-98 15:48:17.500000\n#ROBOT 0.0 0.0 90.0\n\n#SONAR 2: 100.0 200.0\n"
PLAYER = "## Player version 3.0.2\n0000000001.000 16777343 6665 sonar 00 001 001 2 1.000 2.000\n"


def load(filename, format=None, **options):
    """The log, and the notes."""
    notes = []
    log = load_log(filename, options=InputOptions(format=format, **options), on_note=notes.append)
    return log, notes


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize("name", ["a.csv", "a.parquet", "a.mcap", "a.log", "a"])
def test_the_content_decides_not_the_suffix(tmp_path, suffix, name):
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    save_log(SMALL, tmp_path / f"right{suffix}")
    (tmp_path / f"right{suffix}").rename(tmp_path / name)
    log, notes = load(tmp_path / name)
    assert log == SMALL
    fits = name.endswith(suffix) or name in ("a.log", "a")
    assert len(notes) == (0 if fits else 1)
    what = {".csv": "a scan log as CSV", ".parquet": "a Parquet file", ".mcap": "a raw recording (MCAP)"}
    assert all(f"{name}: this is {what[suffix]}, not {what['.' + name[2:]]}; it is read as such" in n for n in notes)


def test_a_named_format_that_the_content_contradicts_is_rejected(tmp_path):
    save_log(SMALL, tmp_path / "a.parquet.csv")
    for named, what in (("parquet", "a Parquet file"), ("bag", "a ROS bag"), ("beesoft", "a Beesoft log")):
        message = refused(load, tmp_path / "a.parquet.csv", named)
        assert f"a.parquet.csv: this is a scan log as CSV, not {what}, which --from {named} needs" in message
    assert load(tmp_path / "a.parquet.csv", "csv") == (SMALL, [])


def test_an_unknown_format_is_rejected_before_the_file_is_read(tmp_path):
    assert f"format 'corridor9' came; allowed are {', '.join(FORMATS)}" in refused(load, tmp_path / "no", "corridor9")


@pytest.mark.parametrize(("text", "scans"), [(BEESOFT, 1), (PLAYER, 1)], ids=["beesoft", "player"])
def test_formats_with_unmistakable_lines_are_recognized(tmp_path, text, scans):
    (tmp_path / "run.txt").write_text(text)
    log, notes = load(tmp_path / "run.txt")
    assert len(log) == scans
    np.testing.assert_allclose(log.range, [1.0, 2.0])
    assert notes, "the choice is reported"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "this is an empty file"),
        (b"\x89PNG\r\n\x1a\n", "this is a picture (PNG)"),
        (b"PK\x03\x04 xlsx", "this is a ZIP archive or a spreadsheet (XLSX)"),
        (b"\x1f\x8b\x08", "this is a file compressed by gzip"),
        (HEADER.encode("utf-16"), "this is text in UTF-16 (save it as UTF-8)"),
        (bytes(range(256)) * 8, "this is a binary file"),
        (b'{"type": "FeatureCollection"}', "this is a JSON file"),
        (b'name = "faw"\n[ring]\n', "this is a TOML file (a ring or settings)"),
        (b"# notes\n[ring]\ncount = 24\n", "this is a text that begins with '# notes'"),
        (b"<html>", "this is an XML or HTML file"),
        (b"Dear robot,\nplease map.\n", "this is a text that begins with 'Dear robot,'"),
        (
            b"time,a,b\n0,1.5,2.5\n1,1.4,2.6\n",
            "this is a table of numbers; name its format",
        ),
        (
            b"scan;stamp;x;y;theta;tx;rx;range\n0;0,1;0,0;0,0;0,0;1;1;1,5\n",
            "row 1: semicolons between",
        ),
        (b"scan\tstamp\tx\ty\ttheta\ttx\trx\trange\n", "row 1: tabs between the columns came"),
        (b"stamp,x,y,theta,tx,rx,range\n", "row 1: column 'scan' is missing"),
        (b"PAR1 cut short", "needed is a scan log as a whole Parquet file"),
    ],
)
def test_what_is_no_log_is_named(tmp_path, content, message):
    if content.startswith(b"PAR1"):
        pytest.importorskip("pyarrow")
    (tmp_path / "a.csv").write_bytes(content)
    came = refused(load, tmp_path / "a.csv")
    assert came.startswith(f"{tmp_path}/a.csv: ")
    assert message in came


def test_folders_are_bags_or_data_sets_or_named(tmp_path):
    assert "this is a folder without metadata.yaml, which the folder of a ROS 2 bag has; allowed" in refused(
        load, tmp_path
    )
    (tmp_path / "x.db3").touch()
    assert "this is a folder with x.db3 without metadata.yaml" in refused(load, tmp_path)
    (tmp_path / "measurement.txt").touch()
    (tmp_path / "poses.txt").touch()
    assert "like corridor8; name its format, if it is one: --from corridor8" in refused(load, tmp_path)
    assert "No such file" in refused(load, tmp_path / "missing")


def test_other_databases_are_no_bags(tmp_path):
    pytest.importorskip("rosbags")
    with sqlite3.connect(tmp_path / "a.db3") as database:
        database.execute("create table other (a int)")
    database.close()
    assert "a.db3" in refused(load, tmp_path / "a.db3")


def test_ranges_that_mean_no_echo_become_silent_readings(tmp_path):
    (tmp_path / "a.csv").write_text(f"{HEADER}\n0,,,,,0,0,1.5\n0,,,,,1,1,5.11\n1,,,,,0,0,4\n1,,,,,1,1,1.25\n")
    log, _ = load(tmp_path / "a.csv", no_echo=(5.11, 4.0))
    np.testing.assert_array_equal(log.range, [1.5, np.nan, np.nan, 1.25])
    assert not len(log.asked)
    assert load(tmp_path / "a.csv", no_echo=(7.0,))[0] == load(tmp_path / "a.csv")[0]


def test_marks_that_are_no_ranges_are_an_error_or_become_silent_readings(tmp_path):
    silent = (
        "scan,stamp,x,y,theta,tx,rx,range\n0,0,0,0,0,0,0,1.2\n0,0,0,0,0,1,1,{0}\n1,1,0,0,0,0,0,{1}\n1,1,0,0,0,1,1,2\n"
    )
    (tmp_path / "marked.csv").write_text(silent.format(0, -1))
    (tmp_path / "silent.csv").write_text(silent.format("", ""))
    assert "if 0 means no echo, give --no-echo 0" in refused(load, tmp_path / "marked.csv")
    log, notes = load(tmp_path / "marked.csv", no_echo=(0.0, -1.0))
    assert log == load(tmp_path / "silent.csv")[0]
    assert notes == []


@pytest.mark.parametrize("name", ["cut.csv", "cut.parquet"])
def test_an_interrupted_recording_gives_its_complete_scans(tmp_path, name):
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
        save_log(SMALL[:0], tmp_path / name)
    journal = tmp_path / (f"{name}.recording.csv" if name.endswith("parquet") else name)
    text = f"{HEADER}\n0,,,,,0,0,1.5\n1,,,,,0,0,1.25\n"
    journal.write_text(text + "2,,,,,0,0")
    recording_marker(tmp_path / name).write_text(f"{len(text)}\n")
    for named in (None, name.partition(".")[2]):
        with pytest.warns(TruncatedRecording, match="2 scans"):
            log, _ = load(tmp_path / name, named)
        np.testing.assert_array_equal(log.range, [1.5, 1.25])


@pytest.mark.parametrize("name", ["cut.csv", "cut.parquet"])
def test_options_apply_to_an_interrupted_recording(tmp_path, name):
    """Values that mean no echo, the named format and the numbers of the sensors, as without the marker."""
    from jaxsonar import Ring

    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
        save_log(SMALL[:0], tmp_path / name)
    text = f"{HEADER}\n" + "".join(f"0,,,,,{k},{k},{1 + k / 4}\n" for k in range(1, 5))
    (tmp_path / (f"{name}.recording.csv" if name.endswith("parquet") else name)).write_text(text + "1,,,,,0,0")
    recording_marker(tmp_path / name).write_text(f"{len(text)}\n")
    with pytest.warns(TruncatedRecording):
        log, _ = load(tmp_path / name, no_echo=(1.5,))
    np.testing.assert_array_equal(log.range, [1.25, np.nan, 1.75, 2.0])
    assert "not a ROS bag, which --from bag needs" in refused(load, tmp_path / name, "bag")
    with (
        pytest.warns(TruncatedRecording),
        pytest.raises(ValueError, match="the sensors 1 to 4 came, so the log seems to count from 1"),
    ):
        load_log(tmp_path / name, ring=Ring.circular(count=4, neighbors=0))


def test_a_raw_recording_is_a_log(tmp_path):
    pytest.importorskip("mcap")
    from support.fake_devices import messages

    from jaxsonar import Ring
    from jaxsonar.hardware.recorder import open_recorder

    recorder = open_recorder(tmp_path / "raw.mcap")
    for number, message in enumerate(messages(3)):
        recorder.message(message, 100.0 + number)
    recorder.close()
    shutil.copy(tmp_path / "raw.mcap", tmp_path / "raw.csv")
    log, notes = load(tmp_path / "raw.mcap")
    assert len(log) == 3
    assert log.echo_count
    assert not notes
    again, notes = load(tmp_path / "raw.csv")
    assert again == log
    assert "this is a raw recording (MCAP), not a scan log as CSV" in notes[0]
    with pytest.raises(ValueError, match="an unknown sensor came; allowed is 0 to 1"):
        load_log(tmp_path / "raw.mcap", ring=Ring.circular(count=2, neighbors=0))


def test_a_damaged_raw_recording_gives_what_is_before_the_damage_and_a_warning(tmp_path):
    pytest.importorskip("mcap")
    from support.fake_devices import messages

    from jaxsonar.hardware.recorder import open_recorder

    recorder = open_recorder(tmp_path / "whole.mcap")
    for number, message in enumerate(messages(40)):
        recorder.message(message, 100.0 + number)
        recorder.tick(100.0 + number)  # a chunk for each message
    recorder.close()
    whole, _ = load(tmp_path / "whole.mcap")
    content = (tmp_path / "whole.mcap").read_bytes()
    third = len(content) // 3
    for wrong in (content[:third], content[:third] + bytes(2000) + content[third + 2000 :]):
        (tmp_path / "wrong.mcap").write_bytes(wrong)
        with pytest.warns(TruncatedRecording, match="the recording is incomplete or damaged"):
            part, _ = load(tmp_path / "wrong.mcap")
        assert 3 < len(part) < len(whole)
        assert part[:-1] == whole[: len(part) - 1]


def test_a_raw_recording_without_a_message_is_rejected(tmp_path):
    pytest.importorskip("mcap")
    from jaxsonar.hardware.recorder import open_recorder

    open_recorder(tmp_path / "raw.mcap").close()
    assert "raw.mcap: no message of a device can be read" in refused(load, tmp_path / "raw.mcap")


def test_sensors_that_are_counted_from_1_are_named(tmp_path):
    from jaxsonar import Ring

    (tmp_path / "a.csv").write_text(f"{HEADER}\n" + "".join(f"0,,,,,{k},{k},1.5\n" for k in range(1, 9)))
    with pytest.raises(ValueError, match="the sensors 1 to 8 came, so the log seems to count from 1; allowed are 0"):
        load_log(tmp_path / "a.csv", ring=Ring.circular(count=8, neighbors=0))
    assert len(load_log(tmp_path / "a.csv", ring=Ring.circular(count=9, neighbors=0)).tx) == 8
    assert len(load_log(tmp_path / "a.csv").tx) == 8
