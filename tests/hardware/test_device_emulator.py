"""The emulated device: a log is transmitted unchanged and in real time, with the requested faults."""

import threading
import time
from collections import Counter

import numpy as np
import pytest

from jaxsonar import Log, Ring, simulate
from jaxsonar.geometry.se2 import relative
from jaxsonar.hardware import SonarError
from jaxsonar.hardware import device_emulator as emulator
from jaxsonar.hardware.device_emulator import emulate
from jaxsonar.hardware.fault_injection import FaultInjector, FaultSettings, corrupt_frame, parse_stall
from jaxsonar.hardware.messages import Group, Pose
from jaxsonar.hardware.protocol import Decoder, encode
from jaxsonar.hardware.transport_base import EndOfStream, open_source
from jaxsonar.hardware.transport_servers import Sink, listen
from jaxsonar.simulation.device_messages import log_messages, room_messages
from jaxsonar.simulation.office import load_office


@pytest.fixture(scope="module")
def office():
    return load_office()


@pytest.fixture(scope="module")
def log(office):
    heard = simulate(office.ring, office.room, office.poses, sigma=0.003, clutter=0.1, seed=3, stamps=office.stamps)
    return heard.as_log(office.ring, office.poses)


def log_of(messages):
    """Oracle: the scans in undamaged messages, by a simple receiver."""
    scans, pose = {}, (np.nan,) * 3
    for message in messages:
        if isinstance(message, Pose):
            pose = (message.x, message.y, message.theta)
            continue
        scan = scans.setdefault(message.scan, {"stamp": message.time_us / 1e6, "echoes": []})
        scan["pose"] = pose
        scan["echoes"] += [
            (e["tx"], e["rx"], float(e["time_us"]) * 343.2 / 2e6, e["amplitude"]) for e in message.echoes
        ]
    rows = [(i, *echo) for i, scan in enumerate(scans.values()) for echo in scan["echoes"]]
    index, tx, rx, distance, amplitude = np.array(rows).reshape(-1, 5).T
    return Log.from_echoes(
        index.astype(int),
        tx.astype(int),
        rx.astype(int),
        distance,
        amplitude=amplitude,
        stamp=np.array([scan["stamp"] for scan in scans.values()]),
        pose=np.array([scan["pose"] for scan in scans.values()]),
        scan=np.array(list(scans)),
    )


def in_order(log):
    """Rows of the echoes by scan, path and range."""
    return np.lexsort([log.range, log.rx, log.tx, log.echo_scan])


def assert_same(heard, log):
    assert np.array_equal(heard.scan, log.scan)
    assert np.array_equal(heard.pose, log.pose, equal_nan=True)
    assert np.allclose(heard.stamp, log.stamp, rtol=0, atol=1e-6)
    assert np.array_equal(heard.start, log.start)
    a, b = in_order(heard), in_order(log)
    assert np.array_equal(heard.tx[a], log.tx[b])
    assert np.array_equal(heard.rx[a], log.rx[b])
    assert np.allclose(heard.range[a], log.range[b], rtol=0, atol=1e-5)  # a tenth of the required 0.1 mm
    assert np.allclose(heard.amplitude[a], log.amplitude[b], rtol=1e-6, equal_nan=True)


# --- logs as messages


def test_a_log_comes_back_from_its_messages(office, log):
    sent = list(log_messages(log, office.ring))
    assert_same(log_of(sent), log)
    received = Decoder(sensors=24).feed(b"".join(map(encode, sent)))
    assert_same(log_of(received), log)


def test_the_farthest_echo_keeps_a_tenth_of_a_millimetre():
    """float32 microseconds at 100 m, the largest possible range."""
    ring = Ring.circular(max_range=100.0)
    distance = np.linspace(99.9, 100.0, 1001)
    tx = np.arange(1001) % 24
    log = Log.from_echoes(
        np.arange(1001) // 50, tx, tx, distance, stamp=np.arange(21.0) * 10, pose=np.full((21, 3), np.nan)
    )
    heard = log_of(log_messages(log, ring))
    assert np.abs(heard.range[in_order(heard)] - distance[in_order(log)]).max() < 1e-4 / 4


