"""Sequential registration by local models: exact models give exact poses, and ambiguous scans stay unregistered."""

import numpy as np
import pytest
from support.hard_cones import simulate

from jaxsonar import LocalModel, SonarError, local_models
from jaxsonar.detection.local_model import Line, Point
from jaxsonar.geometry.se2 import compose, inverse, relative, transform_points, wrap_angle
from jaxsonar.registration.sequential_registration import register_scans
from jaxsonar.simulation.office import load_office

CORNERS = np.array([[0.0, 0.0], [4.1, 0.0], [4.6, 2.2], [2.6, 3.9], [-0.5, 2.9]])
"""A room without parallel walls, metres."""
OTHER = np.array([[0.0, 0.0], [3.6, 0.7], [3.1, 3.5], [-0.3, 3.1]])
"""A room with other angles."""
NO_PATHS = np.zeros((0, 2), dtype=int)


def visible_line(pose, start, end, reach):
    """The exact line of a wall in the robot frame, or None if its foot point is outside the wall or out of reach."""
    start, end = (transform_points(inverse(pose), point) for point in (start, end))
    along = (end - start) / np.linalg.norm(end - start)
    foot = start - (start @ along) * along
    share = (foot - start) @ (end - start) / ((end - start) @ (end - start))
    rho = float(np.linalg.norm(foot))
    if not (0.05 < share < 0.95 and rho < reach):
        return None
    segment = foot + np.array([[-0.2], [0.2]]) * along
    theta = float(wrap_angle(float(np.arctan2(foot[1], foot[0]))))
    return Line(rho, theta, segment, 50.0, 10, NO_PATHS, (0,), np.diag([1e-6, 1e-4]))


def model_at(pose, *, corners=CORNERS, reach=2.5, poles=()):
    walls = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    lines = [line for start, end in walls if (line := visible_line(pose, start, end, reach)) is not None]
    points = [transform_points(inverse(pose), np.array(pole)) for pole in poles]
    points = [Point(float(x), float(y), "edge", 1e-6 * np.eye(2), 8, NO_PATHS, 1.0) for x, y in points]
    return LocalModel(0, 0.0, tuple(lines), points=tuple(points))


def largest(models, odometry=None, **choices):
    """Poses of the largest cluster; NaN for all scans if there is none."""
    clusters = register_scans(models, odometry, **choices)
    return clusters[0] if clusters else np.full((len(models), 3), np.nan)


def trajectory(count=24):
    """A loop around the middle of the room."""
    angle = np.linspace(0, 2 * np.pi, count)
    x, y = 1.9 + 0.8 * np.cos(angle), 1.6 + 0.7 * np.sin(angle)
    return np.stack([x, y, wrap_angle(angle + np.pi / 2)], axis=-1)


def from_first(poses):
    return relative(np.broadcast_to(poses[0], poses.shape), poses)


def assert_same(found, poses, *, position, turn):
    found, poses = from_first(found), from_first(poses)
    np.testing.assert_allclose(found[:, :2], poses[:, :2], atol=position)
    np.testing.assert_allclose(wrap_angle(found[:, 2] - poses[:, 2]), 0.0, atol=turn)


@pytest.mark.slow
@pytest.mark.parametrize("poles", [(), ((1.0, 0.9), (2.9, 2.4))])
def test_exact_models_give_exact_poses(poles):
    poses = trajectory()
    found = largest([model_at(pose, poles=poles) for pose in poses])
    np.testing.assert_array_equal(found[0], 0.0)
    assert_same(found, poses, position=1e-6, turn=1e-6)


@pytest.mark.slow
def test_the_first_pose_is_that_of_the_odometry():
    poses = trajectory()
    found = largest([model_at(pose) for pose in poses], poses)
    np.testing.assert_allclose(found[0], poses[0], atol=1e-12)
    assert_same(found, poses, position=1e-6, turn=1e-6)


@pytest.mark.slow
def test_poses_move_with_the_frame_of_the_odometry():
    """A rigid motion of the odometry moves the poses along."""
    poses = trajectory()
    models = [model_at(pose) for pose in poses]
    moved = np.concatenate(
        [transform_points(np.array([3.0, -7.0, 2.0]), poses[:, :2]), wrap_angle(poses[:, 2:] + 2.0)], axis=1
    )
    here, there = largest(models, poses), largest(models, moved)
    np.testing.assert_allclose(there[0], moved[0], atol=1e-9)
    np.testing.assert_allclose(from_first(there), from_first(here), atol=1e-9)


@pytest.mark.slow
def test_scans_without_features_are_left_out_and_do_not_disturb_others():
    poses = trajectory()
    models = [model_at(pose) for pose in poses]
    empty = [0, 7, 15]
    for k in empty:
        models[k] = LocalModel(k, 0.0, (), "no echo")
    for odometry in (None, poses):
        found = largest(models, odometry)
        assert np.isnan(found[empty]).all()
        left = np.setdiff1d(np.arange(len(poses)), empty)
        assert np.isfinite(found[left]).all()
        assert_same(found[left], poses[left], position=1e-6, turn=1e-6)


