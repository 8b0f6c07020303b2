"""Ranges that do not go with the motion: named for a wrong scale, silent for sound logs."""

import re

import numpy as np
import pytest
from support.wandering_robot import RING, log_of, ranges, trajectory

from jaxsonar.calibration.implausible_scale import implausible_scale
from jaxsonar.simulation.wheel_odometry import simulate_odometry

TRUE = trajectory(300)


def statements(factor, seed=0):
    odometry = simulate_odometry(TRUE, distance=0.02, turn=float(np.radians(1.0)), seed=seed)
    log = log_of(np.round(ranges(TRUE, sigma=0.005, seed=seed) * factor, 2), odometry)
    return [*implausible_scale(RING, log)]


@pytest.mark.parametrize("seed", range(3))
def test_sound_logs_are_not_suspected(seed):
    assert not statements(1.0, seed)


@pytest.mark.parametrize(("factor", "size", "more"), [(0.9, "short", "less"), (1.1, "long", "more")])
def test_a_wrong_scale_is_named_with_the_speed_that_removes_it(factor, size, more):
    (found,) = statements(factor)
    assert f"the ranges are too {size}" in str(found)
    change = re.search(rf"change by (\d+\.\d) \+- \d+\.\d % {more} than the robot moves", str(found))
    assert change is not None
    assert float(change[1]) == pytest.approx(10, abs=4)
    percent = float(str(found).split(" +- ")[1].split()[0])
    speed = float(str(found).split("speed_of_sound to ")[1].split()[0])
    assert speed == pytest.approx(float(RING.speed_of_sound) / factor, rel=3 * percent / 100)
    assert percent < 2.5


def test_without_motion_nothing_is_said():
    still = np.tile(TRUE[:1], (50, 1))
    assert not [*implausible_scale(RING, log_of(ranges(still) * 0.9, still))]