def test_a_scan_becomes_one_pose_and_its_groups(office, log):
    """A pose, then the groups in order; consecutive numbers, ascending times, and the right transmitters per group."""
    sent = list(log_messages(log, office.ring, temperature=21.5))
    assert [message.sequence for message in sent] == list(range(17 * 9))
    groups = [message for message in sent if isinstance(message, Group)]
    assert [type(message) for message in sent] == ([Pose] + [Group] * 8) * 17
    assert [(g.scan, g.group, g.groups) for g in groups] == [(i, k, 8) for i in range(17) for k in range(8)]
    times = [message.time_us for message in sent]
    assert times == sorted(times)
    assert groups[1].time_us - groups[0].time_us == pytest.approx(2 * 2.0 / 343.2 * 1e6, abs=1)
    assert {g.temperature for g in groups} == {21.5}
    for g in groups:
        assert set(g.echoes["tx"].tolist()) <= set(office.ring.firing_groups[g.group].tolist())
        for path in {(tx, rx) for tx, rx, *_ in g.echoes.tolist()}:
            own = g.echoes[(g.echoes["tx"] == path[0]) & (g.echoes["rx"] == path[1])]
            assert own["echo"][np.argsort(own["time_us"])].tolist() == list(range(len(own)))


def test_logs_with_hardly_any_data_are_sent(office):
    """Scans without echoes are sent, missing poses are not, and missing stamps are consecutive."""
    nothing = np.zeros(0, dtype=int)
    log = Log.from_echoes(
        nothing,
        nothing,
        nothing,
        np.zeros(0),
        stamp=np.full(3, np.nan),
        pose=np.full((3, 3), np.nan),
        scan=np.arange(3),
    )
    for moving in (False, True):
        sent = list(log_messages(log, office.ring, moving=moving))
        assert all(isinstance(message, Group) and len(message.echoes) == 0 for message in sent)
        assert np.diff([message.time_us for message in sent]) == pytest.approx(11655, abs=1)
    assert list(log_messages(log[:0], office.ring)) == []


def test_scans_closer_than_the_time_of_flight_are_rejected(office, log):
    quick = Log.from_echoes(
        log.echo_scan, log.tx, log.rx, log.range, stamp=np.arange(17) * 0.01, pose=log.pose, scan=log.scan
    )
    times = [message.time_us for message in log_messages(quick, office.ring)]
    assert times == sorted(times)


WRONG = {
    "sensor 24 came; allowed with this ring is 0 to 23": {"tx": np.array([24])},
    "sensor 99 came": {"rx": np.array([99])},
    "scan -1 came": {"scan": np.array([-1])},
    "scan 4294967296 came": {"scan": np.array([2**32])},
    "stamp -1 .* came": {"stamp": np.array([-1.0])},
    "stamp 1e.15 .* came": {"stamp": np.array([1e15])},
    "range 200 m, .* came": {"range": np.array([200.0])},
    "range 1e-80 m, .* came": {"range": np.array([1e-80])},
    "amplitude 1e.300 came": {"amplitude": np.array([1e300])},
    r"scan 0: pose \(1e.300, 0.0, 0.0\) came": {"pose": np.array([[1e300, 0.0, 0.0]])},
    r"pose \(0.0, 0.0, -10000000.0\) came": {"pose": np.array([[0.0, 0.0, -1e7]])},
}


@pytest.mark.parametrize("error", WRONG)
def test_logs_that_no_device_can_report_are_rejected(office, error):
    columns = {
        "scan_index": np.array([0]),
        "tx": np.array([3]),
        "rx": np.array([3]),
        "range": np.array([1.0]),
        "stamp": np.array([0.0]),
        "pose": np.zeros((1, 3)),
    }
    log = Log.from_echoes(**{**columns, **WRONG[error]})
    with pytest.raises(SonarError, match=error):
        log_messages(log, office.ring)


