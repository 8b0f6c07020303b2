"""From a device to lines and a map: the same results as from the log, and correct for a moving robot."""

import os
import threading
import time

import numpy as np
import pytest
from support.emulated_devices import EmulatedDevice, office_log
from support.fake_devices import Given
from support.logs import echoes_of
from support.maps import assert_same_map

from jaxsonar import Log, Mapper, Ring, build_map, load_log, load_map, save_log
from jaxsonar.hardware.device_emulator import emulate
from jaxsonar.hardware.drop_oldest_queue import DropOldestQueue
from jaxsonar.hardware.fault_injection import FaultSettings
from jaxsonar.hardware.messages import ECHO, Group, Pose
from jaxsonar.hardware.protocol import encode
from jaxsonar.hardware.reader_thread import ReaderThread
from jaxsonar.hardware.scan_assembler import RawScan, ScanAssembler
from jaxsonar.hardware.transport_servers import listen
from jaxsonar.live.live_map import LiveMap
from jaxsonar.live.status import Status
from jaxsonar.live.stream import stream
from jaxsonar.scans.measured_paths import measured_paths
from jaxsonar.scans.raw_scans import group_paths
from jaxsonar.simulation.device_messages import log_messages

RING = Ring.circular()
LINKS = ("tcp://127.0.0.1:0", "udp://127.0.0.1:0", "pty:")


@pytest.fixture(scope="module")
def log(office):
    return office_log(office, sigma=0.002)


@pytest.fixture(scope="module")
def log_file(log, tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "office.csv"
    save_log(log, path)
    return path


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
        with EmulatedDevice(log_messages(log, office.ring), link, speed=0.0) as device:
            status = stream(device.sink.url, office.ring, **choices)
    recorded = echoes_of(load_log(path))
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
    with EmulatedDevice(log_messages(log, office.ring), "tcp://127.0.0.1:0", speed=0.0) as device:
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
    with EmulatedDevice(log_messages(log, office.ring), "tcp://127.0.0.1:0", speed=0.0) as device:
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
    with EmulatedDevice(log_messages(log, office.ring), "tcp://127.0.0.1:0", speed=0.0, faults=faults) as device:
        status = stream(device.sink.url, office.ring, method="hough", record=tmp_path / "rec.csv", map_filename=None)
    found = echoes_of(load_log(tmp_path / "rec.csv"))
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
        sink.disconnect()
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
    with EmulatedDevice(messages, "tcp://127.0.0.1:0", speed=0.0) as device:
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

    with EmulatedDevice(log_messages(log, office.ring), "tcp://127.0.0.1:0", speed=0.0) as device:
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
        assert "17 waiting; ending when these are in the map" in line
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


def test_an_explicit_log_is_replayed_and_recorded_with_what_it_measured(office, log, tmp_path):
    """Firing groups with times; some did not fire."""
    ring, rng = office.ring, np.random.default_rng(2)
    group_of = np.empty(ring.count, int)
    for group, sensors in enumerate(ring.firing_groups):
        group_of[sensors] = group
    fired = rng.random((len(log), 8)) < 0.8
    fired[0] = True
    heard = np.isin(np.arange(len(log.tx)), np.flatnonzero(fired[log.echo_scan, group_of[log.tx]]))
    rows = [(k, *ring.paths[p]) for k in range(len(log)) for p in range(len(ring.paths))]
    echoes = {(k, tx, rx) for k, tx, rx in zip(log.echo_scan[heard], log.tx[heard], log.rx[heard], strict=True)}
    silent = np.array([row for row in rows if row not in echoes and fired[row[0], group_of[row[1]]]])
    scan = np.concatenate([log.echo_scan[heard], silent[:, 0]])
    order = np.argsort(scan, kind="stable")
    tx = np.concatenate([log.tx[heard], silent[:, 1]])[order]
    rx = np.concatenate([log.rx[heard], silent[:, 2]])[order]
    ranges = np.concatenate([log.range[heard], np.full(len(silent), np.nan)])[order]
    scan = scan[order]
    first = np.argmax(fired, axis=1)
    t = 0.012 * (group_of[tx] - first[scan])
    explicit = Log.from_echoes(scan, tx, rx, ranges, t=t, stamp=log.stamp, pose=log.pose)
    save_log(explicit, tmp_path / "log.csv")
    status = stream(f"file:{tmp_path}/log.csv?speed=0", ring, method="hough", record=tmp_path / "again.csv")
    back = load_log(tmp_path / "again.csv")
    assert status.echoes == explicit.echo_count
    np.testing.assert_array_equal(measured_paths(ring, back), measured_paths(ring, explicit))
    a, b = (np.lexsort([one.range, one.rx, one.tx, one.echo_scan]) for one in (back, explicit))
    for column in ("echo_scan", "tx", "rx"):
        np.testing.assert_array_equal(getattr(back, column)[a], getattr(explicit, column)[b])
    np.testing.assert_allclose(back.range[a], explicit.range[b], rtol=0, atol=1e-6)
    np.testing.assert_allclose(back.t[a], explicit.t[b], rtol=0, atol=1.1e-6)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "no data came"),
        (b"1.20, 0.80, 3.10\n" * 200, "no frame of the wire protocol in 3400 bytes"),
        (b"".join(encode(Pose(k, k, 0.0, 0.0, 0.0)) for k in range(3)), "no firing group in 3 frames"),
    ],
)
def test_a_stream_without_scans_is_explained(data, reason, office):
    queue: DropOldestQueue[RawScan] = DropOldestQueue()
    reader = ReaderThread(Given([data]), queue, sensors=24, group_paths=group_paths(office.ring))
    reader.start()
    while not queue.ended:
        queue.get(1.0)
    status = Status(counts=reader.counts)
    assert reason in status.why_nothing_is_used(office.ring)


def test_a_stream_without_a_used_echo_is_explained(office):
    ring = office.ring
    far = np.zeros(1, ECHO)
    far["time_us"] = 2e4
    for echoes, reason in ((far[:0], "no echo in 1 scan"), (far, "none of the 1 echoes is within the maximum range")):
        group = Group(0, 0, 0, 0, 1, float("nan"), echoes)
        live = LiveMap(ring, method="hough", mapping=False)
        raw = ScanAssembler(sensors=24, group_paths=group_paths(ring)).push(group, 0.0)
        live.process(raw)
        counts = {"bytes": 50, "frames": 1, "scans": 1, "echoes": len(echoes)}
        status = Status(scans=1, echoes=len(echoes), in_range=live.in_range, warm=True, counts=counts)
        assert reason in status.why_nothing_is_used(ring)
