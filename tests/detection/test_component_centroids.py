"""Mean lines of components against the oracle: the circular mean of theta, with (rho, n) and (-rho, -n) as one line."""

import numpy as np
import pytest
from support import oracles

from jaxsonar.detection.component_centroids import mean_lines
from jaxsonar.geometry.se2 import wrap_angle


def test_mean_lines_agree_with_the_oracle(rng):
    """Components around theta = pi, around rho = 0, an ordinary one, and two without points."""
    centers = [(1.0, np.pi - 0.02), (0.02, 1.0), (1.5, -2.0)]
    rho = np.stack([c + rng.normal(0, 0.03, 40) for c, _ in centers])
    theta = np.stack([c + rng.normal(0, 0.05, 40) for _, c in centers])
    behind = rho < 0
    rho, theta = np.abs(rho), wrap_angle(np.where(behind, theta + np.pi, theta))
    far = np.cos(theta[1] - 1.0) < 0
    assert far.any()
    assert not far.all()
    component = np.array([[0], [1], [3]]) * np.ones((3, 40), np.int64)
    used = np.ones(rho.shape, bool)
    used[0, :5] = False
    side = np.ones(rho.shape)
    side[1, far] = -1.0  # all points of a component use one side of the origin
    x, y = side * np.cos(theta), side * np.sin(theta)
    came_rho, came_theta, count = mean_lines(
        component[used], np.ones(used.sum(), np.int64), (side * rho)[used], x[used], y[used], components=5
    )
    np.testing.assert_array_equal(count, [35, 40, 0, 40, 0])
    np.testing.assert_array_equal(np.isnan(came_rho), [False, False, True, False, True])
    np.testing.assert_array_equal(np.isnan(came_theta), np.isnan(came_rho))
    for k, row in [(0, 0), (1, 1), (3, 2)]:
        points = [(float(r), float(t)) for r, t, m in zip(rho[row], theta[row], used[row], strict=True) if m]
        expected = oracles.mean_line(sorted(points, key=lambda line: abs(oracles.wrap(line[1] - centers[row][1]))))
        assert float(came_rho[k]) == pytest.approx(expected[0], abs=1e-9)
        assert abs(oracles.wrap(float(came_theta[k]) - expected[1])) < 1e-9


def test_mean_lines_do_not_depend_on_the_side_or_on_how_points_are_summed(rng):
    rho, theta = rng.uniform(0.5, 1.0, 30), rng.uniform(-3.3, -2.9, 30)
    x, y = np.cos(theta), np.sin(theta)
    zero, ones = np.zeros(30, np.int64), np.ones(30, np.int64)
    expected = mean_lines(zero, ones, rho, x, y, components=1)
    flipped = mean_lines(zero, ones, -rho, -x, -y, components=1)
    halves = [(values.reshape(2, 15).sum(axis=1)) for values in (rho, x, y)]
    summed = mean_lines(zero[:2], np.full(2, 15), *halves, components=1)
    for other in (flipped, summed):
        for came, wanted in zip(other, expected, strict=True):
            np.testing.assert_allclose(came, wanted, atol=1e-12)
