"""From a device to lines and a map: the same results as from the log, and correct for a moving robot."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxsonar import (
    Mapper,
    Ring,
    Room,
    SonarError,
    build_map,
    kernels,
    load_log,
    load_map,
    local_model,
    save_log,
    simulate,
)
from jaxsonar.cli.app import main
from jaxsonar.detection.arc_tables import arc_tables
from jaxsonar.detection.settings import hough_settings
from jaxsonar.geometry.se2 import transform_points
from jaxsonar.hardware.device_emulator import emulate
from jaxsonar.hardware.fault_injection import FaultSettings
from jaxsonar.hardware.messages import ECHO
from jaxsonar.hardware.scan_assembler import RawScan, ScanAssembler
from jaxsonar.hardware.transport_servers import listen
from jaxsonar.live.live_map import LiveMap
from jaxsonar.live.status import Status
from jaxsonar.live.stream import stream
from jaxsonar.scans.recording_journal import open_log_recorder
from jaxsonar.simulation.device_messages import log_messages, room_messages
from jaxsonar.simulation.office import load_office

RING = Ring.circular()
LINKS = ("tcp://127.0.0.1:0", "udp://127.0.0.1:0", "pty:")


@pytest.fixture(scope="module")
def office():
    return load_office()


@pytest.fixture(scope="module")
def log(office):
    heard = simulate(office.ring, office.room, office.poses, sigma=0.002, seed=3, stamps=office.stamps)
    return heard.as_log(office.ring, office.poses)


@pytest.fixture(scope="module")
def log_file(log, tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "office.csv"
    save_log(log, path)
    return path


def raw_scans(messages):
    assembler = ScanAssembler(sensors=RING.count)
    return [scan for m in messages for scan in assembler.push(m, time.monotonic())] + assembler.flush()


class Device:
    """An emulated device in a thread, for a stream in this process."""

    def __init__(self, url, messages, **choices):
        self.sink = listen(url)
        self.stop = threading.Event()
        choices = {"speed": 0.0, **choices}
        self.thread = threading.Thread(target=lambda: self._run(messages, choices))
        self.thread.start()

    def _run(self, messages, choices):
        with self.sink:
            emulate(messages, self.sink, stop=self.stop, **choices)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stop.set()
        self.thread.join(20)


def assert_same_map(one, other, *, atol=1e-4):
    assert len(one) == len(other)
    for name in ("segments", "rho", "theta"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=atol)
    assert one.echoes.tolist() == other.echoes.tolist()
    assert one.scans == other.scans
    np.testing.assert_allclose(one.points, other.points, atol=atol)


@pytest.fixture(scope="module")
def expected(office, log):
    return build_map(office.ring, log, method="hough")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("link", "record"), [*((link, "rec.csv") for link in LINKS), (LINKS[0], "rec.parquet"), ("file", "rec.parquet")]
)
def test_a_stream_records_the_log_and_builds_its_map(link, record, office, log, log_file, expected, tmp_path):
    """Over every link: echoes within 0.1 mm, the same map, no loss, and the recording is the log."""
    path, map_path = tmp_path / record, tmp_path / "map.geojson"
    choices = {"method": "hough", "record": path, "map_filename": map_path}
    if link == "file":
        status = stream(f"file:{log_file}?speed=0", office.ring, **choices)
    else:
        with Device(link, log_messages(log, office.ring)) as device:
            status = stream(device.sink.url, office.ring, **choices)
    recorded = load_log(path)
    for column in ("scan", "start", "tx", "rx", "stamp", "pose"):
        np.testing.assert_array_equal(getattr(recorded, column), getattr(log, column))
    assert np.abs(recorded.range - log.range).max() < 1e-6
    assert_same_map(load_map(map_path), expected)
    assert (status.scans, status.echoes) == (len(log), len(log.range))
    counts = status.counts
    assert counts["dropped"] == counts["rejected"] == counts["lost"] == counts["missing"] == counts["gaps"] == 0


@pytest.mark.slow
def test_method_ml_gives_the_map_of_the_log(office, log, tmp_path):
    path = tmp_path / "map.geojson"
    with Device("tcp://127.0.0.1:0", log_messages(log, office.ring)) as device:
        status = stream(device.sink.url, office.ring, map_filename=path)
    mapper = Mapper(ring=office.ring)  # gives the map of build_map (tests/graph_slam)
    state = mapper.start()
    for scan in log:
        state, _ = mapper.step(state, scan)
    assert_same_map(load_map(path), mapper.map(state))
    assert status.lines > 0


@pytest.mark.slow
def test_a_raw_recording_replays_the_device(office, log, expected, tmp_path):
    raw, path, again = tmp_path / "raw.mcap", tmp_path / "map.geojson", tmp_path / "again.csv"
    stream_of = {"method": "hough", "map_filename": path}
    with Device("tcp://127.0.0.1:0", log_messages(log, office.ring)) as device:
        stream(device.sink.url, office.ring, method="hough", record=raw)
    status = stream(f"file:{raw}?speed=0", office.ring, record=again, **stream_of)
    assert status.scans == len(log)
    assert_same_map(load_map(path), expected)
    np.testing.assert_array_equal(load_log(again).pose, log.pose)


@pytest.mark.slow
def test_a_replay_keeps_missing_poses(office, log, tmp_path):
    pose = log.pose.copy()
    pose[[0, 5, 6, 16]] = np.nan
    part = type(log)(log.scan, log.stamp, pose, log.start, log.tx, log.rx, log.range, log.amplitude)
    save_log(part, tmp_path / "part.csv")
    status = stream(f"file:{tmp_path}/part.csv?speed=0", office.ring, method="hough", record=tmp_path / "again.csv")
    np.testing.assert_array_equal(load_log(tmp_path / "again.csv").pose, pose)
    assert status.without_pose == 4


@pytest.mark.slow
def test_a_faulty_link_loses_echoes_and_invents_none(office, log, tmp_path):
    """Every recorded echo was sent; damaged frames are counted."""
    faults = FaultSettings(corrupt=0.1, drop=0.05, reorder=0.1, seed=5)
    with Device("tcp://127.0.0.1:0", log_messages(log, office.ring), faults=faults) as device:
        status = stream(device.sink.url, office.ring, method="hough", record=tmp_path / "rec.csv", map_filename=None)
    found = load_log(tmp_path / "rec.csv")
    row_of = {int(number): row for row, number in enumerate(log.scan)}
    row = np.array([row_of[int(number)] for number in found.scan])[found.echo_scan]
    same = (row[:, None] == log.echo_scan) & (found.tx[:, None] == log.tx) & (found.rx[:, None] == log.rx)
    true = same & (np.abs(found.range[:, None] - log.range) < 1e-6)
    assert (true.sum(axis=1) == 1).all()
    assert true.sum(axis=0).max() == 1
    assert 0.6 * len(log.range) < len(found.range) < len(log.range)
    assert status.counts["rejected"] > 0
    assert status.counts["lost"] > 0
    for scan in found:
        if np.isfinite(scan.pose).all():
            np.testing.assert_array_equal(scan.pose, log.pose[row_of[scan.scan]])
    line = status.text()
    assert f"{status.counts['rejected']} damaged" in line
    assert "\n" not in line


@pytest.mark.slow
@pytest.mark.parametrize("link", ["tcp", "pty"])
def test_a_stream_survives_a_reconnection(link, office, log, tmp_path):
    """The stream continues; the time without a device is recorded and reported."""
    sent = list(log_messages(log, office.ring))
    gone = threading.Event()
    events, path = [], tmp_path / "raw.mcap"
    sink = listen("tcp://127.0.0.1:0" if link == "tcp" else f"pty:{tmp_path}/device")

    def unplugged():
        yield from sent[:70]
        time.sleep(0.3)
        sink.hang_up()
        gone.set()
        yield from sent[70:]

    def run():
        with sink:
            emulate(unplugged(), sink, speed=0.0)

    thread = threading.Thread(target=run)
    thread.start()
    status = stream(sink.url, office.ring, method="hough", record=path, on_event=lambda event: events.append(event))
    thread.join(10)
    assert gone.is_set()
    assert [event.kind for event in events] == ["lost", "back"]
    assert status.counts["gaps"] == 1
    assert status.scans == len(log)
    from jaxsonar.hardware.mcap_recorder import EVENTS, read_mcap

    assert [b'"lost"' in data for topic, _, data in read_mcap(path) if topic == EVENTS] == [True, False]


@pytest.mark.slow
def test_scans_are_queued_during_compilation_and_the_scan_limit_holds(office, log, tmp_path):
    messages = log_messages(log, office.ring)
    seen = []
    with Device("tcp://127.0.0.1:0", messages) as device:
        record = tmp_path / "r.csv"
        status = stream(device.sink.url, office.ring, method="hough", scans=9, record=record, on_scan=seen.append)
    assert status.scans == len(seen) == len(load_log(record)) == 9
    assert [live.scan.scan for live in seen] == log.scan[:9].tolist()
    assert status.warm


@pytest.mark.slow
@pytest.mark.parametrize("mapping", [False, True])
def test_stopping_waits_for_the_compiler_only_if_a_map_is_requested(mapping, office, log, tmp_path, monkeypatch):
    """The recording is complete at once in both cases."""
    compiled, stop, ending = threading.Event(), threading.Event(), []
    monkeypatch.setattr(LiveMap, "warm_up", lambda self: compiled.wait(60))
    record, map_path = tmp_path / "r.csv", tmp_path / "m.geojson"

    def on_status(status):
        if status.queued == len(log):
            stop.set()
        if status.ending and not ending:
            ending.append((len(load_log(record)), os.listdir(tmp_path), status.text()))
            compiled.set()

    with Device("tcp://127.0.0.1:0", log_messages(log, office.ring)) as device:
        choices = {
            "record": record,
            "map_filename": map_path if mapping else None,
            "stop": stop,
            "on_status": on_status,
        }
        status = stream(device.sink.url, office.ring, method="hough", **choices)
    assert len(load_log(record)) == len(log)
    assert status.warm == compiled.is_set() == mapping
    assert status.scans == (len(log) if mapping else 0)
    assert not status.ending
    compiled.set()
    if mapping:
        ((scans, files, line),) = ending
        assert (scans, files) == (len(log), ["r.csv"])
        assert "17 waiting; ending once the map has them" in line
        assert len(load_map(map_path)) > 0


@pytest.mark.slow
def test_errors_are_raised_after_everything_is_written(office, log, tmp_path, monkeypatch):
    from jaxsonar.hardware.transport_base import Source

    broken = ValueError("the driver broke")
    monkeypatch.setattr("jaxsonar.live.replay.LogPlayer.close", lambda self: None)
    real, calls = Source, iter(range(100))

    def read(self, timeout):
        if next(calls) == 2:
            raise broken
        return original(self, timeout)

    from jaxsonar.live.replay import LogPlayer

    original = LogPlayer.read
    monkeypatch.setattr(LogPlayer, "read", read)
    save_log(log, tmp_path / "log.csv")
    paths = {"record": tmp_path / "r.csv", "map_filename": tmp_path / "m.geojson"}
    with pytest.raises(ValueError, match="the driver broke"):
        stream(f"file:{tmp_path}/log.csv?speed=0", office.ring, method="hough", **paths)
    assert issubclass(LogPlayer, real)
    assert 0 < len(load_log(paths["record"])) < len(log)
    assert len(load_map(paths["map_filename"])) > 0


# A robot that moves while the groups fire

WALLS = Room(np.array([[[-1.5, -1.4], [2.0, -1.4]], [[2.0, -1.4], [2.0, 1.3]], [[2.0, 1.3], [-1.5, 1.3]]]))
SPEED, TURN = 0.5, 1.0  # m/s, rad/s


def moving_scans(sigma, count=12):
    """Raw scans of a robot on a curve, each group simulated at its own pose."""
    stamps = 0.1 * np.arange(count)
    along = SPEED * stamps - 0.3
    poses = np.stack([along, 0.1 * np.sin(3 * along), TURN * stamps - 0.4], axis=-1)
    return raw_scans(room_messages(RING, WALLS, poses, stamps, sigma=sigma, seed=1)), poses


def wall_errors(models, poses):
    """Errors of each line against its wall, robot frame, and their covariances."""
    errors, covs = [], []
    for model, pose in zip(models, poses, strict=True):
        for line in model.lines:
            misses = []
            for rho, theta in ((1.4, -np.pi / 2), (2.0, 0.0), (1.3, np.pi / 2)):
                there = rho - pose[:2] @ [np.cos(theta), np.sin(theta)], theta - pose[2]
                misses.append((line.rho - there[0], (line.theta - there[1] + np.pi) % (2 * np.pi) - np.pi))
            errors.append(min(misses, key=lambda miss: abs(miss[1])))
            covs.append(line.cov)
    return np.array(errors), covs


def test_lines_of_a_moving_robot_are_as_accurate_as_at_rest():
    """With the poses of the groups the walls are accurate to the bound; without them errors are much larger."""
    raws, poses = moving_scans(0.001)
    live = LiveMap(RING, sigma=0.001, mapping=False)
    taken = live.process(raws)
    with_motion, covs = wall_errors([scan.model for scan in taken], poses)
    ignoring = [local_model(RING, live.as_scan(raw), sigma=0.001) for raw in raws]
    without, _ = wall_errors(ignoring, poses)
    still = simulate(RING, WALLS, poses, sigma=0.001, seed=2).as_log(RING, poses)
    at_rest, _ = wall_errors([local_model(RING, scan, sigma=0.001) for scan in still], poses)

    def rms(errors):
        return np.sqrt((errors**2).mean(axis=0))

    assert len(with_motion) >= 0.8 * len(at_rest)
    assert (rms(with_motion) < 1.6 * rms(at_rest)).all(), (rms(with_motion), rms(at_rest))
    assert (rms(without) > 4 * rms(with_motion)).all(), (rms(without), rms(with_motion))
    nees = [e @ np.linalg.solve(cov, e) for e, cov in zip(with_motion, covs, strict=True)]
    assert np.median(nees) < 4  # 1.4 for Gaussian errors of that covariance


def test_moved_paths_match_moved_sensors():
    """With one pose for all paths, the arcs are those of a ring mounted at this pose."""
    pose = np.array([0.12, -0.07, 0.4])
    settings = hough_settings(RING, None)
    poses = np.broadcast_to(pose, (len(RING.paths), 3)).astype(np.float32)
    moved = kernels.transform_arcs(arc_tables(RING, settings).arcs, jax.numpy.asarray(poses), settings=settings)
    there = Ring(
        transform_points(pose, np.asarray(RING.position)),
        RING.heading + pose[2],
        beam=RING.beam,
        neighbors=3,
        max_range=2.0,
    )
    other = arc_tables(there, settings).arcs
    for one, two in zip(jax.tree.leaves(moved.paths), jax.tree.leaves(other.paths), strict=True):
        np.testing.assert_allclose(one, two, atol=2e-6)
    for name in ("midpoint_normal", "baseline_tangent_squared", "half_baseline_squared"):
        np.testing.assert_allclose(getattr(moved.arcs, name), getattr(other.arcs, name), atol=2e-6)


@pytest.mark.slow
def test_a_robot_at_rest_needs_no_moved_paths(office, log):
    live = LiveMap(office.ring, method="hough", mapping=False)
    for raw in raw_scans(log_messages(log, office.ring)):
        assert live.path_poses(raw) is None
    zero = np.zeros((len(office.ring.paths), 3))
    one = local_model(office.ring, log[3], method="hough", path_pose=zero)
    two = local_model(office.ring, log[3], method="hough")
    assert [line.as_json() for line in one.lines] == [line.as_json() for line in two.lines]


def test_moved_scans_do_not_recompile():
    raws, _ = moving_scans(0.001, count=4)
    live = LiveMap(RING, method="hough", mapping=False)
    live.process(raws[:1])
    programs = getattr(kernels.transform_arcs, "_cache_size")  # noqa: B009
    before = programs()
    live.process(raws)
    assert programs() == before


def raw_scan(temperature):
    echoes = np.zeros(1, ECHO)
    echoes["time_us"] = 2e6 / 343.2
    nowhere = np.full((1, 3), np.nan)
    return RawScan(0, 0.0, nowhere[0], nowhere, echoes, np.zeros(1, np.int64), temperature, 0, 0.0)


@pytest.mark.parametrize("temperature", [-20.0, 0.0, 35.0])
def test_a_measured_temperature_changes_the_speed_of_sound_only(temperature):
    live = LiveMap(RING, method="hough", mapping=False)
    live.process([raw_scan(float("nan"))])
    assert live.ring is RING
    (taken,) = live.process([raw_scan(temperature)])
    np.testing.assert_allclose(taken.scan.range, [1.0], rtol=1e-6)
    assert live.ring.speed_of_sound == pytest.approx(331.3 * np.sqrt(1 + temperature / 273.15))


# The commands

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
    """End to end with processes and a real link; the first line of the device is its URL."""
    map_path, record = tmp_path / "map.geojson", tmp_path / "rec.parquet"
    url = device("tcp://127.0.0.1:0", "--speed", "0")
    assert re.fullmatch(r"tcp://127\.0\.0\.1:\d+", url)
    streaming = command("stream", url, "--ring", "faw", "--method", "hough", "--record", record, "--map", map_path)
    out, told = streaming.communicate(timeout=120)
    assert (streaming.returncode, out) == (0, ""), told
    assert "17 scans" in told.splitlines()[-1]
    reference = tmp_path / "reference.geojson"
    assert main(["map", str(log_file), "--ring", "faw", "--method", "hough", "-o", str(reference)]) == 0
    assert_same_map(load_map(map_path), load_map(reference))
    assert np.abs(load_log(record).range - load_log(log_file).range).max() < 1e-4


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
    before = time.monotonic()
    streaming.send_signal(signal.SIGINT)
    for _ in range(8 * mapping):  # two signals before the first is handled count as one
        time.sleep(1.0)
        if streaming.poll() is None:
            streaming.send_signal(signal.SIGINT)
    _, told = streaming.communicate(timeout=60)
    assert time.monotonic() - before < 12.0, told
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
