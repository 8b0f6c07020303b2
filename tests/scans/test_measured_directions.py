"""Directions that scans measured, against the definition of a cone."""

import numpy as np
import pytest
from support.firings import explicit

from jaxsonar import Ring
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.scans.measured_directions import (
    SETTINGS,
    direction_sector,
    directions_of_paths,
    measured_directions,
    rotated_directions,
    stacked_directions,
)
from jaxsonar.scans.scan_log import Log

RING = Ring.circular(count=8, beam=np.radians(61.0), neighbors=0)
CENTERS = -np.pi + (np.arange(SETTINGS.directions) + 0.5) * (2 * np.pi / SETTINGS.directions)


def only(*sensors):
    measured = np.zeros(len(RING.paths), bool)
    measured[list(sensors)] = True
    return measured


def test_a_direction_is_measured_inside_the_cone_of_a_measured_path(rng):
    found = directions_of_paths(RING, only(0, 3))
    off = np.abs(wrap_angle(CENTERS[:, None] - np.asarray(RING.heading)[[0, 3]])).min(axis=1)
    np.testing.assert_array_equal(found, off < np.radians(30.5))
    angle = rng.uniform(-10, 10, 200)
    assert (np.abs(wrap_angle(angle - CENTERS[direction_sector(angle)])) <= np.pi / SETTINGS.directions + 1e-9).all()


def test_directions_turn_with_the_robot():
    turn = np.zeros((len(RING.paths), 3))
    turn[:, 2] = np.radians(40.0)
    moved = directions_of_paths(RING, only(2), turn)
    np.testing.assert_array_equal(moved, rotated_directions(directions_of_paths(RING, only(2)), np.radians(40.0)))


def test_directions_without_any_path_of_the_ring_count_as_measured():
    narrow = Ring.circular(count=8, beam=np.radians(21.0), neighbors=0)
    found = directions_of_paths(narrow, only())
    off = np.abs(wrap_angle(CENTERS[:, None] - np.asarray(narrow.heading))).min(axis=1)
    np.testing.assert_array_equal(found, off > np.radians(10.5))


def test_scans_that_measured_everything_need_no_directions():
    none = np.zeros(0, int)
    log = Log.from_echoes(none, none, none, np.zeros(0), stamp=np.zeros(2), pose=np.zeros((2, 3)), asked=RING.paths)
    assert measured_directions(RING, log) is None
    measured = np.stack([np.ones(len(RING.paths), bool), only(1)])
    found = measured_directions(RING, explicit(RING, log, measured))
    np.testing.assert_array_equal(found, [np.ones(SETTINGS.directions, bool), directions_of_paths(RING, only(1))])
    assert found is not None
    assert stacked_directions([None, None]) is None
    np.testing.assert_array_equal(stacked_directions([None, found[1]]), found)


@pytest.mark.parametrize("heading", [0.0, np.pi, -0.5])
def test_a_rotation_keeps_the_number_of_directions(heading):
    some = directions_of_paths(RING, only(0, 5))
    assert rotated_directions(some, heading).sum() == some.sum()
