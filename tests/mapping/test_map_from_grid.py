"""Walls of occupancy grids: grids that are rasterized from known walls give these walls."""

import numpy as np
import pytest
from support.grids import rasterized

from jaxsonar.geometry.se2 import inverse, tangent_of, transform_points, unit, wrap_angle
from jaxsonar.mapping.map_from_grid import map_from_grid

CORNERS = np.array([[0, 0], [4, 0], [4, 1.2], [2.5, 1.2], [2.5, 3], [0, 3]], dtype=float)
WALLS = np.stack([CORNERS, np.roll(CORNERS, -1, axis=0)], axis=1)


def errors(world, walls=WALLS):
    """Offset (m) and direction (rad) of every wall of a map from the nearest true wall, and its index."""
    along = walls[:, 1] - walls[:, 0]
    theta = np.arctan2(along[:, 1], along[:, 0]) - np.pi / 2
    middle = world.segments.mean(axis=1)
    off = (middle[:, None] - walls[:, 0]) @ np.eye(2)
    across = (off * unit(theta)).sum(-1)
    position = (off * tangent_of(theta)).sum(-1)
    turn = wrap_angle(2 * (world.theta[:, None] - theta)) / 2
    fits = (position > 0) & (position < np.linalg.norm(along, axis=1)) & (np.abs(turn) < 0.3)
    nearest = np.where(fits, np.abs(across), np.inf).argmin(axis=1)
    row = np.arange(len(world))
    return across[row, nearest], turn[row, nearest], nearest


@pytest.mark.parametrize("yaw", [0.0, 0.4, -2.2])
@pytest.mark.parametrize(("resolution", "noise", "gaps"), [(0.05, 0.003, 0.0), (0.05, 0.02, 0.3), (0.025, 0.015, 0.2)])
def test_walls_of_a_room_are_found(yaw, resolution, noise, gaps):
    """Every wall once, to a fraction of a cell, with true standard deviations, for any rotation of the grid."""
    # The grid begins 0.4 m outside of the room.
    bounds = transform_points(inverse(np.array([0, 0, yaw])), CORNERS)
    corner = transform_points(np.array([0, 0, yaw]), bounds.min(axis=0)[None] - 0.4)[0]
    origin = np.array([*corner, yaw])
    occupied, free = rasterized(WALLS, resolution, origin, noise=noise, gaps=gaps)
    world = map_from_grid(occupied, free, resolution=resolution, origin=origin)
    across, turn, wall = errors(world)
    assert sorted(wall) == list(range(len(WALLS)))
    assert np.abs(across).max() < 0.8 * resolution
    assert np.abs(turn).max() < np.radians(1.5)
    length = np.linalg.norm(WALLS[wall, 1] - WALLS[wall, 0], axis=1)
    np.testing.assert_allclose(world.length, length, atol=2 * resolution)
    # The line in the world: n . p = rho, and standard deviations of about half a cell.
    np.testing.assert_allclose(
        (world.segments * unit(world.theta)[:, None]).sum(-1), np.tile(world.rho, (2, 1)).T, atol=1e-9
    )
    arm = (world.segments.mean(axis=1) * tangent_of(world.theta)).sum(-1)
    sd = np.sqrt(world.sigma_rho**2 - (arm * world.sigma_theta) ** 2)
    assert (sd > resolution / 5).all()
    assert (sd < resolution).all()
    assert (np.square(across / sd)).mean() < 4.0


def test_a_thick_wall_has_two_sides_and_a_thin_one_is_one_wall():
    occupied, free = np.zeros((60, 80), dtype=bool), np.zeros((60, 80), dtype=bool)
    free[5:55, 5:75] = True
    occupied[5:55, 20:21] = True
    occupied[5:55, 50:54] = True
    world = map_from_grid(occupied, free & ~occupied, resolution=0.05, origin=np.zeros(3))
    np.testing.assert_allclose(sorted(world.segments[:, 0, 0]), 0.05 * np.array([20.5, 50.5, 53.5]), atol=0.01)


def test_nothing_is_no_wall():
    """No occupied cell; single speckles; a block that borders on unknown cells alone."""
    empty = np.zeros((20, 30), dtype=bool)
    speckles = empty.copy()
    speckles[::6, ::7] = True
    for occupied, free in ((empty, ~empty), (speckles, ~speckles), (~empty, empty)):
        assert len(map_from_grid(occupied, free, resolution=0.05, origin=np.zeros(3))) == 0
