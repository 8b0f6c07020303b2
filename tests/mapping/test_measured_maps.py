"""Maps of logs in which not every path was measured in every scan, or not at the pose of the scan."""

from dataclasses import replace

import numpy as np
import pytest
from support.firings import explicit, fire_in_turn, repeat_readings
from support.hard_cones import simulate
from support.maps import assert_same_map
from support.rooms import loop, some_poses

from jaxsonar import Log, Ring, local_models, random_room
from jaxsonar.detection.local_model import LocalModel
from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.segments import point_to_segments
from jaxsonar.mapping.build_map import build_map
from jaxsonar.mapping.map_evidence import gather_evidence
from jaxsonar.scans.single_firings import group_firings

SIGMA = 0.003
DIRECT, CROSS = Ring.circular(neighbors=0), Ring.circular(neighbors=3)
SONARS = Ring.circular(count=16, radius=0.22, beam=np.radians(30.0), neighbors=0, max_range=4.0)
ROOM = Room(loop([(-2.9, -1.4), (2.7, -1.4), (2.7, 1.6), (-2.9, 1.6)]), (), np.zeros((0, 2)))


def length(world, walls=None):
    """Length of the walls of a map, metres; of those on the given walls only."""
    lengths = np.linalg.norm(world.segments[:, 1] - world.segments[:, 0], axis=-1)
    if walls is not None:
        gap = point_to_segments(world.segments.reshape(-1, 2), walls).min(axis=1)
        lengths = lengths[gap.reshape(-1, 2).max(axis=1) < 0.05]
    return float(lengths.sum())


def spinning(time, *, turn=0.7):
    """A robot that drives on an arc and turns, by default at 40 deg/s."""
    return np.stack([-1.613 + 0.2 * time, 0.017 + 0.2 * np.sin(0.3 * time), 0.123 + turn * time], axis=-1)


def trajectory_through(rng, room, scans):
    """Poses on a line between two far free positions of a room, the robot turning slowly."""
    ends = max((some_poses(rng, room, 2) for _ in range(20)), key=lambda two: np.hypot(*(two[1] - two[0])[:2]))
    poses = ends[0] + np.linspace(0, 1, scans)[:, None] * (ends[1] - ends[0])
    poses[:, 2] = 0.4 * np.sin(np.linspace(0, 6, scans))
    return poses


def direct_only(ring, room, poses, seed):
    """A log as files of direct echoes give it: what was measured follows from the echoes."""
    log = simulate(ring, room, poses, sigma=SIGMA, seed=seed).as_log(ring, poses)
    return Log.from_echoes(log.echo_scan, log.tx, log.rx, log.range, stamp=log.stamp, pose=log.pose)


def assert_neighbors_without_measurement_cost_nothing(log, method):
    wanted, came = (build_map(ring, log, method=method) for ring in (DIRECT, CROSS))
    assert length(wanted) > 3
    assert length(came) >= 0.95 * length(wanted)


@pytest.mark.parametrize("method", [pytest.param("ml", marks=pytest.mark.slow), "hough"])
def test_direct_echoes_of_the_office_give_the_walls_of_a_ring_without_neighbors(office, method):
    log = direct_only(DIRECT, office.room, office.poses, seed=1)
    assert_neighbors_without_measurement_cost_nothing(log, method)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ml", "hough"])
@pytest.mark.parametrize("seed", range(3))
def test_direct_echoes_of_rooms_give_the_walls_of_a_ring_without_neighbors(seed, method):
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    log = direct_only(DIRECT, room, trajectory_through(rng, room, 20), seed)
    assert_neighbors_without_measurement_cost_nothing(log, method)


