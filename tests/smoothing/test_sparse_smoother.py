"""Smoothing for sparse rings: better than the odometry where walls tell, the odometry itself where they do not."""

from dataclasses import replace

import numpy as np
import pytest
from support.wandering_robot import RING, log_of, ranges, trajectory

from jaxsonar import SonarError
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.simulation.wheel_odometry import simulate_odometry
from jaxsonar.smoothing.smooth_log import smooth

TRUE = trajectory(120)
SPARSE = replace(RING, beam=np.full(RING.count, np.radians(24.0)))
WIDE = replace(RING, beam=np.full(RING.count, np.radians(45.0)))


def uneven(reported, rng, *, relief=0.02, tail=0.1):
    """Ranges to walls whose surface changes every 0.6 m of the way, and some of persons in front of them."""
    stretch = np.arange(len(reported)) // 15
    off = relief * rng.standard_normal((stretch.max() + 1, reported.shape[1]))[stretch]
    person = rng.random(reported.shape) < tail
    return np.maximum(reported + off - np.where(person, rng.exponential(0.3, reported.shape), 0.0), 0.1)


def drifting(seed):
    return simulate_odometry(TRUE, distance=0.02, turn=float(np.radians(1.0)), seed=seed)


def rms(poses):
    """RMS error of position (metres) and heading (radians); the first pose is the true one."""
    off = poses - TRUE
    return np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1))), np.sqrt(np.mean(wrap_angle(off[:, 2]) ** 2))


@pytest.fixture(scope="module")
def results():
    found = []
    for seed in range(2):
        odometry = drifting(seed)
        reported = uneven(ranges(TRUE, sigma=0.01, seed=seed, ring=SPARSE), np.random.default_rng(seed))
        found.append((odometry, smooth(SPARSE, log_of(reported, odometry), odometry, odometry=odometry, window=1.5)))
    return found


def test_uneven_walls_and_persons_leave_poses_better_than_the_odometry(results):
    before = np.mean([rms(odometry) for odometry, _ in results], axis=0)
    after = np.mean([rms(found.poses) for _, found in results], axis=0)
    assert (after < 0.8 * before).all()


def test_the_covariance_is_consistent(results):
    nees = []
    for _, found in results:
        off = found.poses - TRUE
        off[:, 2] = wrap_angle(off[:, 2])
        rows = np.arange(20, len(TRUE), 10)
        nees.append(np.mean([off[k] @ np.linalg.solve(found.pose_cov[k], off[k]) for k in rows]) / 3)
    assert 0.25 < np.mean(nees) < 2


def test_odometry_that_walls_cannot_improve_is_kept():
    """The poses are exactly those of the odometry, and the result says so."""
    good = OdometryNoise(1e-3, heading_per_meter=3e-5, heading_per_radian=3e-5, minimum=(1e-5, 1e-5))
    reported = uneven(ranges(TRUE, sigma=0.02, ring=SPARSE), np.random.default_rng(1))
    found = smooth(SPARSE, log_of(reported, TRUE), TRUE, odometry=TRUE, window=1.5, odometry_noise=good)
    assert found.heading_gain is not None
    assert 0 <= found.heading_gain < 0.2
    assert found.keeps_odometry
    np.testing.assert_array_equal(found.poses, TRUE)


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.001, 0.03])
def test_the_noise_of_the_ranges_is_estimated(sigma):
    """A scan has hardly more echoes than its pose has unknowns; the odometry contributes."""
    pose = TRUE[:100]
    odometry = simulate_odometry(pose, distance=0.01, turn=float(np.radians(0.5)), seed=4)
    log = log_of(ranges(pose, sigma=sigma, seed=3, ring=WIDE), odometry)
    found = smooth(WIDE, log, odometry, odometry=odometry, window=1.5)
    assert found.sigma == pytest.approx(sigma, rel=0.25)


def test_a_noise_that_was_given_is_not_a_result():
    pose = TRUE[:30]
    log = log_of(ranges(pose, sigma=0.002, seed=3, ring=WIDE), pose)
    assert smooth(WIDE, log, pose, odometry=pose, window=1.5, sigma=0.005).sigma is None


def test_without_any_wall_nothing_is_called_a_result():
    odometry = drifting(6)
    reported = np.random.default_rng(0).uniform(0.3, 4.5, (len(TRUE), SPARSE.count))
    with pytest.raises(SonarError, match="no wall found"):
        smooth(SPARSE, log_of(reported, odometry), odometry, odometry=odometry, window=1.5)
