"""Detection cones: their width and direction are recovered from simulated detections."""

import numpy as np
import pytest

from jaxsonar.diagnostics.beam_width import BIN_CENTERS, detection_probability, fit_cone, fit_each_cone


@pytest.mark.slow
def test_the_measured_cones_have_the_simulated_width(healthy):
    width, error = np.degrees(healthy.beam)
    assert abs(width - 60) < 3
    assert error < 3


@pytest.mark.slow
@pytest.mark.parametrize("half", [10.0, 25.0, 45.0])
def test_the_cone_fit_recovers_the_true_cone(rng, half):
    truth = np.array([np.radians(half), np.radians(2), 0.85, 0.03])
    asked = np.full(len(BIN_CENTERS), 60)
    answered = rng.binomial(asked, detection_probability(truth, BIN_CENTERS))
    curve, error = fit_cone(asked, answered)
    assert abs(curve[0] - truth[0]) < 4 * error
    assert error < np.radians(1)
    assert np.isnan(fit_cone(asked // 60, answered // 60)[1])


def test_a_turned_cone_is_found(rng):
    truth = np.array([np.radians(30), np.radians(2), 0.9, 0.02])
    asked = np.full((3, len(BIN_CENTERS)), 5)
    turn = np.radians([0.0, 12.0, -9.0])[:, None]
    answered = rng.binomial(asked, detection_probability(truth, BIN_CENTERS - turn))
    half, center, nats = fit_each_cone(asked, answered, truth)
    assert (np.abs(center[:, 0] - turn[:, 0]) < 4 * center[:, 1]).all()
    assert (np.abs(half[:, 0] - truth[0]) < 4 * half[:, 1]).all()
    assert (nats[1:] > 5).all()
    assert nats[0] < 3
