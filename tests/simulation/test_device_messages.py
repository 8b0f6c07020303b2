"""Device messages: a log becomes messages and comes back, and simulated scans are those of the simulator."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.emulated_devices import assert_same_log, echo_order, log_from_messages, office_log

from jaxsonar import Log, Ring, simulate
from jaxsonar.geometry.se2 import relative, wrap_angle
from jaxsonar.hardware import SonarError
from jaxsonar.hardware.messages import Group, Pose
from jaxsonar.hardware.protocol import Decoder, encode
from jaxsonar.hardware.scan_assembler import ScanAssembler
from jaxsonar.scans.firing_poses import reading_poses
from jaxsonar.scans.raw_scans import group_paths, scan_from_raw
from jaxsonar.simulation.device_messages import log_messages, room_messages


@pytest.fixture(scope="module")
def log(office):
    return office_log(office, sigma=0.003, clutter=0.1)


def test_a_log_comes_back_from_its_messages(office, log):
    sent = list(log_messages(log, office.ring))
    assert_same_log(log_from_messages(sent), log)
    received = Decoder(sensors=24).feed(b"".join(map(encode, sent)))
    assert_same_log(log_from_messages(received), log)


def test_the_farthest_echo_keeps_a_tenth_of_a_millimetre():
    """float32 microseconds at 100 m, the largest possible range."""
    ring = Ring.circular(max_range=100.0)
    distance = np.linspace(99.9, 100.0, 1001)
    tx = np.arange(1001) % 24
    log = Log.from_echoes(
        np.arange(1001) // 50, tx, tx, distance, stamp=np.arange(21.0) * 10, pose=np.full((21, 3), np.nan)
    )
    heard = log_from_messages(log_messages(log, ring))
    assert np.abs(heard.range[echo_order(heard)] - distance[echo_order(log)]).max() < 1e-4 / 4


def test_a_scan_becomes_one_pose_and_its_groups(office, log):
    """A pose, then the groups in order; consecutive numbers, ascending times, and the right transmitters per group."""
    sent = list(log_messages(log, office.ring, temperature=21.5))
    assert [message.sequence for message in sent] == list(range(17 * 9))
    groups = [message for message in sent if isinstance(message, Group)]
    assert [type(message) for message in sent] == ([Pose] + [Group] * 8) * 17
    assert [(g.scan, g.group, g.groups) for g in groups] == [(i, k, 8) for i in range(17) for k in range(8)]
    times = [message.time_us for message in sent]
    assert times == sorted(times)
    assert times == np.repeat(np.round(log.stamp * 1e6), 9).tolist()  # readings without t belong to the stamp
    moving = [message.time_us for message in log_messages(log, office.ring, moving=True) if isinstance(message, Group)]
    assert moving[1] - moving[0] == pytest.approx(2 * 2.0 / 343.2 * 1e6, abs=1)
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
        steps = np.diff([message.time_us for message in sent])
        assert steps[7::8] == pytest.approx(11655 if moving else 8 * 11655, abs=8)
        assert np.delete(steps, [7, 15]) == pytest.approx(11655 if moving else 0, abs=1)
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
    """A robot on a circle whose heading crosses pi: the poses of its groups follow."""

    def circle(time):
        theta = 3.0 + 1.0 * time
        return np.stack([1.0 + 0.5 * np.sin(theta), 2.0 - 0.5 * np.cos(theta), wrap_angle(theta)], axis=-1)

    stamps = np.arange(6) * 0.2
    poses = circle(stamps)
    nothing = np.zeros(0, dtype=int)
    log = Log.from_echoes(nothing, nothing, nothing, np.zeros(0), stamp=stamps, pose=poses)
    sent = list(log_messages(log, office.ring, moving=True))
    found = np.array([[m.time_us / 1e6, m.x, m.y, m.theta] for m in sent if isinstance(m, Pose)])
    assert [type(message) for message in sent] == [Pose, Group] * 48
    assert np.array_equal(found[::8, 1:], poses)  # the first group has the pose of the log
    assert np.abs(relative(circle(found[:, 0]), found[:, 1:])).max() < 1e-6  # times have whole microseconds
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
    assert_same_log(log_from_messages(sent), part)


def test_a_standing_robot_gets_the_echoes_of_a_simulated_scan(office):
    """Without motion, separately simulated groups are the simulated scan."""
    poses = np.repeat(office.poses[3:4], 2, axis=0)
    stamps = np.array([0.0, 0.5])
    log = simulate(office.ring, office.room, poses, stamps=stamps).as_log(office.ring, poses)
    assert_same_log(log_from_messages(room_messages(office.ring, office.room, poses, stamps)), log)


@pytest.mark.slow
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


RING = Ring.circular(count=8, neighbors=1)
"""Four groups of two sensors."""


def received(sent):
    """The log that a recorder makes of messages."""
    assembler = ScanAssembler(sensors=RING.count, group_paths=group_paths(RING))
    raws = [raw for message in sent for raw in assembler.push(message, 0.0)] + assembler.flush()
    return Log.from_scans([scan_from_raw(raw) for raw in raws])


def readings(log):
    """{(scan, stamp, tx, rx): (ranges, t)} of a log."""
    found = {}
    for scan in log:
        for tx, rx, distance, t in zip(scan.tx.tolist(), scan.rx.tolist(), scan.range, scan.t, strict=True):
            key = (scan.scan, round(scan.stamp + t, 5), tx, rx)
            found.setdefault(key, []).append(None if np.isnan(distance) else round(distance, 5))
    return found


def explicit_log(seed, *, how):
    """A random explicit log: groups of the ring, or one sensor after another; some firings are missing."""
    rng = np.random.default_rng(seed)
    group = np.arange(8) % 4 if how == "groups" else np.arange(8)
    rows, stamps = [], []
    for scan in range(6):
        fired = np.flatnonzero(rng.random(group.max() + 1) < 0.7) if scan else np.arange(group.max() + 1)
        late = 0.01 * np.arange(group.max() + 1) + rng.uniform(0, 0.005)
        late -= late[fired].min(initial=np.inf) if len(fired) else 0.0
        for tx, rx in RING.paths.tolist():
            if group[tx] in fired:
                count = rng.integers(0, 3) if scan else 1
                ranges = np.sort(rng.integers(300, 1900, count)) / 1000 if count else [np.nan]
                rows += [(scan, tx, rx, distance, late[group[tx]]) for distance in ranges]
        stamps.append(3.0 + 0.2 * scan)
    index, tx, rx, distance, t = np.array(rows).T
    index, tx, rx = (column.astype(int) for column in (index, tx, rx))
    pose = np.stack([0.3 * np.array(stamps), np.zeros(6), 0.2 * np.array(stamps)], axis=-1)
    return Log.from_echoes(index, tx, rx, distance, t=t, stamp=np.array(stamps), pose=pose)


@pytest.mark.parametrize("how", ["groups", "sensors"])
@given(seed=st.integers(0, 2**32 - 1))
def test_an_explicit_log_comes_back_with_what_it_measured_and_when(how, seed):
    """Only groups that fired are sent, at their times; silent paths stay silent, and others unmeasured."""
    log = explicit_log(seed, how=how)
    sent = list(log_messages(log, RING))
    back = received(sent)
    assert readings(back) == readings(log)
    assert len(back.asked) == 0
    poses = {message.time_us: (message.x, message.y, message.theta) for message in sent if isinstance(message, Pose)}
    expected = reading_poses(log)
    for scan, pose, t in zip(log.stamp[log.echo_scan], expected, log.t, strict=True):
        if round((scan + t) * 1e6) in poses:
            np.testing.assert_allclose(poses[round((scan + t) * 1e6)], pose, rtol=0, atol=1e-9)


def test_sensors_that_fire_in_turn_come_back_one_scan_each():
    tx = np.arange(16) % 8
    stamps = 1.0 + 0.025 * np.arange(16)
    distance = np.where(np.arange(16) % 5 == 3, np.nan, 1.0 + 0.01 * np.arange(16))
    log = Log.from_echoes(np.arange(16), tx, tx, distance, stamp=stamps, pose=np.zeros((16, 3)))
    assert readings(received(log_messages(log, RING))) == readings(log)


def test_repeated_old_readings_are_not_sent():
    """A reading with an age whose original is in the log was not measured again."""
    index, tx = np.repeat(np.arange(3), 2), np.tile([0, 4], 3)
    distance = np.array([1.0, 1.1, 1.2, 1.1, 1.3, np.nan])
    age = np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0])
    pose = np.zeros((3, 3))
    log = Log.from_echoes(index, tx, tx, distance, age=age, stamp=0.1 * np.arange(3), pose=pose)
    back = readings(received(log_messages(log, RING)))
    assert [(scan, tx) for scan, _, tx, _ in back] == [(0, 0), (0, 4), (1, 0), (2, 0), (2, 4)]
