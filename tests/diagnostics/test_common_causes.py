"""Causes that all sensors have in common are named and corrected: numbering, poses, time, speed of sound, noise."""

import dataclasses

import numpy as np
import pytest
from support.wandering_robot import RING, log_of, ranges, trajectory

from jaxsonar.diagnostics.common_causes import find_common_causes
from jaxsonar.geometry.se2 import rotate, subtract_poses
from jaxsonar.simulation.wheel_odometry import simulate_odometry

POSE = trajectory(180)


@pytest.fixture(scope="module")
def sound():
    """A log without any mistake."""
    return log_of(ranges(POSE), POSE)


def with_poses(log, pose):
    return dataclasses.replace(log, pose=pose)


def with_geometry(position, heading):
    return dataclasses.replace(RING, position=position, heading=heading)


def causes(found):
    return [finding.cause for finding in found.findings]


def assert_one_cause(ring, log, cause, *words, sigma=None):
    """The cause alone is found, with these words."""
    found = find_common_causes(ring, log, sigma=sigma)
    assert causes(found) == [cause]
    finding = found.findings[0]
    assert not finding.sensors
    assert 0.9 < finding.confidence <= 1
    for word in words:
        assert word in finding.sentence, finding.sentence
    assert finding.evidence
    assert finding.remedy
    return found


def test_a_sound_log_has_no_common_cause(sound):
    found = find_common_causes(RING, sound, sigma=0.003)
    assert found.findings == ()
    assert found.ring is RING
    assert found.log is sound
    assert found.sigma == 0.003


def test_without_poses_or_motion_nothing_is_stated(sound):
    assert not find_common_causes(RING, with_poses(sound, np.full_like(POSE, np.nan))).findings
    rest = np.repeat(POSE[:1], 60, axis=0)
    assert not find_common_causes(RING, log_of(ranges(rest), rest)).findings


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (np.degrees, "in degrees"),
        (lambda theta: np.pi / 2 - theta, "compass"),
    ],
)
def test_wrong_headings(sound, change, words):
    pose = np.column_stack([POSE[:, :2], change(POSE[:, 2])])
    found = assert_one_cause(RING, with_poses(sound, pose), "headings", words)
    np.testing.assert_allclose(found.log.pose, POSE, atol=1e-9)


def test_wrong_unit_of_the_positions(sound):
    found = assert_one_cause(RING, with_poses(sound, POSE * [1000, 1000, 1]), "pose unit", "millimetres")
    np.testing.assert_allclose(found.log.pose, POSE, atol=1e-9)


def test_wrong_axes(sound):
    assert_one_cause(RING, with_poses(sound, POSE[:, [1, 0, 2]]), "axes", "swapped")


def test_a_mirrored_ring_keeps_the_numbers_of_its_sensors(sound):
    stated = with_geometry(RING.position * [1, -1], -RING.heading)
    found = assert_one_cause(stated, sound, "mirrored ring", "the ring is mirrored")
    np.testing.assert_allclose(found.ring.position, RING.position, atol=1e-9)
    assert (found.log.tx == sound.tx).all()


@pytest.mark.parametrize("sensors", [1, pytest.param(-5, marks=pytest.mark.slow)])
def test_a_rotated_ring_is_named_with_its_angle(sound, sensors):
    turn = np.radians(30.0 * sensors)
    stated = with_geometry(rotate(np.asarray(RING.position), np.array(-turn)), RING.heading - turn)
    found = assert_one_cause(stated, sound, "rotated ring", f"{abs(30 * sensors)} deg", f"by {abs(sensors)} sensor")
    np.testing.assert_allclose(found.ring.position, RING.position, atol=1e-9)


@pytest.mark.parametrize("scans", [3, pytest.param(-4, marks=pytest.mark.slow)])
def test_late_and_early_poses(scans):
    pose = POSE[:-scans] if scans > 0 else POSE[-scans:]
    true = POSE[scans:] if scans > 0 else POSE[:scans]
    side = "late" if scans > 0 else "early"
    found = assert_one_cause(RING, log_of(ranges(true), pose), "time offset", side)
    inside = slice(10, -10)
    error = subtract_poses(found.log.pose[inside], true[inside])
    assert np.abs(error).max() < 0.05


@pytest.mark.parametrize(
    ("factor", "cause", "words"),
    [
        (1.036, "speed of sound", "too long"),
        (1.12, "range scale", "no such speed"),
    ],
)
def test_all_ranges_too_long_or_too_short(sound, factor, cause, words):
    found = assert_one_cause(RING, dataclasses.replace(sound, range=sound.range * factor), cause, words)
    np.testing.assert_allclose(found.log.range / sound.range, 1, atol=0.006)


@pytest.mark.parametrize("stated", [0.0005, 0.02])
def test_a_wrong_stated_noise_is_replaced(sound, stated):
    found = assert_one_cause(RING, sound, "noise", f"{1e3 * stated:.1f} mm were stated", sigma=stated)
    assert found.sigma == pytest.approx(0.003, rel=0.2)


@pytest.mark.slow
def test_two_mistakes_are_found_one_after_the_other(sound):
    pose = np.column_stack([POSE[:, :2], np.degrees(POSE[:, 2])])
    stated = with_geometry(RING.position * [1, -1], -RING.heading)
    found = find_common_causes(stated, with_poses(sound, pose))
    assert len(found.findings) == 2
    assert {"headings", "mirrored ring"} == set(causes(found))
    assert not find_common_causes(found.ring, found.log).findings


def test_echoes_of_other_poses_are_named_without_a_cause(sound):
    shuffled = dataclasses.replace(sound, range=np.random.default_rng(0).permutation(sound.range))
    found = find_common_causes(RING, shuffled)
    assert causes(found) == ["explained share"]
    assert "of the echoes agree with the scans around them" in found.findings[0].sentence
    assert found.log is shuffled


def test_a_restart_of_the_odometry_is_named(sound):
    pose = POSE.copy()
    pose[90:] -= pose[90]
    found = find_common_causes(RING, with_poses(sound, pose))
    assert causes(found) == ["odometry jump"]
    assert "scan 90" in found.findings[0].sentence


@pytest.mark.parametrize("seed", range(3))
def test_in_a_corridor_drifting_odometry_does_not_tell_the_scale(seed):
    """Only the odometry swings: the walls beside the robot stay where they are."""
    true = np.column_stack([0.1 * np.arange(120), np.full(120, 0.1), np.zeros(120)])
    reported = np.full((len(true), RING.count), np.nan)
    reported[:, 3], reported[:, 9] = 0.7, 0.9  # the sensors to the left and to the right
    reported += 0.003 * np.random.default_rng(seed).standard_normal(reported.shape)
    odometry = simulate_odometry(true, distance=0.02, turn=0.02, seed=seed)
    assert not find_common_causes(RING, log_of(reported, odometry)).findings


def test_scans_that_are_reported_again_are_named():
    reported = ranges(POSE)
    assert_one_cause(RING, log_of(reported[np.arange(len(POSE)) // 3 * 3], POSE), "held readings", "copies")
