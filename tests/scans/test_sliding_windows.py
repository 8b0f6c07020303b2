"""Sliding windows, incremental and of whole logs, against loops and matrices."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import oracles

from jaxsonar import HoughSettings, Log, Ring, SonarError, local_models
from jaxsonar.geometry.se2 import compose, relative, wrap_angle
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.readings import is_repeated
from jaxsonar.scans.scan_log import Scan
from jaxsonar.scans.single_firings import group_firings
from jaxsonar.scans.sliding_windows import SETTINGS as WINDOWS
from jaxsonar.scans.sliding_windows import (
    WindowBuffer,
    automatic_window,
    gather_windows,
    has_moved,
    independent_measurements,
    is_fresh_reading,
    window_lengths,
)

FOUR = Ring.circular(count=4, beam=1.0, neighbors=0)
SETTINGS = HoughSettings()
turns = st.floats(-3, 3)
metres = st.floats(-1, 1)


@given(*[st.tuples(metres, metres, turns)] * 2)
def test_relative_poses_agree_with_matrices(a, b):
    a, b = np.array(a), np.array(b)
    came = relative(a, b)
    wanted = oracles.relative(a, b)
    np.testing.assert_allclose(came[:2], wanted[:2], atol=1e-12)
    assert abs(oracles.wrap(came[2] - wanted[2])) < 1e-12
    assert -np.pi <= came[2] < np.pi
    np.testing.assert_array_equal(relative(np.stack([a, b]), np.stack([b, a]))[0], came)
    np.testing.assert_allclose(relative(a, a), 0, atol=1e-15)


def a_log(seed, *, ring=FOUR, scans=40, missing=0.05, strangers=True):
    """A trajectory with stops, rotations in place and missing poses, with repeated and missing readings."""
    rng = np.random.default_rng(seed)
    pose, poses, readings, before = np.zeros(3), [], [], []
    for _ in range(scans):
        way = rng.choice(["stop", "creep", "drive", "turn"], p=[0.2, 0.2, 0.5, 0.1])
        turn = {"stop": 0.0, "creep": rng.normal(0, 0.005)}.get(way, rng.normal(0, 0.3))
        ahead = {"creep": rng.uniform(0, 0.02), "drive": rng.uniform(0, 0.4)}.get(way, 0.0)
        pose = np.array([pose[0] + ahead * np.cos(pose[2]), pose[1] + ahead * np.sin(pose[2]), pose[2] + turn])
        poses.append(np.full(3, np.nan) if rng.random() < missing else pose)
        kept = [reading for reading in before if rng.random() < 0.7]
        new = [(*rng.integers(0, ring.count, 2).tolist(), rng.integers(30, 60) / 50) for _ in range(rng.integers(0, 3))]
        new = [reading for reading in new if strangers or ring.path_index[int(reading[0]), int(reading[1])] >= 0]
        before = list(dict.fromkeys(kept + new))
        rng.shuffle(before)
        readings.append(before)
    return log_of(readings, poses, scan=rng.permutation(scans) * 3 + 5)


def log_of(readings, poses, scan=None):
    """A log from the readings (tx, rx, range) of every scan."""
    flat = np.array([reading for scan in readings for reading in scan]).reshape(-1, 3)
    return Log.from_echoes(
        np.repeat(np.arange(len(readings)), [len(scan) for scan in readings]),
        flat[:, 0].astype(int),
        flat[:, 1].astype(int),
        flat[:, 2],
        stamp=np.arange(len(readings)) * 0.1,
        pose=np.array(poses, float).reshape(-1, 3),
        scan=scan,
    )


def heard(ring, log):
    """The (path, range) of each scan on the ring's paths."""
    return [
        [
            (int(ring.path_index[tx, rx]), float(reach))
            for tx, rx, reach in zip(scan.tx, scan.rx, scan.range, strict=True)
            if ring.path_index[tx, rx] >= 0
        ]
        for scan in log
    ]


def straight(steps, heading=0.0):
    """Poses along x."""
    return np.array([(x, 0.0, heading) for x in np.append(0.0, np.cumsum(steps))])


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_round_trip_of_a_log_by_single_scans(seed):
    log = a_log(seed, missing=0.3)
    assert Log.from_scans(list(log)) == log
    assert log[3].as_log() == log[3:4]


