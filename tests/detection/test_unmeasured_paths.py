"""Paths that were not measured, sensors that fire in turn, and robots that move within a scan."""

from dataclasses import replace

import numpy as np
import pytest
from support import oracles
from support.hard_cones import simulate

from jaxsonar import (
    Log,
    Ring,
    SonarError,
    build_map,
    extract_lines,
    local_model,
    local_models,
    random_pose,
    random_room,
)
from jaxsonar.floor_plans.room import walls_in_robot_frame
from jaxsonar.geometry.se2 import compose, transform_points
from jaxsonar.scans.measured_paths import measured_paths

RING, DIRECT = Ring.circular(count=24, neighbors=3), Ring.circular(count=24, neighbors=0)
SCANS = 8
DIRECT_PATHS = RING.paths[:, 0] == RING.paths[:, 1]
both_methods = pytest.mark.parametrize("method", ["ml", "hough"])


@pytest.fixture(scope="module")
def rooms():
    """Logs of all paths of the ring, in three random rooms."""
    return [room_log(seed) for seed in range(3)]


def room_log(seed):
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    poses = np.array([random_pose(rng, room) for _ in range(SCANS)])
    return simulate(RING, room, poses, sigma=0.003, dropout=0.05, clutter=0.05, seed=seed).as_log(RING, poses)


def readings(log, kept, **changed):
    """A log with some of the readings."""
    start = np.append(0, np.cumsum(kept))[log.start]
    columns = {name: getattr(log, name)[kept] for name in ("tx", "rx", "range", "amplitude", "t", "age")}
    return replace(log, start=start, **(columns | {"asked": None} | changed))


def direct_only(log):
    return readings(log, log.tx == log.rx)


def length(models):
    """Total length of all lines, metres."""
    return sum(float(np.linalg.norm(line.segment[1] - line.segment[0])) for model in models for line in model.lines)


def dense(log, slots=6):
    """(scans, paths, slots) of a log on the paths of the ring."""
    ranges, used = np.full((len(log), len(RING.paths), slots), np.nan), np.zeros((len(log), len(RING.paths)), int)
    for scan, path, reported in zip(log.echo_scan, RING.path_index[log.tx, log.rx], log.range, strict=True):
        ranges[scan, path, used[scan, path]] = reported
        used[scan, path] += 1
    return ranges


def assert_same_lines(here, there, atol=0.0):
    assert len(here.lines) == len(there.lines) > 0
    for one, two in zip(here.lines, there.lines, strict=True):
        np.testing.assert_allclose([one.rho, one.theta], [two.rho, two.theta], atol=atol)
        np.testing.assert_allclose(one.segment, two.segment, atol=10 * atol)
        np.testing.assert_array_equal(one.paths, two.paths)


# the same echoes, read with another list of paths


@pytest.mark.slow
def test_method_hough_needs_no_list_of_the_paths_that_a_device_has(rooms):
    """Direct echoes only, read with the ring of all paths: the lines of the ring of direct paths, bit by bit."""
    for log in rooms:
        pairs = (local_models(ring, direct_only(log), method="hough") for ring in (RING, DIRECT))
        for here, there in zip(*pairs, strict=True):
            assert [line.as_json() for line in here.lines] == [line.as_json() for line in there.lines]


@pytest.mark.slow
def test_method_ml_needs_no_list_of_the_paths_that_a_device_has(rooms):
    found, wanted = (sum(length(local_models(ring, direct_only(log))) for log in rooms) for ring in (RING, DIRECT))
    assert found == pytest.approx(wanted, rel=0.02)
    silent = sum(length(local_models(RING, replace(direct_only(log), asked=RING.paths))) for log in rooms)
    assert silent < 0.9 * wanted, "cross paths that were measured and heard nothing are evidence"


@pytest.mark.slow
@both_methods
def test_the_map_of_an_office_from_direct_echoes_needs_no_list_of_paths(office, method):
    log = simulate(RING, office.room, office.poses, sigma=0.003, seed=1).as_log(RING, office.poses)
    maps = [build_map(ring, direct_only(log), method=method).segments for ring in (RING, DIRECT)]
    found, wanted = (float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum()) for ends in maps)
    assert found >= 0.95 * wanted > 5


@both_methods
def test_a_mask_of_all_paths_changes_nothing(rooms, method):
    ranges = dense(rooms[0])
    plain = extract_lines(RING, ranges, method=method)
    masked = extract_lines(RING, ranges, method=method, measured=np.ones(ranges.shape[:2], bool))
    assert np.isfinite(plain.rho).any()
    for name in ("rho", "theta", "votes", "echoes", "segments", "cov"):
        np.testing.assert_array_equal(getattr(masked, name), getattr(plain, name))


