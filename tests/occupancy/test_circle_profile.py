"""Circles of a map in grids: what readings confirm of their borders, by sensors around them."""

import numpy as np
import pytest

from jaxsonar.occupancy.circle_profile import with_confirmed_borders
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.occupancy.wall_profile import FacingReadings

CENTER, RADIUS = np.array([0.4, -0.2]), 0.6


def circle(radius=RADIUS, sd=0.06):
    """A map of one circle."""
    point = CENTER[None]
    return KnownReflectors(
        np.zeros((0, 2, 2)), np.zeros((0, 2)), point, np.zeros(1), np.array([radius]), sd**2 * np.eye(3)[None]
    )


def around(angle, later=0.0, turned=0.0):
    """Readings 0.8 m from the border that face the center, with echoes that come later than from the border."""
    away = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    count = len(angle)
    return FacingReadings(
        CENTER + (RADIUS + 0.8) * away,
        angle + np.pi + turned,
        np.full(count, 0.2),
        np.full(count, 0.8 + later),
        np.zeros((0, 2)),
        2.0,
    )


def directions(drawn):
    return np.arctan2(*(drawn.points - CENTER).T[::-1])


@pytest.mark.parametrize("turn", [0.0, 2.5, -np.pi])
def test_only_the_side_that_answered_is_drawn(turn):
    angle = turn + np.linspace(-0.5, 0.5, 21)
    drawn = with_confirmed_borders(circle(), around(angle), resolution=0.05)
    np.testing.assert_allclose(np.linalg.norm(drawn.points - CENTER, axis=-1), RADIUS)
    assert not drawn.point_radius.any()
    off = np.angle(np.exp(1j * (directions(drawn) - turn)))
    assert np.abs(off).max() < 0.5 + np.radians(15) + 0.2
    assert np.diff(np.sort(off)).max() < 1.2 * 0.05 / RADIUS
    assert off.max() > 0.5
    assert off.min() < -0.5


def test_readings_that_look_through_or_away_confirm_nothing():
    angle = np.linspace(-0.5, 0.5, 21)
    for readings in (around(angle, later=1.0), around(angle, turned=1.0), around(angle, later=-0.3), around(angle[:0])):
        assert not len(with_confirmed_borders(circle(), readings, resolution=0.05).points)
    # A door in a round wall.
    gap = np.abs(angle) < 0.2
    readings = around(angle)._replace(first_echo=np.where(gap, 2.0, 0.8))
    found = np.abs(directions(with_confirmed_borders(circle(), readings, resolution=0.05)))
    assert found.min() > 0.05
    assert found.min() < 0.3


def test_small_and_certain_circles_are_drawn_completely():
    for known in (circle(radius=0.1), circle(sd=0.01)):
        for readings in (around(np.zeros(0)), around(np.zeros(5))):
            drawn = with_confirmed_borders(known, readings, resolution=0.05)
            np.testing.assert_array_equal(drawn.points, known.points)
            np.testing.assert_array_equal(drawn.point_radius, known.point_radius)


def test_a_border_is_as_uncertain_as_it_is_in_its_direction():
    # Independent errors of position and radius add up in every direction.
    drawn = with_confirmed_borders(circle(), around(np.linspace(0, 6, 60)), resolution=0.05)
    np.testing.assert_allclose(drawn.point_sd, 0.06 * np.sqrt(2))
    # Center and radius that move together leave the near side where it is.
    together = np.outer([0.1, 0, -0.1], [0.1, 0, -0.1])[None]
    known = circle()._replace(circle_cov=together)
    drawn = with_confirmed_borders(known, around(np.linspace(-0.1, 0.1, 5)), resolution=0.05)
    assert drawn.point_sd.max() < 0.02
    known = circle(radius=0.1)._replace(point_sd=np.full(1, 0.1), circle_cov=together)
    assert with_confirmed_borders(known, around(np.zeros(0)), resolution=0.05).point_sd[0] < 0.01