def test_a_log_of_no_scans():
    assert Log.from_scans([]) == log_of([], [])


# contents of windows


@pytest.mark.slow
@settings(max_examples=40)
@given(st.integers(0, 10_000), st.sampled_from([0.3, 1.0, 2.5, 50.0]), st.sampled_from([0.0, 0.05, 0.4]))
def test_windows_contain_the_fresh_echoes_of_their_section_in_the_frame_of_its_end(seed, length, missing):
    log = a_log(seed, missing=missing)
    windows, left_out = gather_windows(FOUR, log, length=length)
    scans = heard(FOUR, log)
    assert left_out == len(log.tx) - sum(len(scan) for scan in scans)
    waits = oracles.is_first_at_place(log.pose, WINDOWS.place_distance, WINDOWS.place_rotation)
    fresh = [[new and here for new in scan] for scan, here in zip(oracles.is_fresh(scans), waits, strict=True)]
    spans = oracles.window_spans(log.pose, length)
    np.testing.assert_array_equal(windows.last, [last for _, last in spans])
    assert windows.gap == max(WINDOWS.min_gap, length / 4)
    flat = windows.echoes
    assert flat.scan_count == len(spans)
    assert flat.pose is not None
    assert flat.scans_per_window is not None
    for k, span in enumerate(spans):
        wanted = oracles.window_echoes(scans, log.pose, span, fresh)
        mine = slice(flat.start[k], flat.start[k + 1])
        assert windows.scan[mine].tolist() == [scan for scan, _, _, _ in wanted]
        assert flat.path[mine].tolist() == [path for _, path, _, _ in wanted]
        assert flat.reported[mine].tolist() == [reach for _, _, reach, _ in wanted]
        poses = np.array([pose for _, _, _, pose in wanted]).reshape(-1, 3)
        np.testing.assert_allclose(flat.pose[mine, :2], poses[:, :2], atol=1e-12)
        np.testing.assert_allclose(wrap_angle(flat.pose[mine, 2] - poses[:, 2]), 0, atol=1e-12)
        shares = [sum(fresh[scan]) / max(len(scans[scan]), 1) for scan in range(span[0], span[1] + 1)]
        assert flat.scans_per_window[k] == pytest.approx(max(sum(shares), 1))


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.sampled_from([0.3, 1.0, 2.5]))
def test_windows_cover_the_trajectory_with_their_length_and_cross_no_gap(seed, length):
    log = a_log(seed, missing=0.1)
    windows, _ = gather_windows(FOUR, log, length=length)
    known = np.array([bool(np.isfinite(pose).all()) for pose in log.pose])
    covered = np.zeros(len(log), bool)
    assert (np.diff(windows.last) > 0).all()
    for first, last in oracles.window_spans(log.pose, length):
        way = np.hypot(*np.diff(log.pose[first : last + 1, :2], axis=0).T)
        assert known[first : last + 1].all()
        assert way.sum() <= length + 1e-9
        if first > 0 and known[first - 1]:  # one more scan would exceed the length
            assert way.sum() + np.hypot(*(log.pose[first] - log.pose[first - 1])[:2]) > length - 1e-9
        covered[first : last + 1] = True
    assert not covered[~known].any()
    steps = np.hypot(*np.diff(log.pose[:, :2], axis=0).T)
    if np.nanmax(steps) < length / 2:  # otherwise steps are longer than windows
        assert covered[known].all()


def test_every_echo_is_in_two_windows_of_a_uniform_trajectory():
    log = log_of([[(0, 0, 1 + k / 100)] for k in range(65)], straight([0.0625] * 64))
    windows, _ = gather_windows(FOUR, log, length=1.0)
    assert windows.last.tolist() == [8, 16, 24, 32, 40, 48, 56, 64]
    times = np.bincount(windows.scan, minlength=65)
    assert (times[1:56] >= 2).all()
    assert times.max() == 3  # at the ends of windows


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.1, 0.05, 0.025])
def test_incremental_windows_of_decimal_steps_end_at_the_same_scans(step):
    """A pose may lie exactly at the end of a window; both algorithms must round alike."""
    log = log_of([[(0, 0, 1 + k / 100)] for k in range(120)], np.arange(120)[:, None] * [step, 0.0, 0.0])
    for length in (0.2, 0.3, 0.4, 0.6, 1.0, 1.4):
        whole, _ = gather_windows(FOUR, log, length=length)
        assert [windows.last[0] for windows in scan_by_scan(FOUR, log, length)] == whole.last.tolist(), length


