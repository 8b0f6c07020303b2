"""Inputs of all commands: every kind of log, notes and warnings, no output over an input, no silent empty result."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.bags import firing_log, sonar_ring
from support.commands import HEADER, OFFICE, PATH, SIMULATE, call, contents
from support.hard_cones import simulate
from support.input_files import WALLS

from jaxsonar import Room, load_log, load_ring, save_log, save_ring
from jaxsonar.scans.single_firings import group_firings


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """A folder with the office's log."""
    folder = tmp_path_factory.mktemp("office")
    assert call(*SIMULATE, "-o", folder / "log.csv") == 0
    return folder


@pytest.fixture
def here(office, tmp_path, monkeypatch):
    (tmp_path / "log.csv").write_bytes((office / "log.csv").read_bytes())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def direct_echoes(log):
    rows = [row.split(",") for row in Path(log).read_text().splitlines()]
    return "".join(",".join(row) + "\n" for row in rows if row[5] == row[6] or row[5] == "tx")


# Warnings


COMMANDS = {
    "lines": "lines {log} --ring faw --method hough -o out.jsonl",
    "map": "map {log} --ring faw --method hough -o out.geojson",
    "check": "check {log} --ring faw --json out.json",
    "slam": "slam {log} --ring faw --no-smoothing -o out.geojson",
    "batch": "batch {log} --ring faw --method hough --workers 1 -o out",
}


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_paths_that_are_never_heard_are_a_warning_and_strictly_an_error(here, capsys, command):
    Path("direct.csv").write_text(direct_echoes("log.csv"))
    assert call(*COMMANDS[command].format(log="direct.csv").split(), "--strict") == 2
    *_, warning, error = capsys.readouterr().err.splitlines()
    assert warning.startswith("warning: ")
    assert "no echo from neighbor 1, 2 or 3" in warning
    assert "neighbors = 0" in warning
    assert error == f"jaxsonar {command}: --strict: 1 warning came; allowed is input without warnings"
    assert not [path for path in here.iterdir() if path.name.startswith("out") and path.is_file()]


@pytest.mark.slow
@pytest.mark.parametrize("command", ["lines", "map", "batch"])
def test_sound_input_gives_no_warning(here, capsys, command):
    pytest.importorskip("pyarrow")
    assert call(*COMMANDS[command].format(log="log.csv").split(), "--strict") == 0
    assert "warning" not in capsys.readouterr().err


@pytest.mark.slow
def test_marks_for_no_echo_are_named_and_not_used(here, capsys):
    """All sensors that hear nothing report 1.98 m; the result is that of a log with silence there."""
    log, ring = load_log("log.csv"), load_ring("faw")
    rows = [HEADER]
    silent = [HEADER]
    for scan in log:
        pose = f"{scan.scan},{scan.stamp!r},{','.join(map(repr, scan.pose.tolist()))}"
        first = {}
        for tx, rx, reported in zip(scan.tx.tolist(), scan.rx.tolist(), scan.range.tolist(), strict=True):
            first[tx, rx] = min(reported, first.get((tx, rx), 9.0))
        for tx, rx in ring.paths.tolist():
            heard = first.get((tx, rx), 9.0) < 1.9
            rows.append(f"{pose},{tx},{rx},{first[tx, rx] if heard else 1.98!r}\n")
            silent.append(f"{pose},{tx},{rx},{first[tx, rx] if heard else ''}\n")
    Path("marks.csv").write_text("".join(rows))
    Path("silent.csv").write_text("".join(silent))
    results = []
    for name, options in (("marks", ()), ("marks", ("--no-echo", "1.98")), ("silent", ())):
        assert call("lines", f"{name}.csv", "--ring", "faw", "--method", "hough", *options, "-o", "out.jsonl") == 0
        results.append((Path("out.jsonl").read_bytes(), capsys.readouterr().err))
    assert results[0][0] == results[1][0] == results[2][0]
    warnings = [[line for line in text.splitlines() if "warning: " in line] for _, text in results]
    assert [any("1.98" in line for line in lines) for lines in warnings] == [True, False, False]
    assert len(warnings[0]) == len(warnings[1]) + 1 == len(warnings[2]) + 1


