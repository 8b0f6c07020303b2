"""``jaxsonar simulate``: poses with odometry errors or none, and the true poses in another file."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from jaxsonar import Ring, Room, load_log, save_ring, save_room
from jaxsonar.cli import app as cli
from jaxsonar.estimation.trajectory import load_trajectory
from jaxsonar.simulation.office import load_office
from jaxsonar.simulation.wheel_odometry import simulate_odometry

DATA = Path(__file__).resolve().parents[2] / "jaxsonar" / "data"
SIMULATE = ["simulate", DATA / "office.geojson", "--ring", "faw", "--path", DATA / "office-path.csv", "--seed", "5"]
OFFICE = load_office()


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def call(*arguments):
    try:
        return cli.main([str(argument) for argument in (*SIMULATE, *arguments)])
    except SystemExit as end:  # raised by argparse
        return end.code


def test_the_logged_poses_do_not_change_the_echoes():
    assert call("-o", "true.csv") == 0
    assert call("-o", "drift.csv", "--odometry", "2,1", "--truth", "truth.tum") == 0
    assert call("-o", "none.csv", "--no-odometry") == 0
    true, drift, none = (load_log(name) for name in ("true.csv", "drift.csv", "none.csv"))
    for log in (drift, none):
        for column in ("scan", "stamp", "start", "tx", "rx", "range"):
            np.testing.assert_array_equal(getattr(log, column), getattr(true, column))
    np.testing.assert_array_equal(true.pose, OFFICE.poses)
    expected = simulate_odometry(OFFICE.poses, distance=0.02, turn=float(np.radians(1.0)), seed=5)
    np.testing.assert_array_equal(drift.pose, expected)
    assert np.isnan(none.pose).all()
    truth = load_trajectory("truth.tum")
    np.testing.assert_array_equal(truth.stamp, OFFICE.stamps)
    np.testing.assert_allclose(truth.poses, OFFICE.poses, atol=1e-15)


def test_the_settings_are_written_beside_the_log():
    assert call("-o", "a.csv") == 0
    assert call("-o", "b.csv", "--odometry", "0.5,1e-1", "--truth", "b.tum") == 0
    assert call("-o", "c.csv", "--no-odometry") == 0
    a, b, c = (tomllib.loads(Path(f"{name}.settings.toml").read_text()) for name in "abc")
    assert not {"odometry", "no_odometry", "truth"} & set(a)
    assert b == a | {"odometry": [0.5, 0.1]}
    assert c == a | {"no_odometry": True}


def test_standard_output_holds_the_log_or_the_truth(capsys):
    assert call("-o", "-", "--odometry", "2,1") == 0
    assert capsys.readouterr().out.startswith("scan,stamp")
    assert call("-o", "a.csv", "--truth", "-") == 0
    assert len(capsys.readouterr().out.splitlines()) == 18


MISTAKES = {
    "one number": (["--odometry", "2"], ["--odometry", "'2'", "PERCENT,DEG"]),
    "three numbers": (["--odometry", "2,1,0"], ["2,1,0", "two numbers"]),
    "a word": (["--odometry", "2,one"], ["2,one", "PERCENT,DEG"]),
    "less than nothing": (["--odometry=-1,1"], ["-1,1", "0 to 100"]),
    "not a number": (["--odometry", "nan,1"], ["nan,1"]),
    "both": (["--odometry", "2,1", "--no-odometry"], ["--no-odometry", "not allowed with", "--odometry"]),
    "truth over the path": (["--truth", DATA / "office-path.csv"], ["--truth", "input"]),
    "truth over the log": (["--truth", "out.csv"], ["--truth", "-o"]),
    "truth over the settings": (["--truth", "out.settings.toml"], ["--truth", "settings beside the log"]),
    "truth into a missing folder": (["--truth", "no/a.tum"], ["no/a.tum", "folder"]),
    "two on standard output": (["-o", "-", "--truth", "-"], ["--truth -", "standard output"]),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_an_invalid_call_is_answered_in_one_line(mistake, capsys):
    arguments, said = MISTAKES[mistake]
    assert call("-o", "out.csv", *arguments) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert len(shown.err.splitlines()) == 1
    for word in said:
        assert word in shown.err
    assert not list(Path().iterdir())


WRONG = {
    "room": (["room.geojson", "--path", "path.csv"], "millimetres"),
    "degrees": ([DATA / "office.geojson", "--path", "degrees.csv"], "the headings are probably in degrees"),
    "path": ([DATA / "office.geojson", "--path", "mm.csv"], "the positions are probably in millimetres"),
    "noise": ([DATA / "office.geojson", "--path", "path.csv", "--sigma", "3"], "it is probably in millimetres"),
    "ring": ([DATA / "office.geojson", "--path", "path.csv", "--ring", "radians.toml"], "given in radians"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_probable_mistake_is_a_warning_and_strictly_an_error(name, capsys):
    poses = np.column_stack([OFFICE.poses, OFFICE.stamps])
    for file, scale in (("path.csv", 1), ("mm.csv", [1000, 1000, 1, 1]), ("degrees.csv", [1, 1, 180 / np.pi, 1])):
        np.savetxt(file, poses * scale, delimiter=",", header="x,y,theta,stamp", comments="")
    save_room(Room(OFFICE.room.walls * 1000), "room.geojson")
    save_ring(Ring.circular(beam=0.02, max_range=1.0), "radians.toml")
    arguments, words = WRONG[name]
    arguments = ["simulate", *map(str, arguments), "-o", "log.csv", *(["--ring", "faw"] * (name != "ring"))]
    assert cli.main([*arguments, "--strict"]) == 2
    warning, error = capsys.readouterr().err.splitlines()
    assert warning.startswith("warning: ")
    assert words in warning
    assert error == "jaxsonar simulate: --strict: 1 warning came; allowed is input without warnings"
    assert not Path("log.csv").exists()


@pytest.mark.parametrize("separator", [";", "\t"])
def test_a_path_in_another_number_format_is_named(separator, capsys):
    Path("path.csv").write_text(separator.join(["x", "y", "theta"]) + "\n" + separator.join(["1,5"] * 3) + "\n")
    assert (
        cli.main(["simulate", str(DATA / "office.geojson"), "--ring", "faw", "--path", "path.csv", "-o", "a.csv"]) == 2
    )
    came = {";": "semicolons", "\t": "tabs"}[separator]
    assert f"{came} between the columns came; allowed are commas between columns and points, not decimal commas" in (
        capsys.readouterr().err
    )


def test_soft_beams_and_crosstalk_are_options():
    for name, options in {
        "soft.csv": [],
        "quiet.csv": ["--no-crosstalk"],
        "hard.csv": ["--beams", "hard"],
        "explicit.csv": ["--beams", "soft"],
    }.items():
        assert call("-o", name, *options) == 0
    count = {name: len(load_log(f"{name}.csv").range) for name in ("soft", "quiet", "hard", "explicit")}
    assert count["hard"] < count["quiet"] < count["soft"] == count["explicit"]
    settings = tomllib.loads(Path("quiet.settings.toml").read_text())
    assert settings["beams"] == "soft"
    assert settings["no_crosstalk"] is True
    assert call("-o", "a.csv", "--beams", "wide") == 2


BESIDE = [0.6, 1.0]
"""A place in the office, 1 m beside the path."""


def save_walk(file, positions, stamps=(0.0, 1e4)):
    rows = np.column_stack([stamps, np.asarray(positions, dtype=np.float64)])
    np.savetxt(file, rows, delimiter=",", header="stamp,x,y", comments="")


def test_a_person_walks_through_the_room(capsys):
    save_walk("walk.csv", [BESIDE, BESIDE])
    save_room(Room(OFFICE.room.walls, (), OFFICE.room.poles, np.array([[*BESIDE, 0.3]])), "column.geojson")
    assert call("-o", "empty.csv") == 0
    assert call("-o", "walk.log.csv", "--walker", "walk.csv:0.3") == 0
    assert capsys.readouterr().err.count("warning") == 0
    walked, empty = load_log("walk.log.csv"), load_log("empty.csv")
    assert not np.array_equal(walked.range, empty.range)
    arguments = ["column.geojson", "--ring", "faw", "--path", DATA / "office-path.csv", "--seed", "5", "-o", "col.csv"]
    assert cli.main(["simulate", *map(str, arguments)]) == 0
    columns = load_log("col.csv")
    np.testing.assert_array_equal(columns.start, walked.start)
    np.testing.assert_allclose(columns.range, walked.range, atol=1e-9)
    settings = tomllib.loads(Path("walk.log.settings.toml").read_text())
    assert settings["walker"] == ["walk.csv:0.3"]
    save_walk("other.csv", [[-0.2, 0.8], [0.0, 0.9]])
    assert call("-o", "two.csv", "--walker", "walk.csv:0.3", "--walker", "other.csv") == 0


BAD_WALKS = {
    "no file": (["--walker", "no.csv"], ["no.csv"]),
    "no radius": (["--walker", "walk.csv:wide"], ["radius 'wide' came", "CSV:RADIUS"]),
    "zero radius": (["--walker", "walk.csv:0"], ["radius 0 m", "more than 0"]),
    "large radius": (["--walker", "walk.csv:300"], ["radius 300 m", "mm or cm"]),
    "no number": (["--walker", "walk.csv:nan"], ["radius nan m"]),
    "columns": (["--walker", "columns.csv"], ["columns.csv: row 1: x,y came", "stamp, x, y"]),
    "stamps": (["--walker", "back.csv"], ["back.csv: row 3, column stamp", "later"]),
    "over the walk": (["--walker", "own.csv", "-o", "own.csv"], ["-o", "input"]),
}


@pytest.mark.parametrize("mistake", BAD_WALKS)
def test_a_wrong_person_is_answered_in_one_line(mistake, capsys):
    save_walk("walk.csv", [[0.8, 0.0], [0.8, 0.0]])
    save_walk("back.csv", [[0.8, 0.0], [0.8, 0.0]], stamps=(1.0, 0.0))
    save_walk("own.csv", [[0.8, 0.0], [0.8, 0.0]])
    Path("columns.csv").write_text("x,y\n0,0\n")
    arguments, said = BAD_WALKS[mistake]
    assert call("-o", "out.csv", *arguments) == 2
    shown = capsys.readouterr().err
    assert len(shown.splitlines()) == 1
    for word in said:
        assert word in shown


def test_a_column_in_the_way_of_the_robot_is_a_warning(capsys):
    save_room(Room(OFFICE.room.walls, circles=np.array([[0.6, 0.0, 0.2], [*BESIDE, 0.2]])), "room.geojson")
    arguments = ["room.geojson", "--ring", "faw", "--path", DATA / "office-path.csv", "-o", "a.csv"]
    assert cli.main(["simulate", *map(str, arguments)]) == 0
    warnings = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning")]
    assert len(warnings) == 1
    assert "the robot overlaps the circle at (0.6, 0) in" in warnings[0]


PROBABLE = {
    "inside": ([[0.1, 0.0], [0.1, 0.0]], (0.0, 1e4), "the robot overlaps the person in"),
    "millimetres": ([[800.0, 0.0], [900.0, 0.0]], (0.0, 1e4), "out of range; give positions in metres"),
    "clock": ([BESIDE, BESIDE], (1.7e9, 1.7e9 + 9), "give stamps of the same clock"),
}


@pytest.mark.parametrize("name", PROBABLE)
def test_an_improbable_person_is_a_warning_and_strictly_an_error(name, capsys):
    positions, stamps, words = PROBABLE[name]
    save_walk("walk.csv", positions, stamps)
    assert call("-o", "out.csv", "--walker", "walk.csv", "--strict") == 2
    warning, error = capsys.readouterr().err.splitlines()
    assert warning.startswith("warning: walk.csv: ")
    assert words in warning
    assert "--strict" in error
    assert call("-o", "out.csv", "--walker", "walk.csv") == 0
