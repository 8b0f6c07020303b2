"""The SLAM benchmark: drivable scenes, laws of the bound, measures of known errors."""

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
from benchmarks.slam import scenarios, summary
from benchmarks.slam.cramer_rao import Bound, _odometry_information, _RangeJacobians, bound, pose_bound
from benchmarks.slam.scenarios import (
    CLEARANCE,
    DISTANCE,
    SCAN_DISTANCE,
    SCAN_ROTATION,
    TURN,
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

SCENES = {
    "office": scenarios.office,
    "twins": scenarios.twins,
    "corridor": corridor,
    "long": lambda: scenarios.long_run(scans=1500),
} | {f"loop {k}": lambda k=k: loop(k) for k in range(20)}


@cache
def scene_of(name):
    return SCENES[name]()


@pytest.fixture(params=SCENES)
def scene(request):
    return scene_of(request.param)


@pytest.fixture(scope="module")
def office():
    return scenarios.office()


@pytest.mark.slow
def test_trajectories_keep_clear_of_walls(scene):
    route, walls = LineString(scene.poses[:, :2]), MultiLineString(list(scene.room.walls))
    assert not route.crosses(walls)
    assert clearance(scene) == route.distance(walls) >= CLEARANCE
    # The walls enclose the trajectory: one piece of floor contains all of it.
    floor = [piece for piece in shapely.polygonize(list(walls.geoms)).geoms if piece.intersects(route)]
    assert len(floor) == 1 or scene.name == "office"


@pytest.mark.slow
def test_steps_and_rotations_are_bounded(scene):
    if scene.name == "office":
        return
    step = relative(scene.poses[:-1], scene.poses[1:])
    length, turn = np.linalg.norm(step[:, :2], axis=-1), np.abs(step[:, 2])
    assert length.max() <= SCAN_DISTANCE[1] + 1e-9
    assert turn.max() <= SCAN_ROTATION + 0.06
    moving = length > 1e-9
    assert (turn[~moving] > 0).all(), "it turns in place"
    ahead = np.abs(np.arctan2(step[:, 1], step[:, 0]))[moving]
    assert ahead.max() < np.radians(15), "it faces its direction of travel"


def test_loops_return_to_their_start():
    for seed in range(20):
        scene = scene_of(f"loop {seed}")
        position = scene.poses[:, :2]
        early, late = position[: len(position) // 8], position[-len(position) // 8 :]
        apart = np.linalg.norm(early[:, None] - late, axis=-1).min(axis=1)
        assert np.sum(apart < 0.3) >= 10, "it returns to its start"
        assert 35 < scene.distance_traveled < 125


@pytest.mark.slow
def test_walls_are_in_range_and_a_seed_determines_the_scene():
    scene, again = scene_of("loop 3"), loop(3)
    np.testing.assert_array_equal(scene.poses, again.poses)
    np.testing.assert_array_equal(scene.room.walls, again.room.walls)
    walls = np.bincount(scene.simulation.scan[scene.simulation.kind == EchoKind.PLANE], minlength=len(scene.poses))
    assert np.mean(walls >= 8) > 0.9
    assert len(scene_of("loop 4").poses) != len(scene.poses)
    log = scene.log(7)
    np.testing.assert_array_equal(log.pose, scene.odometry(7))
    assert len(log.range) == len(scene.simulation.range)
    np.testing.assert_array_equal(log.pose[0], scene.poses[0])


def test_one_scan_determines_the_whole_pose():
    scene = one_scan(2)
    assert len(scene.poses) == 1
    assert np.linalg.eigvalsh(pose_bound(scene)[0]).max() < 0.03**2


# The bound


def dense(scene):
    """The bound of the poses from one dense matrix."""
    jacobians, scans = _RangeJacobians.of(scene), len(scene.poses)
    row, pose, column = np.arange(len(jacobians.scan)), 3 * jacobians.scan, 3 * scans + 2 * jacobians.reflector
    jacobian = np.zeros((len(row), 3 * scans + 2 * len(jacobians.parameters)))
    for k in range(3):
        jacobian[row, pose + k] = jacobians.d_range_d_pose[:, k]
    for k in range(2):
        jacobian[row, column + k] = jacobians.d_range_d_reflector[:, k]
    information = jacobian.T @ jacobian
    information[3 * scans :, 3 * scans :] += np.eye(2 * len(jacobians.parameters))
    for k, (first, second, between) in enumerate(zip(*_odometry_information(scene.poses, DISTANCE, TURN), strict=True)):
        a, b = slice(3 * k, 3 * k + 3), slice(3 * k + 3, 3 * k + 6)
        information[a, a] += first
        information[b, b] += second
        information[a, b] += between
        information[b, a] += between.T
    covariance = np.linalg.inv(information[3:, 3:])
    return np.stack([covariance[k : k + 3, k : k + 3] for k in range(0, 3 * scans - 3, 3)])


def test_the_sparse_bound_equals_the_dense_one(office):
    got = bound(office)
    np.testing.assert_array_equal(got.poses[0], 0)
    np.testing.assert_allclose(got.poses[1:], dense(office), rtol=1e-6, atol=1e-12)


def test_better_odometry_and_less_noise_lower_the_bound(office):
    base = bound(office)
    better, quieter = bound(office, distance=DISTANCE / 4, turn=TURN / 4), bound(replace(office, sigma=2e-4))
    for less in (better, quieter):
        assert less.ate < base.ate
        assert (np.linalg.eigvalsh(base.poses - less.poses)[1:] > -1e-12).all()
        assert (less.distance < base.distance).all()


def test_the_bound_does_not_depend_on_the_frame(office):
    turn, shift = 0.7, np.array([1.0, -2.0])
    c, s = np.cos(turn), np.sin(turn)
    matrix = np.array([[c, s], [-s, c]])
    poses = np.column_stack([office.poses[:, :2] @ matrix + shift, office.poses[:, 2] + turn])
    moved = bound(Scene("moved", Room(office.room.walls @ matrix + shift, poles=office.room.poles @ matrix), poses))
    still = bound(replace(office, room=Room(office.room.walls, poles=office.room.poles)))
    np.testing.assert_allclose(
        moved.ate, still.ate, rtol=0.02
    )  # the noise differs, and with it echoes near the threshold
    np.testing.assert_allclose(moved.ate_heading, still.ate_heading, rtol=0.02)


def test_along_a_bare_corridor_the_bound_is_that_of_odometry():
    scene = corridor()
    out = np.argmax(np.linalg.norm(scene.poses[:, :2] - scene.poses[0, :2], axis=-1))
    along = np.append(np.cos(scene.poses[3, 2]), np.sin(scene.poses[3, 2]))
    middle = out // 2
    sd = np.sqrt(along @ bound(scene).poses[middle, :2, :2] @ along)
    distance = np.linalg.norm(scene.poses[middle, :2] - scene.poses[0, :2])
    assert 0.5 < sd / (DISTANCE * np.sqrt(distance)) < 1.01


# The measures


def fake(scene, off):
    """Results of the library with a known error."""
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
            (np.array([0.02, 0, 0]), "accepted"),
            (np.array([0.5, 0, 0]), "accepted"),
            (np.array([0, 0, np.pi / 2]), "accepted"),
            (np.array([0.5, 0, 0]), "withdrawn"),
            (np.zeros(3), "proposed"),
        )
    ]
    steps = np.concatenate([[900.0], np.linspace(1, 3, len(poses) - 1)])
    trajectory = Trajectory(scene.simulation.stamps, poses, covariance)
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
    rows = slam.run({"office": [lambda: office]}, ["smoothed", "front end"], single_scans=0)
    assert [row["way"] for row in rows] == ["smoothed", "front end"]
    np.testing.assert_allclose(rows[0]["ratio"], got.odometry / got.ate)
    json.dumps(slam.without_nan(rows), allow_nan=False)
    settings = {"sigma": 0.001, "distance": DISTANCE, "turn": TURN}
    versions = {"jax": "1", "device": "cpu", "commit": "abc"}
    table = summary.table(slam.without_nan({"versions": versions, "settings": settings, "scenarios": rows}))
    assert table.row_count == 2
    assert len(table.columns) == len(summary.COLUMNS) + 1


