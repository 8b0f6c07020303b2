"""A wall is shared by the stretches of a path that are known to each other, and by no others."""

from dataclasses import replace

import numpy as np
import pytest
from support.maps import wall_and_corner

from jaxsonar.estimation.landmark_map import landmark_map_of
from jaxsonar.smoothing.covisibility import NEAR, Passages

SCANS = 4  # of each stretch


@pytest.fixture
def world():
    """A wall along x and a corner, seen on the first stretch and on the last."""
    return wall_and_corner((0, 1, 12, 13))


def passages(last: tuple[float, float, float]) -> Passages:
    """Four stretches, the fourth in the place of the first, and known to the others with these standard deviations."""
    covariance = np.tile(np.eye(3) * 1e-6, (4, 4, 1, 1))
    covariance[:3, 3] = covariance[3, :3] = np.diag(np.square(last))
    covariance[np.arange(4), np.arange(4)] = 0
    poses = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    return Passages(np.repeat(np.arange(4), SCANS), poses, covariance)


ROWS = {number: number for number in range(4 * SCANS)}


def test_what_is_known_changes_no_map(world):
    known = passages((0.01, 0.01, 0.001))
    same = known.parted(world, ROWS)
    np.testing.assert_array_equal(same.segments, world.segments)
    assert (same.scans, same.point_scans) == (world.scans, world.point_scans)
    assert known.heard_by(same, ROWS).all()


def test_who_comes_by_again_and_does_not_know_where_has_walls_of_its_own(world):
    lost = passages((0.3, 0.3, 0.03))
    two = lost.parted(world, ROWS)
    assert two.scans == two.point_scans == ((0, 1), (12, 13))
    np.testing.assert_array_equal(two.rho, np.repeat(world.rho, 2))
    np.testing.assert_array_equal(two.points, np.repeat(world.points, 2, axis=0))
    heard = lost.heard_by(two, ROWS)
    np.testing.assert_array_equal(heard[[0, 3]], [[True, False] * 2, [False, True] * 2])
    again = lost.parted(two, ROWS)
    assert (again.scans, again.point_scans) == (two.scans, two.point_scans)


def test_along_a_wall_nothing_need_be_known(world):
    slid = passages((0.3, 0.01, 0.0))
    parted = slid.parted(world, ROWS)
    assert parted.scans == world.scans
    assert len(parted.points) == 2 * len(world.points)


def test_the_farther_off_the_better_a_heading_must_be_known(world):
    """The corner is 1.1 m from where the stretches begin."""
    lever = np.hypot(0.5, 1.0)
    for sd, points in ((0.9 * NEAR / lever, 1), (1.1 * NEAR / lever, 2)):
        assert len(passages((1e-6, 1e-6, sd)).parted(world, ROWS).points) == points


def test_stretches_that_follow_one_another_share_their_walls(world):
    near = replace(world, scans=((0, 1, 4),), point_scans=((0, 1, 4),))
    loose = passages((0.01, 0.01, 0.001))
    covariance = loose.covariance.copy()
    covariance[0, 1] = covariance[1, 0] = np.diag([0.1**2, 0.1**2, 0.0])
    assert replace(loose, covariance=covariance).parted(near, ROWS).scans == near.scans


def test_scans_look_only_for_what_they_may_hear(world):
    two = passages((0.3, 0.3, 0.03)).parted(world, ROWS)
    around = landmark_map_of([two], tie_corners=False)
    poses, here = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.zeros(2, dtype=np.int64)
    both = around.candidates_in_range(poses, here, 2.0)
    assert all(set(row[row >= 0].tolist()) == {0, 1, 2, 3} for row in both)
    heard = np.zeros((2, len(around.world)), dtype=bool)
    heard[0, [0, 2]] = heard[1, [1, 3]] = True
    own = around._replace(visible=heard).candidates_in_range(poses, here, 2.0)
    assert [set(row[row >= 0].tolist()) for row in own] == [{0, 2}, {1, 3}]
