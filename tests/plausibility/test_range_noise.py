"""The noise of the ranges from second differences."""

import dataclasses

import numpy as np
import pytest
from support.wandering_robot import RING, along_a_wall, log_of, ranges, trajectory

from jaxsonar.plausibility.range_noise import range_noise


@pytest.mark.parametrize("sigma", [0.001, 0.003, 0.01, 0.03])
@pytest.mark.parametrize("pose", [trajectory(300), along_a_wall()], ids=["wavy", "straight"])
def test_the_noise_is_found_without_walls(sigma, pose):
    log = log_of(ranges(pose, sigma=sigma), pose)
    assert range_noise(RING, log) == pytest.approx(sigma, rel=0.2)


def test_the_noise_depends_neither_on_poses_nor_on_the_scale():
    pose = along_a_wall()
    log = log_of(ranges(pose), pose)
    elsewhere = dataclasses.replace(log, pose=pose + np.array([5.0, -3.0, 1.0]))
    assert range_noise(RING, elsewhere) == range_noise(RING, log)
    assert range_noise(RING, dataclasses.replace(log, range=2 * log.range)) == pytest.approx(2 * range_noise(RING, log))


def test_too_few_or_equal_readings_give_no_noise():
    pose = along_a_wall()
    assert np.isnan(range_noise(RING, log_of(ranges(pose[:3]), pose[:3])))
    assert np.isnan(range_noise(RING, log_of(np.full((60, 12), 1.5), pose[:60])))
