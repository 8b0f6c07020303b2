"""Commands stream and emulate: results end to end, signals, and invalid calls in one line."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.emulated_devices import office_log
from support.logs import echoes_of
from support.maps import assert_same_map

from jaxsonar import (
    SonarError,
    load_log,
    load_map,
    save_log,
)
from jaxsonar.cli.app import main
from jaxsonar.live.status import Status
from jaxsonar.live.stream import stream
from jaxsonar.scans.recording_journal import open_log_recorder


@pytest.fixture(scope="module")
def log(office):
    return office_log(office, sigma=0.002)


@pytest.fixture(scope="module")
def log_file(log, tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "office.csv"
    save_log(log, path)
    return path


COMMAND = [sys.executable, "-c", "import sys; from jaxsonar.cli import main; sys.exit(main())"]


@pytest.fixture(scope="module")
def command():
    """Start the command line with the compilation cache of all tests."""
    own = {"PYTHONPATH": str(Path(__file__).parents[2])}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}

    def start(*arguments, **environment):
        return subprocess.Popen([*COMMAND, *map(str, arguments)], env=os.environ | own | environment, **pipes)

    return start


@pytest.fixture
def device(log_file, command):
    """A process that emulates the office. Returns its URL."""
    running = []

    def start(link, *options):
        process = command("emulate", log_file, "--ring", "faw", "--listen", link, *options)
        running.append(process)
        assert process.stdout is not None
        said = re.fullmatch(r"listening on (\S+)\n", process.stdout.readline())
        assert said
        return said[1]

    yield start
    for process in running:
        process.terminate()
        process.communicate(timeout=20)


@pytest.mark.slow
def test_emulate_and_stream_give_the_map_of_the_map_command(device, command, log_file, tmp_path):
    """End to end with processes and a real link; the recording gives the same map as the stream.

    The first line of the device is its URL.
    """
    map_path, record = tmp_path / "map.geojson", tmp_path / "rec.parquet"
    url = device("tcp://127.0.0.1:0", "--speed", "0")
    assert re.fullmatch(r"tcp://127\.0\.0\.1:\d+", url)
    streaming = command("stream", url, "--ring", "faw", "--method", "hough", "--record", record, "--map", map_path)
    out, told = streaming.communicate(timeout=120)
    assert (streaming.returncode, out) == (0, ""), told
    assert "17 scans" in told.splitlines()[-1]
    reference = tmp_path / "reference.geojson"
    assert main(["map", str(record), "--ring", "faw", "--method", "hough", "-o", str(reference)]) == 0
    assert_same_map(load_map(map_path), load_map(reference))
    assert np.abs(echoes_of(load_log(record)).range - load_log(log_file).range).max() < 1e-4


@pytest.mark.slow
def test_a_stream_of_another_protocol_is_named(command, tmp_path):
    """Comma-separated numbers, as a sketch on a microcontroller prints them."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        streaming = command("stream", url, "--ring", "faw", "--record", tmp_path / "t.csv")
        server.settimeout(60)
        link, _ = server.accept()
        with link:
            link.sendall(b"12,55,103,48\r\n" * 100)
        _, told = streaming.communicate(timeout=60)
    assert streaming.returncode == 1, told
    assert f"warning: {url}: no frame of the wire protocol in 1400 bytes" in told.splitlines()[-1]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_the_stream_with_everything_written(number, device, command, tmp_path):
    record, map_path = tmp_path / "rec.csv", tmp_path / "map.geojson"
    url = device("tcp://127.0.0.1:0", "--speed", "8")  # four scans per second
    streaming = command("stream", url, "--ring", "faw", "--method", "hough", "--record", record, "--map", map_path)
    end = time.monotonic() + 100
    while time.monotonic() < end and not (map_path.exists() and record.stat().st_size > 3000):
        time.sleep(0.05)
    streaming.send_signal(number)
    _, told = streaming.communicate(timeout=60)
    assert streaming.returncode == 0, told
    log, world = load_log(record), load_map(map_path)
    assert 1 <= len(log) <= 17
    assert sorted(os.listdir(tmp_path)) == ["map.geojson", "rec.csv"], "nothing is left beside them"
    assert max((max(scans) for scans in world.scans), default=0) <= log.scan.max()
    assert f"{len(log)} scans" in told.splitlines()[-1]


