"""Held readings: a driver that repeats the last range is recognized, and no sound log is accused."""

from dataclasses import replace

import numpy as np
import pytest
from support.wandering_robot import RING, along_a_wall, held, log_of, ranges, trajectory

from jaxsonar.plausibility.held_readings import find_held_readings, with_ages
from jaxsonar.scans.readings import unique_readings

POSE = trajectory()


def slow(reported, period):
    """Sensors that are renewed in every ``period``-th scan, each at another phase."""
    scan = np.arange(len(reported))[:, None]
    phase = np.arange(reported.shape[1]) % period
    return np.take_along_axis(reported, np.maximum((scan - phase) // period * period + phase, 0), axis=0)


def test_held_readings_get_the_age_of_their_original():
    true = ranges(POSE)
    reported, is_held = held(true)
    log = log_of(reported, POSE)
    found = find_held_readings(RING, log)
    expected = np.flatnonzero(is_held[log.echo_scan, log.tx])
    np.testing.assert_array_equal(np.sort(found.reading), expected)
    assert f"{len(expected)} readings" in found.describe()
    aged = with_ages(log, found)
    # Each held reading refers to the scan of the last true echo of its sensor.
    last = np.maximum.accumulate(np.where(np.isfinite(true), np.arange(len(POSE))[:, None], -1), axis=0)
    age = 0.1 * (log.echo_scan - last[log.echo_scan, log.tx])
    np.testing.assert_allclose(aged.age, age, atol=1e-9)
    # Each echo counts once.
    assert unique_readings(aged).echo_count == np.isfinite(true).sum()
    assert not find_held_readings(RING, aged)


@pytest.mark.parametrize("resolution", [1e-5, 1e-3, 0.01, 0.05])
@pytest.mark.parametrize("sigma", [0.0, 0.003, 0.02])
@pytest.mark.parametrize("poses", [trajectory, along_a_wall])
def test_sound_logs_have_no_held_readings(sigma, resolution, poses):
    pose = poses()
    true = ranges(pose, sigma=sigma, resolution=resolution)
    always = np.where(np.isfinite(true), true, np.nan_to_num(true, nan=0.0) + 4.0)  # a mark for no echo
    at_rest = np.repeat(pose[::20], 20, axis=0)
    for reported, where in (
        (true, pose),
        (always, pose),
        (slow(true, 2), pose),
        (slow(true, 3), pose),
        (slow(always, 2), pose),
        (ranges(at_rest, sigma=sigma, resolution=resolution), at_rest),
    ):
        assert not find_held_readings(RING, log_of(reported, where))


@pytest.mark.parametrize("sigma", [0.0, 0.003])
def test_sensors_that_always_hear_a_wall_are_not_accused(sigma):
    """Wide cones: every sensor has a reading in every scan, also with a coarse resolution and old readings."""
    ring = replace(RING, beam=np.full(12, np.radians(95.0)))
    true = ranges(POSE, sigma=sigma, resolution=0.01, ring=ring)
    assert np.isfinite(true).all()
    for reported in (true, slow(true, 2), slow(true, 3)):
        assert not find_held_readings(ring, log_of(reported, POSE))


def test_with_a_coarse_resolution_only_proven_readings_are_held():
    """A reading along a wall is equal to the one before it; it must not be lost."""
    true = ranges(POSE, sigma=0.004, resolution=0.01)
    reported, is_held = held(true)
    log = log_of(reported, POSE)
    found = find_held_readings(RING, log)
    of_it = is_held[log.echo_scan[found.reading], log.tx[found.reading]]
    assert of_it.mean() > 0.98
    assert of_it.sum() > 0.7 * is_held.sum()


def test_an_odometry_that_moves_although_the_robot_rests_is_no_proof():
    reported = np.tile(ranges(POSE[:1], resolution=0.01), (len(POSE), 1))
    assert not find_held_readings(RING, log_of(np.nan_to_num(reported, nan=1.0), POSE))


def test_logs_that_mark_silence_or_have_no_poses_are_not_searched():
    log = log_of(held(ranges(POSE))[0], POSE)
    assert find_held_readings(RING, log)
    assert not find_held_readings(RING, replace(log, pose=np.full_like(log.pose, np.nan)))
    silent = np.where(np.arange(len(log.tx)) == 5, np.nan, log.range)
    assert not find_held_readings(RING, replace(log, range=silent))
    assert not find_held_readings(RING, log[:0])
    unchanged = log_of(ranges(POSE), POSE)
    assert with_ages(unchanged, find_held_readings(RING, unchanged)) is unchanged


def test_readings_of_firings_in_turn_have_their_own_poses():
    """The sensors fire one after another while the robot moves; the log holds times of firing."""
    fine = trajectory(4800, step=0.04 / 12)
    each = ranges(fine).reshape(400, 12, 12)
    true = each[:, np.arange(12), np.arange(12)]
    reported, is_held = held(true)
    log = log_of(reported, fine[::12])
    times = 100 + np.arange(4800) * 0.1 / 12
    log = replace(log, t=log.tx * 0.1 / 12, odometry=np.column_stack([times, fine]))
    found = find_held_readings(RING, log)
    np.testing.assert_array_equal(np.sort(found.reading), np.flatnonzero(is_held[log.echo_scan, log.tx]))
