"""Echoes of the robot are found and left out, and no wall is taken for one."""

from dataclasses import replace

import numpy as np
import pytest
from support.hard_cones import simulate
from support.health_logs import log_of as random_places
from support.robot_echoes import drive, same_measurements, with_robot_echoes
from support.wandering_robot import RING, along_a_wall, log_of, ranges, trajectory

from jaxsonar import Ring, Room, build_map
from jaxsonar.geometry.se2 import compose
from jaxsonar.plausibility.prepared_log import PreparedLog
from jaxsonar.plausibility.robot_echoes import find_robot_echoes, without_robot_echoes
from jaxsonar.scans.measured_paths import measured_paths
from jaxsonar.scans.readings import explicit_log
from jaxsonar.simulation.wheel_odometry import simulate_odometry

POSE = trajectory()
SOUND = log_of(ranges(POSE), POSE)
RECTANGLE = np.array([[-2.0, -1.5], [2.0, -1.5], [2.0, 1.5], [-2.0, 1.5]])
DENSE = Ring.circular(count=16, radius=0.2, beam=np.radians(50.0), neighbors=1, max_range=4.0)


def rectangle(width, height):
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array([width, height]) / 2
    return Room(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))


def simulated(ring, room, pose, **errors):
    return simulate(ring, room, pose, **{"sigma": 0.003, "seed": 4} | errors).as_log(ring, pose)


@pytest.mark.parametrize("single_echo", [False, True])
@pytest.mark.parametrize(("reported", "sigma", "present"), [(0.31, 0.003, 1.0), (0.15, 0.0, 1.0), (0.5, 0.01, 0.8)])
def test_the_echo_of_one_sensor_is_found_and_left_out(reported, sigma, present, single_echo):
    log, added = with_robot_echoes(SOUND, [(8, 8)], [reported], sigma=sigma, present=present, single_echo=single_echo)
    found = find_robot_echoes(RING, log)
    assert found.sensors == (8,)
    assert not found.is_floor
    assert [(one.tx, one.rx) for one in found.echoes] == [(8, 8)]
    assert found.echoes[0].range == pytest.approx(reported, abs=0.003)
    assert (found.mask(log) != added).sum() <= 3
    # Without it, the log is as before, except that scans with nothing but it did not measure the path.
    left = without_robot_echoes(log, found)
    clean = explicit_log(log)
    robot = found.mask(clean)
    expected = np.setdiff1d(clean.echo_scan[robot], clean.echo_scan[~robot & (clean.tx == 8)])
    np.testing.assert_array_equal(np.flatnonzero(~measured_paths(RING, left)[:, 8]), expected)
    others = np.flatnonzero(left.tx != 8)
    assert np.isfinite(left.range[others]).sum() == (SOUND.tx != 8).sum()
    assert not find_robot_echoes(RING, left)


def test_a_sound_log_is_not_changed():
    assert without_robot_echoes(SOUND, find_robot_echoes(RING, SOUND)) is SOUND


def test_the_floor_is_found_on_all_sensors():
    pairs = [(k, k) for k in range(RING.count)]
    log, added = with_robot_echoes(SOUND, pairs, np.linspace(0.5, 0.52, RING.count), sigma=0.008)
    prepared = PreparedLog.of(RING, log)
    found = find_robot_echoes(RING, log)
    assert found.is_floor
    assert found.sensors == tuple(range(RING.count))
    assert (found.mask(log) != added).mean() < 5e-3
    (warning,) = [one for one in prepared.warnings if one.kind == "robot echo"]
    assert "12 sensors read a constant range of 0.5" in str(warning)
    assert "floor" in warning.cause
    assert same_measurements(prepared.log, without_robot_echoes(log, found))


def test_the_warning_names_sensor_range_cause_and_remedy():
    log, _ = with_robot_echoes(SOUND, [(8, 8)], [0.31])
    (warning,) = PreparedLog.of(RING, log).warnings
    assert warning.kind == "robot echo"
    assert "sensor 8 reads 0.309 +- 0.003 m in 100% of its measurements" in warning.what
    assert "robot's own body" in warning.cause
    assert "left out" in warning.remedy


def test_a_body_in_front_of_one_sensor_is_found_on_all_its_paths():
    pose = drive([[-1.5, -1.0], [1.4, 0.9], [1.2, -0.8], [-1.3, 0.8], [0.2, -1.0], [0.9, 1.0]])
    log = simulated(DENSE, rectangle(4.6, 3.4), pose, dropout=0.1, clutter=0.1)
    pairs = [(5, 5), (4, 5), (5, 4), (5, 6), (6, 5)]
    added, _ = with_robot_echoes(log, pairs, [0.2, 0.23, 0.23, 0.24, 0.24])
    found = find_robot_echoes(DENSE, added)
    assert sorted((one.tx, one.rx) for one in found.echoes) == sorted(pairs)
    assert found.sensors == (5,)
    # Only the sensor is named.
    assert "path" not in str(found.warning())


