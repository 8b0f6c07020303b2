"""Reference walls by the poses of a log: they are the true walls, seen from each scan."""

import numpy as np
from support.wandering_robot import RING, WALLS, log_of, ranges, trajectory

from jaxsonar.diagnostics.local_scene import groups_of_scans, scene_from_groups
from jaxsonar.geometry.se2 import unit, wrap_angle


def test_the_walls_are_those_of_the_room():
    pose = trajectory(200)
    scene = scene_from_groups(RING, log_of(ranges(pose), pose))
    scan, row = np.nonzero(scene.is_wall)
    assert len(scan) > 300
    rho, theta = scene.parameters[scan, row].T
    theta = theta + pose[scan, 2]
    rho = rho + (pose[scan, :2] * unit(theta)).sum(axis=-1)
    nearest = np.abs(wrap_angle(theta[:, None] - WALLS[0])).argmin(axis=1)
    right = (np.abs(wrap_angle(theta - WALLS[0][nearest])) < np.radians(3)) & (np.abs(rho - WALLS[1][nearest]) < 0.04)
    assert right.mean() > 0.95
    assert (scene.extent[scan, row, 0] <= scene.extent[scan, row, 1]).all()


def test_scans_of_a_group_share_their_walls():
    pose = trajectory(120)
    log = log_of(ranges(pose), pose)
    scene = scene_from_groups(RING, log)
    for rows in groups_of_scans(log):
        assert (scene.number[rows] == scene.number[rows[0]]).all()
    shared = scene.number[scene.number >= 0]
    assert len(np.unique(shared)) < len(shared) / 4


def test_groups_are_disjoint_and_in_order():
    pose = np.repeat(trajectory(150), 2, axis=0)  # the robot stops at each scan
    rows = np.concatenate(groups_of_scans(log_of(ranges(pose), pose)))
    assert (np.diff(rows) > 0).all()
    assert groups_of_scans(log_of(ranges(pose), np.full_like(pose, np.nan))) == []
