"""``jaxsonar batch``: exit codes, one line per error, bags and raw recordings."""

import json
import math
import os
import subprocess
import sys

import numpy as np
import pytest

from jaxsonar import Log, load_log, load_ring
from jaxsonar.batch_jobs.inputs import find_inputs
from jaxsonar.batch_jobs.shards import split_input
from jaxsonar.cli import app as cli
from jaxsonar.scans.rosbag_log import read_bag_scans
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
    "notes.txt --ring faw -o out": "notes.txt: suffix '.txt' came; allowed for a log is .csv, .parquet, .mcap",
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
    shards = split_input(*find_inputs([path]), staging=tmp_path / "copies", sensors=RING.count, scans=4)
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


@pytest.fixture(params=["ros1", "ros2"])
def bag(request, tmp_path):
    """Two scans of three sensors at two poses; one measurement has no echo."""
    pytest.importorskip("rosbags")
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    one = request.param == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if one else Stores.ROS2_HUMBLE)
    types = store.types

    def header(seconds, frame):
        stamp = types["builtin_interfaces/msg/Time"](seconds, 500_000_000)
        values = {"stamp": stamp, "frame_id": frame} | ({"seq": 0} if one else {})
        return types["std_msgs/msg/Header"](**values)

    def odometry(seconds, x, theta):
        point = types["geometry_msgs/msg/Point"](x, 0.0, 0.0)
        turn = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(theta / 2), math.cos(theta / 2))
        pose = types["geometry_msgs/msg/PoseWithCovariance"](types["geometry_msgs/msg/Pose"](point, turn), np.zeros(36))
        zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        twist = types["geometry_msgs/msg/TwistWithCovariance"](
            types["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36)
        )
        return types["nav_msgs/msg/Odometry"](header(seconds, "odom"), "base", pose, twist)

    def heard(seconds, sensor, value):
        return types["sensor_msgs/msg/Range"](header(seconds, f"sonar_{sensor}"), 0, 0.5, 0.1, 4.0, value)

    messages = [("/odom", odometry(0, 1.0, 0.5))]
    messages += [("/sonar", heard(1, sensor, 1.0 + 0.25 * sensor)) for sensor in (0, 1, 2)]
    messages += [("/odom", odometry(2, 2.0, -0.5)), ("/sonar", heard(3, 2, 4.0)), ("/sonar", heard(3, 0, 0.5))]
    path = tmp_path / ("log.bag" if one else "log")
    with Writer1(path) if one else Writer2(path, version=9) as writer:
        known = {}
        for k, (topic, message) in enumerate(messages):
            name = type(message).__msgtype__
            if topic not in known:
                known[topic] = writer.add_connection(topic, name, typestore=store)
            data = store.serialize_ros1(message, name) if one else store.serialize_cdr(message, name)
            writer.write(known[topic], k * 1_000_000_000, data)
    return path


@pytest.mark.slow
def test_a_bag_gives_scans_of_direct_echoes(bag, tmp_path):
    log = parts_of(bag, tmp_path)
    assert log.tx.tolist() == log.rx.tolist() == [0, 1, 2, 0]
    assert log.start.tolist() == [0, 3, 4]
    assert log.range.tolist() == [1.0, 1.25, 1.5, 0.5]
    assert log.stamp.tolist() == [1.5, 3.5]
    np.testing.assert_allclose(log.pose, [[1.0, 0.0, 0.5], [2.0, 0.0, -0.5]])
    alone = Log.from_scans(list(read_bag_scans(next(bag.glob("*.db3")) if bag.is_dir() else bag, name="log")))
    assert alone == log


def test_an_invalid_bag_is_answered_in_one_line(tmp_path):
    pytest.importorskip("rosbags")
    for name in ("x.bag", "x.db3", "x.mcap"):
        (tmp_path / name).write_bytes(b"#ROSBAG V2.0\nrubbish")
        with pytest.raises(ValueError, match=rf"^{name}: [^\n]+; needed is a whole bag$"):
            parts_of(tmp_path / name, tmp_path)


def test_an_unfinished_recording_is_read_up_to_its_last_complete_scan(tmp_path):
    (tmp_path / "log.csv").write_text(GOOD + "20,20.0,0,0,")
    (tmp_path / "log.csv.recording").write_text(f"{len(GOOD):20d}\n")
    assert len(parts_of(tmp_path / "log.csv", tmp_path)) == 20
    assert [one.source for one in find_inputs([tmp_path])] == ["log.csv"]