def test_too_many_echoes_of_a_path_are_rejected(office):
    zeros = np.zeros(257, dtype=int)
    log = Log.from_echoes(zeros, zeros, zeros, np.linspace(1, 2, 257), stamp=np.zeros(1), pose=np.zeros((1, 3)))
    with pytest.raises(SonarError, match="257 echoes of one path"):
        log_messages(log, office.ring)


def test_a_descending_stamp_is_rejected(office, log):
    back = Log.from_echoes(log.echo_scan, log.tx, log.rx, log.range, stamp=log.stamp[::-1], pose=log.pose)
    with pytest.raises(SonarError, match=r"scans\[1\]\) came; allowed are seconds"):
        log_messages(back, office.ring)


def test_poses_are_interpolated_between_scans(office):
    """A robot at constant speed whose heading crosses pi: the poses of its groups follow."""
    stamps = np.arange(6) * 0.2
    poses = np.stack([1.0 + 0.5 * stamps, 2.0 - 0.3 * stamps, 3.0 + 1.0 * stamps], axis=-1)
    poses[:, 2] = (poses[:, 2] + np.pi) % (2 * np.pi) - np.pi
    nothing = np.zeros(0, dtype=int)
    log = Log.from_echoes(nothing, nothing, nothing, np.zeros(0), stamp=stamps, pose=poses)
    sent = list(log_messages(log, office.ring, moving=True))
    found = np.array([[m.time_us / 1e6, m.x, m.y, m.theta] for m in sent if isinstance(m, Pose)])
    assert [type(message) for message in sent] == [Pose, Group] * 48
    assert np.array_equal(found[7::8, 1:], poses)  # the last group has the pose of the log
    since = np.maximum(found[:, 0] - found[7, 0], 0)  # before the first scan there is no motion
    expected = poses[0] + since[:, None] * np.array([0.5, -0.3, 1.0])
    assert np.abs(relative(expected, found[:, 1:])).max() < 1e-5
    assert np.abs(found[:, 3]).max() <= np.pi


def test_a_missing_pose_is_not_interpolated(office):
    stamps = np.arange(4.0)
    poses = np.array([[0.0, 0, 0], [np.nan] * 3, [2.0, 0, 0], [3.0, 0, 0]])
    nothing = np.zeros(0, dtype=int)
    log = Log.from_echoes(nothing, nothing, nothing, np.zeros(0), stamp=stamps, pose=poses)
    scans = Counter(
        round(m.time_us / 1e6 - 0.05) for m in log_messages(log, office.ring, moving=True) if isinstance(m, Pose)
    )
    assert scans == {0: 8, 1: 1, 2: 8, 3: 8}  # one message reports the unknown pose


def test_a_pose_that_is_missing_is_no_lost_message(office, log):
    """The sequence has no gap, and the log comes back with the same missing poses."""
    pose = log.pose.copy()
    pose[[0, 3, 4, 9]] = np.nan
    part = Log.from_echoes(
        log.echo_scan, log.tx, log.rx, log.range, amplitude=log.amplitude, stamp=log.stamp, pose=pose, scan=log.scan
    )
    sent = list(log_messages(part, office.ring))
    assert [message.sequence for message in sent] == list(range(len(sent)))
    assert_same(log_of(sent), part)


def test_a_standing_robot_gets_the_echoes_of_a_simulated_scan(office):
    """Without motion, separately simulated groups are the simulated scan."""
    poses = np.repeat(office.poses[3:4], 2, axis=0)
    stamps = np.array([0.0, 0.5])
    log = simulate(office.ring, office.room, poses, stamps=stamps).as_log(office.ring, poses)
    assert_same(log_of(room_messages(office.ring, office.room, poses, stamps)), log)


def test_a_moving_robot_gets_each_group_at_its_own_pose(office):
    stamps = np.array([0.0, 0.2])
    poses = office.poses[:2]
    sent = list(room_messages(office.ring, office.room, poses, stamps, seed=4, temperature=-5.0))
    compared = 0
    for pose, group in zip(sent[::2], sent[1::2], strict=True):
        assert isinstance(pose, Pose)
        assert isinstance(group, Group)
        still = np.array([[pose.x, pose.y, pose.theta]])
        there = simulate(office.ring, office.room, still).as_log(office.ring, still)
        own = np.isin(there.tx, office.ring.firing_groups[group.group])
        want = sorted(zip(there.tx[own].tolist(), there.rx[own].tolist(), there.range[own].tolist(), strict=True))
        got = sorted((tx, rx, t * 343.2 / 2e6) for tx, rx, _, _, t, _ in group.echoes.tolist())
        assert [echo[:2] for echo in got] == [echo[:2] for echo in want]
        assert [echo[2] for echo in got] == pytest.approx([echo[2] for echo in want], abs=1e-5)
        compared += len(got)
    assert compared > 50


