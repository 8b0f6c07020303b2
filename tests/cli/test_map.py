"""Commands map, reference and evaluate: files are as documented, inputs stay unchanged, an error is one line."""

import csv
import json
import math
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.commands import HEADER, OFFICE, RING, SIMULATE, call, contents, interrupted_after, script
from support.recordings import recorded

from jaxsonar import load_log
from jaxsonar.detection import extract as local
from jaxsonar.evaluation import laser_map as reference
from jaxsonar.fileio.geojson import feature

NUMBERS = ("rho", "theta", "sigma_rho", "sigma_theta")
MAP = "map log.csv --ring faw -o out.geojson"
REFERENCE = "reference rec -o out.geojson"
EVALUATE = "evaluate map.geojson office.geojson"


def record(folder, scans=12):
    """Write a corridor8 recording of a laser that moves through a room of 4 m x 3 m (mm, tenths of a degree)."""
    folder.mkdir()
    bearing = np.radians(-90.4 + 0.5 * np.arange(361))
    beam = np.stack([np.cos(bearing), np.sin(bearing)], -1)
    lasers, poses = [], []
    for k in range(scans):
        x = 0.05 * k + 0.109
        with np.errstate(divide="ignore"):
            reach = np.min([np.abs((4 - x) / beam[:, 0]), np.abs(1.5 / beam[:, 1])], axis=0)
        ranges = np.where(np.isfinite(reach), np.round(1000 * reach), 81910).astype(int)
        lasers.append(f"{1000 + 200 * k} {' '.join(map(str, ranges))}\n")
        poses.append(f"{1000 + 200 * k} {50 * k} 0 0\n")
    (folder / "laser.txt").write_text("".join(lasers))
    (folder / "poses.txt").write_text("".join(poses))


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """A folder with the office's log, its map, the room itself and a laser's recording."""
    folder = tmp_path_factory.mktemp("office")
    assert call(*SIMULATE, "-o", folder / "log.csv") == 0
    assert call("map", folder / "log.csv", "--ring", "faw", "-o", folder / "map.geojson") == 0
    shutil.copy(OFFICE, folder / "office.geojson")
    record(folder / "rec")
    return folder


