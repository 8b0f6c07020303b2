"""Noise and detection probability of the echoes of a run."""

import numpy as np
import pytest

from jaxsonar import Log, Ring
from jaxsonar.calibration.echo_model import fit_core_and_tails, measure_echo_model

WALL = np.array([[[-10.0, 1.0], [10.0, 1.0]]])


def side_log(turn, heard, *, noise=0.0, seed=0):
    """A robot drives along a wall; its only sensor looks to the left, and the robot is turned by some angle.

    Args:
        turn: heading of the robot in every scan, radians.
        heard: whether the wall is heard in every scan.
        noise: standard deviation of the ranges, metres.
        seed: seed of the noise.
    """
    ring = Ring(np.zeros((1, 2)), [np.pi / 2], beam=np.radians(60), neighbors=0, max_range=3.0)
    count, rng = len(turn), np.random.default_rng(seed)
    pose = np.column_stack([np.linspace(-5, 5, count), np.zeros(count), turn])
    ranges = np.where(heard, 1.0 + noise * rng.standard_normal(count), np.nan)
    scan, sensor = np.arange(count), np.zeros(count, int)
    return ring, Log.from_echoes(scan, sensor, sensor, ranges, stamp=0.1 * scan, pose=pose)


@pytest.mark.parametrize(("core", "share", "scale"), [(0.01, 0.2, 0.2), (0.02, 0.4, 0.15), (0.005, 0.05, 0.1)])
def test_core_and_tails_of_a_mixture_are_found(rng, core, share, scale):
    count = 20_000
    tail = rng.random(count) < share
    residual = np.where(tail, rng.laplace(0, scale, count), rng.normal(0, core, count))
    found = fit_core_and_tails(residual)
    assert found[0] == pytest.approx(core, rel=0.05)
    assert found[1] == pytest.approx(share, rel=0.1)
    assert found[2] == pytest.approx(scale, rel=0.1)


def test_the_mixture_scales_with_the_residuals(rng):
    residual = rng.standard_t(2, 3000) * 0.01
    one, other = fit_core_and_tails(residual), fit_core_and_tails(1.7 * residual)
    np.testing.assert_allclose(other, [1.7 * one[0], one[1], 1.7 * one[2]], rtol=1e-3)


def test_no_residual_gives_no_tails():
    assert fit_core_and_tails(np.zeros(0))[1] == 0


def test_detections_are_counted_over_the_angle():
    """Heard at 2 deg, not heard at 22 deg, heard in every second scan at 12 deg."""
    turn = np.radians(np.tile([2.0, 22.0, 12.0, -12.0], 30))
    heard = np.tile([True, False, True, False], 30)
    ring, log = side_log(turn, heard)
    model = measure_echo_model(ring, [log], [WALL])
    np.testing.assert_array_equal(model.expected, [30, 0, 60, 0, 30, 0])
    np.testing.assert_array_equal(model.heard, [30, 0, 30, 0, 0, 0])
    np.testing.assert_array_equal(np.isnan(model.detection), model.expected == 0)
    assert model.too_short == model.too_long == 0


def test_noise_is_measured_and_short_echoes_are_counted():
    ring, log = side_log(np.zeros(400), np.ones(400, bool), noise=0.01)
    ranges = log.range.copy()
    ranges[::10] -= 0.3
    model = measure_echo_model(
        ring, [Log.from_echoes(log.echo_scan, log.tx, log.rx, ranges, stamp=log.stamp, pose=log.pose)], [WALL]
    )
    assert model.core_sd == pytest.approx(0.01, rel=0.15)
    assert model.too_short == pytest.approx(0.1, abs=0.02)
    assert model.too_long < 0.02
    assert model.echoes == 400
    assert all(word in " ".join(model.describe()) for word in ("core", "too short", "0-5 deg"))


def test_two_logs_add_up():
    ring, log = side_log(np.zeros(50), np.ones(50, bool))
    one, two = (measure_echo_model(ring, [log] * n, [WALL] * n) for n in (1, 2))
    np.testing.assert_array_equal(two.expected, 2 * one.expected)
    assert two.echoes == 2 * one.echoes
