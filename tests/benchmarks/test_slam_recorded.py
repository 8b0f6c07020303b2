"""Thickness of walls in laser points, for walls of known thickness."""

import numpy as np
import pytest

from benchmarks.slam.laser_reference import thicknesses


@pytest.mark.parametrize("turn", [0.0, 0.7, 2.1])
def test_two_walls_of_known_noise(rng, turn):
    """The result does not depend on the direction; clutter and points between the walls do not count."""
    along = rng.uniform(-6, 6, 6000)
    first = np.column_stack([along, 1.2 + 0.03 * rng.standard_normal(6000)])
    second = np.column_stack([along[:3000], -1.1 + 0.01 * rng.standard_normal(3000)])
    clutter = rng.uniform([-6, -0.9], [6, 0.9], (300, 2))
    c, s = np.cos(turn), np.sin(turn)
    found = thicknesses(np.concatenate([first, second, clutter]) @ np.array([[c, s], [-s, c]]) + [30.0, -4.0])
    assert found[0][0] == pytest.approx(0.03, rel=0.05)
    assert found[1][0] == pytest.approx(0.01, rel=0.05)
    assert found[0][1] == pytest.approx(6000, abs=60)
    assert found[1][1] == pytest.approx(3000, abs=60)


def test_a_wall_drawn_twice_is_thicker(rng):
    wall = np.column_stack([rng.uniform(-4, 4, 4000), 0.02 * rng.standard_normal(4000)])
    far = np.column_stack([rng.uniform(-4, 4, 2000), 2.0 + 0.02 * rng.standard_normal(2000)])
    twice = wall + np.where(np.arange(4000)[:, None] % 2, [0.0, 0.04], [0.0, -0.04])
    once, doubled = (thicknesses(np.concatenate([one, far]))[0][0] for one in (wall, twice))
    assert doubled == pytest.approx(np.hypot(once, 0.04), rel=0.05)
