"""``jaxsonar batch``: exit codes, one line per error, bags and raw recordings."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from support.input_files import spinning_bag

from jaxsonar import Log, batch, load_log, load_ring
from jaxsonar.batch_jobs.inputs import find_inputs
from jaxsonar.batch_jobs.shards import split_input
from jaxsonar.cli import app as cli
from jaxsonar.simulation.device_messages import log_messages

pq = pytest.importorskip("pyarrow.parquet")

RING = load_ring("faw")
GOOD = "scan,stamp,x,y,theta,tx,rx,range\n" + "".join(f"{k},{k}.0,0,0,0,3,3,1.0\n" for k in range(20))


def call(*arguments):
    """Run one command in this process. Returns its exit code."""
    try:
        return cli.main([str(argument) for argument in arguments])
    except SystemExit as end:  # raised by argparse
        return end.code


@pytest.fixture
def here(tmp_path, monkeypatch):
    (tmp_path / "log.csv").write_text(GOOD)
    (tmp_path / "bad.csv").write_text(GOOD + "20,20.0,0,0,0,99,0,1.0\n")
    (tmp_path / "notes.txt").write_text("no log")
    (tmp_path / "empty").mkdir()
    os.mkfifo(tmp_path / "pipe.csv")
    monkeypatch.chdir(tmp_path)
    return tmp_path


WRONG = {
    "log.csv -o out": "the following arguments are required: --ring",
    "log.csv --ring faw": "the following arguments are required: -o/--output",
    "--ring faw -o out": "the following arguments are required: IN",
    "log.csv --ring nosuch -o out": "nosuch",
    "nosuch.csv --ring faw -o out": "nosuch.csv: no such file or folder; needed is a log, or a folder of logs",
    "notes.txt --ring faw -o out": "notes.txt: this is a text that begins with 'no log'; allowed is a scan log (CSV",
    ". --ring faw -o .": "-o .: this is an input; allowed is another folder",
    "empty --ring faw -o out": "empty: no log in this folder; allowed are .csv, .parquet, .mcap, .bag, .db3",
    "log.csv --ring faw -o -": "-o - came; allowed is a folder",
    "pipe.csv --ring faw -o out": "pipe.csv: not a regular file, but a log is read more than once; needed is a log",
    "log.csv --ring faw -o notes.txt": "notes.txt: File exists; allowed is a folder that can be written to",
    "log.csv --ring faw -o out --engine ray": "invalid choice: 'ray'",
    "log.csv --ring faw -o out --workers 0": "'0' came; allowed is a whole number from 1 to 1024",
    "log.csv --ring faw -o out --workers two": "'two' came; allowed is a whole number from 1 to 1024",
    "log.csv --ring faw -o out --scheduler tcp://h:1": "scheduler tcp://h:1 came with engine local",
    "log.csv --ring faw -o out --engine dask --scheduler x --workers 2": "workers 2 came with a scheduler",
    "log.csv --ring faw -o out --engine dask --scheduler nonsense://x": "--scheduler nonsense://x: ",
    "log.csv --ring faw -o out --sigma 2": "'2' came; allowed is a number from 0.0001 to 1",
    "log.csv --ring faw -o out --sigma 0.003 --method hough": "allowed is --sigma with --method ml",
    "log.csv --ring faw -o out --settings notes.txt": "notes.txt: no TOML",
    "log.csv --ring faw -o out --window 1.5": "unrecognized arguments: --window 1.5",
}


@pytest.mark.slow
@pytest.mark.parametrize(("words", "answer"), WRONG.items())
def test_an_invalid_call_is_answered_in_one_line(here, capsys, words, answer):
    pytest.importorskip("distributed")
    assert call("batch", *words.split()) == 2
    out, error = capsys.readouterr()
    assert out == ""
    assert error.count("\n") == 1
    assert answer in error
    assert not list(here.glob("out/*/*.parquet"))


@pytest.mark.slow
def test_set_aside_is_exit_code_1_and_one_more_line(here, capsys):
    for _ in range(2):  # resuming reports it again
        assert call("batch", ".", "--ring", "faw", "--method", "hough", "-o", "out", "--workers", 1) == 1
        out, error = capsys.readouterr()
        assert out == ""
        told, aside = error.splitlines()
        assert told.startswith("40 scans, 0 lines, 2 shards")
        assert aside.startswith("set aside: 1 scan; the reasons are in out/manifest.jsonl; the first: bad.csv: scan")
        assert "echo of sensors" in aside
    lines = [json.loads(line) for line in (here / "out" / "manifest.jsonl").read_text().splitlines()]
    assert [line["bad_scans"] for line in lines if "bad_scans" in line] == [1]
    assert pq.read_table("out/scans")["empty"].to_pylist() == ["fewer than 3 echoes within the maximum range"] * 40


@pytest.mark.slow
@pytest.mark.parametrize(("module", "extra"), [("distributed", "cluster"), ("rosbags", "ros"), ("pyarrow", "parquet")])
def test_a_missing_extra_is_answered_in_one_line(here, module, extra):
    (here / "x.bag").write_bytes(b"#ROSBAG V2.0\n")
    source = "x.bag" if extra == "ros" else "log.csv"
    arguments = ["batch", source, "--ring", "faw", "-o", "out", "--engine", "dask" if extra == "cluster" else "local"]
    code = f"""