# Every kind of log


@pytest.mark.slow
def test_firings_in_scans_of_their_own_give_the_map_of_full_scans(tmp_path, capsys):
    """The same firings of a robot at rest, one per scan and grouped."""
    ring = sonar_ring(16)
    each = firing_log(ring, Room(WALLS), lambda time: np.array([1.7, 1.3, 0.1]), np.arange(64) * 0.04)
    save_ring(ring, tmp_path / "ring.toml")
    save_log(each, tmp_path / "each.csv")
    save_log(group_firings(each), tmp_path / "full.csv")
    texts = []
    for name in ("each", "full"):
        assert call("map", tmp_path / f"{name}.csv", "--ring", tmp_path / "ring.toml", "-o", "-") == 0
        texts.append(capsys.readouterr())
    assert texts[0].out == texts[1].out
    assert "64 scans with one firing each are merged into 4 scans" in texts[0].err
    assert "4 walls" in texts[1].err


def test_convert_counts_silent_and_old_readings(here, capsys):
    header = HEADER.strip() + ",age\n"
    Path("ages.csv").write_text(header + "0,0,0,0,0,3,3,1.0,\n0,0,0,0,0,4,4,,\n1,1,0,0,0,3,3,1.0,1\n")
    assert call("convert", "ages.csv", "out.csv") == 0
    assert capsys.readouterr().err == "2 scans, 2 echoes, 1 silent reading, 1 reading not renewed\n"
    assert load_log("out.csv") == load_log("ages.csv")


def test_an_interrupted_recording_is_recovered_with_a_warning(here, capsys):
    whole = HEADER + "0,0,0,0,0,3,3,1.0\n1,1,0,0,0,3,3,1.0\n"
    Path("cut.csv").write_text(whole + "2,2,0,0,")
    Path("cut.csv.recording").write_text(f"{len(whole):20d}\n")
    assert call("convert", "cut.csv", "out.csv") == 0
    warning, done = capsys.readouterr().err.splitlines()
    assert warning.startswith("warning: cut.csv: the recording is incomplete: 2 scans recovered")
    assert done == "2 scans, 2 echoes"
    assert call("convert", "cut.csv", "strict.csv", "--strict") == 2
    assert not Path("strict.csv").exists()


def test_a_table_is_converted(here, capsys):
    """Columns in centimetres, degrees clockwise; 400 means no echo."""
    Path("table.csv").write_text("time;left;front;px;py;yaw\n0.5;100;400;1;2;90\n1.5;200;50;1;2;0\n")
    options = "--from table --range-columns front,left --time-column time --pose-columns px,py,yaw --unit cm"
    more = "--angle-unit deg --clockwise --no-echo 400"
    assert call("convert", "table.csv", "out.csv", *options.split(), *more.split()) == 0
    assert capsys.readouterr().err.splitlines()[-1] == "2 scans, 3 echoes, 1 silent reading"
    log = load_log("out.csv")
    assert log.stamp.tolist() == [0.5, 1.5]
    np.testing.assert_allclose(log.pose, [[1, 2, -np.pi / 2], [1, 2, 0]])
    np.testing.assert_allclose(log.range, [np.nan, 1.0, 0.5, 2.0])
    assert log.tx.tolist() == log.rx.tolist() == [0, 1, 0, 1]


# No silent empty result


EMPTY = {
    "": "no scan",
    "0,0,0,0,0,,,\n1,1,1,0,0,,,\n": "no echo in 2 scans",
    "0,0,0,0,0,3,15,1\n": "none of the 1 echoes is on a path of 'FAW ring'",
    "0,0,0,0,0,3,3,1500\n": "none of the 1 echoes is within the maximum range of 'FAW ring', 2 m",
}