def test_short_windows_contain_one_scan_each():
    log = log_of([[(0, 0, 1.0)], [(0, 0, 1.1)], [(0, 0, 1.2)]], straight([10.0, 10.0]))
    windows, _ = gather_windows(FOUR, log, length=0.01)
    assert windows.last.tolist() == [1, 2]


# repeated readings, robots at rest


def kept_of(readings, poses=None, ring=FOUR):
    """(scan, path, range) of the fresh readings."""
    poses = straight([0.1] * (len(readings) - 1)) if poses is None else poses
    flat, _ = FlatEchoes.from_log(ring, log_of(readings, poses))
    fresh = is_fresh_reading(flat)
    return list(zip(flat.scan[fresh].tolist(), flat.path[fresh].tolist(), flat.reported[fresh].tolist(), strict=True))


@pytest.mark.slow
@given(st.integers(1, 12), st.integers(1, 12))
def test_every_second_repeated_reading_is_fresh_and_a_gap_restarts_the_count(times, again):
    here, other = (0, 0, 1.0), (1, 1, 1.0)
    assert len(kept_of([[here]] * times)) == math.ceil(times / 2)
    gap = [[here]] * times + [[]] + [[here]] * again
    assert len(kept_of(gap)) == math.ceil(times / 2) + math.ceil(again / 2)
    mixed = [[here, other] if k < again else [here] for k in range(times)]
    assert len(kept_of(mixed)) == math.ceil(times / 2) + math.ceil(min(again, times) / 2)
    assert kept_of([[here]] * times)[0][0] == 0


@pytest.mark.slow
@settings(max_examples=40)
@given(st.integers(0, 10_000))
def test_fresh_readings_agree_with_the_slow_oracle(seed):
    log = a_log(seed, strangers=False)
    flat, _ = FlatEchoes.from_log(FOUR, log)
    wanted = [new for scan in oracles.is_fresh(heard(FOUR, log)) for new in scan]
    assert is_fresh_reading(flat).tolist() == wanted


@pytest.mark.parametrize("times", [1, 2, 5])
def test_duplicates_in_a_scan_are_fresh_like_single_readings(times):
    """A device with coarse ranges may report two echoes of a path at one range."""
    twice = kept_of([[(0, 0, 1.0), (0, 0, 1.0)]] * times)
    assert sorted({scan for scan, _, _ in twice}) == [scan for scan, _, _ in kept_of([[(0, 0, 1.0)]] * times)]


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.3, 1.0]))
def test_has_moved_agrees_with_the_slow_oracle(seed, missing):
    log = a_log(seed, missing=missing)
    assert has_moved(log.pose).tolist() == oracles.is_first_at_place(
        log.pose, WINDOWS.place_distance, WINDOWS.place_rotation
    )


def test_a_robot_at_rest_counts_once_and_a_rotating_robot_moves():
    waiting = np.tile([[1.0, 2.0, 0.5]], (6, 1))
    assert has_moved(waiting).tolist() == [True] + [False] * 5
    turning = np.column_stack([np.ones((6, 2)), np.radians([170, 175, 180, -175, -170, -165])])
    assert has_moved(turning).all()
    slow = straight([WINDOWS.place_distance / 4] * 40)
    assert has_moved(slow).sum() == pytest.approx(11, abs=1)


@pytest.mark.parametrize(
    "poses", [np.zeros((0, 3)), np.full((4, 3), np.nan), np.full((1, 3), np.nan), np.zeros((1, 3))]
)
def test_has_moved_for_few_scans(poses):
    assert has_moved(poses).tolist() == np.isfinite(poses).all(axis=1).tolist()


def test_a_robot_at_rest_adds_one_scan_to_its_window():
    readings = [[(0, 0, 1 + k / 50)] for k in range(12)]
    poses = straight([0.2] * 3 + [0.0] * 5 + [0.2] * 3)
    windows, _ = gather_windows(FOUR, log_of(readings, poses), length=2.0)
    assert sorted(set(windows.scan.tolist()) & set(range(9))) == [0, 1, 2, 3]


# nearly empty logs


