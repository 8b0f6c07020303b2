"""``jaxsonar calibrate``: the ring file is as documented; an error is one line and writes nothing."""

import shlex
import shutil
import tomllib

import numpy as np
import pytest
from support.commands import HEADER, OFFICE, PATH, RING, call, contents
from support.recordings import recorded

from jaxsonar import load_ring

# With one free parameter there is no autofocus, and the shapes are those of test_calibrate.
CALIBRATE = "calibrate log.csv --ring faw --free speed"
FASTER = 1.01


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """A log of the office in warmer air, and the ring calibrated from it."""
    folder = tmp_path_factory.mktemp("office")
    (folder / "warm.toml").write_text(RING.replace("name = 'r'", f"name = 'r'\nspeed_of_sound = {FASTER * 343.2}"))
    simulated = ["simulate", OFFICE, "--ring", folder / "warm.toml", "--path", PATH, "--sigma", "0.001"]
    assert call(*simulated, "-o", folder / "log.csv") == 0
    arguments = ["calibrate", folder / "log.csv", "--ring", "faw", "--free", "speed", "-o", folder / "ring.toml"]
    assert call(*arguments, "--figure", folder / "figure.svg") == 0
    return folder


@pytest.fixture
def here(office, tmp_path, monkeypatch):
    for name in ("log.csv", "ring.toml"):
        shutil.copy(office / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_the_written_ring_has_its_calibration(office):
    ring = load_ring(office / "ring.toml")
    assert float(ring.speed_of_sound) == pytest.approx(FASTER * 343.2, rel=1e-3)
    np.testing.assert_allclose(ring.position, load_ring("faw").position, atol=1e-12)
    table = tomllib.loads((office / "ring.toml").read_text())["calibration"]
    assert table["estimated"] == ["speed"]
    assert table["scans"] == 17
    assert set(table["held"]) >= {"offset", "position", "radius", "heading"}
    assert table["residual_rms_after"] < table["residual_rms_before"]


@pytest.mark.slow
def test_the_figure_is_drawn(office):
    text = (office / "figure.svg").read_text()
    assert text.startswith("<?xml")
    assert "<svg" in text


@pytest.mark.slow
def test_a_dash_writes_the_ring_to_standard_output(here, capsys):
    before = contents(here)
    assert call(*CALIBRATE.split(), "-o", "-") == 0
    came = capsys.readouterr()
    assert tomllib.loads(came.out) == tomllib.loads((here / "ring.toml").read_text())
    assert "17 scans" in came.err
    assert "speed of sound" in came.err
    assert contents(here) == before


NO_POSES = HEADER + "".join(f"{k},{k},,,,3,3,1.0\n" for k in range(20))
HALF = RING.replace("name = 'r'", "name = 'r'\nspeed_of_sound = 171.6")
OUT = f"{CALIBRATE} -o out.toml"
MISTAKES = {
    "no log": ("calibrate --ring faw -o out.toml", {}, ["LOG"]),
    "no ring": ("calibrate log.csv -o out.toml", {}, ["--ring"]),
    "no output": (CALIBRATE, {}, ["--output"]),
    "unknown option": (f"{OUT} --scan 3", {}, ["--scan"]),
    "abbreviated option": (f"{OUT} --temp 20", {}, ["--temp"]),
    "missing log": ("calibrate no.csv --ring faw -o out.toml", {}, ["no.csv", "No such file"]),
    "one of two logs missing": ("calibrate log.csv no.csv --ring faw -o out.toml", {}, ["no.csv", "No such file"]),
    "no such ring": ("calibrate log.csv --ring fawn -o out.toml", {}, ["fawn", "faw"]),
    "sensor beyond the ring": ("calibrate log.csv --ring corridor8 -o out.toml", {}, ["log.csv", "tx", "0 to 7"]),
    "unknown freedom": (f"{OUT} --free speed,color", {}, ["color", "offset", "heading"]),
    "no freedom": (f"{OUT} --free ''", {}, ["free", "offset"]),
    "unknown poses": (f"{OUT} --poses guess", {}, ["guess", "trust", "estimate"]),
    "temperature of the moon": (f"{OUT} --temperature 120", {}, ["--temperature", "120", "85"]),
    "temperature that is no number": (f"{OUT} --temperature warm", {}, ["--temperature", "warm"]),
    "odometry of 0": (f"{OUT} --odometry 0", {}, ["--odometry", "0"]),
    "odometry of trusted poses": (f"{OUT} --odometry 0.05", {}, ["odometry 0.05", "trust", "estimate"]),
    "sigma of 0": (f"{OUT} --sigma 0", {}, ["--sigma", "0"]),
    "sigma without end": (f"{OUT} --sigma inf", {}, ["--sigma", "inf"]),
    "window of nothing": (f"{OUT} --window 0", {}, ["--window", "0"]),
    "ring with half the speed of sound": (
        "calibrate log.csv --ring half.toml -o out.toml",
        {"half.toml": HALF},
        ["log.csv", "speed_of_sound 171.6", "290 to 380"],
    ),
    "log without poses": (
        "calibrate bad.csv --ring faw --free speed -o out.toml",
        {"bad.csv": NO_POSES},
        ["bad.csv", "0 of 20 scans", "3 or more"],
    ),
    "log without walls": (
        "calibrate bad.csv --ring faw --free speed -o out.toml",
        {"bad.csv": HEADER + "".join(f"{k},{k},0,0,0,3,3,{0.3 + 0.08 * k}\n" for k in range(20))},
        ["bad.csv", "allowed"],
    ),
    "log that is none": (
        "calibrate bad.csv --ring faw -o out.toml",
        {"bad.csv": "some\ntext\n"},
        ["bad.csv", "this is a text"],
    ),
    "laser that is not there": ("calibrate log.csv --ring faw -o out.toml --laser no", {}, ["--laser no", "no"]),
    "laser of two logs": ("calibrate log.csv log.csv --ring faw -o out.toml --laser no", {}, ["--laser", "2 logs"]),
    "laser with a window": (
        "calibrate log.csv --ring faw -o out.toml --laser no --window 2",
        {},
        ["--laser", "--window", "allowed"],
    ),
    "laser with odometry": (
        "calibrate log.csv --ring faw -o out.toml --laser no --odometry 0.02",
        {},
        ["--laser", "--odometry", "allowed"],
    ),
    "laser with estimated poses": (
        "calibrate log.csv --ring faw -o out.toml --laser no --poses estimate",
        {},
        ["--laser", "--poses estimate", "allowed"],
    ),
    "odometry of a ring with few sensors": (
        "calibrate few.csv --ring corridor8 -o out.toml --poses estimate --odometry 0.05",
        {
            "few.csv": HEADER
            + "".join(f"{k},{k},{0.05 * k},0,0,{s},{s},{1 + 0.1 * s}\n" for k in range(40) for s in (0, 7))
        },
        ["few.csv", "odometry 0.05", "allowed is none"],
    ),
    "laser with other parameters": (f"{OUT} --laser no", {}, ["--laser", "--free", "allowed"]),
    "figure of unknown suffix": (f"{OUT} --figure a.gif", {}, ["--figure", "a.gif", ".svg"]),
    "figure into a missing folder": (f"{OUT} --figure no/a.svg", {}, ["no/a.svg", "folder"]),
    "ring into a missing folder": (f"{CALIBRATE} -o no/out.toml", {}, ["no/out.toml", "folder"]),
    "ring that is a folder": (f"{CALIBRATE} -o dir", {"dir": None}, ["dir", "directory"]),
    "ring over its log": (f"{CALIBRATE} -o log.csv", {}, ["log.csv", "another file"]),
    "ring over itself": ("calibrate log.csv --ring ring.toml -o ring.toml", {}, ["ring.toml", "another file"]),
}


@pytest.mark.slow
@pytest.mark.parametrize(("command", "files", "words"), MISTAKES.values(), ids=MISTAKES.keys())
def test_an_invalid_call_is_answered_in_one_line_and_writes_nothing(here, capsys, command, files, words):
    for name, text in files.items():
        (here / name).mkdir() if text is None else (here / name).write_text(text)
    before = contents(here)
    assert call(*shlex.split(command)) == 2
    came = capsys.readouterr()
    assert came.out == ""
    [line] = [one for one in came.err.splitlines() if not one.startswith("warning: ")]
    assert line.startswith("jaxsonar")
    for word in words:
        assert word in line
    assert contents(here) == before


@pytest.mark.slow
def test_a_recorded_run_is_calibrated_alone_and_with_its_laser(tmp_path, capsys, monkeypatch):
    folder = recorded("corridor8")
    monkeypatch.chdir(tmp_path)
    assert call("convert", folder, "log.csv", "--from", "corridor8") == 0
    common = ["calibrate", "log.csv", "--ring", "corridor8"]
    assert call(*common, "--poses", "estimate", "-o", "alone.toml", "--figure", "alone.svg") == 0
    came = capsys.readouterr().err
    for words in ("range scale", "held: mean offset: not determined", "walls heard, off axis"):
        assert words in came
    assert call(*common, "--laser", folder, "-o", "laser.toml", "--figure", "laser.svg") == 0
    assert "mean range offset" in capsys.readouterr().err
    alone, laser = (load_ring(tmp_path / name) for name in ("alone.toml", "laser.toml"))
    assert float(alone.speed_of_sound) == pytest.approx(float(laser.speed_of_sound), rel=0.01)
    assert np.mean(alone.range_offset) == pytest.approx(0, abs=1e-6)
    assert np.mean(laser.range_offset) > 0.02
    for name in ("alone.svg", "laser.svg"):
        assert (tmp_path / name).read_text().startswith("<?xml")