# --- the device on a link


class Running:
    """An emulated device in a thread, and its counters."""

    def __init__(self, messages, url, **settings):
        self.stop, self.sink, self.error = threading.Event(), listen(url), None
        self.url = self.sink.url
        self.thread = threading.Thread(target=self._run, args=(messages, settings))
        self.thread.start()

    def _run(self, messages, settings):
        try:
            with self.sink:
                self.served = emulate(messages, self.sink, stop=self.stop, **settings)
        except Exception as error:
            self.error = error

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.stop.set()
        self.thread.join(20)
        assert not self.thread.is_alive()
        assert self.error is None, self.error


def receive(url, *, seconds=30.0, until=lambda decoder, found: False, **settings):
    """(messages, decoder, times of arrival) until the end frame."""
    decoder, found, when = Decoder(sensors=24), [], []
    with open_source(url, **settings) as source:
        end = time.monotonic() + seconds
        while not decoder.ended and not until(decoder, found) and time.monotonic() < end:
            try:
                data = source.read(0.1)
            except EndOfStream:
                break
            found += decoder.feed(data or b"")
            when += [time.monotonic()] * (len(found) - len(when))
    return found, decoder, when


URLS = {"tcp": "tcp://127.0.0.1:0", "udp": "udp://127.0.0.1:0", "pty": "pty:"}


@pytest.mark.parametrize("url", URLS.values(), ids=URLS)
def test_the_office_log_survives_every_transport(url, office, log):
    sent = list(log_messages(log, office.ring))
    with Running(sent, url, speed=0.0) as device:
        found, decoder, _ = receive(device.url)
    assert decoder.ended
    assert decoder.counts.rejected == 0
    assert [message.sequence for message in found] == list(range(len(sent)))
    assert_same(log_of(found), log)
    served = device.served
    assert (served.messages, served.frames, served.clients) == (len(sent), len(sent), 1)
    assert served.sent_bytes == sum(len(encode(message)) for message in sent)


class Clocked(Sink):
    """A client that reads everything at once and records the time."""

    def __init__(self):
        self.there, self.when = time.monotonic(), []

    def wait_client(self, stop):
        self.there = time.monotonic()
        return True

    def send(self, data, stop):
        self.when.append(time.monotonic() - self.there)
        return True

    def hang_up(self):
        pass

    def close(self):
        pass


def test_messages_are_sent_in_real_time(office, log):
    """At 20 times the speed: never early, and late only because of a busy machine."""
    sent = list(log_messages(log[:4], office.ring))
    sink = Clocked()
    served = emulate(sent, sink, speed=20.0)
    due = np.array([message.time_us for message in sent]) / 1e6 / 20
    late = np.array(sink.when[: len(sent)]) - due
    assert due[-1] > 0.25
    assert late.min() >= 0
    assert np.median(late) < 0.1
    assert late.max() == pytest.approx(served.max_delay, abs=0.1)


def test_the_playback_speed_scales_time(office, log):
    took = []
    for speed in (0.0, 20.0):
        with Running(list(log_messages(log[:8], office.ring)), "tcp://127.0.0.1:0", speed=speed) as device:
            _, _, when = receive(device.url)
        took.append(when[-1] - when[0])
    assert took[0] < took[1]
    assert took[1] > 0.9 * (log.stamp[7] - log.stamp[0]) / 20


@pytest.mark.parametrize("speed", [-1.0, np.nan, np.inf])
def test_invalid_speeds_are_rejected(speed):
    with listen("tcp://:0") as sink, pytest.raises(SonarError, match=r"--speed: .* came; allowed is 0"):
        emulate([], sink, speed=speed)


