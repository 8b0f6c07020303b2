"""Mistakes in poses and in the numbering of sensors are named; sound logs get no warning."""

from dataclasses import replace

import numpy as np
import pytest
from support.driven_logs import driven_log, from_one, numbered, with_poses
from support.wandering_robot import RING, log_of, ranges, trajectory

from jaxsonar.hardware.errors import SonarError
from jaxsonar.plausibility.alternatives import best_alternative, find_mistakes
from jaxsonar.plausibility.implausible_poses import implausible_poses
from jaxsonar.plausibility.pose_agreement import agreement
from jaxsonar.scans.flat_echoes import FlatEchoes

SCENES = {8: (2, 8, 1), 12: (1, 12, 0)}
"""Seed, sensors and neighbors of the simulated logs."""
scenes = pytest.mark.parametrize("count", [12, pytest.param(8, marks=pytest.mark.slow)])


def _poses(change):
    return lambda ring, log: with_poses(log, change)


MISTAKES = {
    "millimetres": (_poses(lambda x, y, t: (1e3 * x, 1e3 * y, t)), "pose unit", "x and y of the poses are in millim"),
    "centimetres": (_poses(lambda x, y, t: (100 * x, 100 * y, t)), "pose unit", "x and y of the poses are in centim"),
    "inches": (_poses(lambda x, y, t: (x / 0.0254, y / 0.0254, t)), "pose unit", "x and y of the poses are in inches"),
    "feet": (_poses(lambda x, y, t: (x / 0.3048, y / 0.3048, t)), "pose unit", "x and y of the poses are in feet"),
    "degrees": (_poses(lambda x, y, t: (x, y, np.degrees(t) % 360)), "heading unit", "headings are in degrees"),
    "clockwise": (_poses(lambda x, y, t: (x, y, -t)), "heading direction", "headings are clockwise"),
    "compass": (_poses(lambda x, y, t: (x, y, np.pi / 2 - t)), "heading direction", "compass headings"),
    "clockwise degrees": (
        _poses(lambda x, y, t: (x, y, -np.degrees(t))),
        "heading unit",
        "headings are in degrees and clockwise",
    ),
    "compass degrees": (
        _poses(lambda x, y, t: (x, y, (90 - np.degrees(t)) % 360)),
        "heading unit",
        "headings are compass headings in degrees",
    ),
    "x and y swapped": (_poses(lambda x, y, t: (y, x, t)), "axes", "x and y of the poses are swapped"),
    "y negated": (_poses(lambda x, y, t: (x, -y, t)), "axes", "y of the poses is negated"),
    "x negated": (_poses(lambda x, y, t: (-x, y, t)), "axes", "x of the poses is negated"),
    "sensors clockwise": (lambda ring, log: numbered(ring, log, -1, 0), "sensor order", "sensors are numbered clockw"),
    "sensors from one": (lambda ring, log: from_one(log), "first sensor", "sensors are numbered from 1"),
    "turned ring": (lambda ring, log: numbered(ring, log, 1, -3), "first sensor", "the ring is rotated by 3 sensors"),
}


def found(ring, log):
    """Kinds and texts of the warnings; each text has three parts."""
    came = list(implausible_poses(ring, log))
    assert all(str(one).count("; ") == 2 and str(one).isprintable() for one in came)
    return [one.kind for one in came], " ".join(map(str, came))


@scenes
@pytest.mark.parametrize("name", MISTAKES)
def test_each_mistake_is_named(name, count):
    ring, log = driven_log(*SCENES[count])
    mistake, kind, words = MISTAKES[name]
    kinds, text = found(ring, mistake(ring, log))
    assert kinds == [kind]
    assert words in text


@scenes
def test_two_mistakes_at_once_are_named(count):
    ring, log = driven_log(*SCENES[count])
    units = with_poses(log, lambda x, y, theta: (1e3 * x, 1e3 * y, np.degrees(theta)))
    assert found(ring, units)[0] == ["pose unit", "heading unit"]
    both = with_poses(numbered(ring, log, -1, 0), lambda x, y, theta: (1e3 * x, 1e3 * y, theta))
    assert found(ring, both)[0] == ["pose unit", "sensor order"]


@pytest.mark.parametrize("count", SCENES)
def test_sound_logs_have_no_warning(count):
    ring, log = driven_log(*SCENES[count])
    assert found(ring, log) == ([], "")
    assert found(ring, replace(log, pose=np.full_like(log.pose, np.nan))) == ([], "")
    assert found(ring, log[:12]) == ([], "")


@pytest.mark.parametrize(
    "poses",
    [
        np.zeros((60, 3)),
        np.linspace([0, 0, 0], [0, 0, 9], 60),
        np.linspace([-1, 0.3, 0.2], [1, 0.3, 0.2], 60),
        trajectory(300),
    ],
    ids=["at rest", "turning", "straight", "driving"],
)
def test_a_robot_that_moves_little_gets_no_warning(poses):
    assert found(RING, log_of(ranges(poses), poses)) == ([], "")


def test_mistakes_that_look_alike_are_both_named():
    """While the robot only turns, headings and the order of the sensors cannot be told apart."""
    poses = np.linspace([0.3, 0.2, 0], [0.3, 0.2, 6], 60)
    log = log_of(ranges(poses), poses)
    kinds, text = found(RING, with_poses(log, lambda x, y, theta: (x, y, -theta)))
    assert kinds == ["heading direction"]
    assert "the headings are clockwise" in text
    assert "or the sensors are numbered clockwise" in text


def test_the_corrected_log_agrees_as_the_true_one():
    ring, log = driven_log(*SCENES[8])
    wrong = with_poses(log, lambda x, y, theta: (x, y, 90 - np.degrees(theta)))
    best = best_alternative(ring, wrong)
    assert best is not None
    assert agreement(ring, best.apply(wrong)).share == pytest.approx(agreement(ring, log).share, abs=0.01)
    assert len(find_mistakes(ring, wrong)) == 1


def test_the_odometry_of_a_log_is_corrected_with_its_poses():
    poses = trajectory(200)
    log = log_of(ranges(poses), poses)
    stamped = np.column_stack([log.stamp, np.degrees(poses)])[:, [0, 1, 2, 3]]
    stamped[:, 1:3] = poses[:, :2]
    wrong = replace(log, pose=stamped[:, 1:], odometry=stamped)
    best = best_alternative(RING, wrong)
    assert best is not None
    samples = best.apply(wrong).odometry
    assert samples is not None
    np.testing.assert_allclose(samples[:, 1:], poses, atol=1e-9)


def test_echoes_that_belong_to_other_poses_are_a_small_share():
    poses = trajectory(400)
    log = log_of(ranges(poses), poses)
    shuffled = replace(log, range=np.random.default_rng(0).permutation(log.range))
    kinds, text = found(RING, shuffled)
    assert kinds == ["explained share"]
    assert "of the echoes agree with the scans around them" in text


def test_scans_without_anything_in_common():
    """Positions in millimetres of scans of which none hears a wall twice."""
    poses = np.column_stack([1e5 * np.arange(20), np.zeros(20), np.zeros(20)])
    kinds, text = found(RING, log_of(ranges(trajectory(20)), poses))
    assert kinds == ["pose unit"]
    assert "the robot moves by 1e+05 m from scan to scan" in text


def test_sensors_counted_from_one_are_an_error_that_says_so():
    poses = trajectory(60)
    log = from_one(log_of(ranges(poses), poses))
    with pytest.raises(SonarError, match=r"allowed are 0 to 11, .*; the log seems to count from 1"):
        FlatEchoes.from_log(RING, log)