@pytest.fixture
def here(office, tmp_path, monkeypatch):
    shutil.copytree(office, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def strict(text):
    """Parse JSON without NaN and Infinity."""

    def refuse(constant):
        raise ValueError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


def features(path):
    document = strict(Path(path).read_bytes().decode("utf-8"))
    assert set(document) == {"type", "features"}
    assert document["type"] == "FeatureCollection"
    assert all(set(entry) == {"type", "properties", "geometry"} for entry in document["features"])
    return document["features"]


def segments(path):
    """The walls of a map, without its corners and edges."""
    return [entry for entry in features(path) if entry["geometry"]["type"] == "LineString"]


def assert_map_as_documented(path, scans):
    """FORMATS: segments with all their properties, whose rho and theta are those of their ends; corners and edges."""
    for point in features(path):
        if point["geometry"]["type"] == "Point":
            told = point["properties"]
            assert set(told) == {"kind", "cov", "echoes", "scans"}
            assert told["kind"] in ("corner", "edge")
            assert np.shape(point["geometry"]["coordinates"]) == (2,)
            assert np.linalg.eigvalsh(told["cov"]).min() > 0
            assert set(told["scans"]) <= set(scans)
    walls = segments(path)
    for wall in walls:
        told, line = wall["properties"], wall["geometry"]
        assert set(told) == {"kind", *NUMBERS, "echoes", "scans"}
        assert told["kind"] == "segment"
        assert line["type"] == "LineString"
        assert np.shape(line["coordinates"]) == (2, 2)
        assert told["rho"] >= 0
        assert -math.pi <= told["theta"] < math.pi
        normal = np.array([math.cos(told["theta"]), math.sin(told["theta"])])
        np.testing.assert_allclose(np.array(line["coordinates"]) @ normal, told["rho"], rtol=0, atol=1e-6)
        for name in ("sigma_rho", "sigma_theta"):
            assert told[name] > 0
        assert type(told["echoes"]) is int
        assert told["echoes"] > 0
        assert told["scans"]
        assert told["scans"] == sorted(set(told["scans"]))
        assert set(told["scans"]) <= set(scans)
    return walls


def edited(rows, **columns):
    """The rows of a log with some columns recomputed from the row."""
    out = [HEADER]
    for row in rows:
        row = {**row, **{name: change(row) for name, change in columns.items()}}
        out.append(",".join(str(row[name]) for name in HEADER.strip().split(",")) + "\n")
    return "".join(out)


def rows_of(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


# Results


@pytest.mark.slow
@pytest.mark.parametrize("merging", ["fused", "paper"])
def test_a_map_is_as_documented(here, merging):
    assert call(*MAP.split(), "--merging", merging) == 0
    walls = assert_map_as_documented("out.geojson", load_log("log.csv").scan.tolist())
    assert walls


@pytest.mark.slow
def test_the_map_of_the_office_matches_the_room(here, capsys):
    assert call(*EVALUATE.split(), "--json", "out.json") == 0
    table = capsys.readouterr().out
    assert "precision" in table
    assert "recall" in table
    found = strict(Path("out.json").read_text())
    assert found["segments"] == len(segments("map.geojson"))
    assert found["references"] == sum(  # a polygon or line of n positions is n - 1 walls
        len(line) - 1
        for entry in strict(Path("office.geojson").read_text())["features"]
        for line in {"LineString": lambda c: [c], "Polygon": lambda c: c}.get(entry["geometry"]["type"], lambda _: [])(
            entry["geometry"]["coordinates"]
        )
    )
    assert found["precision"] >= 0.8
    assert found["distance_rms_m"] < 0.02
    assert found["distance_max_m"] == max(abs(pair["distance_m"]) for pair in found["pairs"])
    assert call(*EVALUATE.split(), "--json", "-") == 0
    assert capsys.readouterr().out == Path("out.json").read_text()


@pytest.mark.slow
def test_a_map_matches_itself_and_gates_separate(here):
    assert call("evaluate", "map.geojson", "map.geojson", "--json", "same.json") == 0
    same = strict(Path("same.json").read_text())
    assert [same[name] for name in ("precision", "recall", "precision_length", "recall_length")] == pytest.approx(
        [1] * 4
    )
    assert same["distance_max_m"] == pytest.approx(0, abs=1e-9)
    assert call(*EVALUATE.split(), "--gate", "1e-6", "--gate-deg", "0.001", "--json", "tight.json") == 0
    tight = strict(Path("tight.json").read_text())
    assert tight["matched_length_m"] < 0.1
    assert tight["distance_max_m"] is None


@pytest.mark.slow
def test_a_map_to_standard_output_writes_no_other_file(here, capsys):
    before = contents(here)
    assert call("map", "log.csv", "--ring", "faw", "-o", "-", "--figure", "a.svg", "--grid", "g.yaml") == 0
    came = capsys.readouterr()
    assert came.out.encode() == Path("map.geojson").read_bytes()
    assert came.err.startswith("17 scans, ")
    assert len(came.err.splitlines()) == 1
    assert set(contents(here)) - set(before) == {Path("a.svg"), Path("g.yaml"), Path("g.pgm")}


@pytest.mark.slow
def test_written_settings_reproduce_the_map(here):
    assert call(*MAP.split(), "--settings", "map.settings.toml") == 0
    assert Path("out.geojson").read_bytes() == Path("map.geojson").read_bytes()
    assert Path("out.settings.toml").read_bytes() == Path("map.settings.toml").read_bytes()
    before = Path("map.geojson").read_bytes()  # also when input and output are the same
    assert call("map", "log.csv", "--ring", "faw", "-o", "map.geojson", "--settings", "map.settings.toml") == 0
    assert Path("map.geojson").read_bytes() == before


@pytest.mark.slow
def test_figure_grid_and_drawing_show_the_map(here):
    ezdxf = pytest.importorskip("ezdxf")
    assert call(*MAP.split(), "--figure", "A.PDF", "--grid", "g.YML", "--dxf", "D.DXF") == 0
    assert Path("out.geojson").read_bytes() == Path("map.geojson").read_bytes()
    assert Path("A.PDF").read_bytes().startswith(b"%PDF")
    assert 'image: "g.pgm"\n' in Path("g.YML").read_text()
    kind, size, depth, cells = Path("g.pgm").read_bytes().split(b"\n", 3)
    assert (kind, depth) == (b"P5", b"255")
    assert math.prod(map(int, size.split())) == len(cells)
    drawn = [[tuple(line.dxf.start)[:2], tuple(line.dxf.end)[:2]] for line in ezdxf.readfile("D.DXF").modelspace()]
    np.testing.assert_allclose(drawn, [wall["geometry"]["coordinates"] for wall in segments("map.geojson")], atol=1e-9)


@pytest.mark.slow
def test_parquet_and_csv_give_the_same_map(here):
    pytest.importorskip("pyarrow")
    assert call("convert", "log.csv", "log.parquet") == 0
    assert call(*MAP.replace("log.csv", "log.parquet").split()) == 0
    assert Path("out.geojson").read_bytes() == Path("map.geojson").read_bytes()


@pytest.mark.slow
def test_a_scan_without_a_pose_does_not_change_the_map(here, capsys):
    rows = [row for row in rows_of("log.csv") if int(row["scan"]) < 5]
    nowhere = {axis: lambda row, axis=axis: "" if row["scan"] == "2" else row[axis] for axis in ("x", "y", "theta")}
    Path("some.csv").write_text(edited(rows, **nowhere))
    Path("less.csv").write_text(edited([row for row in rows if row["scan"] != "2"]))
    for name in ("some", "less"):
        assert call("map", f"{name}.csv", "--ring", "faw", "-o", f"{name}.geojson") == 0
    assert Path("some.geojson").read_bytes() == Path("less.geojson").read_bytes()
    assert features("some.geojson")
    some, less = capsys.readouterr().err.splitlines()
    assert "1 scan without a pose" in some
    assert "without" not in less


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [HEADER, HEADER + "0,0,0,0,0,,,\n1,1,1,0,0,,,\n", HEADER + "0,,0,0,0,3,3,1.9\n", HEADER + "0,0,0,0,0,3,15,1\n"],
    ids=["no scan", "no echo", "one echo", "an echo that is not listened to"],
)
def test_logs_without_walls_are_valid(here, capsys, text):
    Path("log.csv").write_text(text)
    assert call(*MAP.split(), "--figure", "a.svg") == 0
    assert features("out.geojson") == []
    assert "0 walls" in capsys.readouterr().err.splitlines()[-1]
    assert call("evaluate", "out.geojson", "office.geojson", "--json", "-") == 0
    found = strict(capsys.readouterr().out)
    assert (found["segments"], found["precision"], found["recall"]) == (0, None, 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a$b_{$.csv", "日本.csv", "a & <b>.csv"])
def test_a_figure_of_a_log_of_any_name(here, name):
    Path("log.csv").rename(name)
    assert call("map", name, "--ring", "faw", "-o", "out.geojson", "--figure", "a.svg") == 0
    assert Path("a.svg").is_file()


@pytest.mark.slow
def test_a_reference_is_the_room_around_the_laser(here, capsys):
    Path("room.geojson").write_text(
        json.dumps(
            {
                "type": "FeatureCollection",
                "features": [feature("LineString", [[0, -1.5], [4, -1.5], [4, 1.5], [0, 1.5, 7.5]])],
            }
        )
    )
    assert call(*REFERENCE.split(), "--reach", 6, "--figure", "a.svg") == 0
    assert capsys.readouterr().err.startswith("12 scans, 3 walls, ")
    walls = features("out.geojson")
    assert [wall["properties"] for wall in walls] == [{"kind": "reference"}] * 3
    assert {wall["geometry"]["type"] for wall in walls} == {"LineString"}
    assert call("evaluate", "out.geojson", "room.geojson", "--json", "out.json") == 0
    found = strict(Path("out.json").read_text())
    assert (found["precision"], found["recall"]) == (1, 1)
    assert found["distance_max_m"] < 0.03
    capsys.readouterr()
    assert call("reference", "rec/laser.txt", "--reach", 6, "-o", "-") == 0
    assert capsys.readouterr().out.encode() == Path("out.geojson").read_bytes()


@pytest.mark.slow
def test_one_scan_of_the_laser_is_a_polygonal_model(here, capsys):
    assert call(*REFERENCE.split(), "--scan", "11", "--figure", "a.png") == 0
    kinds = {(entry["geometry"]["type"], entry["properties"]["kind"]) for entry in features("out.geojson")}
    assert ("LineString", "reference") in kinds
    assert kinds <= {("LineString", "reference"), ("LineString", "pseudo"), ("Point", "intersection")}
    assert Path("a.png").read_bytes().startswith(b"\x89PNG")


def test_a_recording_through_all_three_commands(tmp_path, monkeypatch, capsys):
    folder = recorded("corridor8")
    monkeypatch.chdir(tmp_path)
    Path("rec").mkdir()
    for name in ("laser.txt", "measurement.txt", "poses.txt"):  # only the first corridor
        Path("rec", name).write_text("".join(Path(folder, name).read_text().splitlines(keepends=True)[:210]))
    assert call("convert", "rec", "log.csv", "--from", "corridor8") == 0
    extras = ["--figure", "a.png", "--grid", "g.yaml", "--laser", "rec"]
    assert call("map", "log.csv", "--ring", "corridor8", "--window", 1.5, "-o", "map.geojson", *extras) == 0
    assert all(Path(name).stat().st_size > 100 for name in ("a.png", "g.yaml", "g.pgm", "map.settings.toml"))
    walls = assert_map_as_documented("map.geojson", load_log("log.csv").scan.tolist())
    assert len(walls) >= 3
    assert call("reference", "rec", "-o", "ref.geojson") == 0
    capsys.readouterr()
    assert call("evaluate", "map.geojson", "ref.geojson", "--json", "-") == 0
    found = strict(capsys.readouterr().out)
    assert found["precision_length"] > 0.7
    assert found["recall_length"] > 0.3
    assert found["distance_rms_m"] < 0.08


# Errors: one line with what came and what is allowed, and nothing is written

FAR = HEADER + "0,0,0,0,0,3,3,1.0\n1,1,{},0,0,3,3,1.0\n"
LOG = "map bad.csv --ring faw -o out.geojson"
MISTAKES = {
    # logs
    "missing log": ("map no.csv --ring faw -o out.geojson", {}, ["no.csv", "No such file"]),
    "empty log": (LOG, {"bad.csv": ""}, ["bad.csv", "row 1", "header"]),
    "log that is none": (LOG, {"bad.csv": "some\ntext\n"}, ["bad.csv", "row 1", "some", "allowed"]),
    "log without poses": (
        LOG,
        {"bad.csv": HEADER + "0,0,,,,3,3,1\n1,1,,,,,,\n"},
        ["bad.csv", "2 scans", "x, y, theta"],
    ),
    "half a pose": (LOG, {"bad.csv": HEADER + "0,0,1,,0,3,3,1\n"}, ["bad.csv", "row 2", "column y", "all three"]),
    "pose that is no number": (
        LOG,
        {"bad.csv": HEADER + "0,0,nan,0,0,3,3,1\n"},
        ["bad.csv", "row 2", "column x", "nan"],
    ),
    "range that is no number": (LOG, {"bad.csv": HEADER + "0,0,0,0,0,3,3,nan\n"}, ["row 2", "column range", "nan"]),
    "a scan twice": (
        LOG,
        {"bad.csv": HEADER + "0,0,0,0,0,3,3,1\n1,1,0,0,0,3,3,1\n0,0,0,0,0,4,4,1\n"},
        ["bad.csv", "row 4", "column scan", "no earlier scan"],
    ),
    "two poses of a scan": (
        LOG,
        {"bad.csv": HEADER + "0,0,0,0,0,3,3,1\n0,0,2,0,0,4,4,1\n"},
        ["row 3", "column x", "same"],
    ),
    "sensor beyond the ring": (
        LOG,
        {"bad.csv": HEADER + "7,0,0,0,0,24,3,1\n"},
        ["bad.csv", "scan 7", "tx 24", "0 to 23"],
    ),
    "sensor below 0": (LOG, {"bad.csv": HEADER + "7,0,0,0,0,3,-1,1\n"}, ["bad.csv", "row 2", "column rx", "-1"]),
    "a pose out of this world": (LOG, {"bad.csv": FAR.format("1e30")}, ["bad.csv", "allowed"]),
    "a pose far off": (LOG, {"bad.csv": FAR.format("-1e15")}, ["bad.csv", "allowed"]),
    # options
    "window of nothing": (f"{MAP} --window 0", {}, ["--window", "'0'", "from"]),
    "window that is no number": (f"{MAP} --window nan", {}, ["--window", "'nan'", "from"]),
    "window below 0": (f"{MAP} --window -1", {}, ["--window", "'-1'", "from"]),
    "window without end": (f"{MAP} --window 1e9", {}, ["--window", "'1e9'", "from"]),
    "window too short": (f"{MAP} --window 0.005", {}, ["window", "0.005", "0.01"]),
    "window too long": (f"{MAP} --window 500", {}, ["window", "500", "100"]),
    "window beyond the settings": (f"{MAP} --window 90 --settings map.settings.toml", {}, ["rho_cells", "allowed"]),
    "unknown merging": (f"{MAP} --merging best", {}, ["--merging", "best", "fused", "paper"]),
    "unknown method": (f"{MAP} --method guess", {}, ["--method", "guess", "hough"]),
    "settings of a wrong key": (
        f"{MAP} --settings s.toml",
        {"s.toml": "cells = 3"},
        ["s.toml", "cells", "theta_cells"],
    ),
    "settings of no name": (f"{MAP} --settings ''", {}, ["--settings"]),
    "scan of a map": (f"{MAP} --scan 3", {}, ["--scan"]),
    "laser alone": (f"{MAP} --laser rec", {}, ["--laser", "--figure"]),
    "laser that is missing": (f"{MAP} --figure a.svg --laser no", {}, ["no", "No such file", "recording"]),
    "laser that is an empty folder": (
        f"{MAP} --figure a.svg --laser dir",
        {"dir": None},
        ["dir/laser.txt", "recording"],
    ),
    "laser that is a log": (f"{MAP} --figure a.svg --laser log.csv", {}, ["log.csv", "row 1", "362"]),
    "laser of no name": (f"{MAP} --figure a.svg --laser ''", {}, ["--laser"]),
    "figure of unknown suffix": (f"{MAP} --figure a.gif", {}, ["--figure", "a.gif", ".svg"]),
    "figure on standard output": (f"{MAP} --figure -", {}, ["--figure", "'-'", ".svg"]),
    "grid of unknown suffix": (f"{MAP} --grid a.pgm", {}, ["--grid", "a.pgm", ".yaml", ".yml"]),
    "drawing of unknown suffix": (f"{MAP} --dxf a.dwg", {}, ["--dxf", "a.dwg", ".dxf"]),
    "grid of no scan": (f"{LOG} --grid a.yaml", {"bad.csv": HEADER}, ["a.yaml", "no scan", "needed"]),
    "grid of half the country": (f"{LOG} --grid a.yaml", {"bad.csv": FAR.format("1e8")}, ["grid", "allowed"]),
    # outputs that cannot be written
    "map into a missing folder": ("map log.csv --ring faw -o no/out.geojson", {}, ["no/out.geojson", "folder"]),
    "figure into a missing folder": (f"{MAP} --figure no/a.svg", {}, ["no/a.svg", "folder"]),
    "grid into a missing folder": (f"{MAP} --grid no/a.yaml", {}, ["no/a.yaml", "folder"]),
    "drawing into a missing folder": (f"{MAP} --dxf no/a.dxf", {}, ["no/a.dxf", "folder"]),
    "map that is a folder": ("map log.csv --ring faw -o dir", {"dir": None}, ["dir", "directory"]),
    "figure that is a folder": (f"{MAP} --figure d.svg", {"d.svg": None}, ["d.svg", "directory"]),
    "grid that is a folder": (f"{MAP} --grid d.yaml", {"d.yaml": None}, ["d.yaml", "directory"]),
    "grid whose image is a folder": (f"{MAP} --grid d.yaml", {"d.pgm": None}, ["d.pgm", "directory"]),
    "drawing that is a folder": (f"{MAP} --dxf d.dxf", {"d.dxf": None}, ["d.dxf", "directory"]),
    "settings beside that are a folder": (MAP, {"out.settings.toml": None}, ["out.settings.toml", "directory"]),
    "grid where nothing can be written": (f"{MAP} --grid /proc/a.yaml", {}, ["/proc/a.", "cannot write"]),
    "figure where nothing can be written": (f"{MAP} --figure /proc/a.svg", {}, ["/proc/a.svg", "cannot write"]),
    # outputs over inputs; a Path is a link to it
    "map over the log": ("map log.csv --ring faw -o ./log.csv", {}, ["log.csv", "input"]),
    "map over the log by a link": (MAP, {"out.geojson": Path("log.csv")}, ["out.geojson", "input"]),
    "map over the settings": (
        "map log.csv --ring faw --settings s.toml -o s.toml",
        {"s.toml": ""},
        ["s.toml", "input"],
    ),
    "figure over the log by a link": (f"{MAP} --figure l.svg", {"l.svg": Path("log.csv")}, ["l.svg", "input"]),
    "grid over the log by a link": (f"{MAP} --grid l.yml", {"l.yml": Path("log.csv")}, ["l.yml", "input"]),
    "image over the log by a link": (f"{MAP} --grid l.yml", {"l.pgm": Path("log.csv")}, ["l.pgm", "input"]),
    "drawing over the log by a link": (f"{MAP} --dxf l.dxf", {"l.dxf": Path("log.csv")}, ["l.dxf", "input"]),
    "grid over the settings": (f"{MAP} --settings s.yml --grid s.yml", {"s.yml": ""}, ["s.yml", "input"]),
    "drawing over the settings": (f"{MAP} --settings s.dxf --dxf s.dxf", {"s.dxf": ""}, ["s.dxf", "input"]),
    "settings beside over the ring": (
        "map log.csv --ring out.settings.toml -o out.geojson",
        {"out.settings.toml": RING},
        ["out.settings.toml", "input"],
    ),
    "map over the laser": (
        "map log.csv --ring faw -o rec/laser.txt --figure a.svg --laser rec",
        {},
        ["rec/laser.txt", "input"],
    ),
    "figure over the poses of the laser": (
        f"{MAP} --figure l.svg --laser rec",
        {"l.svg": Path("rec/poses.txt")},
        ["l.svg", "input"],
    ),
    # outputs over each other
    "figure over the map": ("map log.csv --ring faw -o a.svg --figure ./a.svg", {}, ["a.svg"]),
    "grid over the map": ("map log.csv --ring faw -o a.yaml --grid a.yaml", {}, ["a.yaml"]),
    "image over the map": ("map log.csv --ring faw -o a.pgm --grid a.yaml", {}, ["a.pgm"]),
    "drawing over the map": ("map log.csv --ring faw -o a.dxf --dxf a.dxf", {}, ["a.dxf"]),
    "drawing over the figure by links": (
        f"{MAP} --figure a.svg --dxf a.dxf",
        {"file": "", "a.svg": Path("file"), "a.dxf": Path("file")},
        ["a."],
    ),
    # references
    "missing recording": ("reference no -o out.geojson", {}, ["no", "No such file", "recording"]),
    "recording that is an empty folder": (
        "reference dir -o out.geojson",
        {"dir": None},
        ["dir/laser.txt", "No such file"],
    ),
    "recording that is a log": ("reference log.csv -o out.geojson", {}, ["log.csv", "row 1", "362"]),
    "recording without poses": (REFERENCE, {"rec/poses.txt": ""}, ["rec/poses.txt", "0 rows", "12"]),
    "recording with a pose out of this world": (
        "reference rec2 -o out.geojson",
        {"rec2": None, "rec2/laser.txt": "1" + " 1000" * 361, "rec2/poses.txt": "1 1e30 0 0"},
        ["rec2", "allowed"],
    ),
    "recording of an unknown format": (f"{REFERENCE} --from scitos24", {}, ["--from", "scitos24", "corridor8"]),
    "scan beyond the recording": (f"{REFERENCE} --scan 12", {}, ["--scan 12", "rec", "0 to 11"]),
    "scan below 0": (f"{REFERENCE} --scan -1", {}, ["--scan", "-1", "from 0"]),
    "scan that is not whole": (f"{REFERENCE} --scan 1.5", {}, ["--scan", "1.5", "whole number"]),
    "reach of nothing": (f"{REFERENCE} --reach 0", {}, ["--reach", "'0'", "0.1 to 100"]),
    "reach that is no number": (f"{REFERENCE} --reach nan", {}, ["--reach", "'nan'", "0.1 to 100"]),
    "reference nowhere": ("reference rec", {}, ["--output"]),
    "reference into a missing folder": ("reference rec -o no/out.geojson", {}, ["no/out.geojson", "folder"]),
    "reference that is a folder": ("reference rec -o rec", {}, ["rec", "directory"]),
    "figure of a reference that is a folder": (f"{REFERENCE} --figure d.svg", {"d.svg": None}, ["d.svg", "directory"]),
    "figure of a reference of unknown suffix": (f"{REFERENCE} --figure a.gif", {}, ["a.gif", ".svg"]),
    "reference over the laser": ("reference rec -o rec/laser.txt", {}, ["rec/laser.txt", "input"]),
    "reference over the poses": ("reference rec/laser.txt -o rec/../rec/poses.txt", {}, ["poses.txt", "input"]),
    "reference over the laser by a link": (REFERENCE, {"out.geojson": Path("rec/laser.txt")}, ["out.geojson", "input"]),
    "figure over the laser by a link": (
        f"{REFERENCE} --figure l.svg",
        {"l.svg": Path("rec/laser.txt")},
        ["l.svg", "input"],
    ),
    "figure over the reference": ("reference rec -o a.svg --figure a.svg", {}, ["a.svg"]),
    # evaluations
    "evaluation of a missing map": ("evaluate no.geojson office.geojson", {}, ["no.geojson", "No such file"]),
    "evaluation against nothing": ("evaluate map.geojson", {}, ["REFERENCE"]),
    "evaluation against a folder": ("evaluate map.geojson rec", {}, ["rec", "directory"]),
    "evaluation against a log": ("evaluate map.geojson log.csv", {}, ["log.csv", "JSON", "FeatureCollection"]),
    "gate of nothing": (f"{EVALUATE} --gate 0", {}, ["--gate", "'0'", "from"]),
    "gate that is no number": (f"{EVALUATE} --gate nan", {}, ["--gate", "'nan'", "from"]),
    "gate beyond a right angle": (f"{EVALUATE} --gate-deg 91", {}, ["--gate-deg", "'91'", "90"]),
    "figures over the map": (f"{EVALUATE} --json ./map.geojson", {}, ["map.geojson", "input"]),
    "figures over the reference by a link": (f"{EVALUATE} --json l", {"l": Path("office.geojson")}, ["l:", "input"]),
    "figures into a missing folder": (f"{EVALUATE} --json no/out.json", {}, ["no/out.json", "folder"]),
    "figures that are a folder": (f"{EVALUATE} --json rec", {}, ["rec", "directory"]),
    "figures of no name": (f"{EVALUATE} --json ''", {}, ["--json"]),
}


def mistaken(here, capsys, line, files):
    """The one line that answers an invalid call, which changes no file."""
    for name, text in files.items():
        if isinstance(text, Path):
            Path(name).symlink_to(os.path.relpath(text, Path(name).parent))
        elif text is None:
            Path(name).mkdir()
        else:
            Path(name).write_text(text)
    before = contents(here)
    assert call(*shlex.split(line)) == 2
    came = capsys.readouterr()
    assert came.out == ""
    assert len(came.err.splitlines()) == 1, came.err
    assert came.err.startswith("jaxsonar")
    assert came.err.endswith("\n")
    assert contents(here) == before
    return came.err


@pytest.mark.slow
@pytest.mark.parametrize(("line", "files", "said"), list(MISTAKES.values()), ids=list(MISTAKES))
def test_an_invalid_call_is_answered_in_one_line_and_changes_nothing(here, capsys, line, files, said):
    if "--dxf" in line and ".dwg" not in line:
        pytest.importorskip("ezdxf")
    if "/proc/" in line and not Path("/proc").is_dir():
        pytest.skip("no folder here in which nobody can write")
    err = mistaken(here, capsys, line, files)
    for words in said:
        assert words in err


@pytest.mark.slow
@pytest.mark.parametrize("option", ["--figure l.svg", "--grid l.yaml", "--json l.json"])
def test_the_option_that_would_overwrite_an_input_is_named(here, capsys, option):
    name = option.split()[1]
    line = f"{EVALUATE} {option}" if "json" in option else f"{MAP} {option}"
    err = mistaken(here, capsys, line, {name: Path("map.geojson" if "json" in option else "log.csv")})
    assert name in err
    assert "-o" not in err


def lines(*coordinates, form="LineString"):
    return json.dumps({"type": "FeatureCollection", "features": [feature(form, ends) for ends in coordinates]})


GOOD = [[0, 0], [1, 0]]
NO_MAPS = {
    "nothing": ("", "no JSON"),
    "half of it": ('{"type": "FeatureCollection", "features": [', "no JSON"),
    "a list": ("[]", "no FeatureCollection came"),
    "no features": ('{"type": "FeatureCollection"}', "no FeatureCollection came"),
    "a Feature alone": (json.dumps(feature("LineString", GOOD)), "no FeatureCollection came"),
    "NaN": (lines(GOOD, [[math.nan, 0], [1, 0]]), "feature 1: position [nan, 0]"),
    "too large to be a number": (lines(GOOD).replace("[1, 0]", "[1e999, 0]"), "feature 0: position [inf, 0]"),
    "huge": (lines(GOOD, GOOD, [[0, 0], [1e300, 0]]), "feature 2: position [1e+300, 0]"),
    "a huge integer": (lines([[0, 0], [10**400, 0]]), "feature 0: position [1000"),
    "text": (lines([["0", 0], [1, 0]]), "feature 0: position ['0', 0]"),
    "null": (lines([[None, 0], [1, 0]]), "feature 0: position [None, 0]"),
    "truth": (lines([[True, 0], [1, 0]]), "feature 0: position [True, 0]"),
    "one coordinate": (lines([[0], [1]]), "feature 0: position [0]"),
    "no lists": (lines(7), "feature 0: 7 instead of a list"),
    "a circle": (lines([0, 0], form="Circle"), "feature 0: geometry 'Circle'"),
    "nested too deeply": ("[" * 100_000, "no JSON"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("text", "said"), list(NO_MAPS.values()), ids=list(NO_MAPS))
@pytest.mark.parametrize("place", ["evaluate bad.json office.geojson", "evaluate map.geojson bad.json"])
def test_an_invalid_map_is_named(here, capsys, place, text, said):
    err = mistaken(here, capsys, f"{place} --json out.json", {"bad.json": text, "out.json": "before"})
    assert f"bad.json: {said}" in err
    assert "allowed" in err


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [lines(), lines([[0, 0, 5], [1, 0, 5]]), lines([[0, 0], [0, 0]]), lines([[0, 0], [9e11, 1e-300]])],
    ids=["no feature", "three coordinates", "no length", "very long"],
)
def test_unusual_maps_are_valid(here, capsys, text):
    Path("odd.json").write_text(text)
    assert call("evaluate", "odd.json", "office.geojson", "--json", "-") == 0
    assert call("evaluate", "map.geojson", "odd.json", "--json", "out.json") == 0
    came = capsys.readouterr()
    strict(came.out[: came.out.index("\n}\n") + 3])
    assert came.err == ""
    assert strict(Path("out.json").read_text())["segments"] > 0


@pytest.mark.slow
def test_only_a_drawing_needs_its_extra(here, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ezdxf", None)
    err = mistaken(here, capsys, f"{MAP} --dxf a.dxf", {})
    assert "a.dxf" in err
    assert "pip install 'jaxsonar[cad]'" in err
    assert call(*MAP.split()) == 0


# Early ends


@pytest.mark.slow
def test_ctrl_c_leaves_no_partial_result(here, capsys, monkeypatch, faw_ring):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    models = list(local.local_models(faw_ring, load_log("log.csv")[:2]))
    monkeypatch.setattr(local, "local_models", interrupted_after(models))
    monkeypatch.setattr(reference, "reference_map", stopped)
    before = contents(here)
    assert call(*MAP.split(), "--figure", "a.svg", "--grid", "a.yaml") == 1
    assert call(*REFERENCE.split(), "--figure", "a.svg") == 1
    came = capsys.readouterr()
    assert came.out == ""
    assert came.err == "jaxsonar map: interrupted\njaxsonar reference: interrupted\n"
    assert contents(here) == before


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    ["map log.csv --ring faw -o -", "reference rec --scan 0 -o -", EVALUATE, f"{EVALUATE} --json -"],
    ids=["map", "reference", "table", "json"],
)
def test_a_closed_pipe_is_not_an_error(here, capsys, monkeypatch, line):
    read, write = os.pipe()
    os.close(read)
    before = contents(here)
    with open(write, "w") as gone:
        monkeypatch.setattr(sys, "stdout", gone)
        assert call(*line.split()) == 1
    assert "Error" not in capsys.readouterr().err
    assert contents(here) == before


@pytest.mark.slow
def test_the_installed_command_prints_the_same(here, capsys):
    done = script(*EVALUATE.split(), "--json", "-")
    assert (done.returncode, done.stderr) == (0, "")
    assert call(*EVALUATE.split(), "--json", "-") == 0
    assert done.stdout == capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("extra", ["", " --json -"], ids=["table", "json"])
def test_a_full_disk_behind_standard_output_is_one_line(here, extra):
    if not Path("/dev/full").exists():
        pytest.skip("no device here that is always full")
    command = [str(Path(sys.executable).parent / "jaxsonar"), *f"{EVALUATE}{extra}".split()]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60)
    assert done.returncode in (1, 2)
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert "No space left" in done.stderr


@pytest.mark.slow
def test_results_to_files_need_no_standard_output(here, monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)  # as Python starts under `>&-`
    assert call(*REFERENCE.split(), "--scan", "0") == 0
    assert features("out.geojson")
