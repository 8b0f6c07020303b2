"""The SLAM benchmark: places that a robot can drive through, a bound by laws of its own, measures of known errors."""

import json
import sys
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from shapely import LineString, MultiLineString

from benchmarks.slam import accuracy as slam
from benchmarks.slam import scenarios as slam_scenes
from benchmarks.slam import summary
from benchmarks.slam.cramer_rao import Bound, _links, _Slopes, bound, pose_bound
from benchmarks.slam.scenarios import (
    CLEARANCE,
    DISTANCE,
    STEP,
    TURN,
    TURNING,
    Scene,
    clearance,
    corridor,
    loop,
    one_scan,
)
from jaxsonar import GlobalMap, Room
from jaxsonar.estimation.trajectory import Trajectory
from jaxsonar.geometry.se2 import relative
from jaxsonar.graph_slam.initial_poses import LoopClosure
from jaxsonar.simulation.traced_echoes import EchoKind

PLACES = {
    "office": slam_scenes.office,
    "twins": slam_scenes.twins,
    "corridor": corridor,
    "long": lambda: slam_scenes.long_run(scans=1500),
} | {f"loop {k}": lambda k=k: loop(k) for k in range(20)}


@cache
def scene_of(name):
    return PLACES[name]()


@pytest.fixture(params=PLACES)
def place(request):
    return scene_of(request.param)


@pytest.fixture(scope="module")
def office():
    return slam_scenes.office()


def test_ways_are_free_of_walls(place):
    way, walls = LineString(place.poses[:, :2]), MultiLineString(list(place.room.walls))
    assert not way.crosses(walls)
    assert clearance(place) == way.distance(walls) >= CLEARANCE
    # The walls close around the way: one piece of floor holds all of it.
    floor = [piece for piece in shapely.polygonize(list(walls.geoms)).geoms if piece.intersects(way)]
    assert len(floor) == 1 or place.name == "office"


def test_ways_are_gentle(place):
    if place.name == "office":
        return
    step = relative(place.poses[:-1], place.poses[1:])
    way, turn = np.linalg.norm(step[:, :2], axis=-1), np.abs(step[:, 2])
    assert way.max() <= STEP[1] + 1e-9
    assert turn.max() <= TURNING + 0.06
    moving = way > 1e-9
    assert (turn[~moving] > 0).all(), "it turns where it stands"
    ahead = np.abs(np.arctan2(step[:, 1], step[:, 0]))[moving]
    assert ahead.max() < np.radians(15), "it looks where it goes"


