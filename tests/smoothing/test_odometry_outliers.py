"""Where the odometry is broken, points of either side are two; walls and those of other times stay what they are."""

import numpy as np
import pytest
from support.maps import wall_and_corner

from jaxsonar.geometry.se2 import compose
from jaxsonar.smoothing.odometry_outliers import RARE, Breaks, broken_steps

SD = np.array([0.008, 0.004, 0.007])
STEPS = 600


def driven(steps):
    """Poses of a path by its steps."""
    out = [np.zeros(3)]
    for step in steps:
        out.append(compose(out[-1], step))
    return np.array(out)


def walk(seed, share=1.0):
    """What odometry told, and what was true: this share of the noise that is expected."""
    told = np.tile([0.15, 0.0, 0.02], (STEPS, 1))
    return told, told + share * SD * np.random.default_rng(seed).standard_normal(told.shape)


@pytest.mark.slow
def test_by_chance_as_many_steps_are_broken_as_is_said():
    linked = np.tile(1 / SD**2, (STEPS, 1))
    found = sum(len(broken_steps(driven(true), told, linked)) for told, true in map(walk, range(40)))
    assert found <= 2 * (40 * RARE + 3 * np.sqrt(40 * RARE))  # a window of two is two steps


@pytest.mark.parametrize("axis", range(3))
def test_a_step_is_broken_that_no_noise_breaks(axis):
    told, true = walk(1, 0.5)
    linked = np.tile(1 / SD**2, (STEPS, 1))
    assert not len(broken_steps(driven(true), told, linked))
    true[400] = told[400] + 7 * SD * np.eye(3)[axis]
    assert 400 in broken_steps(driven(true), told, linked)
    linked[399:402] = 0  # where there is no odometry none can be broken
    assert not len(broken_steps(driven(true), told, linked))


def test_two_steps_together_are_broken_that_are_not_each_by_itself():
    told, true = walk(1, 0.5)
    linked = np.tile(1 / SD**2, (STEPS, 1))
    true[300:302] = told[300:302] + 3.4 * SD * [1, 0, 0]
    assert broken_steps(driven(true), told, linked).tolist() == [300, 301]
    true[301] = told[301]
    assert not len(broken_steps(driven(true), told, linked))


def test_a_path_of_one_scan_has_no_step():
    assert not len(broken_steps(np.zeros((1, 3)), np.zeros((0, 3)), np.zeros((0, 3))))


ROWS = {10 * row: row for row in range(200)}  # the numbers of scans are not their rows


@pytest.fixture
def world():
    """A wall and a corner, seen on both sides of the break and long after."""
    return wall_and_corner(tuple(10 * row for row in (3, 4, 6, 7, 150)))


def test_without_a_break_nothing_changes(world):
    whole = Breaks(np.zeros(0, dtype=np.int64), ROWS)
    same = whole.parted(world)
    assert (same.scans, same.point_scans) == (world.scans, world.point_scans)
    assert whole.heard_by(same, 200).all()


def test_a_point_of_both_sides_is_two_and_a_wall_is_one(world):
    breaks = Breaks(np.array([4]), ROWS)  # from row 4 to row 5
    parted = breaks.parted(world)
    assert parted.scans == world.scans
    assert parted.point_scans == ((30, 40), (60, 70, 1500))  # what is seen much later says nothing of the break
    np.testing.assert_array_equal(parted.points, np.repeat(world.points, 2, axis=0))
    heard = breaks.heard_by(parted, 200)
    assert heard[:, 0].all()
    assert heard[:5, 1].all()
    assert not heard[5:44, 1].any()
    assert heard[60:, 1].all()  # the robot comes by again
    assert not heard[:5, 2].any()
    assert heard[5:, 2].all()
    again = breaks.parted(parted)
    assert again.point_scans == parted.point_scans


def test_a_break_elsewhere_parts_nothing(world):
    breaks = Breaks(np.array([2, 7, 90]), ROWS)
    assert breaks.parted(world).point_scans == world.point_scans
