"""Fast ranges to circles against the exact range model, for the baselines of rings."""

import numpy as np
import pytest

from jaxsonar.reflectors.circle_ranges import circle_ranges
from jaxsonar.sensors.range_models import circle_range


@pytest.mark.parametrize("radius", [0.0, 0.01, 0.2, 1.0, 1e4])
def test_ranges_and_derivatives_are_those_of_the_exact_model(radius, rng):
    angle, height = rng.uniform(-0.8, 0.8, 500), rng.uniform(0.3, 2.0, 500)
    toward = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    midpoint, half = rng.normal(0, 0.3, (500, 2)), rng.normal(0, 0.05, (500, 2))
    center = midpoint + (height + radius)[:, None] * toward
    exact = circle_range(np.column_stack([center, np.full(500, radius)]), midpoint, half)
    distance, slope, by_radius = circle_ranges(center, np.full(500, radius), midpoint, half)
    np.testing.assert_allclose(distance, exact.range, atol=1e-6)
    np.testing.assert_allclose(slope, exact.d_range_d_landmark[:, :2], atol=1e-3)
    np.testing.assert_allclose(by_radius, exact.d_range_d_landmark[:, 2], atol=1e-3)
