"""Segments of a trajectory share a landmark exactly if their relative poses are known well enough."""

from dataclasses import replace

import numpy as np
import pytest
from support.maps import wall_and_corner

from jaxsonar.estimation.landmark_map import landmark_map_of
from jaxsonar.smoothing.covisibility import Traversals
from jaxsonar.smoothing.settings import SETTINGS

SCANS = 4  # of each segment


@pytest.fixture
def world():
    """A wall along x and a corner, observed from the first and the last segment."""
    return wall_and_corner((0, 1, 12, 13))


def traversals(last: tuple[float, float, float]) -> Traversals:
    """Four segments. The fourth one is where the first is; these are its standard deviations relative to the others."""
    covariance = np.tile(np.eye(3) * 1e-6, (4, 4, 1, 1))
    covariance[:3, 3] = covariance[3, :3] = np.diag(np.square(last))
    covariance[np.arange(4), np.arange(4)] = 0
    poses = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    return Traversals(np.repeat(np.arange(4), SCANS), poses, covariance)


ROWS = {number: number for number in range(4 * SCANS)}


def test_well_known_segments_share_all_landmarks(world):
    known = traversals((0.01, 0.01, 0.001))
    same = known.split_landmarks(world, ROWS)
    np.testing.assert_array_equal(same.segments, world.segments)
    assert (same.scans, same.point_scans) == (world.scans, world.point_scans)
    assert known.visibility_mask(same, ROWS).all()


def test_an_uncertain_return_has_landmarks_of_its_own(world):
    uncertain = traversals((0.3, 0.3, 0.03))
    two = uncertain.split_landmarks(world, ROWS)
    assert two.scans == two.point_scans == ((0, 1), (12, 13))
    np.testing.assert_array_equal(two.rho, np.repeat(world.rho, 2))
    np.testing.assert_array_equal(two.points, np.repeat(world.points, 2, axis=0))
    mask = uncertain.visibility_mask(two, ROWS)
    np.testing.assert_array_equal(mask[[0, 3]], [[True, False] * 2, [False, True] * 2])
    again = uncertain.split_landmarks(two, ROWS)
    assert (again.scans, again.point_scans) == (two.scans, two.point_scans)


def test_the_position_along_a_wall_need_not_be_known(world):
    along_wall = traversals((0.3, 0.01, 0.0))
    split = along_wall.split_landmarks(world, ROWS)
    assert split.scans == world.scans
    assert len(split.points) == 2 * len(world.points)


def test_the_required_heading_accuracy_grows_with_distance(world):
    """The corner is 1.1 m from the origins of the segments."""
    arm = np.hypot(0.5, 1.0)
    for sd, points in ((0.9 * SETTINGS.max_covisible_sd / arm, 1), (1.1 * SETTINGS.max_covisible_sd / arm, 2)):
        assert len(traversals((1e-6, 1e-6, sd)).split_landmarks(world, ROWS).points) == points


def test_consecutive_segments_share_their_landmarks(world):
    near = replace(world, scans=((0, 1, 4),), point_scans=((0, 1, 4),))
    loose = traversals((0.01, 0.01, 0.001))
    covariance = loose.covariance.copy()
    covariance[0, 1] = covariance[1, 0] = np.diag([0.1**2, 0.1**2, 0.0])
    assert replace(loose, covariance=covariance).split_landmarks(near, ROWS).scans == near.scans


def test_candidates_are_limited_to_visible_landmarks(world):
    two = traversals((0.3, 0.3, 0.03)).split_landmarks(world, ROWS)
    landmark_map = landmark_map_of([two], tie_corners=False)
    poses, here = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.zeros(2, dtype=np.int64)
    both = landmark_map.candidates_in_range(poses, here, 2.0)
    assert all(set(row[row >= 0].tolist()) == {0, 1, 2, 3} for row in both)
    mask = np.zeros((2, len(landmark_map.map_index)), dtype=bool)
    mask[0, [0, 2]] = mask[1, [1, 3]] = True
    own = landmark_map._replace(visible=mask).candidates_in_range(poses, here, 2.0)
    assert [set(row[row >= 0].tolist()) for row in own] == [{0, 2}, {1, 3}]
