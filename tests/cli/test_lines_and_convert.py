"""Commands lines, simulate and convert: files are as documented, results are reproducible, an error is one line."""

import argparse
import csv
import json
import math
import os
import shutil
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from support.commands import DATA, HEADER, OFFICE, PATH, SIMULATE, call, contents, interrupted_after, script
from support.invalid_lines_calls import INVALID_CALLS

from jaxsonar import load_log, load_ring, save_log
from jaxsonar.cli.arguments import figure_filename
from jaxsonar.detection.settings_toml import load_settings
from jaxsonar.fileio.atomic_files import FIGURE_FORMATS


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """A folder with the office's log and its lines."""
    folder = tmp_path_factory.mktemp("office")
    assert call(*SIMULATE, "-o", folder / "log.csv") == 0
    assert call("lines", folder / "log.csv", "--ring", "faw", "-o", folder / "lines.jsonl") == 0
    return folder


@pytest.fixture
def here(office, tmp_path, monkeypatch):
    """A working folder with copies of the log and the lines."""
    for name in ("log.csv", "lines.jsonl"):
        shutil.copy(office / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def read_models(path):
    def refuse(constant):
        raise ValueError(f"{constant} is no JSON")

    return [json.loads(line, parse_constant=refuse) for line in Path(path).read_text().splitlines()]


# Results


@pytest.mark.slow
def test_a_simulated_log_has_the_poses_of_the_trajectory(here):
    with open("log.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [*HEADER.strip().split(","), "amplitude"]
    with open(PATH, newline="") as file:
        poses = list(csv.DictReader(file))
    scans = list(dict.fromkeys(row["scan"] for row in rows))
    assert scans == [str(k) for k in range(len(poses))]
    listened = {tuple(pair) for pair in load_ring("faw").paths.tolist()}
    for row in rows:
        pose = poses[int(row["scan"])]
        assert all(float(row[key]) == float(pose[key]) for key in ("stamp", "x", "y", "theta"))
        assert (int(row["tx"]), int(row["rx"])) in listened
        assert 0 < float(row["range"]) < 2.02


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ml", "hough"])
def test_lines_are_as_documented(here, method):
    if method == "hough":
        assert call("lines", "log.csv", "--ring", "faw", "--method", "hough", "-o", "lines.jsonl") == 0
    models, log = read_models("lines.jsonl"), load_log("log.csv")
    listened = {tuple(pair) for pair in load_ring("faw").paths.tolist()}
    more = {"points", "undecided", "sigma"} if method == "ml" else set()
    strength = {"cov", "evidence"} if method == "ml" else {"votes"}
    assert [model["scan"] for model in models] == log.scan.tolist()
    assert [model["stamp"] for model in models] == log.stamp.tolist()
    for model in models:
        assert set(model) - {"empty"} == {"scan", "stamp", "lines"} | more
        assert model["lines"] or model["empty"]
        for line in model["lines"]:
            assert set(line) == {"rho", "theta", "segment", "echoes", "paths"} | strength
            assert line["rho"] >= 0
            assert -math.pi <= line["theta"] < math.pi
            assert isinstance(line["echoes"], int)
            assert line["echoes"] >= len(line["paths"]) > 0
            assert {tuple(path) for path in line["paths"]} <= listened
            normal = np.array([math.cos(line["theta"]), math.sin(line["theta"])])
            assert np.shape(line["segment"]) == (2, 2)
            np.testing.assert_allclose(np.array(line["segment"]) @ normal, line["rho"], atol=1e-5)
            first, last = np.array(line["segment"]) @ np.array([-normal[1], normal[0]])
            assert first <= last, "counter-clockwise as seen from the robot"
            if method == "ml":
                assert (np.linalg.eigvalsh(line["cov"]) > 0).all()


@pytest.mark.slow
def test_written_settings_reproduce_the_result(here, office):
    settings = office / "lines.settings.toml"
    assert set(tomllib.loads(settings.read_text())) == {
        *("theta_cells", "rho_cells", "rho_cell", "point_pitch", "smoothing", "threshold", "min_echoes")
    }
    assert call("lines", "log.csv", "--ring", "faw", "--settings", settings, "-o", "again.jsonl") == 0
    assert Path("again.jsonl").read_bytes() == Path("lines.jsonl").read_bytes()
    assert Path("again.settings.toml").read_bytes() == settings.read_bytes()


@pytest.mark.slow
def test_given_settings_are_used_and_written(here):
    Path("mine.toml").write_text("threshold = 0.35\nmin_echoes = 5\nsmoothing = [1, 2, 3, 2, 1]\n")
    paper = ["lines", "log.csv", "--ring", "faw", "--method", "hough"]
    assert call(*paper, "-o", "paper.jsonl") == 0
    assert call(*paper, "--settings", "mine.toml", "-o", "again.jsonl") == 0
    assert load_settings("again.settings.toml") == load_settings("mine.toml")
    lines = [line for model in read_models("again.jsonl") for line in model["lines"]]
    assert lines
    assert min(line["echoes"] for line in lines) >= 5
    assert Path("again.jsonl").read_bytes() != Path("paper.jsonl").read_bytes()


@pytest.mark.slow
def test_lines_to_standard_output(here, capsys):
    before = contents(here)
    assert call("lines", "log.csv", "--ring", "faw", "-o", "-") == 0
    came = capsys.readouterr()
    assert came.out.encode() == Path("lines.jsonl").read_bytes()
    assert came.err.startswith("17 scans, ")
    assert contents(here) == before


@pytest.mark.slow
def test_a_simulation_to_standard_output(here, capsys):
    before = contents(here)
    assert call(*SIMULATE, "-o", "-") == 0
    came = capsys.readouterr()
    assert came.out.encode() == Path("log.csv").read_bytes()
    assert len(came.err.splitlines()) == 1
    assert contents(here) == before


@pytest.mark.slow
def test_lines_through_a_named_pipe_leave_nothing_beside_it(here):
    os.mkfifo("pipe.jsonl")
    with ThreadPoolExecutor() as pool:
        came = pool.submit(Path("pipe.jsonl").read_bytes)
        before = contents(here)
        assert call("lines", "log.csv", "--ring", "faw", "-o", "pipe.jsonl") == 0
        assert came.result(timeout=60) == Path("lines.jsonl").read_bytes()
    assert contents(here) == before


@pytest.mark.slow
def test_output_of_the_installed_command_can_be_appended_to_a_file(here):
    Path("both.csv").write_bytes(b"before\n")
    with open("both.csv", "a") as file:
        command = [Path(sys.executable).parent / "jaxsonar", *SIMULATE, "-o", "-"]
        assert subprocess.run([*map(str, command)], stdout=file, stderr=subprocess.PIPE, timeout=120).returncode == 0
    assert Path("both.csv").read_bytes() == b"before\n" + Path("log.csv").read_bytes()


@pytest.mark.slow
def test_the_same_seed_gives_the_same_log(here):
    for name, seed in (("same.csv", 1), ("other.csv", 2)):
        assert call(*SIMULATE[:-1], seed, "-o", name) == 0
    assert Path("same.csv").read_bytes() == Path("log.csv").read_bytes()
    assert Path("other.csv").read_bytes() != Path("log.csv").read_bytes()


@pytest.mark.slow
def test_errors_of_the_ring_are_simulated(here):
    options = ("--drift", "0.01", "--dropout", "0.5", "--clutter", "0.3", "--max-echoes", "1")
    assert call(*SIMULATE, *options, "-o", "bad.csv") == 0
    good, bad = load_log("log.csv"), load_log("bad.csv")
    assert len(bad) == len(good)
    assert 0.2 * len(good.tx) < len(bad.tx) < 0.9 * len(good.tx)
    places = np.stack([bad.echo_scan, bad.tx, bad.rx], axis=-1)
    assert len(np.unique(places, axis=0)) == len(places), "one echo a path"


@pytest.mark.slow
def test_conversions_lose_nothing(here):
    pytest.importorskip("pyarrow")
    assert call("convert", "log.csv", "log.parquet") == 0
    assert call("convert", "log.parquet", "back.csv") == 0
    assert Path("back.csv").read_bytes() == Path("log.csv").read_bytes()
    assert load_log("log.parquet") == load_log("log.csv")
    shutil.move("log.parquet", "log.data")
    assert call("convert", "log.data", "named.csv", "--from", "parquet") == 0
    assert Path("named.csv").read_bytes() == Path("log.csv").read_bytes()


@pytest.mark.slow
def test_parquet_and_csv_give_the_same_result(here):
    pytest.importorskip("pyarrow")
    assert call(*SIMULATE, "-o", "log.parquet") == 0
    assert call("lines", "log.parquet", "--ring", "faw", "-o", "again.jsonl") == 0
    assert Path("again.jsonl").read_bytes() == Path("lines.jsonl").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(("suffix", "start"), [("svg", b"<?xml"), ("png", b"\x89PNG"), ("PDF", b"%PDF")])
def test_a_figure_of_one_scan(here, suffix, start):
    figure = Path(f"scan.{suffix}")
    assert call("lines", "log.csv", "--ring", "faw", "-o", "again.jsonl", "--figure", figure, "--scan", 3) == 0
    assert figure.read_bytes().startswith(start)
    assert Path("again.jsonl").read_bytes() == Path("lines.jsonl").read_bytes()


@pytest.mark.slow
def test_the_scan_option_selects_the_figure(here):
    def drawn(*chosen):
        assert call("lines", "log.csv", "--ring", "faw", "-o", "again.jsonl", "--figure", "a.svg", *chosen) == 0
        return Path("a.svg").read_bytes()

    assert drawn() == drawn("--scan", 0)
    assert drawn() != drawn("--scan", 3)


def test_the_command_line_accepts_exactly_the_figure_formats():
    for suffix in FIGURE_FORMATS:
        assert figure_filename(f"a{suffix}") == f"a{suffix}"
    with pytest.raises(argparse.ArgumentTypeError, match=", ".join(FIGURE_FORMATS)):
        figure_filename("a.gif")


@pytest.mark.slow
def test_scans_without_echoes_have_no_lines_and_a_reason(here, capsys):
    Path("silent.csv").write_text(HEADER + "-7,,,,,,,\n9,1.5,,,,,,\n10,2,,,,4,4,1.0\n")
    silent = ["lines", "silent.csv", "--ring", "faw", "--method", "hough", "-o", "silent.jsonl"]
    assert call(*silent, "--figure", "a.svg") == 0
    models = read_models("silent.jsonl")[:2]
    assert [(model["scan"], model["stamp"], model["lines"]) for model in models] == [(-7, None, []), (9, 1.5, [])]
    assert all(model["empty"] for model in models)
    assert "3 scans, 0 lines" in capsys.readouterr().err


@pytest.mark.slow
def test_echoes_of_no_path_are_reported(here, capsys):
    Path("wide.csv").write_text(HEADER + "0,,,,,3,12,1.0\n0,,,,,3,3,1.0\n")
    assert call("lines", "wide.csv", "--ring", "faw", "--method", "hough", "-o", "wide.jsonl") == 0
    assert "left out 1 echo" in capsys.readouterr().err


# Errors: one line with what came and what is allowed, and nothing is written


@pytest.mark.slow
@pytest.mark.parametrize(("line", "files", "said"), list(INVALID_CALLS.values()), ids=list(INVALID_CALLS))
def test_an_invalid_call_is_answered_in_one_line_and_changes_nothing(here, capsys, line, files, said):
    if "parquet" in line:
        pytest.importorskip("pyarrow")
    for name, text in files.items():
        Path(name).mkdir() if text is None else Path(name).write_text(text)
    for name in ("out.jsonl", "out.csv", "a.svg"):
        Path(name).write_text("what was here before\n")
    before = contents(here)
    assert call(*line.format(office=OFFICE, path=PATH).split()) == 2
    came = capsys.readouterr()
    assert came.out == ""
    assert came.err.endswith("\n")
    assert len(came.err.splitlines()) == 1, came.err
    assert came.err.startswith("jaxsonar")
    for words in said:
        assert words in came.err
    assert contents(here) == before


@pytest.mark.slow
def test_an_error_with_a_line_break_is_one_line(here, capsys):
    assert call("lines", "log.csv", "--ring", "faw", "-o", "out.jsonl", "--two\nlines") == 2
    assert call("lines", "two\nlines.csv", "--ring", "faw", "-o", "out.jsonl") == 2
    assert call("lines", "log.csv", "--ring", "two\nlines", "-o", "out.jsonl") == 2
    assert len(capsys.readouterr().err.splitlines()) == 3


@pytest.mark.slow
def test_the_installed_command_answers_in_one_line(here):
    done = script("convert", "no.csv", "out.csv")
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 1
    assert "no.csv" in done.stderr


@pytest.mark.slow
def test_ctrl_c_leaves_no_partial_result(here, capsys, monkeypatch, faw_ring):
    from jaxsonar.detection import extract as local

    models = list(local.local_models(faw_ring, load_log("log.csv")[:2]))
    monkeypatch.setattr(local, "local_models", interrupted_after(models))
    before = contents(here)
    assert call("lines", "log.csv", "--ring", "faw", "-o", "out.jsonl") == 1
    came = capsys.readouterr()
    assert came.out == ""
    assert came.err == "jaxsonar lines: interrupted\n"
    assert contents(here) == before


@pytest.mark.slow
@pytest.mark.parametrize(
    "command", [SIMULATE, ["lines", "long.csv", "--ring", "faw", "--method", "hough"]], ids=["simulate", "lines"]
)
def test_a_closed_pipe_is_not_an_error(here, command):
    log = load_log("log.csv")
    rows = Path("log.csv").read_text().splitlines(keepends=True)
    if command[0] == "lines":  # more than the capacity of a pipe
        texts = [
            f"{k * len(log) + int(row.partition(',')[0])},{row.partition(',')[2]}"
            for k in range(20)
            for row in rows[1:]
        ]
        Path("long.csv").write_text("".join([rows[0], *texts]))
    arguments = [str(Path(sys.executable).parent / "jaxsonar"), *map(str, command), "-o", "-"]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        first = process.stdout.readline()
        process.stdout.close()
        err = process.stderr.read()
        code = process.wait(timeout=120)
    assert first.startswith("scan," if command[0] == "simulate" else '{"scan": 0')
    assert code in (0, 1)  # 0 if everything was written before the pipe was closed
    assert "Traceback" not in err
    assert "Exception" not in err
    # The longer log is a joined one, which gives warnings.
    assert len([line for line in err.splitlines() if not line.startswith("warning: ")]) <= 1


def test_the_version_is_that_of_the_project(capsys):
    project = tomllib.loads((DATA.parents[1] / "pyproject.toml").read_text())["project"]
    assert call("--version") == 0
    assert capsys.readouterr().out == f"jaxsonar {project['version']}\n"


@pytest.mark.slow
def test_a_saved_log_is_what_the_command_reads(here):
    """Round trip through the library between two commands."""
    log = load_log("log.csv")
    save_log(log[3:5], "part.csv")
    assert call("lines", "part.csv", "--ring", "faw", "-o", "part.jsonl") == 0
    part, whole = read_models("part.jsonl"), read_models("lines.jsonl")
    assert len(part) == 2
    for mine, its in zip(part, whole[3:5], strict=True):  # sums of other shapes may be rounded differently
        assert mine["scan"] == its["scan"]
        assert [line["paths"] for line in mine["lines"]] == [line["paths"] for line in its["lines"]]
        for key in ("rho", "theta", "segment"):
            ours, theirs = ([line[key] for line in model["lines"]] for model in (mine, its))
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-3)
