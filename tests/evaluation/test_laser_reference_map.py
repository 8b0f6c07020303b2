"""Reference maps from a laser: simulated rooms (ray casting by shapely), and the recorded corridor."""

import math

import numpy as np
import pytest
from support.recordings import recorded

from jaxsonar import random_pose, random_room
from jaxsonar.evaluation.laser_polygonal_model import fit_segment, polygonal_model
from jaxsonar.evaluation.laser_reference_map import reference_map
from jaxsonar.evaluation.map_accuracy import evaluate
from jaxsonar.geometry.se2 import rotation, transform_points
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.laser_datasets import LaserRecording, read_corridor8_laser

AROUND = np.radians(np.arange(-180, 180, 0.5))
HALF = np.radians(np.arange(-90, 90.25, 0.5))
MOUNT = np.array([0.1, -0.05, 0.2])
HALL = [[0, 0], [6, 0], [6, 2.5], [4, 2.5], [4, 3], [2.5, 3], [2.5, 2.5], [0, 2.5]]  # with a recess


def loop(points):
    points = np.array(points, dtype=np.float64)
    return np.stack([points, np.roll(points, -1, axis=0)], axis=1)


def cast(walls, pose, bearing, far=40.0):
    """Ranges to the walls by shapely, metres; NaN where a beam meets none."""
    shapely = pytest.importorskip("shapely")
    scene = shapely.MultiLineString([shapely.LineString(wall) for wall in walls])
    towards = pose[:2] + far * np.stack([np.cos(bearing + pose[2]), np.sin(bearing + pose[2])], axis=-1)
    beams = shapely.linestrings(np.stack([np.broadcast_to(pose[:2], towards.shape), towards], axis=1))
    hits = shapely.intersection(beams, scene)
    reach = shapely.distance(hits, shapely.Point(pose[:2]))
    return np.where(shapely.is_empty(hits), np.nan, reach)


def drive(walls, poses, bearing=AROUND, noise=0.0, rng=None):
    ranges = []
    for pose in poses:
        laser = np.append(transform_points(pose, MOUNT[:2]), pose[2] + MOUNT[2])
        ranges.append(cast(walls, laser, bearing))
    ranges = np.array(ranges)
    if rng is not None:
        ranges += rng.normal(0, noise, ranges.shape)
    return LaserRecording(np.arange(len(poses)) / 5.0, np.array(poses), ranges, bearing, MOUNT)


def path(count=30):
    return np.stack([np.linspace(0.8, 5.2, count), np.full(count, 1.2), np.linspace(-0.5, 0.5, count)], axis=-1)


# --- a single scan ---


def test_a_rectangle_gives_four_walls_and_four_corners():
    walls = loop([[0, 0], [5, 0], [5, 3], [0, 3]])
    pose = np.array([1.7, 1.1, 0.3])
    model = polygonal_model(AROUND, cast(walls, pose, AROUND))
    assert len(model.segments) == len(model.intersections) == 4
    assert len(model.pseudo) == 0
    found = transform_points(pose, model.segments)
    corners = transform_points(pose, model.intersections)  # the beam next to one may count for either wall
    assert np.linalg.norm(corners[:, None] - walls[:, 0], axis=-1).min(axis=1).max() < 1e-3
    inward = np.stack([-(found[:, 1] - found[:, 0])[:, 1], (found[:, 1] - found[:, 0])[:, 0]], axis=-1)
    assert (((np.array([2.5, 1.5]) - found[:, 0]) * inward).sum(axis=-1) > 0).all()  # free space to the left


def test_an_occlusion_gives_a_pseudo_segment():
    walls = loop([[0, 0], [6, 0], [6, 4], [3, 4], [3, 2], [0, 2]])  # an L: the leg hides a part of the hall
    pose = np.array([1.0, 1.0, 0.0])
    model = polygonal_model(HALF, cast(walls, pose, HALF))
    assert len(model.pseudo) == 1
    start, end = transform_points(pose, model.pseudo)[0]
    assert np.linalg.norm(start - [6, 8 / 3 + 1]) < 0.5 or np.linalg.norm(end - [3, 2]) < 0.05
    edge = np.array([3.0, 2.0])
    assert abs(np.linalg.det(np.stack([start - edge, pose[:2] - edge]))) < 0.1  # along the line of sight


