"""Localization in a known map: with and without a start pose, and no pose where places look alike."""

from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest
from support.hard_cones import simulate

import jaxsonar
from jaxsonar import Log, Ring, Room, SonarError
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.geometry.se2 import (
    compose,
    diagonal_covariance,
    inverse,
    relative,
    subtract_poses,
    transform_points,
    wrap_angle,
)
from jaxsonar.localization.hypothesis_tracking import HypothesisTracker
from jaxsonar.localization.known_map import KnownMap, is_floor_plan
from jaxsonar.localization.localize import Localized, localize
from jaxsonar.localization.scan_update import update_hypotheses
from jaxsonar.localization.settings import SETTINGS, UPDATE_SETTINGS
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.map_from_room import map_from_room
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
    # They are equally probable.
    assert all(0.4 < place.probability < 0.6 for place in found.hypotheses[:2])
    assert sum(place.probability for place in found.hypotheses) <= 1
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


def building(box):
    """Two rooms that are alike and a lower one, side by side, with doors; a piece of furniture, if drawn."""
    walls = [
        [[0, 0], [9.2, 0]],
        [[0, 0], [0, 2.6]],
        [[0, 2.6], [6.4, 2.6]],
        [[6.4, 2.2], [9.2, 2.2]],
        [[9.2, 0], [9.2, 2.2]],
    ]
    for x in (3.2, 6.4):
        for side in (x - 0.05, x + 0.05):
            walls += [[[side, 0], [side, 0.7]], [[side, 1.6], [side, 2.6]]]
    if box:
        walls += [[[4.4, 2.3], [5.0, 2.3]], [[4.4, 2.3], [4.4, 2.6]], [[5.0, 2.3], [5.0, 2.6]]]
    return np.array(walls, dtype=float)


@pytest.mark.slow
def test_a_plan_is_ambiguous_until_the_drive_leaves_the_rooms_that_are_alike():
    """The whole drive is used, and the plan is not exact: a wall is off by 2 cm, and furniture is not drawn."""
    true = building(box=True)
    true[:, :, 0] += np.where(true[:, :, 0] > 5.5, 0.02, 0.0)
    x = np.linspace(1.0, 8.2, 26)
    poses = np.column_stack([x, 1.15 + 0.25 * np.cos(1.96 * x), 0.3 * np.sin(3 * x)])
    given = simulate(RING, Room(true), poses, sigma=0.003, dropout=0.1, seed=4).as_log(RING, poses)
    given = replace(given, pose=compose(np.array([3.0, 1.0, 2.0]), poses))
    plan = map_from_room(Room(building(box=False)))
    # A few scans of the first room fit both.
    found = localize(RING, plan, given[:6])
    assert not found.is_certain
    # The whole drive fits one place.
    found = localize(RING, plan, given)
    assert found.is_certain, found.reason
    assert found.hypotheses[0].probability > 0.99
    apart = errors_of(found, poses)
    assert np.median(np.hypot(apart[:, 0], apart[:, 1])) < 0.08
    assert np.median(np.abs(apart[:, 2])) < np.radians(1.5)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 4])
def test_the_office_is_found_in_its_floor_plan(seed):
    """A wrong place that fits the last scans does not win: its track contradicts the odometry."""
    ring, room, truth, stamps = office().ring, office().room, office().poses, office().stamps
    given = simulate(ring, room, truth, sigma=0.003, seed=seed, stamps=stamps).as_log(ring, truth)
    found = localize(ring, map_from_room(room), given)
    assert found.is_certain, found.reason
    assert np.hypot(*errors_of(found, truth)[:, :2].T).max() < 0.05
    assert np.hypot(*(found.hypotheses[0].pose - truth[0])[:2]) < 0.05


@pytest.mark.slow
def test_no_wrong_place_is_certain_if_the_odometry_slips():
    """The odometry slips by 0.2 m: the place is right if it is certain, and the track recovers."""
    ring, room, truth, stamps = office().ring, office().room, office().poses, office().stamps
    odometry = truth.copy()
    odometry[8:] = compose(compose(truth[7], np.array([-0.2, 0.0, 0.0])), relative(truth[7], truth[8:]))
    given = simulate(ring, room, truth, sigma=0.003, seed=1, stamps=stamps).as_log(ring, odometry)
    found = localize(ring, map_from_room(room), given)
    apart = np.hypot(*errors_of(found, truth)[:, :2].T)
    assert not found.is_certain or (apart[[0, -1]] < 0.05).all()


def plain_room():
    corners = np.array([[0, 0], [6, 0.3], [6, 4], [0, 4]], float)
    return Room(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))


def tracker_of(room, given, poses):
    return HypothesisTracker(
        RING, KnownMap.of(map_from_room(room)), given, (), poses, 0.003, OdometryNoise(), SETTINGS.plan_trust
    )


@pytest.mark.parametrize("beams", ["soft", "hard"])
def test_the_true_place_explains_more_than_chance(beams):
    """Soft beams receive three times as many echoes, so that no constant per echo serves both."""
    room, poses = plain_room(), np.array([[1.6, 1.4, 0.3], [1.8, 1.5, 0.4], [2.0, 1.6, 0.5]])
    given = jaxsonar.simulate(RING, room, poses, sigma=0.003, seed=2, beams=beams).as_log(RING, poses)
    tracker = tracker_of(room, given, poses)
    with jax.enable_x64(True):
        here = tracker._at(list(poses[:1]))
    found = tracker._update_all(here.pose, here.covariance, 0, UPDATE_SETTINGS.iterations[0])
    evidence = found.evidence.sum() + found.log_odometry[0]
    assert 0 < tracker.chance_nats * tracker.echo_counts[0] < 0.7 * evidence
    # The true place is one of those that are listed, and none of the map is improbable.
    result = localize(RING, map_from_room(room), given)
    apart = [np.hypot(*(one.pose - poses[0])[:2]) for one in result.hypotheses if one.probability > 0.05]
    assert min(apart) < 0.05
    assert sum(one.probability for one in result.hypotheses) > 0.8