import importlib.util, sys
sys.modules[{module!r}], find = None, importlib.util.find_spec
importlib.util.find_spec = lambda name: None if name == {module!r} else find(name)
from jaxsonar.cli import main
sys.exit(main({arguments}))
"""
    came = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=here)
    assert came.returncode == 2, came.stderr
    assert f"pip install 'jaxsonar[{extra}]'" in came.stderr.splitlines()[-1]


# Other inputs


def parts_of(path, tmp_path):
    shards = split_input(*find_inputs([path]), staging=tmp_path / "copies", ring=RING, scans=4)
    assert {one.format for one in shards} == {"parquet"}
    assert sum(one.chunk.scans for one in shards) == len(load_log(shards[0].filename))
    return load_log(shards[0].filename)


def test_a_raw_recording_gives_the_sent_log(tmp_path):
    pytest.importorskip("mcap")
    from jaxsonar.hardware.mcap_recorder import McapRecorder

    path = RING.path_index
    pairs = [(k, k) for k in range(24)]
    log = Log.from_echoes(
        np.repeat(np.arange(5), 24),
        np.tile([tx for tx, _ in pairs], 5),
        np.tile([rx for _, rx in pairs], 5),
        np.linspace(0.5, 1.9, 120),
        stamp=np.arange(5.0),
        pose=np.stack([np.arange(5.0), np.zeros(5), np.zeros(5)], axis=-1),
    )
    assert (path[log.tx, log.rx] >= 0).all()
    recorder = McapRecorder(tmp_path / "log.mcap")
    for k, message in enumerate(log_messages(log, RING)):
        recorder.message(message, 1.0 + 0.01 * k)
    recorder.close()
    read = parts_of(tmp_path / "log.mcap", tmp_path)
    assert (len(read), len(read.tx)) == (5, 120)
    np.testing.assert_array_equal(read.tx, log.tx)
    np.testing.assert_allclose(read.range, log.range, atol=1e-6)
    np.testing.assert_allclose(read.pose, log.pose)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap"])
def test_a_bag_gives_the_lines_of_the_lines_command(tmp_path, kind, capsys):
    """The robot turns while its sensors fire one after another; the shards begin and end anywhere."""
    pytest.importorskip("rosbags")
    bag, ring_file = spinning_bag(tmp_path / "run", kind)
    assert call("lines", bag, "--ring", ring_file, "-o", tmp_path / "lines.jsonl") == 0
    models = [json.loads(line) for line in (tmp_path / "lines.jsonl").read_text().splitlines()]
    report = batch([bag], load_ring(ring_file), tmp_path / "out", workers=1, shard_scans=7)
    assert report.scans == len(models) > 14
    found = pq.read_table(tmp_path / "out" / "lines").to_pylist()
    wanted = [(model["scan"], *(line[key] for key in ("rho", "theta"))) for model in models for line in model["lines"]]
    assert len(wanted) > len(models)
    assert [row["scan"] for row in found] == [scan for scan, _, _ in wanted]
    np.testing.assert_allclose([(row["rho"], row["theta"]) for row in found], [one[1:] for one in wanted], atol=1e-4)
    capsys.readouterr()
    arguments = ["--ring", ring_file, "-o", tmp_path / "cli", "--workers", 1, "--method", "hough"]
    assert call("batch", bag, *arguments) == 0
    assert f"{bag.name}: odometry: /odom" in capsys.readouterr().err


def test_an_invalid_bag_is_answered_in_one_line(tmp_path):
    pytest.importorskip("rosbags")
    for name in ("x.bag", "x.db3", "x.mcap"):
        (tmp_path / name).write_bytes(b"#ROSBAG V2.0\nrubbish")
        with pytest.raises(ValueError, match=rf"{name}: [^\n]+; (needed|allowed) is "):
            parts_of(tmp_path / name, tmp_path)


def test_an_unfinished_recording_is_read_up_to_its_last_complete_scan(tmp_path):
    (tmp_path / "log.csv").write_text(GOOD + "20,20.0,0,0,")
    (tmp_path / "log.csv.recording").write_text(f"{len(GOOD):20d}\n")
    assert len(parts_of(tmp_path / "log.csv", tmp_path)) == 20
    assert [one.source for one in find_inputs([tmp_path])] == ["log.csv"]


def test_a_batch_that_a_warning_stops_leaves_nothing(here, capsys):
    backwards = GOOD + "20,3.0,0,0,0,3,3,1.0\n"
    (here / "backwards.csv").write_text(backwards)
    assert call("batch", "backwards.csv", "--ring", "faw", "-o", "out", "--strict") == 2
    assert "the stamps run backwards" in capsys.readouterr().err
    assert not (here / "out").exists()