def test_a_failed_run_is_reported(office, monkeypatch):
    monkeypatch.setitem(sys.modules, "jaxsonar.graph_slam.slam", None)  # the import fails
    nothing = Bound(np.zeros((17, 3, 3)), np.zeros(0, int), np.zeros(0), np.zeros(0))
    got = slam.outcome(office, "smoothed", nothing)
    assert got.failed
    assert got.odometry > 0
    row = summary.measures([got])
    assert (row["failed"], row["why"]) == (1, got.failed)
    assert np.isnan(row["ate_mm"])


def test_wrong_closures_contradict_the_truth_in_the_directions_that_they_determine():
    poses = np.array([[0.0, 0, 0], [1.0, 1, np.pi / 2]])
    right = relative(poses[0], poses[1])

    def wrong(off, determined):
        return slam.wrong(poses, LoopClosure(0, 1, right + off, "accepted", determined))

    whole, along_x = np.eye(3), np.eye(3)[:, 1:]  # walls along x do not determine x
    assert not wrong([0.1, 0.1, 0.1], whole)
    assert wrong([0.0, 0.31, 0.0], whole)
    assert wrong([0.0, 0.0, np.radians(11)], whole)
    assert not wrong([0.0, 0.0, 2 * np.pi], whole)
    assert not wrong([5.0, 0.1, 0.1], along_x)
    assert wrong([5.0, 0.31, 0.0], along_x)
