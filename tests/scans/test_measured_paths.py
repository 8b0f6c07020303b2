"""What a scan measured, against the rules of the file format written out in plain loops."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar import kernels
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.measured_paths import full_wall_paths, measured_paths
from jaxsonar.scans.readings import is_repeated, unique_readings
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

RING = Ring.circular(count=5, neighbors=1)
PAIRS = [tuple(pair) for pair in RING.paths.tolist()]
NAN = float("nan")


def log_of(scans, **columns):
    """A log from a list of {(tx, rx): range} for each scan; NaN is a path that heard nothing."""
    rows = [(k, tx, rx, distance) for k, scan in enumerate(scans) for (tx, rx), distance in scan.items()]
    index, tx, rx, distance = (np.array(column) for column in zip(*rows, strict=True)) if rows else (np.zeros(0),) * 4
    stamp = 0.1 * np.arange(len(scans))
    pose = np.zeros((len(scans), 3))
    index, tx, rx = (column.astype(np.int64) for column in (index, tx, rx))
    return Log.from_echoes(index, tx, rx, distance.astype(np.float64), stamp=stamp, pose=pose, **columns)


def expected_paths(scans):
    """The rule of the file format, one path at a time."""
    explicit = any(np.isnan(distance) for scan in scans for distance in scan.values())
    heard = {pair for scan in scans for pair in scan}
    return [[pair in (scan if explicit else heard) for pair in PAIRS] for scan in scans]


ranges = st.sampled_from([0.5, 1.0, 1.5])
two_transmitters = {(0, 0): 1.0, (1, 1): 1.0}  # not a log of sensors that fire in turn
implicit_scan = st.dictionaries(st.sampled_from(PAIRS), ranges, max_size=6)
explicit_scan = st.dictionaries(st.sampled_from(PAIRS), ranges | st.just(NAN), max_size=6)


@given(scans=st.lists(implicit_scan, max_size=4))
def test_a_scan_of_an_implicit_log_measures_all_paths_that_are_heard_anywhere(scans):
    scans = [two_transmitters, *scans]
    np.testing.assert_array_equal(measured_paths(RING, log_of(scans)), expected_paths(scans))


@given(scans=st.lists(explicit_scan, max_size=4))
def test_a_scan_of_an_explicit_log_measures_the_paths_that_it_lists(scans):
    scans = [{(2, 2): NAN}, *scans]
    np.testing.assert_array_equal(measured_paths(RING, log_of(scans)), expected_paths(scans))


@given(scans=st.lists(explicit_scan, min_size=1, max_size=4), data=st.data())
def test_parts_of_a_log_measure_what_the_whole_log_measures(scans, data):
    log = log_of([two_transmitters, *scans])
    begin = data.draw(st.integers(0, len(log) - 1))
    np.testing.assert_array_equal(measured_paths(RING, log[begin:]), measured_paths(RING, log)[begin:])
    one = log[begin].as_log()
    np.testing.assert_array_equal(measured_paths(RING, one), measured_paths(RING, log)[begin : begin + 1])
    again = Log.from_scans(list(log))
    np.testing.assert_array_equal(measured_paths(RING, again), measured_paths(RING, log))


def test_sensors_that_fire_in_turn_measure_only_what_their_scan_lists():
    scans = [{(k % 5, k % 5): 1.0} for k in range(10)]
    np.testing.assert_array_equal(measured_paths(RING, log_of(scans)).sum(axis=1), np.ones(10))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("sensors", [2, 4, 5])
def test_sparse_full_scans_are_no_firings_in_turn(sensors, seed):
    """In a large hall, each scan of all sensors holds one echo at most."""
    rng = np.random.default_rng(seed)
    ring = Ring.circular(count=sensors, neighbors=0)
    log = log_of([{(k, k): 1.0} if rng.random() < 0.7 else {} for k in rng.integers(0, sensors, 200).tolist()])
    assert measured_paths(ring, log).all()


@pytest.mark.parametrize(("heard", "kept"), [(0.3, 1.0), (0.8, 0.9)])
def test_sensors_that_fire_in_turn_are_known_by_their_order(heard, kept):
    """Most firings hear nothing and have a scan without a reading, or some scans are missing in the log."""
    rng = np.random.default_rng(0)
    order, log = rng.permutation(5).tolist(), []
    for k in range(300):
        if rng.random() < kept:
            log.append({(order[k % 5], order[k % 5]): 1.0} if rng.random() < heard else {})
    assert not len(log_of(log).asked)


def test_one_sensor_alone_does_not_fire_in_turn():
    scans = [{(3, 3): 1.0}, {}, {(3, 3): 1.1}]
    np.testing.assert_array_equal(measured_paths(RING, log_of(scans)).sum(axis=1), np.ones(3))


def test_pairs_that_are_no_paths_of_the_ring_are_ignored():
    log = log_of([{(0, 2): 1.0, (9, 9): 1.0, (0, 0): NAN}])
    assert measured_paths(RING, log).sum() == 1


def test_echoes_are_the_readings_that_heard_something():
    flat, left_out = FlatEchoes.from_log(RING, log_of([{(0, 0): 1.0, (1, 1): NAN, (0, 3): 1.0, (0, 2): NAN}]))
    np.testing.assert_array_equal(flat.reported, [1.0])
    assert left_out == 1  # (0, 3) heard something, but is no path of this ring


def test_full_measurement_needs_no_mask():
    flat, _ = FlatEchoes.from_log(RING, log_of([dict.fromkeys(PAIRS, 1.0), {(0, 0): 1.0}]))
    assert flat.measured is None
    assert flat.path_pose is None


@pytest.mark.parametrize("reading", [1.0, NAN])
def test_an_unrenewed_reading_counts_once(reading):
    other = {(1, 1): 1.0, (2, 2): NAN}
    age = np.array([0, 0, 0, 0.1, 0, 0, 0.2, 0, 0, 0, 0, 0])
    scans = [{(0, 0): reading, **other}] * 4
    log = log_of(scans, age=age)
    np.testing.assert_array_equal(np.flatnonzero(is_repeated(log)), [3, 6])
    once = unique_readings(log)
    expected = measured_paths(RING, log)
    row = RING.path_index[0, 0]
    np.testing.assert_array_equal(expected[:, row], [True, False, False, True])
    np.testing.assert_array_equal(measured_paths(RING, once), expected)


def test_an_unrenewed_reading_without_its_original_is_kept():
    log = log_of([{(0, 0): 1.0, (1, 1): 2.0}, {(0, 0): 1.5, (1, 1): 2.0}], age=np.array([0.05, 0, 0.03, 0]))
    assert not is_repeated(log).any()
    assert unique_readings(log) is log


def repeated_in(stamp, age, scan=None):
    """Rows of repeated readings among equal readings of one path, one in each scan."""
    count = len(stamp)
    log = Log.from_echoes(
        np.arange(count) if scan is None else np.array(scan),
        np.zeros(count, int),
        np.zeros(count, int),
        np.ones(count),
        age=np.array(age),
        stamp=np.array(stamp),
        pose=np.zeros((count, 3)),
    )
    return np.flatnonzero(is_repeated(log)).tolist()


@pytest.mark.parametrize("digits", [1, 2, 3, 4])
@pytest.mark.parametrize("rounded", ["age", "stamp", "both"])
def test_rounded_ages_and_stamps_are_recognized(digits, rounded):
    """A sensor renews its reading with every third scan; equal ranges all the time."""
    period = 4.3 * 10.0**-digits
    time = 1.7e9 + period * np.arange(30)
    age = period * (np.arange(30) % 3)
    stamp = np.round(time, digits) if rounded != "age" else time
    age = np.round(age, digits) if rounded != "stamp" else age
    assert repeated_in(stamp, age) == [k for k in range(30) if k % 3]


def test_readings_that_were_measured_between_scans_are_not_repeated():
    """Each scan holds a new reading, 30 ms old."""
    assert repeated_in(0.1 * np.arange(20), np.full(20, 0.03)) == []


def test_without_stamps_an_old_reading_repeats_an_equal_one_of_the_scan_before():
    stamp = np.full(5, np.nan)
    assert repeated_in(stamp, [0, 0.04, 0.07, 0, 0.04]) == [1, 2, 4]
    log = log_of([{(0, 0): 1.0}, {(0, 0): 1.5}, {(0, 0): 1.0}, {(0, 0): 1.0}], age=np.array([0, 0.1, 0.2, 0.3]))
    assert np.flatnonzero(is_repeated(replace(log, stamp=np.full(4, np.nan)))).tolist() == [3]


@pytest.mark.parametrize("is_explicit", [False, True])
def test_a_single_scan_does_not_hold_what_an_earlier_scan_counted(is_explicit):
    listed = {(2, 2): NAN} if is_explicit else {}
    scans = [{(0, 0): 1.0, (1, 1): 2.0, **listed}, {(0, 0): 1.0, **listed}, {(1, 1): 2.5, **listed}]
    age = np.concatenate([np.zeros(len(scans[0])), [0.1], np.zeros(len(listed)), np.zeros(len(scans[2]))])
    log = log_of(scans, age=age)
    flat, _ = FlatEchoes.from_log(RING, log)
    assert np.diff(flat.start).tolist() == [2, 0, 1]
    for k, scan in enumerate(log):
        one, _ = FlatEchoes.from_log(RING, scan.as_log())
        np.testing.assert_array_equal(one.path, flat.path[flat.scan == k])
        np.testing.assert_array_equal(measured_paths(RING, scan.as_log())[0], measured_paths(RING, log)[k])
    again = Log.from_scans(list(log))
    np.testing.assert_array_equal(measured_paths(RING, again), measured_paths(RING, log))
    assert len(log[1:2].tx) == 1 + len(listed)


def test_removing_repetitions_from_an_implicit_log_keeps_the_silence_of_other_paths():
    log = log_of([{(0, 0): 1.0, (1, 1): 2.0}, {(0, 0): 1.0}, {(1, 1): 2.0}], age=np.array([0, 0, 0.1, 0]))
    once = unique_readings(log)
    direct = [RING.path_index[k, k] for k in (0, 1)]
    np.testing.assert_array_equal(measured_paths(RING, log)[:, direct], [[True, True], [False, True], [True, True]])
    np.testing.assert_array_equal(measured_paths(RING, once), measured_paths(RING, log))
    assert once.echo_count == 3


@pytest.mark.parametrize("neighbors", [0, 1, 3])
def test_measuring_every_path_once_receives_a_wall_as_often_as_the_kernel_says(neighbors):
    ring = Ring.circular(count=24, neighbors=neighbors)
    found = full_wall_paths(ring, np.ones((1, len(ring.paths))))
    expected = kernels.hough_accumulator.full_wall_paths(ring.echo_paths)
    np.testing.assert_allclose(found, float(expected), rtol=1e-5)


def test_firings_in_turn_receive_a_wall_as_often_as_all_at_once():
    ring = Ring.circular(count=24, neighbors=0)
    once, twice = np.ones((1, 24)), np.full((1, 24), 2.0)
    np.testing.assert_allclose(full_wall_paths(ring, twice), 2 * full_wall_paths(ring, once))
    front = np.zeros((1, 24))
    front[0, [23, 0, 1]] = 1  # three cones of 60 deg over 90 deg
    np.testing.assert_allclose(full_wall_paths(ring, front), 2.0, rtol=0.02)
