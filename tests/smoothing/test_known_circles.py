"""Circles among the landmarks of the smoothing: which ones are taken, and what they replace."""

import numpy as np

from jaxsonar import GlobalMap, kernels
from jaxsonar.estimation.landmark_map import landmark_map_of
from jaxsonar.smoothing.smoother import _with_known_circles


def map_with(points, kinds, radius=None, radius_sd=None):
    """A map of one wall and of points."""
    count = len(points)
    cov = np.full((count, 3, 3), np.nan)
    if radius_sd is not None:
        cov = np.square(np.array(radius_sd))[:, None, None] * np.eye(3)
    return GlobalMap(
        segments=np.array([[[0.0, 1.0], [2.0, 1.0]]]),
        rho=np.ones(1),
        theta=np.array([np.pi / 2]),
        sigma_rho=np.full(1, 1e-3),
        sigma_theta=np.full(1, 1e-3),
        echoes=np.array([30]),
        scans=((0, 1),),
        points=np.array(points, dtype=np.float64).reshape(-1, 2),
        point_kinds=tuple(kinds),
        point_cov=np.tile(1e-6 * np.eye(2), (count, 1, 1)),
        point_echoes=np.full(count, 9),
        point_scans=((0, 1),) * count,
        point_radius=np.full(count, np.nan) if radius is None else np.array(radius),
        point_circle_cov=cov,
    )


def test_only_circles_of_known_radius_become_landmarks_and_replace_the_points_at_their_border():
    world = map_with([[1.0, 0.25], [3.0, 0.0]], ["edge", "corner"])
    found = map_with(
        [[1.0, 0.0], [2.0, -1.0], [3.0, 0.0], [5.0, 0.0]],
        ["circle", "circle", "corner", "undecided"],
        radius=[0.2, 0.3, np.nan, np.nan],
        radius_sd=[0.002, 0.2, 0.01, 0.01],
    )
    both = _with_known_circles(world, found)
    assert both is not None
    assert both.point_kinds == ("corner", "circle")
    landmarks = landmark_map_of([both], tie_corners=False).landmarks
    assert landmarks.kind[:3].tolist() == [kernels.PLANE, kernels.CORNER, kernels.CIRCLE]
    assert landmarks.radius is not None
    np.testing.assert_allclose(landmarks.radius[:3], [0, 0, 0.2])


def test_a_map_without_a_circle_of_known_radius_is_not_adjusted_again():
    world = map_with([[3.0, 0.0]], ["corner"])
    assert _with_known_circles(world, world) is None
    assert _with_known_circles(world, map_with([[2.0, -1.0]], ["circle"], [0.3], [0.2])) is None


def test_maps_without_circles_have_no_radii():
    assert landmark_map_of([map_with([[3.0, 0.0]], ["edge"])], tie_corners=False).landmarks.radius is None
