"""Grouping of single firings into scans: nothing is lost, and silence has a transmitter only if the echoes prove it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar.geometry.se2 import subtract_poses
from jaxsonar.scans.firing_poses import reading_poses
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.single_firings import group_firings


def arc(time, *, turn=0.7, speed=0.4):
    """Pose of a robot that drives on a circle, at some times."""
    time = np.asarray(time, np.float64)
    radius = speed / turn
    theta = turn * time
    return np.stack([1.0 + radius * np.sin(theta), 2.0 + radius * (1 - np.cos(theta)), theta], axis=-1)


def single_firings(count=12, *, sensors=4, period=0.025, silent=()):
    """A log in which every firing is a scan of its own; the firings ``silent`` hear nothing."""
    stamp = 100 + period * np.arange(count)
    tx = np.arange(count) % sensors
    heard = np.where(np.isin(np.arange(count), silent), np.nan, 1 + 0.01 * np.arange(count))
    return Log.from_echoes(np.arange(count), tx, tx, heard, stamp=stamp, pose=arc(stamp))


def assert_same_poses(found, expected):
    np.testing.assert_allclose(subtract_poses(np.asarray(found), np.asarray(expected)), 0, atol=1e-9)


@given(silent=st.sets(st.integers(0, 11), max_size=6))
def test_grouped_firings_keep_every_reading_time_and_pose(silent):
    log = single_firings(silent=sorted(silent))
    grouped = group_firings(log)
    assert len(grouped) == 3
    np.testing.assert_array_equal(grouped.start, [0, 4, 8, 12])
    np.testing.assert_array_equal(grouped.range, log.range)
    np.testing.assert_allclose(grouped.stamp[grouped.echo_scan] + grouped.t, log.stamp, atol=1e-9)
    assert_same_poses(reading_poses(grouped), log.pose)
    assert not len(grouped.asked)
    assert group_firings(grouped) is grouped


def test_a_group_of_firings_ends_before_the_second_firing_of_a_transmitter():
    log = single_firings(7)
    asked = np.zeros((0, 2), int)  # one transmitter in each scan, in no order
    log = replace(log, tx=np.array([0, 1, 0, 2, 3, 3, 1]), rx=np.array([0, 1, 0, 2, 3, 3, 1]), asked=asked)
    np.testing.assert_array_equal(group_firings(log).start, [0, 2, 5, 7])


def test_firings_without_stamps_or_after_a_pause_are_not_merged():
    log = replace(single_firings(4), asked=np.zeros((0, 2), int))
    assert len(group_firings(replace(log, stamp=np.full(4, np.nan)))) == 4
    pause = replace(log, stamp=log.stamp + np.array([0, 0, 30, 30]))
    np.testing.assert_array_equal(group_firings(pause).start, [0, 2, 4])


def test_scans_with_several_transmitters_are_not_changed():
    log = single_firings(4)
    log = replace(log, start=np.array([0, 2, 2, 2, 4]), asked=np.array([[0, 0]]))
    assert group_firings(log) is log


def without_silent_readings(log):
    """The log as a device writes it that reports echoes only."""
    heard = np.isfinite(log.range)
    columns = {name: getattr(log, name)[heard] for name in ("tx", "rx", "range", "amplitude", "t", "age")}
    start = np.searchsorted(log.echo_scan[heard], np.arange(len(log) + 1))
    return Log(log.scan, log.stamp, log.pose, start, **columns)


@pytest.mark.parametrize("seed", range(4))
def test_silent_firings_of_a_periodic_order_get_their_transmitter(seed):
    rng = np.random.default_rng(seed)
    sensors = int(rng.integers(3, 17))
    order = rng.permutation(sensors)
    log = single_firings(20 * sensors, sensors=sensors)
    log = replace(log, tx=order[log.tx], rx=order[log.rx])
    silent = rng.random(len(log)) < 0.5
    log = replace(log, range=np.where(silent, np.nan, log.range))
    found = group_firings(without_silent_readings(log))
    expected = group_firings(log)
    assert len(found) == len(expected)
    for name in ("tx", "rx", "range", "start", "t"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_silent_firings_without_an_order_stay_unknown():
    rng = np.random.default_rng(0)
    log = single_firings(200, sensors=8)
    tx = rng.integers(0, 8, len(log))
    silent = rng.random(len(log)) < 0.5
    log = replace(log, tx=tx, rx=tx, range=np.where(silent, np.nan, log.range))
    found = group_firings(without_silent_readings(log))
    assert found.echo_count == len(found.tx) == (~silent).sum()


def test_a_firing_with_an_echo_is_silent_on_the_other_paths_of_its_transmitter():
    # Neighbors listen, too: in the first round everybody hears, later only the transmitter itself.
    tx = np.array([0, 0, 1, 1, *[0, 1] * 4])
    rx = np.array([0, 1, 1, 0, *[0, 1] * 4])
    scan = np.array([0, 0, 1, 1, *range(2, 10)])
    stamp = 0.025 * np.arange(10)
    log = Log.from_echoes(scan, tx, rx, np.ones(12), stamp=stamp, pose=arc(stamp))
    grouped = group_firings(log)
    assert len(grouped) == 5
    later = grouped[1]
    heard = {(int(a), int(b)): bool(np.isfinite(r)) for a, b, r in zip(later.tx, later.rx, later.range, strict=True)}
    assert heard == {(0, 0): True, (0, 1): False, (1, 1): True, (1, 0): False}
