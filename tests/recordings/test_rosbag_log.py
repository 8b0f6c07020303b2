"""Logs of bags of all kinds: every reading at its own time, whatever the bag calls its sensors."""

import numpy as np
import pytest
from support.bags import KINDS, START, BagMessages, bag_of_firings, firing_log, sonar_ring, spinning
from support.hard_cones import simulate
from support.rooms import loop

from jaxsonar import Log, Room, load_log
from jaxsonar.geometry.se2 import compose, wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.recordings.input_options import InputOptions
from jaxsonar.recordings.rosbag_log import read_bag
from jaxsonar.scans.firing_poses import reading_poses

pytest.importorskip("rosbags")

ROOM = Room(loop([(0, 0), (4.2, 0), (4.2, 3.0), (0, 3.0)]))
RING = sonar_ring(8, max_range=1.6)
SIDES = ["front", "front_left", "left", "rear_left", "rear", "rear_right", "right", "front_right"]


def drive(time):
    """A robot that drives a circle."""
    angle = 0.5 * time
    return np.array([2.1 + 0.5 * np.sin(angle), 1.0 + 0.5 - 0.5 * np.cos(angle), wrap_angle(angle)])


@pytest.fixture(scope="module")
def firings():
    """Sensors that fire in turn every 30 ms on a moving robot."""
    return firing_log(RING, ROOM, drive, np.arange(200) * 0.03)


def read(bag, path, *, ring=RING, **options):
    """The log of a bag, and the notes."""
    notes = []
    return read_bag(bag.write(path / "run"), ring=ring, options=InputOptions(**options), on_note=notes.append), notes


def assert_same_readings(log: Log, firings: Log, pose_at=drive, *, atol=2e-3):
    """Check that a log has these firings, each at its time and the pose of this time."""
    assert log.tx.tolist() == log.rx.tolist() == firings.tx.tolist()
    np.testing.assert_allclose(log.range, firings.range, atol=1e-6)
    time = log.stamp[log.echo_scan] + log.t - START
    np.testing.assert_allclose(time, firings.stamp[firings.echo_scan], atol=1e-6)
    if pose_at is None:
        assert np.isnan(log.pose).all()
        assert log.odometry is None
        return
    expected = np.array([pose_at(one) for one in time])
    found = reading_poses(log)
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=atol)
    np.testing.assert_allclose(wrap_angle(found[:, 2] - expected[:, 2]), 0, atol=atol)
    assert len(log.asked) == 0
    assert log.odometry is not None


