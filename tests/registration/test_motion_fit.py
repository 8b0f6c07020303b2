"""Local walls, and scale of the ranges and time offset that are estimated with them."""

import dataclasses

import numpy as np
import pytest
from support.wandering_robot import RING, WALLS, log_of, ranges, trajectory

from jaxsonar import kernels
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.plausibility.pose_agreement import select_groups
from jaxsonar.registration.local_reflectors import find_reflectors, group_echoes
from jaxsonar.registration.motion_fit import LAG, SCALE, fit_motion

POSE = trajectory(180)


def echoes_of(log):
    return group_echoes(RING, log, select_groups(log))


def fitted(log, **options):
    fit = fit_motion(echoes_of(log), **options)
    assert fit is not None
    return fit


@pytest.fixture(scope="module")
def log():
    """Ranges of a wandering robot, 3 mm noise, at true poses."""
    return log_of(ranges(POSE), POSE)


def test_the_walls_of_the_room_are_found(log):
    echoes = echoes_of(log)
    found = find_reflectors(echoes, echoes.pose)
    wall = found.kind == kernels.PLANE
    theta, rho = WALLS
    first = np.array([np.flatnonzero(echoes.group == group)[0] for group in found.group[wall]])
    near = np.abs(wrap_angle(found.parameters[wall, 1, None] - theta)).argmin(axis=1)
    normal = np.stack([np.cos(theta[near]), np.sin(theta[near])], axis=-1)
    expected = rho[near] - (echoes.origin[first] * normal).sum(axis=-1)
    close = np.abs(found.parameters[wall, 0] - expected) < 0.02
    close &= np.abs(wrap_angle(found.parameters[wall, 1] - theta[near])) < np.radians(3)
    assert wall.sum() > 10
    assert close.mean() > 0.9


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.04])
def test_the_scale_is_found_within_its_error(log, factor):
    fit = fitted(dataclasses.replace(log, range=log.range * factor))
    assert abs(fit.estimate[SCALE] - (factor - 1)) < 4 * max(fit.error[SCALE], 0.001)
    assert fit.error[SCALE] < 0.01
    assert abs(fit.estimate[LAG]) < 4 * max(fit.error[LAG], 0.003)
    assert fit.noise == pytest.approx(0.003, rel=0.4)


@pytest.mark.parametrize("scans", [1, -2])
def test_the_time_offset_is_found_within_its_error(scans):
    before, after = slice(0, len(POSE) - abs(scans)), slice(abs(scans), None)
    true, given = (POSE[after], POSE[before]) if scans > 0 else (POSE[before], POSE[after])
    fit = fitted(log_of(ranges(true), given))
    assert fit.estimate[LAG] == pytest.approx(0.1 * scans, abs=4 * max(fit.error[LAG], 0.003))


def test_a_fixed_parameter_keeps_its_value(log):
    wrong = dataclasses.replace(log, range=log.range * 1.05)
    fixed, free = fitted(wrong, free=(False, False)), fitted(wrong)
    assert fixed.estimate.tolist() == [0, 0]
    assert fixed.log_likelihood < free.log_likelihood


def test_too_few_groups_give_no_estimate(log):
    assert fit_motion(echoes_of(log[:20])) is None
    assert fit_motion(echoes_of(dataclasses.replace(log, pose=np.full_like(log.pose, np.nan)))) is None


@pytest.mark.parametrize("size", [2e4, 1e15])
def test_a_glitch_of_a_pose_costs_its_own_echoes_alone(log, size):
    pose = log.pose.copy()
    pose[90, 0] += size
    echoes = group_echoes(RING, dataclasses.replace(log, pose=pose), select_groups(log))
    assert 0 < len(echoes.path) <= len(echoes_of(log).path)
    assert np.abs(echoes.pose[:, :2]).max() < 10
    assert len(find_reflectors(echoes, echoes.pose).kind) > 10
