"""Invalid calls of the commands map, reference and evaluate: call, files to write first, words of the answer."""

import json
import math
from pathlib import Path

from support.commands import HEADER, RING

from jaxsonar.fileio.geojson import feature

MAP = "map log.csv --ring faw -o out.geojson"
REFERENCE = "reference rec -o out.geojson"
EVALUATE = "evaluate map.geojson office.geojson"
FAR = HEADER + "0,0,0,0,0,3,3,1.0\n1,1,{},0,0,3,3,1.0\n"
LOG = "map bad.csv --ring faw -o out.geojson"
INVALID_CALLS = {
    # logs
    "missing log": ("map no.csv --ring faw -o out.geojson", {}, ["no.csv", "No such file"]),
    "empty log": (LOG, {"bad.csv": ""}, ["bad.csv", "empty file"]),
    "log that is none": (LOG, {"bad.csv": "some\ntext\n"}, ["bad.csv", "text", "some", "allowed"]),
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


def lines_geojson(*coordinates, form="LineString"):
    return json.dumps({"type": "FeatureCollection", "features": [feature(form, ends) for ends in coordinates]})


GOOD = [[0, 0], [1, 0]]

INVALID_MAPS = {
    "nothing": ("", "no JSON"),
    "half of it": ('{"type": "FeatureCollection", "features": [', "no JSON"),
    "a list": ("[]", "no FeatureCollection came"),
    "no features": ('{"type": "FeatureCollection"}', "no FeatureCollection came"),
    "a Feature alone": (json.dumps(feature("LineString", GOOD)), "no FeatureCollection came"),
    "NaN": (lines_geojson(GOOD, [[math.nan, 0], [1, 0]]), "feature 1: position [nan, 0]"),
    "too large to be a number": (lines_geojson(GOOD).replace("[1, 0]", "[1e999, 0]"), "feature 0: position [inf, 0]"),
    "huge": (lines_geojson(GOOD, GOOD, [[0, 0], [1e300, 0]]), "feature 2: position [1e+300, 0]"),
    "a huge integer": (lines_geojson([[0, 0], [10**400, 0]]), "feature 0: position [1000"),
    "text": (lines_geojson([["0", 0], [1, 0]]), "feature 0: position ['0', 0]"),
    "null": (lines_geojson([[None, 0], [1, 0]]), "feature 0: position [None, 0]"),
    "truth": (lines_geojson([[True, 0], [1, 0]]), "feature 0: position [True, 0]"),
    "one coordinate": (lines_geojson([[0], [1]]), "feature 0: position [0]"),
    "no lists": (lines_geojson(7), "feature 0: 7 instead of a list"),
    "a circle": (lines_geojson([0, 0], form="Circle"), "feature 0: geometry 'Circle'"),
    "nested too deeply": ("[" * 100_000, "no JSON"),
}