@pytest.mark.slow
def test_written_silence_gives_the_map_of_paths_that_every_scan_measures(office):
    sim = simulate(CROSS, office.room, office.poses, sigma=SIGMA, seed=2, stamps=office.stamps)
    log = sim.as_log(CROSS, office.poses)
    written = explicit(CROSS, log, np.ones((len(log), len(CROSS.paths)), bool))
    assert_same_map(build_map(CROSS, written), build_map(CROSS, log), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("window", [None, 1.0])
def test_one_firing_per_scan_gives_the_map_of_full_scans(window):
    """16 sensors fire one after another while the robot drives and turns."""
    together, alone = fire_in_turn(SONARS, ROOM, spinning, 40, sigma=SIGMA)
    wanted, came = (build_map(SONARS, log, window=window) for log in (together, alone))
    assert len(wanted) >= 2
    np.testing.assert_allclose(came.segments, wanted.segments, atol=1e-6)
    assert came.echoes.tolist() == wanted.echoes.tolist()


@pytest.mark.slow
@pytest.mark.parametrize("window", [None, 1.0])
def test_a_turning_robot_whose_sensors_fire_in_turn_maps_what_it_maps_at_rest(window):
    """The robot turns by 16 deg during a scan; every reading counts at its own pose."""
    turning, _ = fire_in_turn(SONARS, ROOM, spinning, 40, sigma=SIGMA)
    resting, _ = fire_in_turn(SONARS, ROOM, lambda time: spinning(0.4 * np.floor(time / 0.4 + 1e-6)), 40, sigma=SIGMA)
    wanted, came = (build_map(SONARS, log, window=window) for log in (resting, turning))
    assert length(came, ROOM.walls) >= 0.95 * length(wanted, ROOM.walls) > 5
    assert length(came, ROOM.walls) > 0.85 * length(came)  # the rest are lines of corners


@pytest.mark.slow
@pytest.mark.parametrize("window", [None, 1.0])
def test_repeated_readings_give_the_same_map(window):
    stamp = 0.4 * np.arange(30)
    poses = spinning(stamp, turn=0.1)
    log = simulate(CROSS, ROOM, poses, sigma=SIGMA, stamps=stamp).as_log(CROSS, poses)
    log = explicit(CROSS, log, np.ones((len(log), len(CROSS.paths)), bool))
    repeated = repeat_readings(log, age=0.25, poses=spinning(stamp + 0.25, turn=0.1))
    wanted, came = (build_map(CROSS, part, window=window) for part in (log, repeated))
    assert len(wanted) >= 2
    assert length(came) == pytest.approx(length(wanted), rel=0.02 if window else 1e-6)


def models_of(log):
    """Local models without lines."""
    return [LocalModel(int(scan), float(stamp), ()) for scan, stamp in zip(log.scan, log.stamp, strict=True)]


@pytest.mark.parametrize("still", [False, True])
def test_free_space_does_not_depend_on_the_split_into_scans(still):
    trajectory = (lambda time: spinning(0.6 * np.floor(time / 0.6 + 1e-6))) if still else spinning
    together, alone = fire_in_turn(Ring.circular(neighbors=1), ROOM, trajectory, 5, sigma=SIGMA)
    ring = Ring.circular(neighbors=1)
    logs = together, group_firings(alone)
    one, other = (gather_evidence(ring, log, models_of(log)).free_space.tiles for log in logs)
    assert one.keys() == other.keys()
    for key, times in one.items():
        np.testing.assert_array_equal(times, other[key])


def test_repeated_readings_add_no_free_space():
    stamp = 0.4 * np.arange(6)
    poses = spinning(stamp)
    log = simulate(SONARS, ROOM, poses, sigma=SIGMA, stamps=stamp).as_log(SONARS, poses)
    log = explicit(SONARS, log, np.ones((len(log), len(SONARS.paths)), bool))
    repeated = repeat_readings(log, age=0.25, poses=spinning(stamp + 0.25))
    one, other = (gather_evidence(SONARS, part, models_of(part)).free_space.tiles for part in (log, repeated))
    assert one.keys() == other.keys()
    for key, times in one.items():
        np.testing.assert_array_equal(times, other[key])


def test_old_readings_free_space_where_they_were_measured():
    stamp = 0.4 * np.arange(6)
    poses = spinning(stamp)
    log = simulate(SONARS, ROOM, poses[:-1], sigma=SIGMA, stamps=stamp[:-1]).as_log(SONARS, poses[:-1])
    log = explicit(SONARS, log, np.ones((len(log), len(SONARS.paths)), bool))
    late = replace(log, stamp=stamp[1:], pose=poses[1:], age=np.full(len(log.tx), 0.4))
    late = replace(late, odometry=np.column_stack([stamp, poses]))
    one, other = (gather_evidence(SONARS, part, models_of(part)).free_space.tiles for part in (log, late))
    assert one.keys() == other.keys()
    for key, times in one.items():
        np.testing.assert_array_equal(np.isfinite(times), np.isfinite(other[key]))


def test_scans_that_measured_nothing_free_nothing():
    nothing = np.zeros(0, int)
    log = Log.from_echoes(nothing, nothing, nothing, np.zeros(0), stamp=np.arange(4.0), pose=np.zeros((4, 3)))
    assert not gather_evidence(SONARS, log, models_of(log)).free_space.tiles
    assert len(list(local_models(SONARS, log))) == 4
