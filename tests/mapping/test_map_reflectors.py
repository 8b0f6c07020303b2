"""Columns, poles and ends of walls in maps: whole logs, scan by scan, files and figures."""

import dataclasses

import numpy as np
import pytest
from matplotlib.patches import Circle

from jaxsonar import Mapper, Ring, Room, build_map, simulate
from jaxsonar.geometry.se2 import compose, wrap_angle
from jaxsonar.mapping.build_map import add_reflectors
from jaxsonar.mapping.map_geojson import load_map, load_points, save_map
from jaxsonar.reflectors.range_measurements import RangeMeasurements
from jaxsonar.reports.plot_map import map_figure

RING = Ring.circular()
COLUMN = np.array([0.1, 1.2, 0.25])
ROOM = Room(np.array([[[-3.0, -1.2], [3.0, -1.2]]]), poles=np.array([[-0.9, 0.7]]), circles=COLUMN[None])
POSES = np.column_stack([np.linspace(-1.0, 0.8, 9), np.full(9, -0.1), np.full(9, 0.2)])


@pytest.fixture(scope="module")
def log():
    return simulate(RING, ROOM, POSES, sigma=0.001, seed=3).as_log(RING, POSES)


@pytest.fixture(scope="module")
def world(log):
    return build_map(RING, log)


def test_a_column_and_a_pole_are_in_the_map(world):
    circle = world.with_kinds("circle")
    assert len(circle.points) == 1
    np.testing.assert_allclose([*circle.points[0], circle.point_radius[0]], COLUMN, atol=0.02)
    assert circle.point_probabilities[0, 3] > 0.9
    edge = world.with_kinds("edge").points
    assert np.linalg.norm(edge - [-0.9, 0.7], axis=1).min() < 0.01


def test_a_wall_that_was_taken_out_is_found_again_and_none_appears_twice():
    """Far from the origin of the world, where the line's distance depends on its direction."""
    room = Room(np.array([[[-3.0, -1.2], [3.0, -1.2]], [[-0.5, 0.9], [0.4, 0.9]]]))
    log = simulate(RING, room, POSES, sigma=0.001, seed=3).as_log(RING, compose(np.array([20.0, -30.0, 2.0]), POSES))
    whole, measurements = build_map(RING, log), RangeMeasurements.from_log(RING, log)
    assert len(whole) == 2
    short = whole.length < 1.2
    assert short.sum() == 1
    (old,), again = np.flatnonzero(short), add_reflectors(whole.take_walls(~short), measurements)
    assert len(again) == 2
    (new,) = np.flatnonzero(again.length < 1.2)
    assert again.rho[new] >= 0
    assert abs(wrap_angle(again.theta[new] - whole.theta[old])) < 4 * np.hypot(
        again.sigma_theta[new], whole.sigma_theta[old]
    )
    assert abs(again.rho[new] - whole.rho[old]) < 4 * np.hypot(again.sigma_rho[new], whole.sigma_rho[old])
    np.testing.assert_allclose(again.segments[new].mean(axis=0), whole.segments[old].mean(axis=0), atol=0.1)
    # A fragment that the map has is not described twice.
    middle, half = whole.segments[old].mean(axis=0), (whole.segments[old, 1] - whole.segments[old, 0]) / 8
    segments = whole.segments.copy()
    segments[old] = middle - half, middle + half
    assert len(add_reflectors(dataclasses.replace(whole, segments=segments), measurements)) == 2


def test_the_map_scan_by_scan_is_the_same(world, log):
    mapper = Mapper(ring=RING)
    state = mapper.start()
    for scan in log:
        state, _ = mapper.step(state, scan)
    again = mapper.map(state)
    assert again.point_kinds == world.point_kinds
    np.testing.assert_allclose(again.points, world.points, atol=1e-6)
    np.testing.assert_allclose(again.point_radius, world.point_radius, atol=1e-6)


def test_without_the_search_there_are_neither_circles_nor_ends(log):
    walls = build_map(RING, log, reflectors=False)
    assert "circle" not in walls.point_kinds
    assert walls.end_kinds == ()


def test_files_keep_circles_and_ends(world, tmp_path):
    save_map(world, tmp_path / "map.geojson")
    again = load_map(tmp_path / "map.geojson")
    assert (again.point_kinds, again.end_kinds) == (world.point_kinds, world.end_kinds)
    for name in ("point_radius", "point_circle_cov", "point_probabilities", "end_cov"):
        np.testing.assert_array_equal(getattr(again, name), getattr(world, name))
    points, kinds, radii = load_points(tmp_path / "map.geojson", kinds=("circle",))
    assert kinds == ("circle",)
    np.testing.assert_array_equal(radii, world.with_kinds("circle").point_radius)
    np.testing.assert_array_equal(points, world.with_kinds("circle").points)


def test_the_figure_shows_circles_with_their_radius(world):
    (axes,) = map_figure(world).axes
    radii = [patch.get_radius() for patch in axes.patches if isinstance(patch, Circle)]
    np.testing.assert_allclose(radii, world.with_kinds("circle").point_radius)


def test_an_edge_ends_its_wall_within_its_covariance():
    """The edge of a free wall, near enough to answer."""
    room = Room(np.array([[[-3.0, -1.5], [3.0, -1.5]], [[-0.7, 0.5], [0.7, 0.5]]]))
    poses = np.column_stack([np.linspace(-1.2, 1.2, 9), np.full(9, -0.2), np.full(9, 0.1)])
    world = build_map(RING, simulate(RING, room, poses, sigma=0.001, seed=1).as_log(RING, poses))
    wall = int(np.argmin(np.abs(world.segments[..., 1] - 0.5).max(axis=1)))
    kinds = world.end_kinds[wall]
    assert "edge" in kinds
    for side, kind in enumerate(kinds):
        if kind:
            x = world.segments[wall, side, 0]
            assert abs(abs(x) - 0.7) < 0.02
            assert abs(abs(x) - 0.7) < 4 * np.sqrt(world.end_cov[wall, side, 0, 0])
