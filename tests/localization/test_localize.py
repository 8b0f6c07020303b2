"""Localization in a known map: with and without a start pose, and no pose where places look alike."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from jaxsonar import Log, Ring, Room, SonarError, simulate
from jaxsonar.geometry.se2 import compose, inverse, transform_points, wrap_angle
from jaxsonar.localization.localize import Localized, localize
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.simulation.office import load_office

RING = Ring.circular()
SIGMA = 0.001


def world_of(walls, known=1e-4):
    """A map of walls with the given standard deviations (metres and radians)."""
    along = walls[:, 1] - walls[:, 0]
    theta = np.arctan2(along[:, 1], along[:, 0]) - np.pi / 2
    rho = (walls[:, 0] * np.stack([np.cos(theta), np.sin(theta)], -1)).sum(-1)
    theta = wrap_angle(np.where(rho < 0, theta + np.pi, theta))
    count = len(walls)
    sd = np.full(count, known)
    return GlobalMap(np.array(walls), np.abs(rho), theta, sd, sd, np.full(count, 100), ((0, 1),) * count)


@cache
def office():
    return load_office()


@cache
def log(seed=1):
    heard = simulate(RING, office().room, office().poses, sigma=SIGMA, seed=seed, stamps=office().stamps)
    return heard.as_log(RING, office().poses)


def errors_of(found: Localized, truth):
    apart = found.poses - truth
    return np.column_stack([apart[:, :2], wrap_angle(apart[:, 2])])


def assert_correct(found, truth):
    """The errors are small and consistent with the covariances."""
    assert found.is_certain, found.reason
    apart = errors_of(found, truth)
    assert np.hypot(apart[:, 0], apart[:, 1]).max() < 0.02
    assert np.abs(apart[:, 2]).max() < np.radians(1.5)
    squared = np.einsum("ni,nij,nj->n", apart, np.linalg.inv(found.covariance), apart)
    assert squared.mean() < 9.0
    np.testing.assert_array_equal(found.trajectory.poses, found.poses)


@pytest.fixture(scope="module")
def world():
    return world_of(office().room.walls)


@pytest.mark.slow
def test_global_localization_does_not_depend_on_the_frames(world):
    """The frame of the odometry is arbitrary, and the poses rotate with the map."""
    some = log()[:10]
    odometry = compose(np.array([5.0, -3.0, 1.0]), office().poses[:10])
    found = localize(RING, world, replace(some, pose=odometry), sigma=SIGMA)
    assert_correct(found, office().poses[:10])
    turn = np.array([-4.0, 7.0, 2.5])
    moved = localize(RING, world_of(transform_points(turn, office().room.walls)), some, sigma=SIGMA)
    assert_correct(moved, compose(turn, office().poses[:10]))
    np.testing.assert_allclose(compose(inverse(turn), moved.poses), found.poses, atol=2e-3)


@pytest.mark.slow
def test_one_scan_and_a_start_pose(world):
    for row, wrong in ((5, (0.2, -0.1, 0.1)), (8, (-0.15, 0.2, -0.15))):
        truth = office().poses[row : row + 1]
        found = localize(RING, world, log()[row : row + 1], start=(truth[0] + wrong).tolist(), sigma=SIGMA)
        assert_correct(found, truth)


@pytest.mark.slow
def test_a_rectangle_is_ambiguous():
    """A rectangle is symmetric under half a turn: there are two poses, and none is returned."""
    walls = np.array([[[0, 0], [3, 0]], [[3, 0], [3, 2]], [[3, 2], [0, 2]], [[0, 2], [0, 0]]], dtype=float)
    poses = np.array([[0.8 + 0.12 * k, 0.7 + 0.03 * k, 0.2 + 0.05 * k] for k in range(5)])
    given = simulate(RING, Room(walls), poses, sigma=SIGMA, seed=2).as_log(RING, poses)
    found = localize(RING, world_of(walls), given, sigma=SIGMA)
    assert not found.is_certain
    assert "ambiguous" in found.reason
    assert np.isnan(found.poses).all()
    assert not len(found.trajectory)
    other = np.array([3.0, 2.0, 0.0]) - poses[0] * [1, 1, -1] + [0, 0, np.pi]
    for place, truth in zip(sorted(found.hypotheses[:2], key=lambda one: one.pose[0]), (poses[0], other), strict=True):
        np.testing.assert_allclose(place.pose[:2], truth[:2], atol=0.01)
        assert abs(wrap_angle(float(place.pose[2] - truth[2]))) < np.radians(1)
    assert all(f"{place.pose[0]:.2f}, {place.pose[1]:.2f} m" in found.reason for place in found.hypotheses[:2])
    # A start pose resolves the ambiguity.
    assert_correct(localize(RING, world_of(walls), given, start=[0.9, 0.6, 0.1], sigma=SIGMA), poses)


@pytest.mark.slow
def test_corners_of_a_floor_plan_explain_echoes(world):
    """A floor plan has no points: corners are added where its walls meet at right angles."""
    truth = office().poses[8:9]
    found = localize(RING, world, log()[8:9], start=(truth[0] + [0.2, -0.1, 0.1]).tolist(), sigma=SIGMA)
    assert_correct(found, truth)
    assert found.hypotheses[0].explained > 0.6


@pytest.mark.slow
def test_a_place_outside_the_map_is_not_found(world):
    walls = np.array([[[0, 0], [1.3, 0.2]], [[1.3, 0.2], [1.9, 1.4]], [[1.9, 1.4], [0.2, 1.7]], [[0.2, 1.7], [0, 0]]])
    poses = np.array([[0.8, 0.8, 0.1 * k] for k in range(4)])
    given = simulate(RING, Room(walls), poses, sigma=SIGMA, seed=2).as_log(RING, poses)
    found = localize(RING, world, given, sigma=SIGMA)
    assert not found.is_certain
    assert "no place" in found.reason or "ambiguous" in found.reason


def test_invalid_arguments_are_errors(world):
    nothing = world_of(np.zeros((0, 2, 2)))
    none = np.zeros(0, int)
    with pytest.raises(SonarError, match="no scan"):
        localize(RING, world, Log.from_echoes(none, none, none, np.zeros(0), stamp=np.zeros(0), pose=np.zeros((0, 3))))
    with pytest.raises(SonarError, match="no wall"):
        localize(RING, nothing, log()[:1])
    for start in ([0.0, 1.0], [0.0, 1.0, float("nan")]):
        with pytest.raises(SonarError, match="allowed are x, y"):
            localize(RING, world, log()[:1], start=start)
    with pytest.raises(SonarError, match="sigma"):
        localize(RING, world, log()[:1], sigma=-1.0)