@pytest.mark.parametrize(
    ("readings", "poses", "last"),
    [
        ([], np.zeros((0, 3)), []),
        ([[]] * 5, straight([0.5] * 4), [1, 2, 3, 4]),
        ([[(0, 0, 1.0)]], straight([]), [0]),
        ([[(0, 0, 1.0)]] * 4, np.full((4, 3), np.nan), []),
        ([[(0, 0, 1.0)], [], [(0, 0, 1.0)]], [[0, 0, 0], [np.nan] * 3, [0, 0, 0]], [0, 2]),
    ],
)
def test_windows_of_few_readings(readings, poses, last):
    log = log_of(readings, poses)
    windows, left_out = gather_windows(FOUR, log, length=1.0)
    assert windows.last.tolist() == last
    assert left_out == 0


@pytest.mark.parametrize("length", [0.0, -1.0, math.nan, math.inf, -math.inf])
def test_invalid_window_lengths_raise_an_error(length):
    log = a_log(1)
    with pytest.raises(SonarError, match=r"window = .* m; allowed is 0.01 to 100 m"):
        gather_windows(FOUR, log, length=length)
    with pytest.raises(SonarError, match=r"window = .* m; allowed is 0.01 to 100 m"):
        local_models(FOUR, log, window=length)


@pytest.mark.parametrize("length", [1e4, 1e300])
def test_windows_too_long_for_an_accumulator_raise_an_error(length):
    with pytest.raises(SonarError, match="allowed"):
        local_models(FOUR, a_log(1), window=length)


def test_unknown_sensors_raise_an_error():
    log = log_of([[(0, 0, 1.0)], [(1, 7, 1.0)]], straight([0.5]))
    message = "tx 1, rx 7; allowed are 0 to 3"
    with pytest.raises(SonarError, match=message):
        gather_windows(FOUR, log, length=1.0)
    buffer = WindowBuffer()
    for scan in log:
        buffer, _ = buffer.add(scan, length=1.0)
    with pytest.raises(SonarError, match=message):
        buffer.window(FOUR, length=1.0)


def test_pairs_that_are_no_paths_are_counted_and_omitted():
    log = log_of([[(0, 0, 1.0), (0, 1, 1.0)], [(2, 3, 1.0), (1, 1, 0.7)]], straight([0.5]))
    windows, left_out = gather_windows(FOUR, log, length=5.0)
    assert left_out == 2
    assert windows.echoes.path.tolist() == [0, 1]
    told = []
    local_models(FOUR, log, window=5.0, on_left_out=told.append)
    assert told == [2]


def test_the_order_of_scans_does_not_depend_on_their_numbers():
    readings = [[(k % 4, k % 4, 1 + k / 50)] for k in range(20)]
    poses = straight([0.1] * 19)
    plain, shuffled = log_of(readings, poses), log_of(readings, poses, scan=np.arange(20)[::-1] * 7 + 100)
    one, other = (gather_windows(FOUR, log, length=1.0)[0] for log in (plain, shuffled))
    np.testing.assert_array_equal(one.last, other.last)
    np.testing.assert_array_equal(one.scan, other.scan)
    np.testing.assert_array_equal(one.echoes.pose, other.echoes.pose)


# incremental windows


def scan_by_scan(ring, log, length):
    """Windows of a log, built scan by scan, with the rows of the log."""
    buffer, ended, row, found = WindowBuffer(), True, {int(number): k for k, number in enumerate(log.scan)}, []

    def close(buffer):
        part, windows = buffer.window(ring, length=length)
        rows = np.array([row[int(number)] for number in part.scan])
        found.append(type(windows)(rows[windows.last], windows.echoes, rows[windows.scan], windows.gap))

    for scan in log:
        following, ends = buffer.add(scan, length=length)
        if not np.isfinite(scan.pose).all() and not ended:
            close(buffer)
        buffer, ended = following, ends or not np.isfinite(scan.pose).all()
        if ends:
            close(buffer)
    if not ended:
        close(buffer)
    return found


