"""Sonar points of PointCloud and PointCloud2."""

import numpy as np
import pytest
from support.bags import KINDS, START, BagMessages, sonar_ring
from support.hard_cones import simulate
from support.rooms import loop

from jaxsonar import Room
from jaxsonar.geometry.se2 import inverse, transform_points
from jaxsonar.hardware.errors import SonarError
from jaxsonar.recordings.rosbag_log import read_bag

pytest.importorskip("rosbags")

RING = sonar_ring(8)
ROOM = Room(loop([(0, 0), (4.2, 0), (4.2, 3.0), (0, 3.0)]))


def pose_at(time):
    return np.array([1.5 + 0.2 * time, 1.4, 0.3 * time])


def simulated(scans=10):
    """Scans of all sensors, the first echo of each."""
    poses = np.array([pose_at(0.5 * k) for k in range(scans)])
    ranges = simulate(RING, ROOM, poses, sigma=0.003, seed=3).dense(8, 1)[..., 0]
    return poses, ranges


def points_of(ranges):
    """Points on the axes of the sensors, robot frame."""
    axis = np.stack([np.cos(RING.heading), np.sin(RING.heading)], axis=-1)
    return (np.asarray(RING.position) + ranges[:, None] * axis)[np.isfinite(ranges)]


def bag_of_points(kind, cloud, *, frame="base_link", to_frame=lambda points, _: points):
    poses, ranges = simulated()
    bag = BagMessages(kind)
    for k, row in enumerate(ranges):
        bag.odometry(0.5 * k, poses[k])
        getattr(bag, cloud)(0.5 * k, to_frame(points_of(row), poses[k]), frame=frame)
    return bag, poses, ranges


def assert_same(log, poses, ranges):
    scan, sensor = np.nonzero(np.isfinite(ranges))
    assert log.echo_scan.tolist() == scan.tolist()
    assert log.tx.tolist() == log.rx.tolist() == sensor.tolist()
    np.testing.assert_allclose(log.range, ranges[scan, sensor], atol=1e-5)
    np.testing.assert_allclose(log.pose, poses, atol=1e-6)
    np.testing.assert_allclose(log.stamp - START, 0.5 * np.arange(len(poses)), atol=1e-6)
    assert set(log.asked[:, 0]) == set(sensor)


@pytest.mark.parametrize(("kind", "cloud"), [(kind, cloud) for kind in KINDS for cloud in ("cloud", "cloud2")])
def test_points_are_ranges_of_the_sensors(tmp_path, kind, cloud):
    bag, poses, ranges = bag_of_points(kind, cloud)
    notes = []
    assert_same(read_bag(bag.write(tmp_path / "run"), ring=RING, on_note=notes.append), poses, ranges)
    assert f"points: {np.isfinite(ranges).sum()} of /sonar, each of the sensor with the nearest axis" in notes


def test_points_in_the_frame_of_a_mount(tmp_path):
    mount = np.array([0.4, -0.1, 2.0])
    bag, poses, ranges = bag_of_points(
        "mcap", "cloud2", frame="sonar_mount", to_frame=lambda points, _: transform_points(inverse(mount), points)
    )
    bag.transform(-1.0, "base_link", "sonar_mount", mount)
    assert_same(read_bag(bag.write(tmp_path / "run"), ring=RING), poses, ranges)


def test_points_in_the_frame_of_the_odometry(tmp_path):
    bag, poses, ranges = bag_of_points(
        "sqlite", "cloud", frame="odom", to_frame=lambda points, pose: transform_points(pose, points)
    )
    assert_same(read_bag(bag.write(tmp_path / "run"), ring=RING), poses, ranges)


def test_ranges_are_preferred_and_clouds_of_lasers_rejected(tmp_path, rng):
    bag, *_ = bag_of_points("sqlite", "cloud")
    with pytest.raises(SonarError, match="sonar points came; needed is the ring"):
        read_bag(bag.write(tmp_path / "without"))
    bag.cloud2(0.0, rng.uniform(0, 3, (2000, 2)), topic="/velodyne_points")
    assert read_bag(bag.write(tmp_path / "laser"), ring=RING).echo_count > 0
    bag.range(0.0, 1.25, frame="us0")
    bag.range(0.1, 1.5, frame="us1")
    assert read_bag(bag.write(tmp_path / "both"), ring=RING).range.tolist() == [1.25, 1.5]
    laser = BagMessages()
    laser.cloud2(0.0, rng.uniform(0, 3, (2000, 2)), topic="/points")
    with pytest.raises(SonarError, match="clouds of 2000 points came on /points; allowed are sonar points"):
        read_bag(laser.write(tmp_path / "only"), ring=RING)