@pytest.mark.parametrize(("rows", "reason"), EMPTY.items(), ids=["no scan", "no echo", "no path", "millimetres"])
@pytest.mark.parametrize("command", ["lines", "map"])
def test_a_log_without_a_used_echo_is_explained_and_writes_nothing(
    tmp_path, monkeypatch, capsys, command, rows, reason
):
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text(HEADER + rows)
    before = contents(tmp_path)
    assert call(*COMMANDS[command].format(log="log.csv").split()) == 1
    *warnings, line = capsys.readouterr().err.splitlines()
    assert line.startswith(f"nothing found: log.csv: {reason}")
    assert [one.split(";")[0] for one in warnings] == ["warning: the log has no scan"] * (reason == "no scan")
    assert contents(tmp_path) == before


@pytest.mark.slow
@pytest.mark.parametrize(("rows", "reason"), EMPTY.items(), ids=["no scan", "no echo", "no path", "millimetres"])
def test_a_batch_without_a_used_echo_is_explained(tmp_path, monkeypatch, capsys, rows, reason):
    pytest.importorskip("pyarrow")
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text(HEADER + rows)
    assert call(*COMMANDS["batch"].format(log="log.csv").split()) == 1
    assert f"nothing found: log.csv: {reason}" in capsys.readouterr().err.splitlines()[-1]


def test_a_conversion_without_a_scan_writes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text(HEADER)
    assert call("convert", "log.csv", "out.csv") == 1
    assert capsys.readouterr().err == "nothing converted: log.csv: no scan: the log is empty\n"
    assert not Path("out.csv").exists()


# No output over an input


OVER = {
    "convert": "convert log.csv {same}.csv",
    "lines": "lines log.csv --ring faw -o {same}.csv",
    "lines's figure": "lines log.csv --ring faw -o out.jsonl --figure {same}.svg",
    "map": "map log.csv --ring faw -o {same}.csv",
    "slam": "slam log.csv --ring faw -o out.geojson --trajectory {same}.csv",
    "localize": "localize log.csv --ring faw --map room.geojson --trajectory {same}.csv",
    "calibrate": "calibrate log.csv --ring ring.toml -o {same}.toml",
    "check": "check log.csv --ring faw --json {same}.csv",
    "simulate": "simulate room.geojson --ring faw --path path.csv -o {same}.csv",
    "stream": "stream file:log.csv?speed=0 --ring faw --record {same}.csv",
}