@pytest.mark.parametrize("scheme", ["tcp", "pty"])
def test_the_next_client_continues_where_the_last_one_left(scheme, office, log):
    """No message is skipped between two clients, and the device waits without a client."""
    sent = list(log_messages(log, office.ring))
    half = len(sent) // 2
    left = threading.Event()

    def slowly():
        yield from sent[:half]
        left.wait(20)
        yield from sent[half:]

    with Running(slowly(), URLS[scheme], speed=0.0) as device:
        first, *_ = receive(device.url, until=lambda decoder, found: len(found) == half)
        left.set()
        second, decoder, _ = receive(device.url)
    assert decoder.ended
    assert [message.sequence for message in first + second] == [message.sequence for message in sent]
    # The device cannot see that a terminal was closed if it is reopened at once.
    assert device.served.clients == 2 or (scheme == "pty" and device.served.clients == 1)


def test_an_unplugged_link_loses_only_what_was_in_flight(office, log):
    """The source reconnects after a reset; messages in flight are lost, the others are complete."""
    sent = list(log_messages(log, office.ring))
    events = []
    sink = listen("tcp://127.0.0.1:0")

    def with_a_break():
        for message in sent:
            if message.sequence == 70:
                time.sleep(0.2)
                sink.hang_up()
            yield message

    with sink:
        thread = threading.Thread(target=emulate, args=(with_a_break(), sink), kwargs={"speed": 0.0})
        thread.start()
        found, decoder, _ = receive(sink.url, on_event=events.append)
        thread.join(20)
    assert decoder.ended
    assert [event.kind for event in events] == ["lost", "back"]
    numbers = [message.sequence for message in found]
    assert numbers == sorted(set(numbers))
    assert numbers[-(len(sent) - 70) :] == list(range(70, len(sent)))


def test_a_waiting_device_can_be_stopped(office, log):
    """While it waits for a client, for the time of a message, or for a client that does not read."""
    sent = list(log_messages(log, office.ring))
    with Running(sent, "tcp://127.0.0.1:0"):
        time.sleep(0.1)
    with Running(sent, "tcp://127.0.0.1:0", speed=1e-6) as device:
        found, *_ = receive(device.url, until=lambda decoder, found: len(found) == 2)
    assert len(found) == 2
    with Running(sent * 300, "tcp://127.0.0.1:0", speed=0.0) as device, open_source(device.url):
        time.sleep(0.3)
        begin = time.monotonic()
        device.stop.set()
        device.thread.join(20)
        assert time.monotonic() - begin < 10


def test_a_message_that_cannot_be_encoded_is_an_error():
    bad = Pose(0, 0, float("nan"), 0.0, 0.0)
    with listen("tcp://:0") as sink, pytest.raises(SonarError, match="pose message"):
        emulate([bad], sink)


# --- faulty links


def test_injected_faults_never_become_echoes(office, log):
    """Received data are correct, lost and damaged frames are counted, and the order is kept up to swaps."""
    sent = list(log_messages(log, office.ring))
    faults = FaultSettings(corrupt=0.1, drop=0.1, reorder=0.1, seed=5)
    with Running(sent, "tcp://127.0.0.1:0", speed=0.0, faults=faults) as device:
        found, decoder, _ = receive(device.url)
    done = device.served
    true = {message.sequence: encode(message) for message in sent}
    assert all(encode(message) == true[message.sequence] for message in found)
    assert 5 < done.damaged < 30
    assert 5 < done.dropped < 30
    assert 5 < done.swapped < 30
    assert len(sent) - done.dropped - 2 * done.damaged <= len(found) <= len(sent) - done.dropped
    assert decoder.counts.rejected > 0
    numbers = [message.sequence for message in found]
    assert numbers != sorted(numbers)
    assert np.diff(numbers).min() >= -1 - 2 * (done.dropped + done.damaged)


