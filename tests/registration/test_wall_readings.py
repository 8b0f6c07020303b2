"""Fresh readings of a run, and the wall that each path should hear: compared with a loop over readings and walls."""

from dataclasses import replace

import numpy as np
import pytest

from jaxsonar import Log, Ring
from jaxsonar.geometry.se2 import compose, transform_points, unit, wrap_angle
from jaxsonar.registration.wall_readings import (
    SETTINGS,
    distance_travelled,
    fresh_readings,
    nearest_faces,
    wall_geometry,
)


@pytest.fixture
def ring():
    return Ring.circular(count=6, radius=0.2, beam=np.radians(40), neighbors=1, max_range=3.0)


def nearest_by_loop(ring, path, pose, segments):
    """Wall, distance and angle of one reading, by trying all walls."""
    geometry, best = ring.exact_paths, (-1, np.inf, 0.0)
    place = transform_points(pose, np.asarray(geometry.midpoint)[path : path + 1])[0]
    half = geometry.width[path] / 2
    axis = geometry.start[path] + half + pose[2]
    for number, (start, end) in enumerate(segments):
        along = (end - start) / np.linalg.norm(end - start)
        foot = start + ((place - start) @ along) * along
        beyond = max((start - foot) @ along, (foot - end) @ along)
        towards = foot - place
        angle = float(wrap_angle(np.arctan2(towards[1], towards[0]) - axis))
        distance = float(np.linalg.norm(towards))
        if beyond < SETTINGS.end_margin and abs(angle) < half and distance < best[1]:
            best = number, distance, angle
    return best


def test_the_nearest_face_is_that_of_a_loop(ring, rng):
    segments = rng.uniform(-3, 3, (7, 2, 2))
    path, pose = rng.integers(0, len(ring.paths), 200), rng.uniform(-3, 3, (200, 3))
    faces = nearest_faces(ring, path, pose, segments)
    expected = [nearest_by_loop(ring, one, place, segments) for one, place in zip(path, pose, strict=True)]
    np.testing.assert_array_equal(faces.wall, [one[0] for one in expected])
    assert 10 < (faces.wall >= 0).sum() < 200
    np.testing.assert_allclose(faces.distance, [one[1] for one in expected], atol=1e-9)
    seen = faces.wall >= 0
    np.testing.assert_allclose(faces.off_axis[seen], np.array([one[2] for one in expected])[seen], atol=1e-9)


def test_faces_move_with_the_world(ring, rng):
    segments, motion = rng.uniform(-3, 3, (5, 2, 2)), np.array([4.0, -7.0, 2.0])
    path, pose = rng.integers(0, len(ring.paths), 100), rng.uniform(-2, 2, (100, 3))
    moved = transform_points(motion, segments.reshape(-1, 2)).reshape(-1, 2, 2)
    one, other = nearest_faces(ring, path, pose, segments), nearest_faces(ring, path, compose(motion, pose), moved)
    np.testing.assert_array_equal(one.wall, other.wall)
    np.testing.assert_array_equal(one.side, other.side)
    np.testing.assert_allclose(one.distance, other.distance, atol=1e-9)


def test_the_side_is_that_of_the_normal(ring):
    segments = np.array([[[-1.0, 1.0], [1.0, 1.0]]])
    _, half_length, theta = wall_geometry(segments)
    assert half_length[0] == 1
    below = nearest_faces(ring, np.zeros(1, int), np.array([[0.0, 0.0, np.pi / 2]]), segments)
    above = nearest_faces(ring, np.zeros(1, int), np.array([[0.0, 2.0, -np.pi / 2]]), segments)
    assert below.side[0] == -above.side[0] == np.sign(unit(theta[0])[1])
    np.testing.assert_allclose([below.distance[0], above.distance[0]], 0.8)


def test_without_walls_nothing_is_found(ring):
    faces = nearest_faces(ring, np.arange(3), np.zeros((3, 3)), np.zeros((0, 2, 2)))
    assert (faces.wall == -1).all()
    assert np.isinf(faces.distance).all()


def test_readings_at_rest_and_repeated_ones_are_left_out(ring):
    count = 12
    pose = np.zeros((count, 3))
    pose[:6, 0] = 0.05 * np.arange(6)
    pose[6:, 0] = pose[5, 0]  # at rest from scan 5 on
    ranges = np.array([1.0, 1.0, 1.1, 1.2, 1.3, 1.4, *[1.5 + 0.01 * k for k in range(6)]])
    scan, sensor = np.arange(count), np.zeros(count, int)
    log = Log.from_echoes(scan, sensor, sensor, ranges, stamp=0.1 * scan, pose=pose)
    fresh = fresh_readings(replace(ring, neighbors=0), log)
    np.testing.assert_array_equal(fresh.range, [1.0, 1.1, 1.2, 1.3, 1.4])
    assert len(fresh) == count
    np.testing.assert_allclose(distance_travelled(log.pose), np.minimum(0.05 * np.arange(count), 0.25))


def test_the_distance_travelled_leads_past_scans_without_a_pose():
    pose = np.column_stack([[0.0, 3.0, np.nan, 3.0, np.nan], [0.0, 4.0, 0.0, 6.0, 0.0], np.zeros(5)])
    np.testing.assert_allclose(distance_travelled(pose), [0.0, 5.0, 5.0, 7.0, 7.0])
    assert distance_travelled(np.full((2, 3), np.nan)).tolist() == [0.0, 0.0]
    assert len(distance_travelled(np.zeros((0, 3)))) == 0


def test_every_renewed_reading_of_sensors_that_fire_in_turn_is_kept(ring):
    """Two sensors are renewed alternately by a slow robot, which reaches a new place in every second scan at most."""
    count = 20
    number, pose = np.arange(count), np.zeros((count, 3))
    pose[:, 0] = 0.006 * number
    renewed = number[:, None] - (number[:, None] + [0, 1]) % 2  # scan in which each reading was measured
    age, ranges = 0.1 * (number[:, None] - renewed), np.where([True, False], 1.0, 2.0 - 0.006 * renewed)
    scan, sensor = np.repeat(number, 2), np.tile([0, 3], count)
    kept = renewed.ravel() >= 0
    columns = (column.ravel()[kept] for column in (scan, sensor, sensor, ranges))
    options = {"age": age.ravel()[kept], "asked": np.zeros((0, 2), int)}
    log = Log.from_echoes(*columns, **options, stamp=0.1 * number, pose=pose)
    fresh = fresh_readings(replace(ring, neighbors=0), log)
    new = log.age == 0
    assert new.sum() == count
    np.testing.assert_array_equal(fresh.tx, log.tx[new])
    np.testing.assert_array_equal(fresh.echo_scan, log.echo_scan[new])


def test_every_reading_of_an_explicit_log_is_kept(ring):
    """A log with silent readings lists its measurements: equal ranges are measurements of their own."""
    count = 10
    pose = np.zeros((count, 3))
    pose[:, 0] = 0.05 * np.arange(count)
    scan, sensor = np.repeat(np.arange(count), 2), np.tile([0, 3], count)
    ranges = np.where(sensor == 0, 1.0, np.nan)
    log = Log.from_echoes(scan, sensor, sensor, ranges, stamp=0.1 * np.arange(count), pose=pose)
    assert fresh_readings(replace(ring, neighbors=0), log).echo_count == count
