"""Jumps of the odometry: found where it restarts, and nowhere in sound logs of any motion."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike
from support.wandering_robot import log_of, trajectory
from support.wandering_robot import ranges as simulated_ranges

from jaxsonar.geometry.se2 import compose, inverse, relative
from jaxsonar.plausibility.odometry_jumps import find_odometry_jumps, implausible_odometry
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.wheel_odometry import simulate_odometry

RING = Ring.circular(count=14, radius=0.2, beam=np.radians(40.0), neighbors=0, max_range=5.0)


def ranges(pose, **options):
    return simulated_ranges(pose, ring=RING, **options)


def restarted(pose, row, at: ArrayLike = (0.0, 0.0, 0.0)):
    """Odometry that begins again at a pose before the scan of a row."""
    again = compose(np.asarray(at, dtype=float), relative(pose[row], pose[row:]))
    return np.concatenate([pose[:row], again])


def drifting(truth, seed):
    return simulate_odometry(truth, distance=0.02, turn=0.02, seed=seed)


@pytest.mark.parametrize("seed", range(12))
def test_a_restart_is_found_at_its_scan(seed):
    rng = np.random.default_rng(seed)
    truth = trajectory(200, step=rng.uniform(0.01, 0.06))
    row = int(rng.integers(20, 190))
    odometry = restarted(drifting(truth, seed), row)
    period = rng.choice([0.05, 0.1, 0.3])
    log = log_of(ranges(truth, sigma=rng.choice([0.001, 0.01]), seed=seed), odometry, period=period)
    (jump,) = find_odometry_jumps(RING, log)
    assert (jump.before, jump.after) == (row - 1, row)
    assert jump.restarts
    assert jump.ranges_continue is True
    assert jump.seconds == pytest.approx(period)
    np.testing.assert_allclose(jump.step, relative(odometry[row - 1], odometry[row]))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("stamps", [True, False])
def test_a_correction_of_the_odometry_is_found(seed, stamps):
    """The pose jumps to anywhere, while the robot drives on."""
    rng = np.random.default_rng(seed)
    truth = trajectory(150)
    row, to = int(rng.integers(10, 140)), rng.uniform([-3, -3, -3], 3)
    odometry = restarted(drifting(truth, seed), row, to)
    log = log_of(ranges(truth, seed=seed), odometry)
    log = log if stamps else replace(log, stamp=np.full(len(log), np.nan))
    jumps = find_odometry_jumps(RING, log)
    assert [jump.after for jump in jumps] == [row]
    assert jumps[0].ranges_continue is True
    assert not jumps[0].restarts
    assert np.isfinite(jumps[0].seconds) == stamps


def test_every_jump_is_found_and_the_warning_names_the_first_one():
    odometry = restarted(restarted(trajectory(300), 100), 200, (5.0, 1.0, 2.0))
    log = log_of(ranges(trajectory(300)), odometry)
    assert [jump.after for jump in find_odometry_jumps(RING, log)] == [100, 200]
    (text,) = map(str, implausible_odometry(RING, log))
    for words in ("odometry jumps 2 times", "at scan 100", " m and ", " deg in 0.10 s", "restarted", "slam"):
        assert words in text


def test_a_robot_that_is_carried_while_the_log_goes_on_is_found_by_its_impossible_speed():
    truth = trajectory(300)
    truth = np.concatenate([truth[:100], truth[200:]])
    log = log_of(ranges(truth), restarted(truth, 100, (2.0, 1.0, 0.5)), period=0.1)
    (jump,) = find_odometry_jumps(RING, log)
    assert (jump.after, jump.ranges_continue) == (100, False)
    assert "moved by hand" in str(next(implausible_odometry(RING, log)))


def sound_logs():
    """Names, true poses, poses of the log, and times, of sound logs."""
    truth = trajectory(300)
    time = 0.1 * np.arange(300)
    yield "driving", truth, drifting(truth, 1), time
    yield "at rest", truth[[5] * 300], truth[[5] * 300], time
    yield "at rest, then driving", truth[[5] * 280 + [*range(5, 25)]], truth[[5] * 280 + [*range(5, 25)]], time
    turning = truth[[5] * 300] + np.outer(np.clip(np.arange(300) - 150, 0, 40), [0, 0, 0.15])
    yield "turning", turning, turning, time
    gap = np.concatenate([truth[:100], truth[180:]])
    yield "a gap in time", gap, gap, np.concatenate([time[:100], time[180:]])
    yield "scans are missing", gap, gap, np.full(len(gap), np.nan)
    yield "scans far apart", truth[::25], truth[::25], time[::25]
    yield "scans far apart, wrong times", truth[::25], truth[::25], time[:12]
    yield "a slow odometry", truth, truth[np.arange(300) // 5 * 5], time
    jitter = time + np.random.default_rng(0).uniform(-0.049, 0.049, 300)
    yield "times that jitter", truth, drifting(truth, 2), jitter
    yield "times in steps", truth, drifting(truth, 2), np.floor(time)
    backward = np.concatenate([time[:150], time[:150]])
    yield "a clock that is set", truth, drifting(truth, 2), backward
    lacks = drifting(truth, 3)
    lacks[60:200:3] = np.nan
    lacks[100:160] = np.nan
    yield "poses are missing", truth, lacks, time
    apart = np.concatenate([truth[:100], truth[200:]])
    yield "two runs with poses in one frame", apart, apart, time[:200]
    twice = np.concatenate([truth[:150], truth[:150]])
    yield "driven twice from the start", twice, twice, time
    places = np.random.default_rng(4).uniform([-2.5, -1.5, -3], [2.5, 1.5, 3], (60, 3))
    yield "places anywhere", places, places, time[:60]
    slip = drifting(truth, 5)
    yield "a slip", truth, restarted(slip, 150, compose(slip[150], np.array([0.08, 0.02, 0.1]))), time
    coarse = truth.copy()
    coarse[:, 2] = np.cumsum(np.where(np.arange(300) % 75 == 74, np.pi / 2, 0))
    yield "turns between two scans", coarse, coarse, time * 20


@pytest.mark.parametrize(
    ("truth", "pose", "stamp"), [one[1:] for one in sound_logs()], ids=[n[0] for n in sound_logs()]
)
def test_a_sound_log_has_no_jump(truth, pose, stamp):
    log = replace(log_of(ranges(truth), pose), stamp=stamp)
    assert find_odometry_jumps(RING, log) == ()


def test_a_jump_is_found_in_any_frame_of_the_world_and_not_without_poses():
    odometry = restarted(trajectory(120), 60, (2.0, 2.0, 2.0))
    heard = ranges(trajectory(120))
    moved = compose(inverse(np.array([100.0, -40.0, 3.0])), odometry)
    assert [jump.after for jump in find_odometry_jumps(RING, log_of(heard, moved))] == [60]
    assert find_odometry_jumps(RING, log_of(heard, np.full((120, 3), np.nan))) == ()
    assert find_odometry_jumps(RING, Log.from_scans([])) == ()


def test_poses_of_any_size_are_valid():
    odometry = restarted(trajectory(120), 60)
    for factor in (1e-300, 1e-9, 1e3, 1e12, 1e300):
        find_odometry_jumps(RING, log_of(ranges(trajectory(120)), factor * odometry))