def test_silent_scans_do_not_change_what_is_explained_by_chance():
    room, poses = plain_room(), np.array([[1.6, 1.4, 0.3], [1.8, 1.5, 0.4]])
    given = simulate(RING, room, poses, sigma=0.003, seed=2).as_log(RING, poses)
    scans = [given[0], given[1], *(replace(given[0], scan=k, **silence()) for k in range(2, 8))]
    longer = Log.from_scans(scans)
    more = poses[0] + np.arange(8)[:, None] * (poses[1] - poses[0])
    assert tracker_of(room, longer, more).chance_nats == pytest.approx(tracker_of(room, given, poses).chance_nats)


def silence():
    nothing = np.zeros(0)
    return {
        "tx": np.zeros(0, int),
        "rx": np.zeros(0, int),
        **dict.fromkeys(("range", "amplitude", "t", "age"), nothing),
    }


def test_poles_and_columns_of_a_plan_are_as_uncertain_as_its_walls():
    room = Room(plain_room().walls, poles=np.array([[2.0, 2.0]]), circles=np.array([[4.0, 2.5, 0.2]]))
    world = map_from_room(room)
    assert world.point_kinds == ("edge", "circle")
    np.testing.assert_array_equal(world.points, [[2.0, 2.0], [4.0, 2.5]])
    np.testing.assert_array_equal(world.point_radius, [np.nan, 0.2])
    assert is_floor_plan(world)
    known = KnownMap.of(world)
    assert (known.covariance[:, 0, 0] > 0.99 * SETTINGS.plan_sd[0] ** 2).all()
    low, high = known.bounds
    np.testing.assert_allclose([low, high], [[0.0, 0.0], [6.0, 4.0]], atol=1e-9)


def test_an_update_balances_echoes_and_odometry():
    """Its evidence is Laplace's approximation, and a fit far from a certain prediction is rejected."""
    truth = office().poses[0]
    noise = OdometryNoise()
    known = KnownMap.of(map_from_room(office().room))
    tracker = HypothesisTracker(RING, known, log()[:1], (), office().poses[:1], SIGMA, noise, SETTINGS.plan_trust)
    predicted = truth + np.array([0.02, -0.01, 0.01])
    poses = np.stack([truth, predicted, predicted])
    sd = [(0.05, 0.05), (0.05, 0.05), (1e-4, 1e-4)]
    covariances = np.stack([diagonal_covariance(one) for one in sd])
    padded = np.resize(poses, (SETTINGS.batch, 3)), np.resize(covariances, (SETTINGS.batch, 3, 3))
    with jax.enable_x64(True):
        found = update_hypotheses(*padded, known.arrays, tracker.scans[0], np.int64(9))
    found = [np.asarray(column)[: len(poses)] for column in found]
    after, covariance, log_odometry = found[0], found[1], found[5]
    np.testing.assert_allclose(after[:2, :2], np.tile(truth[:2], (2, 1)), atol=0.01)
    np.testing.assert_allclose(after[2], predicted, atol=5e-4)
    change = subtract_poses(after, poses)
    squared = np.einsum("ni,nij,nj->n", change, np.linalg.inv(covariances), change)
    volume = (np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(covariances)[1]) / 2
    np.testing.assert_allclose(log_odometry, volume - squared / 2, atol=1e-6)
    assert (log_odometry < 0).all()
    assert (squared < UPDATE_SETTINGS.max_innovation).all()


def test_the_scans_of_a_long_log_share_their_stretches():
    """The weights are those of the table of all distances."""
    count = 3 * SETTINGS.distance_rows // 2
    odometry = np.cumsum(np.random.default_rng(3).normal(0, 0.1, (count, 3)), axis=0)
    known = KnownMap.of(map_from_room(office().room))
    trust = SETTINGS.plan_trust
    tracker = HypothesisTracker(RING, known, log()[:1], (), odometry, SIGMA, OdometryNoise(), trust)
    step = relative(odometry[:-1], odometry[1:])
    moved = np.append(0.0, np.hypot(*step[:, :2].T) + SETTINGS.turn_length * np.abs(step[:, 2]))
    distance = np.linalg.norm(odometry[:, None, :2] - odometry[:, :2], axis=-1)
    expected = moved / np.maximum((distance < trust.stretch / 2) @ moved, trust.stretch)
    np.testing.assert_allclose(tracker.scan_weights[1:], expected[1:])
    # A track that follows the odometry agrees with it.
    turned = compose(np.array([1.0, 2.0, 3.0]), odometry)
    assert tracker.odometry_misfit(turned) < 1e-9
    turned[count // 2 :, 0] += 1.0
    assert tracker.odometry_misfit(turned) > 1e-3


def test_an_update_is_compiled_once():
    """Numbers of hypotheses, echoes and landmarks compile nothing again."""
    before = update_hypotheses._cache_size()  # pyright: ignore
    for rows, walls in ((3, 9), (1, 7)):
        localize(RING, world_of(office().room.walls[:walls]), log()[:rows], start=[0.1, 0.0, 0.0], sigma=SIGMA)
    assert update_hypotheses._cache_size() <= before + 1  # pyright: ignore


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
    with pytest.raises(SonarError, match="map_sd"):
        localize(RING, world, log()[:1], map_sd=(0.0, 0.1))