def assert_same_windows(ring, log, length):
    whole, _ = gather_windows(ring, log, length=length)
    single = scan_by_scan(ring, log, length)
    assert [int(windows.last[0]) for windows in single] == whole.last.tolist()
    flat = whole.echoes
    assert flat.pose is not None
    assert flat.scans_per_window is not None
    for k, windows in enumerate(single):
        mine, one = slice(flat.start[k], flat.start[k + 1]), windows.echoes
        np.testing.assert_array_equal(windows.scan, whole.scan[mine])
        np.testing.assert_array_equal(one.path, flat.path[mine])
        np.testing.assert_array_equal(one.reported, flat.reported[mine])
        np.testing.assert_array_equal(one.pose, flat.pose[mine])
        np.testing.assert_allclose(one.scans_per_window, flat.scans_per_window[k : k + 1], rtol=1e-12)
        assert windows.gap == whole.gap


@pytest.mark.slow
@settings(max_examples=50)
@given(st.integers(0, 10_000), st.sampled_from([0.25, 0.7, 2.0, 50.0]), st.sampled_from([0.0, 0.05, 0.5]))
def test_incremental_windows_equal_those_of_the_whole_log(seed, length, missing):
    assert_same_windows(FOUR, a_log(seed, missing=missing), length)


def test_incremental_windows_handle_duplicates_in_a_scan():
    log = log_of([[(0, 0, 1.0), (0, 0, 1.0)]] * 4, straight([0.25] * 3))
    assert_same_windows(FOUR, log, 0.5)


def test_adding_a_scan_does_not_change_the_buffer():
    log = a_log(5, missing=0.0)
    buffer, _ = WindowBuffer().add(log[0], length=1.0)
    before = (buffer.scans, buffer.travelled, buffer.fresh, dict(buffer.runs), buffer.place, dict(buffer.latest))
    buffer.add(log[1], length=1.0)
    after = (buffer.scans, buffer.travelled, buffer.fresh, dict(buffer.runs), buffer.place, dict(buffer.latest))
    assert after == before


def test_the_buffer_drops_scans_older_than_a_window():
    nobody = np.zeros(0, int)
    buffer, step = (
        WindowBuffer(),
        partial(Scan, stamp=0.0, tx=nobody, rx=nobody, range=np.zeros(0), amplitude=np.zeros(0)),
    )
    for k in range(200):
        buffer, _ = buffer.add(step(scan=k, pose=np.array([k / 8, 0.0, 0.0])), length=1.0)
        assert len(buffer.scans) <= 9
    assert [scan.scan for scan in buffer.scans] == list(range(191, 200))


# logs that list what was measured


def listed_log(seed, *, scans=40, in_turn=False, ages=True):
    """Readings of four sensors and silence, with poses of a stop-and-go robot; some readings repeat an older one."""
    rng = np.random.default_rng(seed)
    step = rng.choice([0.0, 0.004, 0.1], scans - 1)[:, None] * [1.0, 0.2, 0.3]
    poses = np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)])
    poses[rng.random(scans) < 0.05] = np.nan
    rows, latest = [], {}
    for scan in range(scans):
        for sensor in [scan % 4] if in_turn else range(4):
            if sensor in latest and ages and rng.random() < 0.3:
                reported, measured_at = latest[sensor]
                rows.append((scan, sensor, reported, 0.1 * scan - measured_at))
            elif rng.random() < 0.9:
                latest[sensor] = (rng.choice([1.0, 1.25, np.nan]), 0.1 * scan)
                rows.append((scan, sensor, latest[sensor][0], 0.0))
    scan, sensor, reported, age = np.array(rows).T
    scan, sensor = scan.astype(int), sensor.astype(int)
    return Log.from_echoes(
        scan,
        sensor,
        sensor,
        reported,
        age=age,
        stamp=0.1 * np.arange(scans),
        pose=poses,
        asked=np.zeros((0, 2), int),
        odometry=np.array([[-10.0, 0, 0, 0], [10, 0, 0, 0]]),  # the readings belong to the poses of their scans
    )


