"""Planar segments: distances and crossings keep under rigid motions, and agree with each other."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar.geometry.se2 import transform_points
from jaxsonar.geometry.segments import cross, crossings, lengths, perpendicular_intersections, point_to_segments

coordinates = st.floats(-5, 5, allow_nan=False)
poses = st.tuples(coordinates, coordinates, coordinates).map(np.array)


def random_segments(seed, count=4):
    return np.random.default_rng(seed).uniform(-3, 3, (count, 2, 2))


@given(poses, st.integers(0, 1000))
def test_rigid_motions_change_no_length_distance_or_crossing(pose, seed):
    segments, points = random_segments(seed), random_segments(seed + 1)[:, 0]
    moved = transform_points(pose, segments)
    np.testing.assert_allclose(lengths(moved), lengths(segments), atol=1e-9)
    np.testing.assert_allclose(
        point_to_segments(transform_points(pose, points), moved), point_to_segments(points, segments), atol=1e-9
    )
    u, v = np.diff(segments[:2], axis=1)
    moved_u, moved_v = np.diff(moved[:2], axis=1)
    assert cross(moved_u, moved_v) == pytest.approx(cross(u, v), abs=1e-9)
    assert cross(v, u) == -cross(u, v)


@given(st.integers(0, 1000))
def test_both_fractions_of_a_crossing_are_the_same_point(seed):
    first, second = random_segments(seed), random_segments(seed + 1)
    a, b = crossings(first, second)
    on_first = first[:, None, 0] + a[..., None] * (first[:, 1] - first[:, 0])[:, None]
    on_second = second[None, :, 0] + b[..., None] * (second[:, 1] - second[:, 0])
    np.testing.assert_allclose(on_first, on_second, atol=1e-6, rtol=1e-6)


def test_parallel_lines_do_not_cross():
    first = np.array([[[0.0, 0.0], [1.0, 1.0]]])
    assert np.isnan(crossings(first, first + np.array([0.0, 1.0]))).all()


def test_distance_to_the_nearest_end_or_to_the_line():
    segment = np.array([[[0.0, 0.0], [2.0, 0.0]]])
    points = np.array([[1.0, 0.5], [-3.0, 4.0], [3.0, 0.0], [1.5, 0.0]])
    np.testing.assert_allclose(point_to_segments(points, segment)[:, 0], [0.5, 5.0, 1.0, 0.0])


def test_perpendicular_intersections_are_those_of_about_perpendicular_walls():
    """Two walls meet at (2, 1) with gaps of 0.1 and 0.2; the third one is parallel to the first."""
    segments = np.array([[[2.0, -1.0], [2.0, 0.9]], [[-1.0, 1.0], [1.8, 1.0]], [[-1.0, -1.0], [-1.0, 0.5]]])
    found = perpendicular_intersections(np.array([0.0, np.pi / 2, np.pi]), segments, max_skew=0.1)
    assert found.first.tolist() == [0, 1]
    assert found.second.tolist() == [1, 2]
    np.testing.assert_allclose(found.point, [[2.0, 1.0], [-1.0, 1.0]], atol=1e-12)
    np.testing.assert_allclose(found.gap, [[0.1, 0.2], [0.0, 0.5]], atol=1e-12)
    assert len(perpendicular_intersections(np.array([0.0, 0.5]), segments[:2], max_skew=0.1).first) == 0