@pytest.mark.parametrize("kind", KINDS)
def test_every_reading_has_its_time_and_pose(firings, tmp_path, kind):
    log, notes = read(bag_of_firings(firings, kind, pose_at=drive), tmp_path)
    assert_same_readings(log, firings)
    assert len(log) == 25
    assert all(np.diff(log.start) == 8)
    assert 0 < log.echo_count < len(log.tx)
    assert notes == [
        "sensors: 8 by the numbers of their frames, sonar_0 to sonar_7",
        "odometry: /odom (odom -> base_link), the only one",
        "times: stamps of the headers",
        f"no echo: +inf ({200 - log.echo_count})",
        f"scans: 25 with {log.echo_count} echoes and {200 - log.echo_count} silent readings",
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_the_content_decides_not_the_suffix(firings, tmp_path, kind):
    bag = bag_of_firings(firings[:40], kind, pose_at=drive).write(tmp_path / "run")
    file = bag if kind == "ros1" else next(one for one in bag.iterdir() if one.suffix != ".yaml")
    other = tmp_path / "recording.dat"
    other.write_bytes(file.read_bytes())
    for path in (bag, file, other):
        assert_same_readings(load_log(path, ring=RING), firings[:40])


@pytest.mark.parametrize(
    "names", ["ultrasonic/{}", "/robot1/us_{}_link", "hcsr04_{}", *([[f"hcsr04_{side}" for side in SIDES]])]
)
def test_names_of_sensors(firings, tmp_path, names):
    given = {} if isinstance(names, str) else {name: k for k, name in enumerate(names)}
    log, _ = read(bag_of_firings(firings, names=names, pose_at=drive), tmp_path, sensors=given)
    assert_same_readings(log, firings)


def test_names_of_the_ring(firings, tmp_path):
    names = [f"sonar_{k + 1}" for k in range(8)]
    bag = bag_of_firings(firings, names=names, pose_at=drive).write(tmp_path / "run")
    for prefix in ("", "/"):
        ring = sonar_ring(8, names=[f"{prefix}{name}" for name in names])
        assert_same_readings(load_log(bag, ring=ring), firings)
    with pytest.raises(SonarError, match=r"seem to count from 1.*--sensor sonar_1=0 --sensor sonar_2=1 "):
        load_log(bag, ring=RING)
    turned = sonar_ring(8, names=names[::-1])
    assert load_log(bag, ring=turned).tx.tolist() == (7 - firings.tx).tolist()


def test_all_sensors_on_one_topic(firings, tmp_path):
    bag = BagMessages()
    for scan in firings:
        bag.range(scan.stamp, float(np.nan_to_num(scan.range[0], nan=np.inf)), frame=f"us{scan.tx[0]}", topic="/sonars")
        bag.odometry(scan.stamp, drive(scan.stamp))
    assert_same_readings(read(bag, tmp_path)[0], firings)


@pytest.mark.parametrize("no_echo", [np.inf, 4.0, 4.01, 0.0, -1.0, 0.02])
def test_silence_is_not_a_wall(firings, tmp_path, no_echo):
    assert_same_readings(read(bag_of_firings(firings, pose_at=drive, no_echo=no_echo), tmp_path)[0], firings)


def test_invalid_readings_were_not_measured(firings, tmp_path):
    bag = bag_of_firings(firings, pose_at=drive)
    for k, value in enumerate((np.nan, -np.inf, 0.01, 0.0, -1.0)):
        bag.range(0.014 + 0.3 * k, value, frame=f"sonar_{k}")
    log, notes = read(bag, tmp_path)
    assert_same_readings(log, firings)
    assert "not measured: 0 or negative (2), less than min_range (1), NaN (1), -inf (1)" in notes


def test_infrared_is_left_out(firings, tmp_path):
    bag = bag_of_firings(firings, pose_at=drive)
    for k in range(4):
        bag.range(0.1, 0.03, frame=f"cliff_{k}", radiation=1)
    log, notes = read(bag, tmp_path)
    assert_same_readings(log, firings)
    assert notes[0] == "infrared: 4 ranges of 4 sensors are left out: cliff_0, cliff_1, cliff_2, cliff_3"
    alone = BagMessages()
    alone.range(0.0, 0.03, frame="cliff_0", radiation=1)
    with pytest.raises(SonarError, match=r"only ranges of other sensors \(infrared\) came"):
        read(alone, tmp_path / "alone")


def test_another_odometry_is_not_used(firings, tmp_path):
    bag = bag_of_firings(firings, pose_at=drive)
    moved = np.array([10.0, 5.0, 0.5])
    for time in np.arange(-0.01, 6.1, 0.05):
        bag.odometry(time, compose(moved, drive(time)), topic="/odometry/global", frame="map")
    log, notes = read(bag, tmp_path)
    assert_same_readings(log, firings)
    assert "/odom (odom -> base_link), chosen of 2 by its frames; not used: /odometry/global" in notes[1]
    for wanted in ("/odometry/global", "odometry/global"):
        log, _ = read(bag, tmp_path / wanted.strip("/").replace("/", "-") / wanted[:1].strip("/"), odometry=wanted)
        assert_same_readings(log, firings, lambda time: compose(moved, drive(time)))


def test_odometry_as_a_transform(firings, tmp_path):
    bag = bag_of_firings(firings)
    for time in np.arange(-0.01, 6.1, 0.02):
        bag.transform(time, "odom", "base_footprint", drive(time), topic="/tf")
        bag.transform(time, "map", "odom", (1.0, 2.0, 0.5), topic="/tf")
        bag.transform(time, "base_link", "wheel", (0.0, 0.2, time), topic="/tf")
    log, notes = read(bag, tmp_path)
    assert_same_readings(log, firings)
    assert notes[1] == "odometry: /tf (odom -> base_footprint), the only one"


def test_odometry_of_another_frame_is_moved_to_the_robot(firings, tmp_path):
    bag = bag_of_firings(firings)
    mount = np.array([0.3, -0.1, 0.4])
    bag.transform(-0.1, "base_link", "camera", mount)
    for time in np.arange(-0.01, 6.1, 0.02):
        bag.odometry(time, compose(drive(time), mount), child="camera")
    log, notes = read(bag, tmp_path)
    assert_same_readings(log, firings)
    assert "odometry: moved from 'camera' to 'base_link' by the transforms" in notes


@pytest.mark.parametrize("period", [0.01, 0.05, 0.2])
def test_odometry_at_another_rate(firings, tmp_path, period):
    log, _ = read(bag_of_firings(firings, pose_at=drive, odometry_period=period), tmp_path)
    assert_same_readings(log, firings, atol=0.01 if period > 0.1 else 2e-3)


def test_no_odometry(firings, tmp_path):
    log, notes = read(bag_of_firings(firings), tmp_path)
    assert_same_readings(log, firings, None)
    assert "odometry: none came, so the poses are unknown" in notes


def test_stamps_in_any_order_and_messages_that_were_recorded_twice(firings, tmp_path, rng):
    bag = BagMessages()
    for scan in firings:
        value = float(np.nan_to_num(scan.range[0], nan=np.inf))
        for _ in range(1 + (scan.scan % 7 == 0)):
            delay = rng.uniform(0, 0.2)
            bag.range(scan.stamp + delay, value, frame=f"sonar_{scan.tx[0]}", stamp=scan.stamp + START)
    for time in np.arange(-0.01, 6.1, 0.02):
        bag.odometry(time + rng.uniform(0, 0.2), drive(time), stamp=time + START)
    assert_same_readings(read(bag, tmp_path)[0], firings)


@pytest.mark.parametrize("stamp", [0.0, 17.5])
def test_stamps_that_are_unset_or_of_another_clock(firings, tmp_path, stamp):
    bag = BagMessages()
    for scan in firings:
        value = float(np.nan_to_num(scan.range[0], nan=np.inf))
        bag.range(scan.stamp, value, frame=f"sonar_{scan.tx[0]}", stamp=stamp and stamp + scan.stamp)
        bag.odometry(scan.stamp, drive(scan.stamp))
    assert_same_readings(read(bag, tmp_path)[0], firings)


def test_sensors_of_different_rates_and_lost_messages(firings, tmp_path, rng):
    kept = rng.random(len(firings)) < 0.7
    some = firings._part(np.flatnonzero(kept))
    bag = bag_of_firings(some, pose_at=drive)
    for time in np.arange(0.007, 6, 0.05):
        bag.range(time, 0.5, frame="fast_8")
    sensors = {f"sonar_{k}": k for k in range(8)} | {"fast_8": 8}
    log, _ = read(bag, tmp_path, ring=sonar_ring(9), sensors=sensors)
    for scan in log:
        assert len(set(scan.tx.tolist())) == len(scan.tx)
        assert scan.t is not None
        assert scan.t.max() <= 2
    slow = log.tx < 8
    assert log.tx[slow].tolist() == some.tx.tolist()
    assert (log.tx == 8).sum() == len(np.arange(0.007, 6, 0.05))


def test_sensors_that_always_hear_something_are_explicit_too(tmp_path):
    bag = BagMessages()
    for k in range(12):
        if k != 5:
            bag.range(0.1 * k, 1.0 + 0.1 * (k % 3), frame=f"sonar_{k % 3}")
    log, _ = read(bag, tmp_path, ring=sonar_ring(3))
    assert log.echo_count == len(log.tx) == 11
    assert log.asked.shape == (0, 2)


def test_a_scan_does_not_cross_a_jump_of_the_odometry(firings, tmp_path):
    bag = bag_of_firings(firings)
    for time in np.arange(-0.01, 6.1, 0.02):
        bag.odometry(time, drive(time) if time < 3 else drive(time) - drive(3.0))
    log, notes = read(bag, tmp_path)
    assert sum(one.startswith("warning: the odometry jumps once, by ") for one in notes) == 1
    time = log.stamp[log.echo_scan] + log.t - START
    for scan in range(len(log)):
        here = time[log.echo_scan == scan]
        assert (here < 3.01).all() or (here >= 2.99).all()
    expected = np.array([drive(one) if one < 3 else drive(one) - drive(3.0) for one in time])
    clear = np.abs(time - 3.0) > 0.02
    np.testing.assert_allclose(reading_poses(log)[clear, :2], expected[clear, :2], atol=2e-3)


def test_two_robots_in_one_bag(firings, tmp_path):
    bag = bag_of_firings(firings, names="/robot1/us{}")
    for scan in firings:
        bag.range(scan.stamp, 0.7, frame=f"robot2/us{scan.tx[0]}")
    for time in np.arange(-0.01, 6.1, 0.02):
        bag.odometry(time, drive(time), topic="/robot1/odom", frame="robot1/odom", child="robot1/base_link")
        bag.odometry(time, (0.0, 0.0, 0.0), topic="/robot2/odom", frame="robot2/odom", child="robot2/base_link")
    path = bag.write(tmp_path / "run")
    with pytest.raises(SonarError, match="do not tell which sensor"):
        load_log(path, ring=RING)
    options = InputOptions(odometry="/robot1/odom")
    assert_same_readings(load_log(path, ring=RING, options=options), firings)


@pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap"])
def test_an_invalid_bag_is_one_line(tmp_path, suffix):
    magic = {".bag": b"#ROSBAG V2.0\n", ".db3": b"SQLite format 3\0", ".mcap": b"\x89MCAP0\r\n"}[suffix]
    (tmp_path / f"x{suffix}").write_bytes(magic + b"rubbish")
    with pytest.raises(SonarError, match=rf"^x{suffix}: [^\n]+; needed is a whole bag$"):
        read_bag(tmp_path / f"x{suffix}", name=f"x{suffix}")


def test_a_bag_without_ranges_is_one_line(tmp_path):
    bag = BagMessages()
    bag.odometry(0.0, (0, 0, 0))
    with pytest.raises(SonarError, match=r"nav_msgs/msg/Odometry came; needed are ultrasound messages"):
        read(bag, tmp_path)


def lines_on_walls(log, ring, method):
    """Number of lines within 6 deg and 0.1 m of a wall of the room, and number of all lines."""
    from jaxsonar import local_models

    walls = ((np.pi, 0.0), (0.0, 4.2), (-np.pi / 2, 0.0), (np.pi / 2, 3.0))
    good = count = 0
    for scan, model in zip(log, local_models(ring, log, method=method), strict=True):
        for line in model.lines:
            theta = line.theta + scan.pose[2]
            rho = line.rho + scan.pose[0] * np.cos(theta) + scan.pose[1] * np.sin(theta)
            off = [abs(float(wrap_angle(theta - wall))) < np.radians(6) and abs(rho - at) < 0.1 for wall, at in walls]
            good, count = good + any(off), count + 1
    return good, count


@pytest.mark.slow
def test_a_spinning_robot_sees_the_walls_as_one_at_rest(tmp_path):
    """16 sensors in turn every 25 ms, odometry at 50 Hz, 40 deg/s."""
    ring = sonar_ring(16, radius=0.22, beam=np.radians(70), max_range=2.5)
    times, pose_at = np.arange(320) * 0.025, spinning((1.5, 1.2), np.radians(40))
    bag = bag_of_firings(firing_log(ring, ROOM, pose_at, times), pose_at=pose_at).write(tmp_path / "run")
    spin, spin_all = lines_on_walls(load_log(bag, ring=ring), ring, "ml")
    poses = np.array([pose_at(time) for time in times[::16]])
    rest, rest_all = lines_on_walls(simulate(ring, ROOM, poses, sigma=0.003).as_log(ring, poses), ring, "ml")
    assert rest >= 75
    assert spin_all >= 0.95 * rest_all
    assert spin >= 0.95 * rest
