"""Reflectors beside walls: columns, poles, mirror images, and what is no longer there."""

import numpy as np
import pytest

from jaxsonar import Ring, Room, simulate
from jaxsonar.detection.local_model import KIND_NAMES
from jaxsonar.reflectors.find_reflectors import find_reflectors
from jaxsonar.reflectors.kind_fit import CIRCLE, EDGE, PLANE
from jaxsonar.reflectors.posed_scans import PosedScans
from jaxsonar.reflectors.range_measurements import RangeMeasurements
from jaxsonar.scans.scan_log import Log

RING = Ring.circular()
WALLS = np.array([[[-3.0, -1.6], [3.0, -1.6]]])
"""One long wall on the right of the robot."""
COLUMN = np.array([0.1, 1.1])
NONE = np.zeros((0, 2))
POSES = np.column_stack([np.linspace(-0.4, 0.4, 5), np.full(5, -0.1), np.full(5, 0.2)])


def measured(room, poses=POSES, *, sigma=0.001, seed=0, first=0):
    log = simulate(RING, room, poses, sigma=sigma, seed=seed, stamps=first + np.arange(len(poses)) / 10).as_log(
        RING, poses
    )
    return log


def found(log, walls=WALLS, points=NONE):
    return find_reflectors(RangeMeasurements.from_log(RING, log), walls, points, sigma=0.003)


@pytest.mark.parametrize("radius", [0.1, 0.2, 0.4])
def test_a_column_is_a_circle_with_an_honest_covariance(radius):
    errors = []
    for seed in range(6):
        log = measured(Room(WALLS, circles=np.array([[0.1, 0.8 + radius, radius]])), seed=seed)
        (one,) = found(log).reflectors
        assert one.kind == CIRCLE
        error = np.append(one.position, one.radius) - [0.1, 0.8 + radius, radius]
        errors.append(error @ np.linalg.solve(one.cov, error) / 3)
    assert 0.2 < np.mean(errors) < 3.0


def test_a_pole_is_an_edge():
    (one,) = found(measured(Room(WALLS, poles=np.array([[0.1, 0.7]])))).reflectors
    assert one.kind == EDGE
    np.testing.assert_allclose(one.position, [0.1, 0.7], atol=0.005)
    assert np.isnan(one.radius)
    assert one.probability.sum() == pytest.approx(1.0)


def test_a_room_without_them_has_none():
    assert found(measured(Room(WALLS))).reflectors == ()


def test_a_short_wall_of_the_map_at_a_column_is_replaced_and_a_true_one_remains():
    short = np.array([[[-0.2, 0.8], [0.4, 0.8]]])
    walls = np.concatenate([WALLS, short])
    column = found(measured(Room(WALLS, circles=np.array([[0.1, 1.0, 0.2]]))), walls)
    assert column.replaced_walls.tolist() == [False, True]
    wall = found(measured(Room(walls)), walls)
    assert not wall.replaced_walls.any()
    assert all(one.is_wall for one in wall.reflectors)


def test_a_wall_that_the_map_lacks_is_a_plane_with_its_line():
    short = np.array([[[-0.3, 0.8], [0.5, 0.8]]])
    reflectors = found(measured(Room(np.concatenate([WALLS, short])))).reflectors
    (one,) = (other for other in reflectors if other.kind == PLANE)
    assert not one.is_wall
    assert one.probability[PLANE] > 0.98
    error = one.line - np.array([0.8, np.pi / 2])
    assert np.abs(error).max() < 0.01
    assert error @ np.linalg.solve(one.line_cov, error) < 14.0  # 0.1 % of the errors of two parameters are larger
    np.testing.assert_allclose(one.segment[:, 1], 0.8, atol=0.01)
    assert ((one.segment[:, 0] > -0.4) & (one.segment[:, 0] < 0.6)).all()


def test_points_of_the_map_on_a_column_are_replaced_and_others_remain():
    points = np.array([[0.1, 0.82], [-3.0, -1.6], [1.5, 1.5]])
    result = found(measured(Room(WALLS, circles=np.array([[0.1, 1.0, 0.2]]))), points=points)
    assert result.replaced_points.tolist() == [True, False, False]


def test_what_later_scans_do_not_hear_is_gone():
    there, empty = Room(WALLS, circles=np.array([[0.1, 1.0, 0.2]])), Room(WALLS)
    before, after = measured(there), measured(empty, first=10)
    scans = [*before, *after]
    numbered = [type(scan)(**{**vars(scan), "scan": k}) for k, scan in enumerate(scans)]
    assert [one for one in found(Log.from_scans(numbered)).reflectors] == []
    assert len(found(Log.from_scans(numbered[5:] + numbered[:5])).reflectors) in (0, 1)


def test_a_mirror_image_behind_a_wall_is_no_wall():
    """In a corridor as narrow as this, both walls in turn give the echoes of a third wall."""
    corridor = np.array([[[-4.0, -0.7], [4.0, -0.7]], [[-4.0, 0.7], [4.0, 0.7]]])
    poses = np.column_stack([np.linspace(-1.0, 1.0, 9), np.zeros(9), np.full(9, 0.1)])
    image = np.array([[[-1.2, 1.68], [1.2, 1.68]]])
    result = found(measured(Room(corridor), poses), np.concatenate([corridor, image]))
    assert not result.replaced_walls[:2].any()


def test_the_order_of_scans_does_not_matter_and_places_keep_their_latest_scans():
    log = measured(Room(WALLS, circles=np.array([[0.1, 1.0, 0.2]])))
    scans = list(log)
    whole = PosedScans.of(RING, scans)
    parts = PosedScans.of(RING, scans[3:]).union(PosedScans.of(RING, scans[:3]))
    one, two = whole.measurements(), parts.measurements()
    assert one is not None
    assert two is not None
    np.testing.assert_array_equal(one.distance, two.distance)
    again = whole.union(whole)
    assert sum(len(of_place) for of_place in again.places.values()) <= 3 * len(whole.places)


def test_kinds_have_names():
    assert [KIND_NAMES[k] for k in (EDGE, CIRCLE)] == ["edge", "circle"]
