"""The embedded office has the documented geometry, and its walls are detected with the accuracy of the paper."""

import math

import numpy as np
import pytest
from support import oracles

from jaxsonar import Ring, local_models, simulate
from jaxsonar.evaluation.line_accuracy import line_accuracy
from jaxsonar.evaluation.settings import SETTINGS

SIGMA = 0.003
SEEDS = range(10)
CHAIR = "chair back-rest"
PAPER_RHO, PAPER_THETA = 0.0323, math.radians(7.41)
"""The paper's largest deviations over three walls of one scan."""


@pytest.fixture(scope="module")
def noisy(office):
    """The office simulated with several seeds: (simulation, models) of each."""
    found = []
    for seed in SEEDS:
        heard = simulate(office.ring, office.room, office.poses, sigma=SIGMA, seed=seed, stamps=office.stamps)
        found.append((heard, list(local_models(office.ring, heard.as_log(office.ring, office.poses)))))
    return found


def gap(point, wall):
    """Distance of a point from a segment, by sampling points along it."""
    along = np.linspace(0, 1, 20_001)[:, None]
    return np.linalg.norm(wall[0] + along * (wall[1] - wall[0]) - point, axis=-1).min()


def in_frame(pose, point):
    """A world point in the robot frame."""
    x, y = np.asarray(point) - pose[:2]
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return np.array([cos * x + sin * y, cos * y - sin * x])


def seen_line(pose, wall):
    """(rho, theta) of a wall's line in the robot frame, from the foot of the perpendicular."""
    start, end = (in_frame(pose, point) for point in wall)
    along = (end - start) / np.linalg.norm(end - start)
    foot = start - (start @ along) * along
    return np.hypot(*foot), math.atan2(foot[1], foot[0])


def is_line(line, rho, theta, *, rho_gate=SETTINGS.lines.gate_rho, theta_gate=SETTINGS.lines.gate_theta):
    return abs(line.rho - rho) <= rho_gate and abs(oracles.wrap(line.theta - theta)) <= theta_gate


def chair_of(office):
    return office.room.walls[office.room.wall_names.index(CHAIR)]


def test_the_ring_is_the_ring_of_the_paper(office):
    assert (office.ring.count, office.ring.neighbors, office.ring.max_range) == (24, 3, 2.0)
    np.testing.assert_allclose(office.ring.position, Ring.circular().position, atol=1e-12)
    assert len(office.ring.paths) == 24 + 144


def test_the_trajectory_has_17_poses_and_the_steps_of_the_paper(office):
    assert office.poses.shape == (17, 3)
    steps = np.hypot(*np.diff(office.poses[:, :2], axis=0).T)
    allowed = np.array([0.25, 0.30, 0.50])
    nearest = allowed[np.abs(steps[:, None] - allowed).argmin(axis=1)]
    np.testing.assert_allclose(steps, nearest, atol=1e-3)
    assert set(nearest) == set(allowed)
    assert (np.diff(office.stamps) > 0).all()
    np.testing.assert_array_equal(office.poses[0], 0)


def test_three_walls_are_in_range_of_the_first_pose(office):
    near = {
        name
        for wall, name in zip(office.room.walls, office.room.wall_names, strict=True)
        if name != CHAIR and gap(office.poses[0, :2], wall) < 2.0
    }
    assert near == {"left wall", "right wall", "back wall"}


def test_the_chair_is_at_the_position_of_the_paper(office):
    chair = chair_of(office)
    np.testing.assert_allclose(in_frame(office.poses[0], chair.mean(axis=0)), [0.99, -0.63], atol=1e-3)
    assert 0.3 < np.linalg.norm(chair[1] - chair[0]) < 0.6


def test_there_are_recesses_for_a_door_and_a_cupboard(office):
    assert {"door", "cupboard", "door jamb", "cupboard side"} <= set(office.room.wall_names)


def test_all_poses_have_clearance(office):
    for x, y, _ in office.poses:
        assert min(gap(np.array([x, y]), wall) for wall in office.room.walls) > 0.3
        assert all(math.dist((x, y), pole) > 0.3 for pole in office.room.poles)


@pytest.mark.slow
def test_the_robot_crosses_no_wall(office):
    way = np.stack([office.poses[:-1, :2], office.poses[1:, :2]], axis=1)
    along = np.linspace(0, 1, 11)[:, None]
    for start, end in way:
        for point in start + along * (end - start):
            assert min(gap(point, wall) for wall in office.room.walls) > 0.25


def test_the_room_is_closed_and_not_aligned_with_the_ring(office):
    """Outer walls form a closed loop; no wall is perpendicular to a sensor axis at the first pose."""
    outer = [wall for wall, name in zip(office.room.walls, office.room.wall_names, strict=True) if name != CHAIR]
    ends = [tuple(end) for wall in outer for end in wall.tolist()]
    assert all(ends.count(end) == 2 for end in ends)
    for wall in outer:
        turn = math.degrees(seen_line(office.poses[0], wall)[1]) % 15
        assert min(turn, 15 - turn) > 1


@pytest.mark.slow
def test_the_chair_is_detected_at_later_poses_only(office, noisy):
    """For every seed: no line at the first pose, and a line at one or more later poses."""
    chair = chair_of(office)
    for _, models in noisy:
        seen = [
            any(is_line(line, *seen_line(pose, chair)) for line in model.lines)
            for model, pose in zip(models, office.poses, strict=True)
        ]
        assert not seen[0]
        assert any(seen[1:])


@pytest.mark.slow
def test_three_walls_at_the_first_pose_with_deviations_as_in_the_paper(office, noisy):
    """For 8 of 10 seeds exactly the three walls have lines, within the paper's deviations."""
    good = 0
    for _, models in noisy:
        walls = {
            name: seen_line(office.poses[0], wall)
            for wall, name in zip(office.room.walls, office.room.wall_names, strict=True)
            if name != CHAIR and gap(office.poses[0, :2], wall) < 2.0
        }
        hits = [
            [name for name, wall in walls.items() if is_line(line, *wall, rho_gate=PAPER_RHO, theta_gate=PAPER_THETA)]
            for line in models[0].lines
        ]
        good += sorted(hits) == [["back wall"], ["left wall"], ["right wall"]]
    assert good >= 8


@pytest.mark.slow
def test_most_clearly_visible_walls_are_detected(office, noisy):
    recall = []
    for heard, models in noisy:
        result = line_accuracy(office.ring, models, heard, office.room, office.poses, sigma=SIGMA)
        assert result.walls >= 2 * 17
        recall.append(result.recall)
        assert result.false_per_scan <= 2
        assert np.sqrt(np.mean(result.rho_error**2)) < PAPER_RHO
        assert np.sqrt(np.mean(result.theta_error**2)) < PAPER_THETA
    assert np.mean(recall) >= 0.9


@pytest.mark.slow
def test_segments_of_true_walls_lie_on_them(office, noisy):
    """The middle of each segment of the back wall is near that wall in the world frame."""
    wall = office.room.walls[office.room.wall_names.index("back wall")]
    for _, models in noisy[:3]:
        for model, pose in zip(models[:4], office.poses, strict=False):
            cos, sin = math.cos(pose[2]), math.sin(pose[2])
            for line in model.lines:
                if is_line(line, *seen_line(pose, wall)):
                    middle = line.segment.mean(axis=0) @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]
                    assert gap(middle, wall) < 0.05