def test_the_same_seed_makes_the_same_faults(office, log):
    frames = [encode(message) for message in log_messages(log, office.ring)]

    def passed(seed):
        link = FaultInjector(FaultSettings(corrupt=0.2, drop=0.2, reorder=0.2, seed=seed))
        return [piece for data in frames for piece in link.transmit(data)] + link.flush()

    assert passed(1) == passed(1)
    assert passed(1) != passed(2)


def test_each_fault_does_what_it_says():
    frames = [bytes([k, 255, 0]) for k in range(1, 201)]
    none, lost = FaultInjector(FaultSettings()), FaultInjector(FaultSettings(drop=1.0))
    bad, swapped = FaultInjector(FaultSettings(corrupt=1.0)), FaultInjector(FaultSettings(reorder=1.0))
    assert [none.transmit(data) for data in frames] == [[data] for data in frames]
    assert [lost.transmit(data) for data in frames] == [[]] * 200
    assert all(bad.transmit(data) != [data] for data in frames)
    pairs = [swapped.transmit(data) for data in frames[:5]]
    assert pairs == [[], [frames[1], frames[0]], [], [frames[3], frames[2]], []]
    assert swapped.flush() == [frames[4]]
    assert swapped.flush() == []
    assert (none.damaged, lost.dropped, bad.damaged, swapped.swapped) == (0, 200, 200, 3)


def test_every_kind_of_corruption_occurs(rng):
    whole = bytes(range(1, 100)) + b"\0"
    sizes = Counter(np.sign(len(corrupt_frame(rng, whole)) - len(whole)) for _ in range(600))
    assert min(sizes[-1], sizes[0], sizes[1]) > 150
    assert all(corrupt_frame(rng, whole) != whole for _ in range(1000))
    assert all(corrupt_frame(rng, b"\0") != b"\0" for _ in range(100))


def test_a_stalled_device_sends_late(office, log):
    """The receiver reports the silence, and the delayed messages arrive afterwards."""
    sent = list(log_messages(log[:4], office.ring))

    def slowly():
        for message in sent:
            time.sleep(0.02)
            yield message

    events = []
    with Running(slowly(), "tcp://127.0.0.1:0", speed=0.0, faults=FaultSettings(stall=0.5, every=0.6)) as device:
        found, *_ = receive(device.url, on_event=events.append, silence=0.3)
    assert len(found) == len(sent)
    assert device.served.stalls >= 1
    assert [event.kind for event in events][:2] == ["silent", "back"]


def test_stalls_are_periodic():
    link = FaultInjector(FaultSettings(stall=1.0, every=10.0))
    pauses = [(k / 10, link.stall_duration(k / 10)) for k in range(500)]
    assert [when for when, pause in pauses if pause] == [10.0, 20.0, 30.0, 40.0]
    late = FaultInjector(FaultSettings(stall=1.0, every=10.0))
    assert [late.stall_duration(when) for when in (9.9, 35.0, 39.0, 40.0, 41.0)] == [0.0, 1.0, 0.0, 1.0, 0.0]


@pytest.mark.parametrize(
    ("text", "stall"), [("2", (2.0, 10.0)), ("2@7", (2.0, 7.0)), (".5@1.5", (0.5, 1.5)), ("30", (30.0, 60.0))]
)
def test_stall_options_are_parsed(text, stall):
    assert parse_stall(text) == stall
    FaultSettings(stall=stall[0], every=stall[1])


@pytest.mark.parametrize("text", ["", "x", "2@", "@2", "-1", "2@3@4", "nan", "1e3"])
def test_invalid_stalls_are_rejected(text):
    with pytest.raises(SonarError, match=r"--stall: .* came; allowed is"):
        parse_stall(text)


@pytest.mark.parametrize(
    "faults",
    [
        {"corrupt": 1.1},
        {"drop": -0.1},
        {"reorder": np.nan},
        {"stall": -1.0},
        {"stall": 5.0, "every": 5.0},
        {"seed": -1},
    ],
    ids=str,
)
def test_invalid_faults_are_rejected(faults):
    with pytest.raises(SonarError, match=rf"--{next(iter(faults))}: .* came; allowed is"):
        FaultSettings(**faults)


def test_the_end_frame_is_repeated():
    assert emulator.END_FRAMES > 1
