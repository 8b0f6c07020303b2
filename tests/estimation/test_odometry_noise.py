"""Odometry noise: additive over steps, gaps bridged, invalid values refused."""

import numpy as np
import pytest

from jaxsonar import SonarError
from jaxsonar.estimation.odometry_noise import OdometryNoise, ProportionalNoise, step_variance


def test_variances_add_up_over_steps(rng):
    walk = np.cumsum(rng.uniform(-0.2, 0.2, (40, 3)), axis=0)
    walk[:, 0] = np.abs(walk[:, 0]).cumsum()
    walk[:, 1:] = 0, 0.3  # on a line, so that steps divide
    noise = OdometryNoise(minimum=(1e-9, 1e-9))
    fine = noise(walk, np.arange(40))
    coarse = noise(walk, np.arange(1, 40, 2))
    np.testing.assert_allclose((fine[1:] ** 2).reshape(-1, 2, 3).sum(axis=1), coarse**2, rtol=1e-9)


def test_a_step_bridges_scans_without_odometry():
    walk = np.column_stack([np.arange(5.0), np.zeros(5), np.zeros(5)])
    walk[2] = np.nan
    found = OdometryNoise(position_per_meter=0.1, heading_per_meter=0.2, minimum=(1e-9, 1e-9))(
        walk, np.array([0, 1, 3, 4])
    )
    np.testing.assert_allclose(found**2, np.outer([1, 2, 1], [0.01, 0.0025, 0.04]), rtol=1e-9)


def test_proportional_noise_grows_with_displacement_and_rotation():
    walk = np.array([[0, 0, 0], [2.0, 0, 0.5]])
    place, turn = 0.02 * 2 + 0.0005, 0.02 * (0.5 + 0.5 * 2) + 0.001
    np.testing.assert_allclose(ProportionalNoise(0.02)(walk, np.arange(2)), [[place, place, turn]])


@pytest.mark.parametrize(
    "wrong", [{"position_per_meter": -1.0}, {"heading_per_meter": float("nan")}, {"minimum": (0.0, 0.1)}]
)
def test_invalid_noise_is_refused(wrong):
    with pytest.raises(SonarError, match="odometry_noise"):
        OdometryNoise(**wrong)


def test_an_unmeasured_step_has_a_much_larger_variance():
    unknown = step_variance(OdometryNoise(), np.full(3, np.nan))
    assert (unknown > 50 * step_variance(OdometryNoise(), np.array([0.15, 0.0, 0.1]))).all()
