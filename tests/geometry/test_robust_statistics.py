"""Weights and spreads of residuals with heavy tails, compared with scipy."""

import numpy as np
import pytest
from scipy import stats

from jaxsonar.geometry.robust_statistics import robust_deviation, student_weights


@pytest.mark.parametrize("freedom", [1.0, 3.0, 30.0])
def test_weights_are_the_slope_of_the_log_density_over_the_residual(freedom):
    residual, step = np.array([-4.0, -0.5, 0.3, 2.0, 20.0]), 1e-5
    slope = (stats.t.logpdf(residual + step, freedom) - stats.t.logpdf(residual - step, freedom)) / (2 * step)
    np.testing.assert_allclose(student_weights(residual**2, freedom), -slope / residual, rtol=1e-5)


def test_the_robust_deviation_is_that_of_scipy(rng):
    values = rng.standard_t(3, 201)
    expected = stats.median_abs_deviation(values, scale=float(stats.norm.ppf(0.75)))
    assert robust_deviation(values) == pytest.approx(expected, rel=1e-4)
    assert robust_deviation(3 - 2 * values) == pytest.approx(2 * robust_deviation(values))
    assert robust_deviation(np.zeros(0)) == 0


def test_the_deviation_about_a_known_center_is_that_of_a_symmetric_sample(rng):
    values = rng.standard_normal(101)
    symmetric = 2 + np.concatenate([values, -values])
    assert robust_deviation(values + 2, center=2.0) == pytest.approx(robust_deviation(symmetric))