@pytest.mark.parametrize("is_explicit", [False, True])
@pytest.mark.parametrize("first", [0, 7, 12])
def test_ages_may_begin_anywhere(first, is_explicit):
    """Readings before the first age, or with ages themselves, have the same weight in incremental windows."""
    readings = [[(s, s, 1.0 + (k // 2 + s) / 100) for s in range(4)] for k in range(40)]
    log = log_of(readings, straight([0.05] * 39))
    age = np.where((log.echo_scan % 2 == 1) & (log.echo_scan > first) & (log.tx < 3), 0.1, 0.0)
    asked = np.zeros((0, 2), int) if is_explicit else log.asked
    still = np.array([[-10.0, 0, 0, 0], [10, 0, 0, 0]])
    log = replace(log, age=age, stamp=0.1 * np.arange(40), asked=asked, odometry=still)
    last, ends = WindowBuffer(), []
    for k in range(len(log)):  # scans as a device reports them, with the repeated readings
        part = slice(log.start[k], log.start[k + 1])
        columns = {name: getattr(log, name)[part] for name in ("tx", "rx", "range", "amplitude", "t", "age")}
        scan = replace(log[k], **columns, asked=log.asked)
        last, is_end = last.add(scan, length=1.0)
        ends += [(k, last)] if is_end else []
    whole, _ = gather_windows(FOUR, log, length=1.0)
    assert whole.echoes.scans_per_window is not None
    compared = 0
    for k, buffer in ends:
        if k <= first + 1:
            continue  # no age so far
        _, windows = buffer.window(FOUR, length=1.0)
        row = whole.last.tolist().index(k)
        np.testing.assert_array_equal(
            windows.echoes.reported, whole.echoes.reported[whole.echoes.start[row] : whole.echoes.start[row + 1]]
        )
        np.testing.assert_allclose(windows.echoes.scans_per_window, whole.echoes.scans_per_window[row])
        compared += 1
    assert compared > 1


def expected_weights(log, spans):
    """Number of scans of all four sensors to which the measurements of each window amount, by a loop."""
    seen, place, new, ever = {}, -1, [], set()
    first = oracles.is_first_at_place(log.pose, WINDOWS.place_distance, WINDOWS.place_rotation)
    repeated = is_repeated(log)
    for scan in range(len(log)):
        place += first[scan]
        new.append([])
        for row in range(log.start[scan], log.start[scan + 1]):
            sensor = int(log.tx[row])
            if repeated[row]:
                continue
            ever.add(sensor)
            if np.isfinite(log.pose[scan]).all() and seen.get(sensor) != place:
                seen[sensor] = place
                new[-1].append(sensor)
    weights = []
    for begin, last in spans:
        counts = np.bincount([s for scan in new[begin : last + 1] for s in scan], minlength=4)
        weights.append(counts.sum() / max((counts > 0).sum(), 1))  # the cones of the four sensors do not overlap
    return np.maximum(weights, 1)


@pytest.mark.slow
@settings(max_examples=40)
@given(st.integers(0, 10_000), st.booleans(), st.sampled_from([0.25, 0.7, 50.0]))
def test_windows_weigh_measurements_and_count_each_path_once_at_a_place(seed, in_turn, length):
    log = listed_log(seed, in_turn=in_turn)
    windows, _ = gather_windows(FOUR, log, length=length)
    wanted = expected_weights(log, oracles.window_spans(log.pose, length))
    weights = windows.echoes.scans_per_window
    assert weights is not None
    np.testing.assert_allclose(weights, wanted, rtol=0.02)
    assert_same_windows(FOUR, log, length)


def test_firings_in_turn_weigh_as_much_as_the_same_firings_at_once():
    """One firing per scan, or all four sensors in every fourth scan."""
    poses = straight([0.02] * 79)
    in_turn = log_of([[(k % 4, k % 4, 1.0 + k / 1000)] for k in range(80)], poses)
    at_once = log_of([[(s, s, 1.0 + (4 * k + s) / 1000) for s in range(4)] for k in range(20)], poses[::4])
    one, other = (gather_windows(FOUR, log, length=2.0)[0].echoes for log in (in_turn, at_once))
    assert one.scans_per_window is not None
    assert other.scans_per_window is not None
    assert one.scans_per_window[-1] == pytest.approx(20, rel=0.05)
    assert other.scans_per_window[-1] == pytest.approx(20)
    assert len(one.scan) == pytest.approx(len(other.scan), rel=0.05)


def test_silence_that_was_measured_weighs_and_what_was_not_measured_does_not():
    poses, heard = straight([0.1] * 9), [[(0, 0, 1.0)]] * 10
    silent = [[(0, 0, 1.0), (1, 1, np.nan)]] * 10
    weights = []
    for readings in (heard, silent):
        log = replace(log_of(readings, poses), asked=np.zeros((0, 2), int))
        found = gather_windows(FOUR, log, length=50.0)[0].echoes.scans_per_window
        assert found is not None
        weights.append(found[0] * len({tx for tx, _, _ in readings[0]}))  # measurements
    np.testing.assert_allclose(weights, [10, 20], rtol=0.02)


def test_readings_of_a_robot_that_waits_between_firings_count_once_per_path():
    """All four sensors fire in turn, twice, at the same place."""
    log = log_of([[(k % 4, k % 4, 1.0 + k / 100)] for k in range(8)], np.zeros((8, 3)))
    windows, _ = gather_windows(FOUR, log, length=1.0)
    assert windows.scan.tolist() == [0, 1, 2, 3]


def test_echoes_of_a_window_have_the_poses_of_their_own_times():
    """Four sensors fire in turn within a scan, or in scans of their own."""
    poses = straight([0.025] * 39)
    single = log_of([[(k % 4, k % 4, 1.0)] for k in range(40)], poses)
    grouped = group_firings(single)
    assert len(grouped) == 10
    for length in (0.5, 5.0):
        world = []
        for log in (single, grouped):
            windows, _ = gather_windows(FOUR, log, length=length)
            flat = windows.echoes
            assert flat.pose is not None
            at = compose(log.pose[windows.last[flat.scan]], flat.pose)
            world.append({(int(p), round(float(x), 6)) for p, x in zip(flat.path, at[:, 0], strict=True)})
        assert world[0] == world[1]
        assert len(world[0]) == 40


# The choice of windows


def straight_drive(ring, *, spacing=0.05, scans=100, poses=True):
    """A log in which every sensor hears a wall from positions on a line."""
    pose = np.column_stack([spacing * np.arange(scans), np.zeros(scans), np.zeros(scans)])
    sensor = np.tile(np.arange(ring.count), scans)
    return Log.from_echoes(
        np.repeat(np.arange(scans), ring.count),
        sensor,
        sensor,
        np.full(len(sensor), 1.0),
        stamp=np.arange(float(scans)),
        pose=pose if poses else np.full((scans, 3), np.nan),
        asked=ring.paths,
    )


@pytest.mark.parametrize(
    ("count", "beam_deg", "sparse"), [(24, 60, False), (24, 59, True), (8, 30, True), (8, 180, False)]
)
def test_windows_are_chosen_for_rings_of_which_few_paths_receive_a_wall(count, beam_deg, sparse):
    """A long wall is received by count x beam / 360 deg direct paths."""
    ring = Ring.circular(count=count, beam=math.radians(beam_deg), neighbors=0)
    chosen = automatic_window(ring, straight_drive(ring))
    assert chosen == (WINDOWS.sparse_length if sparse else None)


def test_windows_are_longer_for_logs_with_few_places():
    lengths = [automatic_window(FOUR, straight_drive(FOUR, spacing=spacing)) for spacing in (0.02, 0.1, 0.3, 0.5, 2.0)]
    assert lengths == [1.5, 1.5, 3.6, 6.0, 6.0]


def test_no_window_is_chosen_without_a_trajectory():
    assert automatic_window(FOUR, straight_drive(FOUR, scans=20)) is None  # less than a window
    assert automatic_window(FOUR, straight_drive(FOUR, poses=False)) is None
    assert automatic_window(FOUR, straight_drive(FOUR)[:0]) is None


@given(length=st.floats(0.01, 100))
def test_windows_of_a_map_have_several_lengths_within_the_limits(length):
    found = window_lengths(length)
    assert found[0] == length
    assert all(WINDOWS.min_length <= one <= WINDOWS.max_length for one in found)
    assert len(set(found)) == len(found) >= 2
    with pytest.raises(SonarError, match="window"):
        window_lengths(-length)


@pytest.mark.parametrize("seed", range(3))
def test_independent_measurements_are_those_of_windows(seed):
    """A window of the whole trajectory holds each of them once."""
    log = a_log(seed, missing=0.0, strangers=False)
    found = independent_measurements(FOUR, log)
    windows, left_out = gather_windows(FOUR, log, length=90.0)
    assert found.left_out == left_out
    last = windows.echoes.scan == len(windows.last) - 1
    assert last.sum() == found.used.sum()
    assert found.independent[found.echoes.scan, found.echoes.path][found.used].all()