def test_the_model_is_equivariant_under_rotations():
    walls, pose = loop(HALL), np.array([1.2, 1.3, 0.4])
    one = polygonal_model(AROUND, cast(walls, pose, AROUND))
    step = AROUND[1] - AROUND[0]
    turned = pose + np.array([0, 0, 40 * step])
    two = polygonal_model(AROUND, cast(walls, turned, AROUND))
    assert len(one.segments) == len(two.segments)
    first, second = transform_points(pose, one.segments), transform_points(turned, two.segments)
    apart = np.abs(first[:, None] - second).max(axis=(2, 3)).min(axis=1)
    assert apart.max() < 1e-6  # the seam at the back is nowhere


@pytest.mark.parametrize("ranges", [np.full(361, np.nan), np.where(np.arange(361) == 7, 1.0, np.nan)])
def test_no_returns_give_an_empty_model(ranges):
    model = polygonal_model(HALF, ranges)
    assert len(model.segments) == len(model.pseudo) == len(model.intersections) == 0


def test_the_fit_is_total_least_squares(rng):
    points = np.stack([np.linspace(-1, 1, 50), rng.normal(0, 0.01, 50)], axis=-1)
    start, end = fit_segment(points)
    for angle in (0.3, 1.57, 2.9):
        turn = rotation(angle)
        np.testing.assert_allclose(fit_segment(points @ turn.T), np.stack([start, end]) @ turn.T, atol=1e-9)
    normal = np.array([-(end - start)[1], (end - start)[0]]) / np.linalg.norm(end - start)
    best = ((points - start) @ normal).std()
    for angle in np.radians([-0.1, 0.1]):
        other = rotation(angle) @ normal
        assert ((points - points.mean(0)) @ other).std() > best


@pytest.mark.parametrize(
    ("bearing", "ranges", "words"),
    [
        (HALF[::-1].copy(), np.ones(361), "ascend"),
        (HALF, -np.ones(361), "below 0"),
        (HALF, np.full(361, np.inf), "infinite"),
    ],
)
def test_invalid_laser_scans_are_refused(bearing, ranges, words):
    with pytest.raises(SonarError, match=words) as caught:
        polygonal_model(bearing, ranges)
    assert "allowed are" in str(caught.value)


# --- a whole run ---


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "tolerance"), [(0.0, 0.002), (0.01, 0.006)])
def test_the_walls_of_a_hall_with_a_recess_are_found(noise, tolerance, rng):
    truth = loop(HALL)
    walls = reference_map(drive(truth, path(), noise=noise, rng=rng))
    result = evaluate(walls, truth)
    assert len(walls) == len(truth)
    assert result.recall == result.precision == 1
    assert result.recall_length > 0.98
    assert np.abs(result.distance).max() < tolerance
    assert np.abs(result.angle).max() < math.radians(0.1 if not noise else 1.0)
    assert (np.diff(np.linalg.norm(walls[:, 1] - walls[:, 0], axis=1)) <= 0.05).all()  # the longest first


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_random_rooms_are_accurate_to_millimetres(seed):
    rng = np.random.default_rng(seed)
    room = random_room(rng, box=0.0, segment=0.0, pole=0.0)
    poses = np.array([random_pose(rng, room) for _ in range(20)])
    result = evaluate(reference_map(drive(room.walls, poses), reach=8.0), room.walls)
    assert result.precision_length > 0.98
    assert result.recall_length > 0.95
    long = result.overlap > 0.4
    assert np.abs(result.distance[long]).max() < 0.005


