"""Smoothing: consistent poses and walls of the office from its ranges, undetermined directions, invalid input."""

import numpy as np
import pytest
from support.hard_cones import simulate

from jaxsonar import Log, Room, SonarError
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.geometry.se2 import compose, relative, wrap_angle
from jaxsonar.simulation.office import load_office
from jaxsonar.smoothing.smooth_log import Smoothed, smooth

SIGMA = 0.005


def drift(poses, rng, place=0.02, heading=0.0175):
    """Odometry of a random walk."""
    steps = relative(poses[:-1], poses[1:])
    root = np.sqrt(np.hypot(steps[:, 0], steps[:, 1]))[:, None]
    steps = steps + root * np.array([place, place, heading]) * rng.standard_normal(steps.shape)
    out = [poses[0]]
    for step in steps:
        out.append(compose(out[-1], step))
    return np.array(out)


@pytest.fixture(scope="module")
def recording():
    office = load_office()
    log = simulate(office.ring, office.room, office.poses, sigma=SIGMA, seed=0).as_log(office.ring, office.poses)
    return office.ring, log, drift(office.poses, np.random.default_rng(0))


@pytest.fixture(scope="module")
def found(recording):
    ring, log, odometry = recording
    start = odometry.copy()
    start[12] = np.nan  # predicted by odometry
    return smooth(
        ring,
        log,
        start,
        odometry=odometry,
        scale=True,
        odometry_noise=OdometryNoise(position_per_meter=0.02, heading_per_meter=0.0175),
    )


def error(found: Smoothed, log: Log):
    off = found.poses - log.pose
    return np.column_stack([off[:, :2], wrap_angle(off[:, 2])])


@pytest.mark.slow
def test_poses_and_walls_are_better_than_odometry_and_consistent(recording, found):
    _, log, odometry = recording
    assert len(found.left_out) == 0
    off, cov = error(found, log), found.pose_cov
    drifted = np.linalg.norm(odometry[1:, :2] - log.pose[1:, :2], axis=1)
    assert np.sqrt(np.mean(off[1:, :2] ** 2)) < 0.03
    assert np.sqrt(np.mean(off[1:, 2] ** 2)) < np.radians(1.8)
    assert np.linalg.norm(off[1:, :2], axis=1).mean() < drifted.mean() + 0.01
    nees = np.einsum("ni,nij,nj->n", off[1:], np.linalg.inv(cov[1:]), off[1:])
    assert nees.mean() < 8
    assert found.sigma == pytest.approx(SIGMA, rel=0.1)
    assert found.used > 0.7
    assert (found.explained_counts > 10).all()
    np.testing.assert_allclose(off[0], 0, atol=1e-3)
    assert np.sqrt(cov[0, 0, 0]) < 1e-3
    np.testing.assert_array_equal(cov, np.swapaxes(cov, 1, 2))
    world = found.world
    assert len(world) >= 6
    normal = np.stack([np.cos(world.theta), np.sin(world.theta)], -1)
    np.testing.assert_allclose(
        np.einsum("nek,nk->ne", world.segments, normal), world.rho[:, None] + [[0, 0]], atol=1e-9
    )
    assert (world.rho >= 0).all()
    assert (world.sigma_rho < 0.3).all()
    assert np.isfinite(world.point_cov).all()
    for value, sd in zip(found.scale, found.scale_sd, strict=True):
        assert abs(value) < 4 * sd
        assert 0 < sd <= 0.05 * (1 + 1e-9)


@pytest.fixture(scope="module")
def corridor(recording):
    """Two walls, no odometry: the position along them is undetermined."""
    ring, _, _ = recording
    room = Room(walls=np.array([[[-9.0, 1.0], [9.0, 1.0]], [[-9.0, -1.0], [9.0, -1.0]]]))
    poses = np.column_stack([np.linspace(-1, 1, 9), np.zeros(9), np.zeros(9)])
    log = simulate(ring, room, poses, sigma=SIGMA, seed=1).as_log(ring, poses)
    return log, smooth(ring, log, poses)


@pytest.mark.slow
def test_an_undetermined_direction_has_a_large_variance(corridor):
    """Decimetres, not 30 m: the two estimated walls are not exactly parallel, and a wedge determines the position."""
    log, found = corridor
    assert len(found.left_out) == 0
    sd = np.sqrt(np.diagonal(found.pose_cov, axis1=1, axis2=2))
    assert (sd[1:, 0] > 0.2).all()
    assert (sd[1:, 0] > 20 * sd[1:, 1]).all()
    assert (sd[1:, 1] < 0.03).all()
    assert (np.abs(error(found, log)[:, 1:]) < 5 * sd[:, 1:] + 1e-4).all()


@pytest.mark.slow
def test_the_position_along_a_bare_corridor_is_consistent(corridor):
    log, found = corridor
    sd = np.sqrt(np.diagonal(found.pose_cov, axis1=1, axis2=2))
    assert (np.abs(error(found, log)[1:, 0]) < 3 * sd[1:, 0]).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": np.full((17, 3), np.nan)}, "none of the 17 scans has a pose"),
        ({"poses": np.zeros((3, 3))}, r"poses of shape \(3, 3\)"),
        ({"odometry": np.zeros((2, 3))}, r"odometry of shape \(2, 3\)"),
        ({"scale": True}, "need odometry"),
        ({"sigma": -1.0}, "sigma"),
        ({"window": -1.0}, "window"),
    ],
)
def test_invalid_input_is_refused(recording, change, message):
    ring, log, _ = recording
    with pytest.raises(SonarError, match=message):
        smooth(ring, log, **({"poses": log.pose} | change))