@pytest.mark.slow
@pytest.mark.parametrize("mapping", [False, True])
def test_signals_stop_the_stream_during_compilation(mapping, device, command, tmp_path):
    """Method ml takes many seconds to compile: one signal stops a recording, two stop a map."""
    record = tmp_path / "rec.csv"
    call = ["stream", device("tcp://127.0.0.1:0", "--speed", "20"), "--ring", "faw", "--record", record]
    call += ["--map", tmp_path / "map.geojson"] if mapping else []
    streaming = command(*call, JAX_ENABLE_COMPILATION_CACHE="false")
    end = time.monotonic() + 60
    while time.monotonic() < end and not (record.exists() and record.stat().st_size > 3000):
        time.sleep(0.02)
    streaming.send_signal(signal.SIGINT)
    for _ in range(50 * mapping):  # signals that arrive before the first one is handled count as one
        time.sleep(1.0)
        if streaming.poll() is not None:
            break
        streaming.send_signal(signal.SIGINT)
    _, told = streaming.communicate(timeout=60)
    # Had it waited for the compilation, it would have processed scans, and with a map it would have succeeded.
    assert streaming.returncode == mapping, told
    assert ("interrupted" if mapping else "0 scans, compiling") in told.splitlines()[-1]
    assert os.listdir(tmp_path) == ["rec.csv"]
    assert len(load_log(record)) > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ("stream", "nowhere", "--ring", "faw"),
        ("stream", "tcp://127.0.0.1:1", "--ring", "faw"),
        ("stream", "pty:/dev/nowhere", "--ring", "faw"),
        ("stream", "file:nowhere.csv", "--ring", "faw"),
        ("stream", "file:nowhere.mcap", "--ring", "faw"),
        ("stream", "file:{log}?speed=-1", "--ring", "faw"),
        ("stream", "file:{log}", "--ring", "nowhere.toml"),
        ("stream", "file:{log}", "--ring", "faw", "--record", "x.txt"),
        ("stream", "file:{log}", "--ring", "faw", "--record", "nowhere/x.csv"),
        ("stream", "file:{log}", "--ring", "faw", "--record", "{log}"),
        ("stream", "file:{log}", "--ring", "faw", "--map", "x.svg"),
        ("stream", "file:{log}", "--ring", "faw", "--grid", "x.pgm"),
        ("stream", "file:{log}", "--ring", "faw", "--grid", "nowhere/x.yaml"),
        ("stream", "file:{log}", "--ring", "faw", "--grid-mode", "scale"),
        ("stream", "file:{log}", "--ring", "faw", "--scans", "0"),
        ("stream", "file:{log}", "--ring", "faw", "--method", "hough", "--sigma", "0.01"),
        ("emulate", "{log}", "--ring", "faw", "--listen", "file:x"),
        ("emulate", "{log}", "--ring", "faw", "--listen", "tcp://127.0.0.1:0", "--corrupt", "2"),
        ("emulate", "{log}", "--ring", "faw", "--listen", "tcp://127.0.0.1:0", "--stall", "soon"),
        ("emulate", "{log}", "--ring", "corridor8", "--listen", "tcp://127.0.0.1:0"),
        ("emulate", "nowhere.csv", "--ring", "faw", "--listen", "tcp://127.0.0.1:0"),
        ("emulate", "room.geojson", "--ring", "faw", "--listen", "tcp://127.0.0.1:0"),
        ("emulate", "{log}", "--ring", "faw", "--listen", "tcp://127.0.0.1:0", "--path", "x.csv"),
    ],
)
def test_invalid_calls_are_answered_in_one_line(arguments, log_file, capsys):
    try:
        code = main([text.format(log=log_file) for text in arguments])
    except SystemExit as end:
        code = end.code
    out, told = capsys.readouterr()
    assert code == 2, told
    assert out == ""
    assert told.count("\n") == 1
    assert "allowed" in told or "needed" in told, told


@pytest.mark.slow
def test_a_stream_writes_the_grid_of_its_recording(log, log_file, tmp_path, capsys):
    """With and without a map; without poses one line and no file."""
    call = ["--ring", "faw", "--method", "hough"]
    record, grid = tmp_path / "rec.csv", tmp_path / "grid.yaml"
    assert main(["stream", f"file:{log_file}?speed=0", *call, "--record", str(record), "--grid", str(grid)]) == 0
    assert sorted(os.listdir(tmp_path)) == ["grid.pgm", "grid.yaml", "rec.csv"]
    reference = tmp_path / "reference.yaml"
    assert main(["map", str(record), *call, "-o", str(tmp_path / "m.geojson"), "--grid", str(reference)]) == 0
    assert grid.with_suffix(".pgm").read_bytes() == reference.with_suffix(".pgm").read_bytes()
    lost = tmp_path / "lost"
    lost.mkdir()
    save_log(replace(log, pose=np.full_like(log.pose, np.nan)), lost / "log.csv")
    capsys.readouterr()
    assert main(["stream", f"file:{lost / 'log.csv'}?speed=0", *call, "--grid", str(lost / "grid.yaml")]) == 2
    assert os.listdir(lost) == ["log.csv"]
    assert re.search("grid.yaml: 17 scans without a pose came, .*needed is", capsys.readouterr().err.splitlines()[-1])


@pytest.mark.slow
def test_the_viewer_writes_a_file_and_names_a_missing_extra(office, log, log_file, tmp_path, monkeypatch, capsys):
    pytest.importorskip("rerun")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    file = tmp_path / "view.rrd"
    call = ["stream", f"file:{log_file}?speed=0", "--ring", "faw", "--method", "hough", "--rrd", str(file)]
    assert main(call) == 0
    assert file.stat().st_size > 20_000
    capsys.readouterr()
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main([*call[:-2], "--view"]) == 2
    assert capsys.readouterr().err == "jaxsonar stream: --view needs the extra viz: pip install 'jaxsonar[viz]'\n"


def test_the_status_is_one_line():
    status = Status(scans=3, counts={"rejected": 2, "impossible": 1, "oversized": 1, "gaps": 1}, event="gone\n")
    assert "2 damaged (1 oversized, 1 impossible)" in status.text()
    assert "1 gaps" in status.text()


@pytest.mark.slow
def test_a_recording_needs_a_writable_file(tmp_path, office, log_file):
    with pytest.raises(SonarError, match="allowed"):
        stream(f"file:{log_file}?speed=0", office.ring, record=tmp_path / "no" / "x.csv")
    assert open_log_recorder(tmp_path / "x.csv").close() is None