def test_a_door_stays_open_and_a_wall_is_cut_at_reach():
    truth = np.array([[[0.0, 0.0], [2.5, 0.0]], [[3.4, 0.0], [12.0, 0.0]]])
    poses = np.stack([np.linspace(0, 6, 40), np.full(40, 1.0), np.zeros(40)], axis=-1)
    walls = reference_map(drive(truth, poses), reach=2.0)
    ends = np.sort(walls[:, :, 0], axis=1)
    ends = ends[np.argsort(ends[:, 0])]
    np.testing.assert_allclose(ends[0], [0.0, 2.5], atol=0.05)
    assert ends[1, 0] == pytest.approx(3.4, abs=0.05)
    assert 6.5 < ends[1, 1] < 6 + math.sqrt(3) + 0.01  # few scans saw the last of it
    assert len(walls) == 2


def test_both_faces_of_a_thin_wall():
    truth = np.array([[[0.0, 0.0], [4.0, 0.0]], [[4.0, 0.12], [0.0, 0.12]]])
    below = np.stack([np.linspace(0.5, 3.5, 20), np.full(20, -1.0), np.zeros(20)], axis=-1)
    walls = reference_map(drive(truth, np.concatenate([below, below * [1, -1, 1]])))
    assert len(walls) == 2
    along = (walls[:, 1] - walls[:, 0])[:, 0]
    assert along.min() < 0 < along.max()
    np.testing.assert_allclose(np.sort(walls[:, :, 1].mean(axis=1)), [0, 0.12], atol=0.002)


@pytest.mark.slow
def test_walls_that_few_scans_saw_are_left_out():
    hall = loop(HALL)
    laser = drive(hall, path())
    person = np.array([[[3.0, 1.5], [3.5, 1.6]]])
    ranges = laser.ranges.copy()
    ranges[:4] = drive(np.concatenate([hall, person]), path()[:4]).ranges
    seen = reference_map(LaserRecording(laser.stamp, laser.pose, ranges, laser.bearing, laser.mount))
    assert evaluate(person, seen).precision == 0
    assert evaluate(seen, hall).precision == 1


def test_a_run_without_returns():
    laser = drive(loop(HALL), path(4))
    nothing = np.full_like(laser.ranges, np.nan)
    assert reference_map(LaserRecording(laser.stamp, laser.pose, nothing, laser.bearing, MOUNT)).shape == (0, 2, 2)
    lost = LaserRecording(laser.stamp, np.full_like(laser.pose, np.nan), laser.ranges, laser.bearing, MOUNT)
    with pytest.raises(SonarError, match="without a pose"):
        reference_map(lost)


@pytest.mark.slow
def test_the_recorded_corridor():
    """Two parallel walls with doors and recesses; normals 91.4 and 270.0 deg, 1.220 and 1.083 m from the start."""
    walls = reference_map(read_corridor8_laser(recorded("corridor8")))
    along = walls[:, 1] - walls[:, 0]
    length = np.linalg.norm(along, axis=1)
    inward = np.arctan2(along[:, 0], -along[:, 1])
    for normal, distance, side in ((91.4, 1.220, 1), (270.0, 1.083, -1)):
        outward = np.array([math.cos(math.radians(normal)), math.sin(math.radians(normal))])
        faces = np.cos(inward - math.radians(normal)) < -math.cos(math.radians(10))  # they look at the robot
        middle = walls.mean(axis=1)
        near = faces & (np.abs(middle @ outward - distance) < 0.35) & (middle[:, 1] * side > 0) & (middle[:, 0] < 18)
        direction = (outward @ [0, 1] * along[near, 0] * -1).sum(), (along[near, 1] * -side).sum()
        assert abs(direction[1] / direction[0]) < math.tan(math.radians(3))
        assert np.average(middle[near] @ outward, weights=length[near]) == pytest.approx(distance, abs=0.08)
        assert length[near].sum() > 9.5
    assert length.max() > 4
    assert 20 < len(walls) < 60