def test_a_cross_echo_without_its_reverse_is_crosstalk():
    """Sound takes the same way back: a body that one path hears, its reverse path hears, too."""
    pose = drive([[-1.5, -1.0], [1.4, 0.9], [1.2, -0.8], [-1.3, 0.8], [0.2, -1.0], [0.9, 1.0]])
    log = simulated(DENSE, rectangle(4.6, 3.4), pose)
    one_way, _ = with_robot_echoes(log, [(4, 5)], [0.23])
    assert not find_robot_echoes(DENSE, one_way)
    both_ways, _ = with_robot_echoes(one_way, [(5, 4)], [0.23])
    assert find_robot_echoes(DENSE, both_ways).paths == {(4, 5), (5, 4)}


def test_the_result_does_not_depend_on_the_world_frame():
    log, _ = with_robot_echoes(SOUND, [(3, 3)], [0.4])
    moved = replace(log, pose=compose(np.array([5.0, -2.0, 2.5]), log.pose))
    assert find_robot_echoes(RING, moved).echoes == find_robot_echoes(RING, log).echoes


PATHS = {
    "corridor": (rectangle(12.0, 1.8), drive([[-5.3, 0.0], [5.3, 0.0], [-5.3, 0.0], [5.3, 0.0]])),
    "along the walls": (rectangle(5.0, 4.0), drive([*RECTANGLE, *RECTANGLE, *RECTANGLE, RECTANGLE[0]])),
    "turning in a square": (rectangle(3.0, 3.0), np.column_stack([np.zeros((100, 2)), np.linspace(0, 14, 100)])),
    "at rest": (rectangle(3.0, 4.0), np.tile([0.3, 0.2, 0.5], (60, 1))),
    "one wall": (Room(np.array([[[-8.0, 1.0], [8.0, 1.0]]])), drive([[-6.0, 0.0], [6.0, 0.0], [-6.0, 0.0]])),
}


@pytest.mark.parametrize("posed", [True, False])
@pytest.mark.parametrize("name", PATHS)
@pytest.mark.parametrize("ring", [DENSE, Ring.circular(count=4, radius=0.2, beam=np.radians(60.0), neighbors=0)])
def test_walls_at_a_constant_distance_are_no_echoes_of_the_robot(ring, name, posed):
    room, pose = PATHS[name]
    log = simulated(ring, room, pose)
    log = log if posed else replace(log, pose=np.full_like(log.pose, np.nan))
    quantized = replace(log, range=np.round(log.range / 0.05) * 0.05)
    drifted = replace(log, pose=simulate_odometry(pose, distance=0.02, turn=0.03, seed=1)) if posed else log
    for one in (log, quantized, drifted):
        assert not find_robot_echoes(ring, one)


@pytest.mark.parametrize("resolution", [1e-5, 1e-3, 0.01, 0.05])
@pytest.mark.parametrize("poses", [trajectory, along_a_wall])
def test_sound_logs_have_none(poses, resolution):
    pose = poses()
    for sigma in (0.0, 0.003, 0.02):
        assert not find_robot_echoes(RING, log_of(ranges(pose, sigma=sigma, resolution=resolution), pose))


def test_without_poses_other_sensors_that_look_there_contradict_a_wall():
    ring = Ring.circular()
    for seed in range(3):
        log = random_places(seed, ring)
        assert not find_robot_echoes(ring, log)
        added, mask = with_robot_echoes(log, [(7, 7)], [0.25], seed=seed)
        found = find_robot_echoes(ring, added)
        assert found.sensors == (7,)
        assert (found.mask(added) != mask).sum() <= 2


def test_without_poses_the_floor_around_the_robot_is_found():
    ring = Ring.circular(neighbors=0)
    log = random_places(1, ring)
    added, _ = with_robot_echoes(log, [(k, k) for k in range(24)], np.full(24, 0.4))
    found = find_robot_echoes(ring, added)
    assert found.is_floor
    assert len(found.sensors) == 24


def test_a_robot_at_rest_proves_nothing_without_poses():
    ring = Ring.circular(neighbors=0)
    room, pose = PATHS["at rest"]
    log = replace(simulated(ring, room, pose), pose=np.full_like(pose, np.nan))
    added, _ = with_robot_echoes(log, [(7, 7)], [0.25])
    assert not find_robot_echoes(ring, added)


@pytest.mark.slow
@pytest.mark.parametrize("window", [None, 1.5])
def test_the_map_is_as_without_the_echoes(window):
    pose = drive([[-1.5, -1.0], [1.4, 0.9], [1.2, -0.8], [-1.3, 0.8], [0.2, -1.0], [0.9, 1.0]], step=0.15)
    log = simulated(DENSE, rectangle(4.6, 3.4), pose)
    added, _ = with_robot_echoes(log, [(5, 5), *((k, k) for k in range(8, 12))], [0.3, 0.5, 0.5, 0.5, 0.5])
    prepared = PreparedLog.of(DENSE, added)
    assert prepared.warnings
    clean, cured = build_map(DENSE, log, window=window), build_map(DENSE, prepared.log, window=window)
    assert len(cured.segments) == len(clean.segments)
    np.testing.assert_allclose(np.sort(cured.rho), np.sort(clean.rho), atol=0.01)