@both_methods
def test_a_mask_says_the_same_as_a_log(rooms, method):
    """Some of the paths are measured, different ones in every scan."""
    rng, log = np.random.default_rng(1), rooms[1]
    measured = rng.random((SCANS, len(RING.paths))) < 0.5
    kept = measured[log.echo_scan, RING.path_index[log.tx, log.rx]]
    heard = readings(log, kept)
    silent_scan, silent_path = np.nonzero(measured & np.isnan(dense(heard)).all(axis=2))
    scan = np.concatenate([heard.echo_scan, silent_scan])
    order = np.argsort(scan, kind="stable")
    tx, rx = np.concatenate([np.stack([heard.tx, heard.rx]), RING.paths[silent_path].T], axis=1)[:, order]
    reported = np.concatenate([heard.range, np.full(len(silent_scan), np.nan)])[order]
    explicit = Log.from_echoes(scan[order], tx, rx, reported, stamp=log.stamp, pose=log.pose)
    np.testing.assert_array_equal(measured_paths(RING, explicit), measured)
    lines = extract_lines(RING, dense(heard), method=method, measured=measured)
    for row, model in enumerate(local_models(RING, explicit, method=method)):
        count = len(model.lines)
        np.testing.assert_allclose(lines.rho[row, :count], [line.rho for line in model.lines], atol=1e-6)
        assert np.isnan(lines.rho[row, count:]).all()
    other = extract_lines(RING, dense(heard), method=method)
    assert (other.echoes > 0).sum() < (lines.echoes > 0).sum(), "half of the paths of a wall were silent"


def test_an_echo_of_a_path_that_was_not_measured_raises_a_one_line_error():
    ranges = np.full((1, len(RING.paths), 1), np.nan)
    ranges[0, 7, 0] = 1.0
    with pytest.raises(SonarError, match=r"^measured\[0, 7\] = False came with an echo at 1 m; allowed are echoes of"):
        extract_lines(RING, ranges, measured=np.zeros((1, len(RING.paths)), bool))


# motion within a scan


@both_methods
def test_one_pose_for_all_paths_is_a_ring_that_is_mounted_there(rooms, method):
    pose = np.array([0.12, -0.07, 0.4])
    there = Ring(
        transform_points(pose, np.asarray(RING.position)),
        RING.heading + pose[2],
        beam=RING.beam,
        neighbors=3,
        max_range=RING.max_range,
    )
    scan = rooms[2][1]
    moved = local_model(RING, scan, method=method, path_pose=np.broadcast_to(pose, (len(RING.paths), 3)))
    assert_same_lines(moved, local_model(there, scan, method=method), atol=2e-3)


@both_methods
def test_firings_in_turn_of_a_robot_at_rest_are_firings_at_once(rooms, method):
    at_once = rooms[0]
    in_turn = replace(at_once, t=at_once.tx * 0.025, pose=np.broadcast_to(at_once.pose[0], at_once.pose.shape))
    for here, there in zip(*(local_models(RING, log, method=method) for log in (in_turn, at_once)), strict=True):
        assert [line.as_json() for line in here.lines] == [line.as_json() for line in there.lines]


def turning_log(rate):
    """Sensors of a ring fire one after the other while the robot turns (rad/s); odometry at 50 Hz."""
    rng = np.random.default_rng(7)
    room = random_room(rng)
    middle, interval = random_pose(rng, room), 0.02
    time = np.arange(0, SCANS * RING.count) * interval
    poses = middle + np.column_stack([0 * time, 0 * time, rate * time])
    heard = simulate(RING, room, poses, sigma=0.001, seed=7).as_log(RING, poses)
    fired = readings(heard, heard.tx == heard.echo_scan % RING.count)
    odometry = np.column_stack([time, poses])
    firing, scan = fired.echo_scan, fired.echo_scan // RING.count
    log = Log.from_echoes(
        scan,
        fired.tx,
        fired.rx,
        fired.range,
        t=(firing - scan * RING.count) * interval,
        stamp=time[:: RING.count],
        pose=poses[:: RING.count],
        asked=RING.paths,
        odometry=odometry,
    )
    return room, log


def wall_errors(room, log, models):
    """Deviations (m, rad) of all lines from the nearest wall."""
    found = []
    for pose, model in zip(log.pose, models, strict=True):
        rho, theta = walls_in_robot_frame(room, pose)
        for line in model.lines:
            off = np.stack([np.abs(rho - line.rho), np.abs(oracles.wrap(theta - line.theta))])
            found.append(off[:, np.argmin(off.sum(axis=0))])
    return np.array(found)


@pytest.mark.slow
@both_methods
def test_lines_of_a_turning_robot_are_as_good_as_at_rest(method):
    """The robot turns by 16 deg within a scan."""
    tolerance = {"ml": [0.03, np.radians(2)], "hough": [0.05, np.radians(6)]}[method]

    def good(log):
        return (wall_errors(room, log, local_models(RING, log, method=method)) < tolerance).all(axis=1)

    room, still = turning_log(0.0)
    room, log = turning_log(np.radians(34))
    rest, turning = good(still), good(log)
    assert rest.mean() > 0.6
    assert turning.mean() > rest.mean() - 0.1
    assert turning.sum() > 0.85 * rest.sum()
    assert good(replace(log, t=np.zeros(len(log.t)))).sum() < 0.7 * turning.sum(), "all echoes at the pose of the scan"


def test_a_log_with_times_and_odometry_is_a_scan_with_poses():
    _, log = turning_log(0.6)
    log = log[:2]
    scan = log[1]
    poses = compose(np.zeros(3), np.column_stack([np.zeros((24, 2)), 0.6 * 0.02 * np.arange(24)]))
    one = local_model(RING, scan, method="hough", path_pose=poses[RING.paths[:, 0]])
    two = list(local_models(RING, log, method="hough"))[1]
    assert_same_lines(one, two, atol=1e-4)
