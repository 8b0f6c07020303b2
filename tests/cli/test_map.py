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
from support.commands import HEADER, OFFICE, SIMULATE, call, contents, interrupted_after, script
from support.invalid_map_calls import EVALUATE, INVALID_CALLS, INVALID_MAPS, MAP, REFERENCE, lines_geojson
from support.recordings import recorded, write_corridor8_laser

from jaxsonar import load_log
from jaxsonar.detection import extract as local
from jaxsonar.evaluation import laser_reference_map as reference
from jaxsonar.fileio.geojson import feature, write_features

NUMBERS = ("rho", "theta", "sigma_rho", "sigma_theta")


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """A folder with the office's log, its map, the room itself and a laser's recording."""
    folder = tmp_path_factory.mktemp("office")
    assert call(*SIMULATE, "-o", folder / "log.csv") == 0
    assert call("map", folder / "log.csv", "--ring", "faw", "-o", folder / "map.geojson") == 0
    shutil.copy(OFFICE, folder / "office.geojson")
    write_corridor8_laser(folder / "rec")
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
            assert set(told) - {"radius", "probability"} == {"kind", "cov", "echoes", "scans"}
            assert told["kind"] in ("corner", "edge", "circle", "undecided")
            assert ("radius" in told) == (told["kind"] == "circle")
            assert sum(told.get("probability", {"any": 1}).values()) == pytest.approx(1, abs=1e-6)
            assert np.shape(point["geometry"]["coordinates"]) == (2,)
            assert np.shape(told["cov"]) == ((3, 3) if told["kind"] == "circle" else (2, 2))
            assert np.linalg.eigvalsh(told["cov"]).min() > 0
            assert set(told["scans"]) <= set(scans)
    walls = segments(path)
    for wall in walls:
        told, line = wall["properties"], wall["geometry"]
        assert set(told) - {"ends"} == {"kind", *NUMBERS, "echoes", "scans"}
        assert told["kind"] == "segment"
        assert line["type"] == "LineString"
        assert np.shape(line["coordinates"]) == (2, 2)
        assert told["rho"] >= 0
        assert -math.pi <= told["theta"] < math.pi
        normal = np.array([math.cos(told["theta"]), math.sin(told["theta"])])
        np.testing.assert_allclose(np.array(line["coordinates"]) @ normal, told["rho"], rtol=0, atol=1e-6)
        for name in ("sigma_rho", "sigma_theta"):
            assert told[name] is None or told[name] > 0
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
    long = [pair["distance_m"] for pair in found["pairs"] if pair["overlap_m"] > 0.3]
    assert np.sqrt(np.mean(np.square(long))) < 0.01
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
def test_a_log_without_walls_is_valid(here, capsys):
    Path("log.csv").write_text(HEADER + "0,,0,0,0,3,3,1.9\n")
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


@pytest.mark.slow
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


@pytest.fixture(scope="module")
def corridor(tmp_path_factory):
    """A log of a ring with eight narrow sonars that drives along a corridor."""
    folder = tmp_path_factory.mktemp("corridor")
    write_features([feature("LineString", [[-1, y], [6, y]]) for y in (-0.9, 1.0)], folder / "room.geojson")
    rows = [f"{x:.2f},{0.05 * math.sin(x):.4f},0" for x in np.arange(0, 4, 0.08)]
    (folder / "path.csv").write_text("\n".join(["x,y,theta", *rows]) + "\n")
    simulated = ["simulate", folder / "room.geojson", "--ring", "corridor8", "--path", folder / "path.csv"]
    assert call(*simulated, "--sigma", 0.005, "--seed", 3, "-o", folder / "log.csv") == 0
    return folder / "log.csv"


@pytest.mark.slow
def test_windows_are_chosen_if_single_scans_determine_no_lines(corridor, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert call("map", corridor, "--ring", "corridor8", "-o", "chosen.geojson") == 0
    assert "--window 1.5 is used" in capsys.readouterr().err
    assert call("map", corridor, "--ring", "corridor8", "--window", 1.5, "-o", "given.geojson") == 0
    assert "is used" not in capsys.readouterr().err
    assert Path("chosen.geojson").read_bytes() == Path("given.geojson").read_bytes()
    assert Path("chosen.settings.toml").read_bytes() == Path("given.settings.toml").read_bytes()
    assert len(segments("chosen.geojson")) == 2
    # The settings of the run give the same map again.
    again = ["--settings", "chosen.settings.toml", "-o", "again.geojson"]
    assert call("map", corridor, "--ring", "corridor8", *again) == 0
    assert Path("again.geojson").read_bytes() == Path("given.geojson").read_bytes()


@pytest.mark.slow
def test_sigma_applies_to_windows(corridor, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for sigma in (0.005, 0.03):
        options = ["--window", 1.5, "--sigma", sigma, "-o", f"{sigma}.geojson"]
        assert call("map", corridor, "--ring", "corridor8", *options) == 0
        assert len(segments(f"{sigma}.geojson")) == 2
    assert Path("0.005.geojson").read_bytes() != Path("0.03.geojson").read_bytes()


# Errors: one line with what came and what is allowed, and nothing is written


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
@pytest.mark.parametrize(("line", "files", "said"), list(INVALID_CALLS.values()), ids=list(INVALID_CALLS))
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


@pytest.mark.slow
@pytest.mark.parametrize(("text", "said"), list(INVALID_MAPS.values()), ids=list(INVALID_MAPS))
@pytest.mark.parametrize("place", ["evaluate bad.json office.geojson", "evaluate map.geojson bad.json"])
def test_an_invalid_map_is_named(here, capsys, place, text, said):
    err = mistaken(here, capsys, f"{place} --json out.json", {"bad.json": text, "out.json": "before"})
    assert f"bad.json: {said}" in err
    assert "allowed" in err


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [
        lines_geojson(),
        lines_geojson([[0, 0, 5], [1, 0, 5]]),
        lines_geojson([[0, 0], [0, 0]]),
        lines_geojson([[0, 0], [9e11, 1e-300]]),
    ],
    ids=["no feature", "three coordinates", "no length", "very long"],
)
def test_unusual_maps_are_valid(here, capsys, text):
    Path("odd.json").write_text(text)
    assert call("evaluate", "odd.json", "office.geojson", "--json", "-") == 0
    assert call("evaluate", "map.geojson", "odd.json", "--json", "out.json") == 0
    came = capsys.readouterr()
    strict(came.out[: came.out.index("\n}\n") + 3])
    assert all(line.startswith("warning: odd.json: the room is") for line in came.err.splitlines())
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
    monkeypatch.setattr("jaxsonar.mapping.build_map.local_models", interrupted_after(models))
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


def test_a_reference_in_millimetres_is_a_warning_and_strictly_an_error(tmp_path, capsys):
    for name, scale in (("room", 1), ("mm", 1000)):
        wall = [[0, 0], [6 * scale, 0], [6 * scale, 4 * scale]]
        write_features([feature("LineString", wall, kind="wall")], tmp_path / f"{name}.geojson")
    arguments = ("evaluate", tmp_path / "room.geojson", tmp_path / "mm.geojson")
    assert call(*arguments) == 0
    assert "mm.geojson: the room is 6000 m x 4000 m" in capsys.readouterr().err
    assert call(*arguments, "--strict") == 2
    assert call("evaluate", tmp_path / "room.geojson", tmp_path / "room.geojson", "--strict") == 0