@pytest.mark.parametrize("link", [None, os.symlink, os.link], ids=["itself", "symbolic link", "hard link"])
@pytest.mark.parametrize("command", OVER)
def test_no_output_replaces_an_input(here, capsys, command, link):
    Path("ring.toml").write_text(Path(OFFICE).with_name("ring-faw.toml").read_text())
    Path("room.geojson").write_bytes(Path(OFFICE).read_bytes())
    Path("path.csv").write_bytes(Path(PATH).read_bytes())
    given = {"calibrate": "ring.toml", "simulate": "path.csv"}.get(command, "log.csv")
    same = Path(given).stem
    suffix = Path(OVER[command]).suffix
    if link is not None or suffix not in given:
        same = "same"
        (link or os.symlink)(given, f"same{suffix}")
    before = contents(here)
    assert call(*OVER[command].format(same=same).split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{same}{suffix}: this is an input; allowed is another file" in line
    assert contents(here) == before


def test_no_output_replaces_a_file_of_a_recording(tmp_path, capsys):
    """A bag is a folder of files."""
    (tmp_path / "run").mkdir()
    for name in ("metadata.yaml", "run_0.csv"):
        (tmp_path / "run" / name).write_text("any")
    assert call("convert", tmp_path / "run", tmp_path / "run" / "run_0.csv") == 2
    assert "this is an input" in capsys.readouterr().err


def test_a_map_needs_an_echo_of_a_scan_with_a_pose(tmp_path, monkeypatch, capsys):
    """The echoes of the scan without a pose do not count."""
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text(HEADER + "0,0,0,0,0,,,\n1,1,,,,3,3,1\n1,1,,,,4,4,1\n")
    before = contents(tmp_path)
    assert call(*COMMANDS["map"].format(log="log.csv").split()) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "nothing found: log.csv: none of the 2 echoes is in a scan with a pose: give x, y and theta"
    assert contents(tmp_path) == before


@pytest.mark.slow
def test_a_map_without_walls_is_explained(tmp_path, monkeypatch, capsys):
    """No line at all, and lines of which each is seen by one scan."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").write_text(HEADER + "0,0,0,0,0,3,3,1\n0,0,0,0,0,9,9,1.3\n")
    assert call(*COMMANDS["map"].format(log="log.csv").split()) == 0
    reason, result = capsys.readouterr().err.splitlines()[-2:]
    assert reason.startswith("no wall: no line in 1 local model with a pose; 1 without: ")
    assert result.startswith("1 scan, 1 local model, 0 segments, 0 walls")
    assert json.loads(Path("out.geojson").read_text())["features"] == []
    room = Room(np.array([[[-1.0, 1.0], [1.0, 1.0]]]))
    ring = load_ring("faw")
    true = np.zeros((4, 3))
    wrong = np.array([[0, 0, 0], [900, 0, 1.0], [0, 900, 2.0], [900, 900, 3.0]])
    save_log(simulate(ring, room, true, sigma=0.003, seed=1).as_log(ring, wrong), "log.csv")
    assert call(*COMMANDS["map"].format(log="log.csv").split()) == 0
    reason, _ = capsys.readouterr().err.splitlines()[-2:]
    assert "no wall is seen by more than 1 scan, and 2 are needed; are the poses right" in reason


SILENT = HEADER + "0,0,0,0,0,3,3,\n1,1,1,0,0,3,3,\n2,2,2,0,0,3,3,\n"
ESTIMATES = {
    "slam": "slam log.csv --ring faw -o out.geojson",
    "localize": "localize log.csv --ring faw --map room.geojson --trajectory out.tum",
    "calibrate": "calibrate log.csv --ring faw -o out.toml",
}


@pytest.mark.parametrize("command", ESTIMATES)
def test_a_log_without_an_echo_gives_no_poses_and_no_parameters(tmp_path, monkeypatch, capsys, command):
    """The reason is that there is no echo, not what follows from that."""
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text(SILENT)
    Path("room.geojson").write_bytes(Path(OFFICE).read_bytes())
    before = contents(tmp_path)
    assert call(*ESTIMATES[command].split()) == 1
    *_, line = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"nothing found: log.csv: no echo in \d scans?: every range is empty or means no echo", line)
    assert contents(tmp_path) == before


def test_slam_of_a_sparse_ring_names_the_odometry(tmp_path, capsys):
    """A window is nothing that the person asked for."""
    ring = sonar_ring(16)
    log = firing_log(ring, Room(WALLS), lambda time: np.array([1.7, 1.3, 0.1]), np.arange(64) * 0.04)
    save_ring(ring, tmp_path / "ring.toml")
    save_log(replace(log, pose=np.full((len(log), 3), np.nan)), tmp_path / "log.csv")
    assert call("slam", tmp_path / "log.csv", "--ring", tmp_path / "ring.toml", "-o", tmp_path / "out.geojson") == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "no scan has odometry, and fewer than 4 paths" in line
    assert "window" not in line


def test_a_mark_that_no_range_has_is_a_note(here, capsys):
    Path("one.csv").write_text(HEADER + "0,0,0,0,0,3,3,1.0\n")
    assert call("convert", "one.csv", "out.csv", "--no-echo", "2.5", "--no-echo", "1") == 0
    assert capsys.readouterr().err.splitlines() == [
        "--no-echo 2.5: no range has this value",
        "1 scan, 0 echoes, 1 silent reading",
    ]
