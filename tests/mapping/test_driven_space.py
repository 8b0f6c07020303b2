"""Where the robot drove: cells against an oracle, windows, and noisy poses. Walls across its path go, others stay."""

import itertools
import math

import numpy as np
import pytest
from support.segments import moved, segments_at

from jaxsonar import Ring
from jaxsonar.mapping.artifact_removal import remove_driven_through
from jaxsonar.mapping.driven_space import DrivenSpace
from jaxsonar.mapping.settings import SETTINGS

CELL = SETTINGS.evidence.position_cell
RING = Ring.circular()
SCANS = 81
WINDOWS = ((0, SCANS), (0, 20, 21, 55, SCANS), range(SCANS + 1))
"""Borders of the windows into which a drive is divided."""


def path(*, noise=0.0, seed=0):
    """Poses along the x axis from 0 to 4 m, and their times."""
    rng = np.random.default_rng(seed)
    poses = np.zeros((SCANS, 3))
    poses[:, 0] = np.linspace(0, 4, SCANS)
    return poses + rng.normal(0, [noise, noise, noise], poses.shape), np.arange(SCANS, dtype=float)


def driven(poses, times, borders=(0, SCANS)):
    """The driven space of a drive that is divided into windows."""
    space = DrivenSpace.empty()
    for begin, end in itertools.pairwise(borders):
        space = space.union(DrivenSpace.of(RING, poses[begin:end], times[begin:end]))
    return space


def test_the_latest_visit_agrees_with_an_oracle():
    poses, times = path(noise=0.1, seed=3)
    inner = np.hypot(*np.asarray(RING.position).T).min()
    steps = int(min(SETTINGS.evidence.inner_share * inner, SETTINGS.evidence.max_half_width) / CELL)
    points = np.random.default_rng(4).uniform([-0.5, -0.5], [4.5, 0.5], (500, 2))
    expected = [
        max(
            (
                time
                for (x, y, _), time in zip(poses, times, strict=True)
                if math.hypot(
                    math.floor(point[0] / CELL) - math.floor(x / CELL),
                    math.floor(point[1] / CELL) - math.floor(y / CELL),
                )
                <= steps
            ),
            default=-math.inf,
        )
        for point in points
    ]
    assert 50 < np.isfinite(expected).sum() < 450
    np.testing.assert_array_equal(driven(poses, times).latest(points), expected)


@pytest.mark.parametrize("borders", WINDOWS, ids=["whole", "windows", "single scans"])
@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_wall_across_the_path_goes_and_walls_beside_it_stay(borders, noise):
    """Also in a world that is rotated; the walls beside the path are 0.4 m from it, parallel and perpendicular."""
    across, beside = ([2.0, 0.0], 0.0), [([2.0, 0.4], math.pi / 2), ([2.0, -0.9], 0.0), ([5.0, 0.0], 0.0)]
    center, theta = zip(across, *beside, strict=True)
    walls = segments_at(center, theta, length=1.0)
    for turn in (0.0, 0.7, 2.5):
        poses, times = path(noise=noise)
        world = np.array([3.0, -2.0, turn])
        c, s = math.cos(turn), math.sin(turn)
        poses[:, :2] = poses[:, :2] @ np.array([[c, s], [-s, c]]) + world[:2]
        poses[:, 2] += turn
        there = moved(walls, world)
        left = remove_driven_through(there, driven(poses, times, borders))
        np.testing.assert_array_equal(left.center, there.center[1:])


def test_windows_have_the_driven_space_of_the_whole_drive():
    poses, times = path(noise=0.05, seed=1)
    whole = driven(poses, times)
    for borders in WINDOWS:
        joined = driven(poses, times, borders)
        np.testing.assert_array_equal(joined.cells, whole.cells)
        np.testing.assert_array_equal(joined.time, whole.time)


def test_scans_without_a_pose_are_nowhere():
    poses, times = path()
    poses[30:] = np.nan
    part = driven(poses, times)
    np.testing.assert_array_equal(part.cells, driven(poses[:30], times[:30], (0, 30)).cells)
    assert not len(driven(np.full((3, 3), np.nan), np.arange(3.0), (0, 3)).cells)
