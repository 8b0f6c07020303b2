"""What a scan measured, against the rules of the file format written out in plain loops."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar import kernels
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.measured_paths import full_wall_paths, is_repeated, measured_paths, unique_readings
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
