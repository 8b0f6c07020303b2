"""Constraints between consecutive submaps: consistent, and more accurate than odometry where walls are shared."""

from dataclasses import replace

import numpy as np
import pytest
from support.submap_pairs import FIRST, NICHE
from support.submaps import drive, rectangle, submap, submaps

from jaxsonar.geometry.se2 import relative, wrap_angle
from jaxsonar.loop_closure.closure_detection import detect_closure
from jaxsonar.loop_closure.sequential_constraint import sequential_factor
from jaxsonar.loop_closure.submap_matching import nearest_pairs


@pytest.mark.slow
def test_sequential_factors_are_more_accurate_and_consistent():
    total, joint, before, better, count = 0.0, 0.0, 0.0, 0, 20
    for seed in range(count):
        rng = np.random.default_rng(seed)
        made, true = submaps(NICHE, drive((1, 1), (3, 1), (3, 2.2), (1.2, 2.2), (1, 1)), rng, scans=25, slip=3.0)
        link, expected = sequential_factor(made[0], made[1], 4), relative(true[0], true[1])
        assert (link.first, link.second) == (4, 5)
        off = link.first_from_second - expected
        off[2] = wrap_angle(off[2])
        total += off @ link.information @ off
        joint += float(np.abs(off[:2]).sum())
        before += float(np.abs((made[0].exit_pose - expected)[:2]).sum())
        better += np.linalg.det(link.information) > 2 * np.linalg.det(np.linalg.inv(made[0].covariance[:3, :3]))
    assert better >= 0.8 * count  # unchanged where doors or corners repeat within the uncertainty of the exit pose
    assert joint < 0.7 * before
    assert 0.5 < total / (3 * count) < 1.7


def test_without_shared_walls_the_sequential_factor_is_the_odometry_factor():
    rng = np.random.default_rng(0)
    here, there = (
        submap(NICHE, FIRST, FIRST[-1], rng),
        submap(rectangle(9, 9), drive((1.5, 4), (1.5, 6)), FIRST[-1], rng),
    )
    empty = replace(
        there,
        landmarks=there.landmarks.take(np.arange(0)),
        scan_counts=there.scan_counts[:0],
        covariance=there.covariance[:3, :3],
    )
    link = sequential_factor(here, empty)
    np.testing.assert_array_equal(link.first_from_second, here.exit_pose)
    assert detect_closure(empty, here, np.zeros(3), np.eye(3)) is None
    assert len(nearest_pairs(here, empty, np.zeros(3), np.eye(3))) == 0
