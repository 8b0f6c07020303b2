"""The scale of the ranges from sensors that approach static targets."""

from dataclasses import replace

import numpy as np
import pytest

from jaxsonar import Log, Ring
from jaxsonar.calibration.closing_tracks import estimate_scale, find_tracks, fit_slope, robust_mean
from jaxsonar.geometry.se2 import compose, transform_points, unit

HALF_CONE = np.radians(15.0)
CORRECTED = 1 - HALF_CONE**2 / 12
"""Mean cosine of the angle of a target whose distribution over the cone is a triangle."""


def facing_ring(**options):
    """Three sensors that look ahead and 7 deg to both sides."""
    heading = np.radians([-7.0, 0.0, 7.0])
    return Ring(0.2 * unit(heading), heading, beam=2 * HALF_CONE, neighbors=0, max_range=3.0, **options)


def approach(ring, scale, offset=0.0, *, legs=5, noise=0.0, seed=0):
    """A log of a robot that drives towards a wall, turns to another one, and so on; ranges times scale plus offset."""
    rng, poses, ranges = np.random.default_rng(seed), [], []
    for leg in range(legs):
        bearing, turned = 0.3 + 1.7 * leg, rng.triangular(-HALF_CONE, 0, HALF_CONE)
        for s in np.linspace(0, 1.2, 20):
            position = np.array([10.0 * leg, 0.0]) + s * unit(bearing)
            poses.append([*position, bearing])
            sensors = transform_points(np.array(poses[-1]), np.asarray(ring.position))
            normal = unit(bearing + turned)
            wall = np.array([10.0 * leg, 0.0]) @ normal + 2.5
            ranges.append(scale * (wall - sensors @ normal) + offset + noise * rng.standard_normal(ring.count))
    poses, ranges = np.array(poses), np.array(ranges)
    scan, sensor = np.repeat(np.arange(len(poses)), ring.count), np.tile(np.arange(ring.count), len(poses))
    return Log.from_echoes(scan, sensor, sensor, ranges.ravel(), stamp=0.1 * np.arange(len(poses)), pose=poses)


def test_the_slope_of_a_track_on_the_axis_is_the_scale():
    along = np.linspace(0, 1, 12)
    position = along[:, None] * unit(0.7)
    found = fit_slope(0.95 * (2.0 - along) + 0.07, position, np.full(12, 0.7), HALF_CONE)
    assert found is not None
    assert found[0] == pytest.approx(np.log(0.95 / CORRECTED), abs=1e-6)


def test_one_wrong_echo_hardly_changes_the_slope():
    along = np.linspace(0, 1, 12)
    ranges = 0.95 * (2.0 - along)
    ranges[4] -= 0.5
    found = fit_slope(ranges, along[:, None] * unit(0.0), np.zeros(12), HALF_CONE)
    assert found is not None
    assert found[0] == pytest.approx(np.log(0.95 / CORRECTED), abs=2e-3)


def test_sensors_that_look_across_the_motion_say_nothing():
    along = np.linspace(0, 1, 12)
    position = along[:, None] * unit(np.radians(80.0))
    assert fit_slope(2.0 - along * np.cos(np.radians(80)), position, np.zeros(12), HALF_CONE) is None


@pytest.mark.parametrize("offset", [0.0, 0.07, -0.03])
def test_the_scale_does_not_depend_on_the_offset(offset):
    found = estimate_scale(facing_ring(), [approach(facing_ring(), 0.94, offset)])
    assert abs(found.log_scale - np.log(0.94)) < 3 * found.sd
    assert found.sd < 0.02
    assert found.tracks == 15


def test_the_scale_is_relative_to_the_ring():
    log = approach(facing_ring(), 0.94, noise=0.003)
    found = estimate_scale(facing_ring(), [log])
    calibrated = facing_ring(speed_of_sound=343.2 / np.exp(found.log_scale))
    assert estimate_scale(calibrated, [log]).log_scale == pytest.approx(0.0, abs=2e-3)


def test_the_scale_is_invariant_under_motions_of_the_world():
    log = approach(facing_ring(), 0.97, noise=0.005)
    moved = replace(log, pose=compose(np.array([5.0, -2.0, 3.0]), log.pose))
    one, other = (estimate_scale(facing_ring(), [log]) for log in (log, moved))
    assert one.log_scale == pytest.approx(other.log_scale, abs=1e-9)


def test_a_robot_that_turns_in_place_yields_no_track():
    ring, turn = facing_ring(), np.linspace(0, 6, 40)
    log = approach(ring, 1.0)
    pose = np.column_stack([np.zeros((40, 2)), turn])
    spinning = replace(log[:40], pose=pose)
    assert find_tracks(ring, spinning) == []
    assert np.isinf(estimate_scale(ring, [spinning]).sd)


def test_moving_targets_are_outvoted():
    """A person walks ahead of the robot in one leg of six: the ranges do not close at all."""
    ring = facing_ring()
    log = approach(ring, 0.95, legs=6, noise=0.003)
    last = log.echo_scan >= len(log) - 20
    ranges = np.where(last, np.maximum(log.range, 0.9 * np.max(log.range[last])), log.range)
    found = estimate_scale(ring, [replace(log, range=ranges)])
    assert abs(found.log_scale - np.log(0.95)) < 3 * found.sd


def test_the_standard_deviation_is_that_of_repeated_runs():
    ring = facing_ring()
    errors = []
    for seed in range(12):
        found = estimate_scale(ring, [approach(ring, 0.95, noise=0.01, seed=seed)])
        errors.append((found.log_scale - np.log(0.95)) / found.sd)
    assert np.sqrt(np.mean(np.square(errors))) < 1.5
    assert abs(np.mean(errors)) < 1.0


def test_the_robust_mean_is_weighted_and_equivariant(rng):
    sd = rng.uniform(0.01, 0.1, 30)
    value = rng.normal(0.03, np.hypot(sd, 0.03))
    mean, spread, error = robust_mean(value, sd)
    assert abs(mean - 0.03) < 4 * error
    shifted = robust_mean(value + 0.5, sd)
    np.testing.assert_allclose(shifted, [mean + 0.5, spread, error], atol=1e-6)
    outlying = robust_mean(np.append(value, 3.0), np.append(sd, 0.02))
    assert abs(outlying[0] - mean) < error


def test_second_echoes_do_not_change_the_tracks():
    """Every measurement also hears something 0.4 m behind the target; the order of its echoes does not matter."""
    ring, log = facing_ring(), approach(facing_ring(), 0.96, legs=1, noise=0.003)
    echo, behind = np.repeat(np.arange(log.echo_count), 2), np.tile([0.4, 0.0], log.echo_count)
    columns = (log.echo_scan[echo], log.tx[echo], log.rx[echo], log.range[echo] + behind)
    both = Log.from_echoes(*columns, stamp=log.stamp, pose=log.pose)
    expected = find_tracks(ring, log)
    assert len(expected) == ring.count
    for one, other in zip(expected, find_tracks(ring, both), strict=True):
        assert one[:2] == other[:2]
        np.testing.assert_array_equal(one.start, other.start)


def test_cross_echoes_and_unposed_scans_are_left_out():
    ring = replace(facing_ring(), neighbors=1)
    log = approach(facing_ring(), 1.0)
    assert find_tracks(ring, replace(log, rx=(log.tx + 1) % 3)) == []
    assert find_tracks(ring, replace(log, pose=np.full_like(log.pose, np.nan))) == []
