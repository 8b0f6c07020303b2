"""Negative evidence between submaps: walls are missed only in directions that were measured."""

from dataclasses import replace

import numpy as np
import pytest
from support.submap_pairs import FIRST, NICHE, SECOND, two

from jaxsonar.geometry.se2 import compose
from jaxsonar.loop_closure.submap_negative_evidence import submap_negative_evidence
from jaxsonar.loop_closure.submap_view import SubmapView
from jaxsonar.scans.measured_directions import SETTINGS

TURNED = np.array([0.5, -0.2, np.pi / 2])


@pytest.fixture
def pair():
    """Two submaps of one room, and wrong relative poses."""
    earlier, newest, true, *_ = two(NICHE, FIRST, SECOND, 0, 0.1)
    return earlier, newest, np.stack([compose(true, TURNED), compose(true, -TURNED)])


def evidence(pair, directions=None):
    earlier, newest, poses = pair
    first, second = (
        SubmapView.of(replace(one, directions=None if directions is None else directions(one)))
        for one in (earlier, newest)
    )
    return submap_negative_evidence(first, second, poses, tolerance=0.05, reliable_range=1.7)


def test_evidence_of_fully_measured_scans_needs_no_directions(pair):
    every = evidence(pair, lambda one: np.ones((len(one.poses), SETTINGS.directions), bool))
    np.testing.assert_array_equal(every, evidence(pair))


def test_nothing_is_missed_in_unmeasured_directions(pair):
    none = evidence(pair, lambda one: np.zeros((len(one.poses), SETTINGS.directions), bool))
    assert (none <= evidence(pair)).all()
    assert (none < evidence(pair)).any()
    half = evidence(pair, lambda one: np.tile(np.arange(SETTINGS.directions) < 90, (len(one.poses), 1)))
    assert (none <= half).all()
    assert (half <= evidence(pair)).all()


def test_directions_are_those_of_the_robot(pair, rng):
    """A submap with turned robots and directions turned back is the same."""
    some = rng.random(SETTINGS.directions) < 0.5
    sectors, angle = 30, 30 * 2 * np.pi / SETTINGS.directions

    def turned(one):
        return np.tile(np.roll(some, -sectors), (len(one.poses), 1))

    expected = evidence(pair, lambda one: np.tile(some, (len(one.poses), 1)))
    earlier, newest, poses = pair
    rotated = [replace(one, poses=one.poses + np.array([0, 0, angle])) for one in (earlier, newest)]
    np.testing.assert_allclose(evidence((*rotated, poses), turned), expected)
