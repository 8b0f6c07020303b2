"""SLAM with partly measured scans and with sensors that fire in turn: as if all had been measured at once."""

from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest
from support.firings import explicit, fire_in_turn
from support.hard_cones import simulate
from support.slam_scene import ODOMETRY_NOISE, ROOM

from jaxsonar import Ring, SonarError
from jaxsonar.cli.slam_summary import as_json, summary_lines
from jaxsonar.detection.extract import local_models
from jaxsonar.estimation.trajectory import Trajectory
from jaxsonar.evaluation.trajectory_errors import trajectory_errors
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.graph_slam.frontend import start_submap, update
from jaxsonar.graph_slam.incremental_mapper import Mapper
from jaxsonar.graph_slam.scan_echoes import known_walls_missed
from jaxsonar.graph_slam.slam import SETTINGS, slam
from jaxsonar.scans.scan_log import Log
from jaxsonar.simulation.wheel_odometry import simulate_odometry

RING = Ring.circular()
DIRECT = Ring.circular(count=48, neighbors=0)
WITH_CROSS_PATHS = Ring.circular(count=48, neighbors=3)
SCANS, PERIOD = 30, 0.025
SIGMA = 0.002


def trajectory(time):
    """Through the room and back, in curves, while all sensors fire in turn ``SCANS`` times."""
    duration = SCANS * RING.count * PERIOD

    def place(part):
        return np.column_stack([1.0 + 3.3 * np.sin(np.pi * part) ** 2, 1.6 + 0.5 * np.sin(2 * np.pi * part)])

    to = place(time / duration + 1e-4) - place(time / duration - 1e-4)
    return np.column_stack([place(time / duration), wrap_angle(np.arctan2(to[:, 1], to[:, 0]))])


STAMPS = np.arange(SCANS) * RING.count * PERIOD
TRUTH = Trajectory(STAMPS, trajectory(STAMPS))


def drifting(poses):
    return simulate_odometry(poses, distance=0.003, turn=float(np.radians(0.2)), seed=2)


@cache
def in_turn():
    """Full scans with ``t``, single firings, and the same echoes of a robot that stops for every scan."""
    together, alone = fire_in_turn(RING, ROOM, trajectory, SCANS, period=PERIOD, sigma=SIGMA, seed=1)
    assert together.odometry is not None
    odometry = drifting(np.array(together.odometry)[:, 1:])
    first = odometry[:: RING.count]
    together = replace(together, pose=first, odometry=np.column_stack([together.odometry[:, 0], odometry]))
    at_rest = simulate(RING, ROOM, TRUTH.poses, sigma=SIGMA, seed=1).as_log(RING, first)
    return together, replace(alone, pose=odometry), replace(at_rest, stamp=STAMPS)


@cache
def direct_log(scans=SCANS):
    poses = TRUTH.poses[:scans]
    log = simulate(DIRECT, ROOM, poses, sigma=SIGMA, seed=1).as_log(DIRECT, drifting(poses))
    return replace(log, stamp=STAMPS[:scans])


def first_model():
    """The local model of the first scan, by the program that ``slam`` uses, too."""
    return next(local_models(DIRECT, direct_log(2)))


@cache
def direct_slam():
    return slam(DIRECT, direct_log(), odometry_noise=ODOMETRY_NOISE)


def errors(found):
    return trajectory_errors(found.trajectory, TRUTH, align="first")


@pytest.mark.slow
def test_sensors_that_fire_in_turn_give_the_result_of_a_robot_that_stops():
    together, alone, at_rest = in_turn()
    found, expected = (slam(RING, log, odometry_noise=ODOMETRY_NOISE) for log in (together, at_rest))
    own, reference = errors(found), errors(expected)
    assert own.ate < 1.5 * reference.ate + 0.003
    assert own.ate_heading < 1.5 * reference.ate_heading + np.radians(0.2)
    assert abs(len(found.world) - len(expected.world)) <= 1
    assert found.world.length.sum() > 0.9 * expected.world.length.sum()
    assert found.explained.measured > 0.9
    # One firing a scan is the same log: one pose for each full scan.
    single = slam(RING, alone, odometry_noise=ODOMETRY_NOISE)
    np.testing.assert_allclose(single.poses, found.poses, atol=1e-6)
    np.testing.assert_allclose(single.stamp, STAMPS)
    # Without the times the result is wrong.
    timeless = replace(together, t=np.zeros(len(together.t)), odometry=None)
    ignored = slam(RING, timeless, odometry_noise=ODOMETRY_NOISE, smooth=False)
    assert errors(ignored).ate > 3 * own.ate