@pytest.mark.slow
def test_a_bare_corridor_needs_odometry():
    """Two parallel walls do not determine the position along them."""
    corridor = np.array([[-9.0, -1.0], [9.0, -1.0], [9.0, 1.0], [-9.0, 1.0]])
    poses = np.stack([np.linspace(-3, 3, 16), np.zeros(16), np.zeros(16)], axis=-1)
    models = [model_at(pose, corners=corridor) for pose in poses]
    assert all(len(model.lines) == 2 for model in models)
    assert np.isnan(largest(models)).all()
    drifting = poses * np.array([1.02, 1.0, 1.0])
    found = largest(models, drifting)
    assert_same(found, drifting, position=1e-6, turn=1e-6)


def test_empty_input_gives_no_poses():
    assert largest([]).shape == (0, 3)
    assert np.isnan(largest([LocalModel(k, 0.0, (), "no echo") for k in range(3)])).all()


@pytest.mark.slow
def test_a_gap_in_odometry_is_bridged_by_the_walls():
    """The frame of odometry may change after a gap."""
    poses = trajectory()
    odometry = poses.copy()
    odometry[12:] += np.array([5.0, 5.0, 0.0])
    odometry[12] = np.nan
    found = largest([model_at(pose) for pose in poses], odometry)
    assert_same(found, poses, position=1e-6, turn=1e-6)


def test_odometry_of_another_shape_is_an_error():
    with pytest.raises(SonarError, match=r"odometry of shape \(3, 3\); allowed is \(2, 3\)"):
        largest([model_at(pose) for pose in trajectory(2)], np.zeros((3, 3)))


def test_progress_reaches_the_end():
    said = []
    largest(
        [model_at(pose) for pose in trajectory(6)], progress=lambda done, all_of_them: said.append((done, all_of_them))
    )
    assert said[-1] == (6, 6)
    assert said == sorted(said)


@pytest.mark.slow
def test_two_rooms_are_two_clusters():
    """Without odometry the relative pose of two rooms is unknown; each cluster is correct in itself."""
    poses = trajectory()
    rooms = (CORNERS, OTHER)
    clusters = register_scans([model_at(pose, corners=corners, reach=3.5) for corners in rooms for pose in poses])
    registered = np.isfinite([poses_of[:, 0] for poses_of in clusters])
    np.testing.assert_array_equal(sorted(registered.tolist()), np.kron(np.eye(2), np.ones(len(poses)))[::-1])
    for poses_of in clusters:
        assert_same(poses_of[np.isfinite(poses_of[:, 0])], poses, position=1e-3, turn=1e-3)


@pytest.fixture(scope="module")
def office():
    """The trajectory through the office, and the local models along it."""
    office = load_office()
    heard = simulate(office.ring, office.room, office.poses, sigma=0.001, seed=1, stamps=office.stamps)
    return office.poses, list(local_models(office.ring, heard.as_log(office.ring, office.poses)))


def drifting(poses, share, rng):
    """Odometry with errors proportional to the distance and the rotation of each step."""
    motion = relative(poses[:-1], poses[1:])
    size = np.linalg.norm(motion[:, :2], axis=1, keepdims=True), np.abs(motion[:, 2:])
    motion += share * rng.normal(size=motion.shape) * np.concatenate([size[0], size[0], size[0] + size[1]], axis=1)
    odometry = [poses[0]]
    for step in motion:
        odometry.append(compose(odometry[-1], step))
    return np.array(odometry)


def assert_aligned(found, poses, *, position, turn):
    """The poses agree after rigid alignment by least squares."""
    centered, expected = (xy - xy.mean(axis=0) for xy in (found[:, :2], poses[:, :2]))
    # Kabsch in the complex plane.
    angle = np.angle((np.conj(centered @ [1, 1j]) * (expected @ [1, 1j])).sum())
    moved = transform_points(np.array([0.0, 0.0, angle]), centered)
    assert np.linalg.norm(moved - expected, axis=1).max() < position
    assert np.abs(wrap_angle(found[:, 2] + angle - poses[:, 2])).max() < turn


@pytest.mark.slow
def test_the_office_with_odometry(office, rng):
    poses, models = office
    found = largest(models, drifting(poses, 0.02, rng))
    assert np.isfinite(found).all()
    assert_aligned(found, poses, position=0.06, turn=np.radians(3))


@pytest.mark.slow
def test_the_office_without_odometry(office):
    """Some scans are left out, but none is wrong. With a smaller margin more scans are registered."""
    poses, models = office
    clusters = register_scans(models)
    registered = np.isfinite([found[:, 0] for found in clusters])
    assert (registered.sum(axis=0) <= 1).all()
    large = [found for found, those in zip(clusters, registered, strict=True) if those.sum() > 2]
    assert large
    for found in large:
        those = np.isfinite(found[:, 0])
        assert_aligned(found[those], poses[those], position=0.1, turn=np.radians(5))
    with_small_margin = np.isfinite([found[:, 0] for found in register_scans(models, margin=0.5)])
    assert (with_small_margin.sum(axis=0) <= 1).all()
    assert with_small_margin.sum() > registered.sum()