def test_loops_are_loops():
    for seed in range(20):
        scene = scene_of(f"loop {seed}")
        place = scene.poses[:, :2]
        early, late = place[: len(place) // 8], place[-len(place) // 8 :]
        apart = np.linalg.norm(early[:, None] - late, axis=-1).min(axis=1)
        assert np.sum(apart < 0.3) >= 10, "it comes back to where it began"
        assert 35 < scene.way < 125


def test_walls_are_in_reach_and_the_same_seed_is_the_same_place():
    scene, again = scene_of("loop 3"), loop(3)
    np.testing.assert_array_equal(scene.poses, again.poses)
    np.testing.assert_array_equal(scene.room.walls, again.room.walls)
    walls = np.bincount(scene.heard.scan[scene.heard.kind == EchoKind.PLANE], minlength=len(scene.poses))
    assert np.mean(walls >= 8) > 0.9
    assert len(scene_of("loop 4").poses) != len(scene.poses)
    log = scene.log(7)
    np.testing.assert_array_equal(log.pose, scene.odometry(7))
    assert len(log.range) == len(scene.heard.range)
    np.testing.assert_array_equal(log.pose[0], scene.poses[0])


def test_one_scan_hears_two_walls_that_cross():
    scene = one_scan(2)
    assert len(scene.poses) == 1
    assert np.linalg.eigvalsh(pose_bound(scene)[0]).max() < 0.03**2


# The bound


def dense(scene):
    """The same from one large matrix."""
    slopes, scans = _Slopes.of(scene), len(scene.poses)
    row, pose, place = np.arange(len(slopes.scan)), 3 * slopes.scan, 3 * scans + 2 * slopes.own
    jacobian = np.zeros((len(row), 3 * scans + 2 * len(slopes.places)))
    for k in range(3):
        jacobian[row, pose + k] = slopes.by_pose[:, k]
    for k in range(2):
        jacobian[row, place + k] = slopes.by_place[:, k]
    information = jacobian.T @ jacobian
    information[3 * scans :, 3 * scans :] += np.eye(2 * len(slopes.places))
    for k, (first, second, between) in enumerate(zip(*_links(scene.poses, DISTANCE, TURN), strict=True)):
        a, b = slice(3 * k, 3 * k + 3), slice(3 * k + 3, 3 * k + 6)
        information[a, a] += first
        information[b, b] += second
        information[a, b] += between
        information[b, a] += between.T
    covariance = np.linalg.inv(information[3:, 3:])
    return np.stack([covariance[k : k + 3, k : k + 3] for k in range(0, 3 * scans - 3, 3)])


def test_the_bound_in_parts_is_the_bound_at_once(office):
    got = bound(office)
    np.testing.assert_array_equal(got.poses[0], 0)
    np.testing.assert_allclose(got.poses[1:], dense(office), rtol=1e-6, atol=1e-12)


def test_more_is_known_with_better_odometry_and_less_noise(office):
    base = bound(office)
    better, quieter = bound(office, distance=DISTANCE / 4, turn=TURN / 4), bound(replace(office, sigma=2e-4))
    for less in (better, quieter):
        assert less.ate < base.ate
        assert (np.linalg.eigvalsh(base.poses - less.poses)[1:] > -1e-12).all()
        assert (less.distance < base.distance).all()


def test_the_bound_turns_with_the_frame(office):
    turn, shift = 0.7, np.array([1.0, -2.0])
    c, s = np.cos(turn), np.sin(turn)
    matrix = np.array([[c, s], [-s, c]])
    poses = np.column_stack([office.poses[:, :2] @ matrix + shift, office.poses[:, 2] + turn])
    moved = bound(Scene("moved", Room(office.room.walls @ matrix + shift, poles=office.room.poles @ matrix), poses))
    still = bound(replace(office, room=Room(office.room.walls, poles=office.room.poles)))
    np.testing.assert_allclose(moved.ate, still.ate, rtol=0.02)  # other noise, hence other echoes at the threshold
    np.testing.assert_allclose(moved.ate_heading, still.ate_heading, rtol=0.02)


def test_along_a_bare_corridor_odometry_is_all_there_is():
    scene = corridor()
    out = np.argmax(np.linalg.norm(scene.poses[:, :2] - scene.poses[0, :2], axis=-1))
    along = np.append(np.cos(scene.poses[3, 2]), np.sin(scene.poses[3, 2]))
    middle = out // 2
    sd = np.sqrt(along @ bound(scene).poses[middle, :2, :2] @ along)
    way = np.linalg.norm(scene.poses[middle, :2] - scene.poses[0, :2])
    assert 0.5 < sd / (DISTANCE * np.sqrt(way)) < 1.01


# The measures


def fake(scene, off):
    """Results that are wrong by so much, as the library would give them."""
    walls = scene.room.walls + np.array([0.0, 0.004])
    none = np.zeros(len(walls))
    world = GlobalMap(walls, none, none, none, none, np.zeros(len(walls), int), ((),) * len(walls))
    poses = scene.poses + off
    poses[0] = scene.poses[0]
    covariance = np.tile(np.diag([1e-4, 1e-4, 1e-4]), (len(poses), 1, 1))
    covariance[0] = 0
    right = relative(scene.poses[1], scene.poses[9])
    closures = [
        LoopClosure(1, 9, right + off, state, np.eye(3))
        for off, state in (
            (np.array([0.02, 0, 0]), "counted"),
            (np.array([0.5, 0, 0]), "counted"),
            (np.array([0, 0, np.pi / 2]), "counted"),
            (np.array([0.5, 0, 0]), "withdrawn"),
            (np.zeros(3), "proposed"),
        )
    ]
    steps = np.concatenate([[900.0], np.linspace(1, 3, len(poses) - 1)])
    trajectory = Trajectory(scene.heard.stamps, poses, covariance)
    return SimpleNamespace(
        trajectory=trajectory, world=world, odometry=scene.odometry(0), closures=closures, step_ms=steps
    )


def test_measures_of_known_errors(office, monkeypatch):
    off = np.array([0.01, 0.0, 0.02])
    module = SimpleNamespace(slam=lambda ring, log, **options: fake(office, off))
    monkeypatch.setitem(sys.modules, "jaxsonar.graph_slam.slam", module)
    got = slam.outcome(office, "smoothed", bound(office))
    share = np.sqrt(16 / 17)
    np.testing.assert_allclose([got.ate, got.ate_heading], [0.01 * share, 0.02 * share])
    np.testing.assert_allclose(got.nees, (1 + 4) / 3)
    assert got.placed == 1
    assert (got.made, got.wrong, got.withdrawn) == (3, 2, 1)
    assert 0.002 < got.walls <= 0.004, "as far as they lie across the shift"
    assert (got.missed, got.first) == (0, 900)
    assert got.false < 0.01
    assert 1.9 < got.p50 < 2.1
    assert 2.9 < got.p99 <= 3
    told = slam.run({"office": [lambda: office]}, ["smoothed", "front end"], ones=0)
    assert [row["way"] for row in told] == ["smoothed", "front end"]
    np.testing.assert_allclose(told[0]["ratio"], got.odometry / got.ate)
    json.dumps(slam.without_nan(told), allow_nan=False)
    settings = {"sigma": 0.001, "distance": DISTANCE, "turn": TURN}
    versions = {"jax": "1", "device": "cpu", "commit": "abc"}
    table = summary.table(slam.without_nan({"versions": versions, "settings": settings, "scenarios": told}))
    assert table.row_count == 2
    assert len(table.columns) == len(summary.COLUMNS) + 1


def test_a_run_that_fails_is_told(office, monkeypatch):
    monkeypatch.setitem(sys.modules, "jaxsonar.graph_slam.slam", None)  # as if it were not there
    nothing = Bound(np.zeros((17, 3, 3)), np.zeros(0, int), np.zeros(0), np.zeros(0))
    got = slam.outcome(office, "smoothed", nothing)
    assert got.failed
    assert got.odometry > 0
    row = summary.measures([got])
    assert (row["failed"], row["why"]) == (1, got.failed)
    assert np.isnan(row["ate_mm"])


def test_wrong_closures_are_those_that_are_off():
    poses = np.array([[0.0, 0, 0], [1.0, 1, np.pi / 2]])
    right = relative(poses[0], poses[1])

    def wrong(off, determined):
        return slam.wrong(poses, LoopClosure(0, 1, right + off, "counted", determined))

    whole, along_x = np.eye(3), np.eye(3)[:, 1:]  # walls along x leave x open
    assert not wrong([0.1, 0.1, 0.1], whole)
    assert wrong([0.0, 0.31, 0.0], whole)
    assert wrong([0.0, 0.0, np.radians(11)], whole)
    assert not wrong([0.0, 0.0, 2 * np.pi], whole)
    assert not wrong([5.0, 0.1, 0.1], along_x)
    assert wrong([5.0, 0.31, 0.0], along_x)