@pytest.mark.slow
def test_a_mapper_takes_the_times_of_a_log_scan_by_scan():
    together = in_turn()[0][16:24]  # scans of at most 64 echoes
    mapper = Mapper(ring=RING, odometry_noise=ODOMETRY_NOISE)
    state = mapper.start()
    for scan in together:
        state, _ = mapper.step(state, scan)
    found = slam(RING, together, odometry_noise=ODOMETRY_NOISE, smooth=False)
    np.testing.assert_allclose(mapper.trajectory(state)[0], found.poses, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("is_explicit", [True, False])
def test_cross_paths_that_were_not_measured_change_nothing(is_explicit):
    """Direct echoes only, with a ring that has cross paths, too: as with the ring without."""
    log = direct_log()
    measured = np.zeros((len(log), len(WITH_CROSS_PATHS.paths)), bool)
    measured[:, : DIRECT.count] = True
    part = explicit(WITH_CROSS_PATHS, log, measured) if is_explicit else replace(log, asked=log.asked)
    expected = direct_slam()
    found = slam(WITH_CROSS_PATHS, part, odometry_noise=ODOMETRY_NOISE)
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-4)
    assert abs(found.world.length.sum() / expected.world.length.sum() - 1) < 0.01
    assert found.explained.measured == pytest.approx(expected.explained.measured, abs=0.01)


def test_a_wall_needs_fewer_echoes_if_fewer_paths_were_measured():
    log = direct_log(1)
    measured = np.zeros((1, len(WITH_CROSS_PATHS.paths)), bool)
    measured[:, : DIRECT.count] = True
    part = explicit(WITH_CROSS_PATHS, log, measured)
    model = first_model()
    expected = update(DIRECT, start_submap(), log[0], model, row=0)
    found = update(WITH_CROSS_PATHS, start_submap(), part[0], model, row=0)
    assert len(expected.scan_counts) >= 2
    np.testing.assert_array_equal(found.belief.landmarks.kind, expected.belief.landmarks.kind)
    np.testing.assert_allclose(found.belief.landmarks.parameters, expected.belief.landmarks.parameters, atol=1e-9)
    assert expected.directions == (None,)
    (directions,) = found.directions
    assert directions is not None
    assert directions.all()  # the direct paths look in all directions


def test_only_measured_paths_miss_known_walls():
    log = direct_log(1)
    state = update(DIRECT, start_submap(), log[0], first_model(), row=0)
    seen_twice = np.full(len(state.scan_counts), 2)
    nothing = Log.from_scans([replace(log[0], tx=log.tx[:0], rx=log.tx[:0], range=log.range[:0], **NO_READINGS)])[0]

    def missed(scan, measured):
        return known_walls_missed(DIRECT, state.belief, seen_twice, scan, None, measured)

    every, none = np.ones(len(DIRECT.paths), bool), np.zeros(len(DIRECT.paths), bool)
    with jax.enable_x64(True):
        assert not missed(log[0], every)
        assert missed(nothing, every)
        assert not missed(nothing, none)


NO_READINGS = {"amplitude": np.zeros(0), "t": None, "age": None}


@pytest.mark.slow
def test_the_explained_share_is_reported_as_measured_and_as_required():
    log = direct_log(12)
    for smooth in (True, False):
        found = slam(DIRECT, log, odometry_noise=ODOMETRY_NOISE, smooth=smooth)
        assert SETTINGS.min_explained == found.explained.required
        assert 0.5 < found.explained.measured <= 1
        table = as_json(found, None)
        assert (table["explained"], table["explained_required"]) == found.explained
        line = next(line for line in summary_lines(found, None) if "explained" in line)
        assert f"{100 * found.explained.measured:.0f} %" in line
        assert "10 %" in line
    assert found.smoothed is None
    rng = np.random.default_rng(0)
    noise = replace(log, range=rng.uniform(0.3, 1.9, len(log.range)))
    for smooth in (True, False):
        with pytest.raises(SonarError, match=r"explain [\d.]+ % of the echoes; needed are 10 % or more"):
            slam(DIRECT, noise, odometry_noise=ODOMETRY_NOISE, smooth=smooth)
