"""Matching of two submaps: residuals of landmark pairs, their derivatives, and the least-squares pose."""

from dataclasses import replace

import numpy as np
import pytest
from support.submap_pairs import FIRST, NICHE, SECOND, two

from jaxsonar import kernels
from jaxsonar.geometry.se2 import compose, wrap_angle
from jaxsonar.loop_closure.submap_matching import Pairs, fit_pose, nearest_pairs, pair_residuals


def test_pair_residuals_and_their_derivatives(rng):
    earlier, newest, true, _, _ = two(NICHE, FIRST, SECOND, 3, 0.1)
    pairs = nearest_pairs(earlier, newest, true, np.diag([1e-4, 1e-4, 1e-5]))
    assert len(pairs) > 5
    pose = true + np.array([0.05, -0.03, 0.02])
    seen = pair_residuals(earlier, newest, pairs.earlier, pairs.newest, pose)
    # Independent computation: transform a point on each reflector.
    for k, (a, b) in enumerate(zip(*pairs, strict=True)):
        if earlier.landmarks.kind[a] != kernels.PLANE:
            place = compose(pose, np.append(newest.landmarks.anchor[b] + newest.landmarks.parameters[b], 0.0))[:2]
            np.testing.assert_allclose(
                seen.residual[k], place - earlier.landmarks.anchor[a] - earlier.landmarks.parameters[a]
            )
            continue
        level, theta = newest.landmarks.parameters[b]
        foot = newest.landmarks.anchor[b] + level * np.array([np.cos(theta), np.sin(theta)])
        moved = compose(pose, np.append(foot, theta))
        normal = np.array([np.cos(moved[2]), np.sin(moved[2])])
        expected = [normal @ (moved[:2] - earlier.landmarks.anchor[a]) - earlier.landmarks.parameters[a, 0]]
        expected.append(float(wrap_angle(float(moved[2] - earlier.landmarks.parameters[a, 1]))))
        np.testing.assert_allclose(seen.residual[k], expected, atol=1e-12)
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-6
        sides = [pair_residuals(earlier, newest, *pairs, pose + sign * step).residual for sign in (1, -1)]
        np.testing.assert_allclose((sides[0] - sides[1]) / 2e-6, seen.d_residual_d_pose[..., k], atol=1e-6)
    for k in range(2):
        step = np.zeros(2)
        step[k] = 1e-6
        sides = [
            pair_residuals(
                earlier,
                replace(newest, landmarks=newest.landmarks.with_parameters(newest.landmarks.parameters + sign * step)),
                *pairs,
                pose,
            ).residual
            for sign in (1, -1)
        ]
        np.testing.assert_allclose((sides[0] - sides[1]) / 2e-6, seen.d_residual_d_newest[..., k], atol=1e-6)


def test_the_fit_is_the_least_squares_solution():
    earlier, newest, true, _, _ = two(NICHE, FIRST, SECOND, 1, 0.1)
    pairs = nearest_pairs(earlier, newest, true, np.diag([1e-4, 1e-4, 1e-5]))
    fit = fit_pose(earlier, newest, pairs, true)
    for step in 1e-3 * np.concatenate([np.eye(3), -np.eye(3)]):
        # Around the minimum chi2 is a quadratic form with the information matrix; here it is computed directly.
        seen = pair_residuals(earlier, newest, *pairs, fit.pose + step)
        rows = (3 + 2 * pairs.earlier[:, None] + np.arange(2)).ravel()
        others = (3 + 2 * pairs.newest[:, None] + np.arange(2)).ravel()
        design = np.zeros((len(rows), len(others)))
        for k, block in enumerate(pair_residuals(earlier, newest, *pairs, fit.pose).d_residual_d_newest):
            design[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = block
        cov = earlier.covariance[np.ix_(rows, rows)] + design @ newest.covariance[np.ix_(others, others)] @ design.T
        off = seen.residual.ravel()
        expected = fit.chi2 + step @ fit.information @ step
        assert off @ np.linalg.solve(cov, off) == pytest.approx(expected, abs=0.02 * expected)


def test_take_selects_pairs():
    pairs = Pairs(np.array([3, 1, 2]), np.array([0, 4, 5])).take(np.array([0, 2]))
    assert pairs.earlier.tolist() == [3, 2]
    assert pairs.newest.tolist() == [0, 5]
