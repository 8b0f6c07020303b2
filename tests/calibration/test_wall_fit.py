"""Relative range offsets from walls: the same as a dense least squares, and blind to what walls can take up."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from jaxsonar import Ring
from jaxsonar.calibration.settings import SPARSE_SETTINGS as SETTINGS
from jaxsonar.calibration.wall_echoes import WallEchoes, assign_echoes
from jaxsonar.calibration.wall_fit import fit_offsets, shared_wall_sensors
from jaxsonar.geometry.se2 import transform_points, unit
from jaxsonar.scans.scan_log import Log

COUNT = 6
OFFSET = np.array([0.012, -0.006, 0.004, -0.010, 0.008, -0.008])
WALLS = np.array([[[-2.0, 1.5], [2.0, 1.5]], [[2.5, -1.5], [2.5, 1.5]], [[2.0, -1.6], [-2.0, -1.6]]])


@pytest.fixture(scope="module")
def ring():
    return Ring.circular(count=COUNT, radius=0.2, beam=np.radians(70), neighbors=0, max_range=3.0)


def wall_log(ring, *, noise=0.0, scale=1.0, common=0.0, seed=0):
    """Scans of a robot that wanders and turns between three walls."""
    rng = np.random.default_rng(seed)
    poses = np.column_stack([np.linspace(-1.2, 1.2, 90), 0.3 * np.sin(np.linspace(0, 9, 90)), np.linspace(0, 7.0, 90)])
    scan, sensor, ranges = [], [], []
    for k, pose in enumerate(poses):
        place = transform_points(pose, np.asarray(ring.position))
        axis = pose[2] + np.asarray(ring.heading)
        for start, end in WALLS:
            along = (end - start) / np.linalg.norm(end - start)
            normal = np.array([-along[1], along[0]])
            height = (start - place) @ normal
            normal, height = np.where(height[:, None] < 0, -normal, normal), np.abs(height)
            foot = ((place - start) @ along > 0) & ((place - start) @ along < np.linalg.norm(end - start))
            heard = foot & ((normal * unit(axis)).sum(-1) > np.cos(ring.beam / 2)) & (height < 2.9)
            for s in np.flatnonzero(heard):
                scan.append(k)
                sensor.append(s)
                ranges.append(scale * height[s] + OFFSET[s] + common + noise * rng.standard_normal())
    sensor = np.array(sensor)
    return Log.from_echoes(
        np.array(scan), sensor, sensor, np.array(ranges), stamp=0.1 * np.arange(len(poses)), pose=poses
    )


def echoes_of(ring, log):
    travelled = np.append(0.0, np.cumsum(np.hypot(*np.diff(log.pose[:, :2], axis=0).T)))
    return assign_echoes(ring, log, travelled, WALLS, ring)


def relative(offset):
    return offset - offset.mean()


@pytest.fixture(scope="module")
def echoes(ring) -> WallEchoes:
    return echoes_of(ring, wall_log(ring, noise=0.004))


def test_the_relative_offsets_are_found(echoes):
    found = fit_offsets(echoes, log_speed=0.0, free=True, sigma=None)
    sd = np.sqrt(np.diag(found.covariance))[:-1]
    assert np.abs((found.offset - relative(OFFSET)) / sd).max() < 4
    assert sd.max() < 0.004
    assert found.offset.sum() == pytest.approx(0, abs=1e-9)
    assert found.sigma == pytest.approx(0.004, rel=0.4)


def test_a_common_offset_moves_the_walls_only(ring, echoes):
    found = fit_offsets(echoes, log_speed=0.0, free=True, sigma=None)
    more = replace(echoes, reported=echoes.reported + 0.05)
    other = fit_offsets(more, log_speed=0.0, free=True, sigma=None)
    np.testing.assert_allclose(other.offset, found.offset, atol=1e-5)
    np.testing.assert_allclose(np.abs(other.plane[:, 0] - found.plane[:, 0]), 0.05, atol=1e-3)
    np.testing.assert_allclose(other.residual, found.residual, atol=1e-4)


def test_the_mean_offset_stays_at_its_prior(echoes):
    found = fit_offsets(echoes, log_speed=0.0, free=True, sigma=None)
    assert found.mean_offset_sd == pytest.approx(SETTINGS.mean_offset_sd, rel=0.05)


def test_it_is_the_minimum_of_the_dense_cost(ring, echoes):
    """SciPy's least squares over offsets, shifts and rotations of the walls, for a given scale of the residuals."""
    sigma, walls = 0.004, len(echoes.center)
    found = fit_offsets(echoes, log_speed=0.01, free=True, sigma=sigma)
    midpoint = transform_points(echoes.pose, np.asarray(ring.position)[echoes.path])

    def residuals(x):
        offset, shift, turn = x[:COUNT], x[COUNT : COUNT + walls], x[COUNT + walls :]
        normal = unit(echoes.theta + turn)[echoes.wall]
        distance = shift[echoes.wall] + ((echoes.center[echoes.wall] - midpoint) * normal).sum(-1)
        error = (echoes.reported - offset[echoes.path] - np.exp(-0.01) * np.abs(distance)) / sigma
        robust = np.sign(error) * np.sqrt((SETTINGS.freedom + 1) * np.log1p(error**2 / SETTINGS.freedom))
        prior = [relative(offset) / SETTINGS.relative_offset_sd, turn / SETTINGS.direction_sd, [offset.sum() / 1e-6]]
        return np.concatenate([robust, *prior])

    dense = least_squares(residuals, np.zeros(COUNT + 2 * walls), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    given = np.concatenate([found.offset, found.plane[:, 0], found.plane[:, 1]])
    # The dispersion of the jackknife shrinks the offsets towards the prior.
    assert (residuals(given) ** 2).sum() < (1 + 5e-3) * 2 * dense.cost
    np.testing.assert_allclose(found.offset, relative(dense.x[:COUNT]), atol=1e-3)


def test_held_offsets_are_zero(echoes):
    found = fit_offsets(echoes, log_speed=0.0, free=False, sigma=None)
    np.testing.assert_allclose(found.offset, 0, atol=1e-6)
    free = fit_offsets(echoes, log_speed=0.0, free=True, sigma=None)
    assert np.median(np.abs(free.residual)) < np.median(np.abs(found.residual))


def test_sensors_without_shared_walls_stay_at_the_prior(echoes):
    alone = echoes.take(np.isin(echoes.path, [0]))
    found = fit_offsets(alone, log_speed=0.0, free=True, sigma=None)
    np.testing.assert_allclose(found.offset, 0, atol=1e-4)
    expected = SETTINGS.relative_offset_sd * np.sqrt(1 - 1 / COUNT)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance))[:-1], expected, rtol=0.02)
    assert not shared_wall_sensors(alone).any()
    assert shared_wall_sensors(echoes).all()


