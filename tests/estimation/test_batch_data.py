"""The measurements of batch estimation: silent, repeated and unmeasured paths, and poses within scans."""

from dataclasses import replace

import numpy as np
from support.firings import explicit, fire_in_turn, repeat_readings
from support.hard_cones import simulate
from support.slam_scene import ROOM

from jaxsonar import Ring
from jaxsonar.estimation.batch_data import BatchData
from jaxsonar.estimation.estimation_log import estimation_log
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.geometry.se2 import compose, relative
from jaxsonar.scans.firing_poses import reading_poses

RING = Ring.circular(count=12, neighbors=1)
POSES = np.array([[1.0, 1.6, 0.3], [1.3, 1.7, 0.6], [1.7, 1.7, 0.9]])


def batch(log, ring=RING):
    return BatchData.from_logs(ring, [log], [np.array(log.pose)], OdometryNoise())


def scene_log():
    log = simulate(RING, ROOM, POSES, sigma=0.002, seed=0).as_log(RING, POSES)
    return replace(log, stamp=np.arange(float(len(POSES))))


def drive(time):
    return np.column_stack([1.0 + 0.4 * time, 1.6 + 0.1 * np.sin(time), 0.5 * time])


def echoes_of(data):
    """Row, path and range of all echoes."""
    row, column = np.nonzero(np.isfinite(data.reported))
    return sorted(zip(row.tolist(), data.path[row, column].tolist(), data.reported[row, column].tolist(), strict=True))


def test_silent_and_unmeasured_paths_add_no_echo():
    log = scene_log()
    measured = np.ones((len(log), len(RING.paths)), bool)
    data = batch(log)
    assert data.measured is None
    assert data.path_pose is None
    assert data.motion is None
    assert data.echo_count == log.echo_count
    assert echoes_of(batch(explicit(RING, log, measured))) == echoes_of(data)
    measured[1, ::2] = False
    part = batch(explicit(RING, log, measured))
    assert part.measured is not None
    np.testing.assert_array_equal(part.measured[:3], measured)
    assert part.measured[3:].all()  # padding
    assert echoes_of(part) == [echo for echo in echoes_of(data) if measured[echo[0], echo[1]]]


def test_every_echo_has_the_pose_of_its_time():
    together, _ = fire_in_turn(RING, ROOM, drive, 3, sigma=0.002, seed=0)
    data = batch(together)
    assert data.motion is not None
    row, column = np.nonzero(np.isfinite(data.reported))
    heard = np.isfinite(together.range)
    expected = reading_poses(together)[heard]
    path = RING.path_index[together.tx, together.rx][heard]
    order = np.lexsort((together.range[heard], path, together.echo_scan[heard]))
    mine = np.lexsort((data.reported[row, column], data.path[row, column], row))
    found = compose(data.poses[row], data.motion[row, column])
    np.testing.assert_allclose(found[mine], expected[order], atol=1e-9)
    assert np.abs(data.motion).max() > 0.05


def test_readings_that_were_not_renewed_count_once():
    log = scene_log()
    later = compose(POSES, np.array([0.1, 0.0, 0.2]))
    twice = repeat_readings(log, age=0.5, poses=later)
    data = batch(estimation_log(twice))
    assert data.echo_count == log.echo_count
    assert sorted(echo[1:] for echo in echoes_of(data)) == sorted(echo[1:] for echo in echoes_of(batch(log)))


def test_equal_readings_of_a_log_that_tells_what_was_measured_all_count():
    log = scene_log()
    still = replace(log, tx=np.repeat(log.tx[:1], len(log.tx)), rx=np.repeat(log.tx[:1], len(log.tx)))
    still = replace(still, range=np.ones(len(log.tx)), start=np.array([0, 1, 2, len(log.tx)]))[:3]
    one_each = replace(still, start=np.arange(4), **{name: getattr(still, name)[:3] for name in COLUMNS})
    assert batch(one_each).echo_count == 2  # renewed every second scan, for all that is known
    assert batch(replace(one_each, asked=np.zeros((0, 2), int))).echo_count == 3


COLUMNS = ("tx", "rx", "range", "amplitude", "t", "age")


def path_poses_of(log):
    poses = batch(log).path_pose
    assert poses is not None
    return poses


def test_the_motion_within_scans_stays_when_poses_change():
    together, alone = fire_in_turn(RING, ROOM, drive, 3, sigma=0.002, seed=0)
    prepared = estimation_log(replace(together, odometry=None))
    moved = replace(prepared, pose=compose(np.array([3.0, -1.0, 0.7]), np.array(prepared.pose)) + [[0, 0, 0]] * 3)
    first = path_poses_of(prepared)
    np.testing.assert_allclose(path_poses_of(replace(moved, pose=moved.pose[::-1].copy())), first, atol=1e-9)
    grouped = estimation_log(alone)
    np.testing.assert_allclose(path_poses_of(grouped), path_poses_of(together), atol=1e-9)
    np.testing.assert_allclose(relative(grouped.pose, together.pose), 0, atol=1e-12)
    plain = scene_log()
    assert estimation_log(plain) is plain