def test_an_uncertain_scale_makes_the_offsets_uncertain(echoes):
    """The covariance of two Gaussian parameters: the error of the scale times the slope of the offsets."""
    step, sd = 1e-3, 1e-3
    low, high = (fit_offsets(echoes, log_speed=value, free=True, sigma=0.004).offset for value in (-step, step))
    slope = relative((high - low) / (2 * step))
    known = fit_offsets(echoes, log_speed=0.0, free=True, sigma=0.004).covariance
    unsure = fit_offsets(echoes, log_speed=0.0, log_speed_sd=sd, free=True, sigma=0.004).covariance
    assert 0 < unsure[-1, -1] <= sd**2
    assert known[-1, -1] < 1e-12
    # The weights change as well, which the linear model leaves out.
    np.testing.assert_allclose(relative(unsure[:-1, -1]) / unsure[-1, -1], slope, atol=0.06)
    assert (np.diag(unsure)[:-1] > 0.9 * np.diag(known)[:-1]).all()


def test_walls_do_not_change_the_scale(echoes):
    """An uncertain scale is a nuisance parameter of the offsets: residuals and walls are those of the given scale."""
    found = fit_offsets(echoes, log_speed=0.02, log_speed_sd=0.02, free=True, sigma=None)
    predicted = found.offset[echoes.path] + np.exp(-0.02) * found.distance
    np.testing.assert_allclose(echoes.reported - predicted, found.residual, atol=1e-9)


def test_the_two_faces_of_a_wall_are_two_walls(ring):
    log = wall_log(ring)
    behind = np.array([1.0, -1.0, 1.0]) * log.pose + np.array([0.0, 3.0, np.pi])  # beyond the wall at y = 1.5
    both = replace(log, pose=np.where(np.arange(len(log))[:, None] % 2, behind, log.pose))
    found = echoes_of(ring, both)
    normal = unit(found.theta)
    facing = (normal[found.wall] * (found.center[found.wall] - found.pose[:, :2])).sum(-1)
    assert (facing > 0).all()
