"""The unit of ranges: found by the maximum range of the ring, and by the poses within it; never on sound logs."""

from dataclasses import replace

import numpy as np
import pytest
from support.wandering_robot import RING, log_of, ranges, trajectory

from jaxsonar.plausibility.range_units import find_range_unit

POSES = trajectory()
LOG = log_of(ranges(POSES), POSES)
TIME_OF_FLIGHT = 2 / 343.2
UNITS = {
    "millimetres": 1000,
    "centimetres": 100,
    "inches": 1 / 0.0254,
    "feet": 1 / 0.3048,
    "times of flight in microseconds": 1e6 * TIME_OF_FLIGHT,
    "times of flight in milliseconds": 1e3 * TIME_OF_FLIGHT,
    "times of flight in seconds": TIME_OF_FLIGHT,
    "lengths of the round trip, out and back": 2,
}


def scaled(factor, log=LOG, **changes):
    return replace(log, range=log.range * factor, **changes)


@pytest.mark.parametrize("max_range", [3.5, 5.0, 9.0])
@pytest.mark.parametrize("name", UNITS)
def test_the_poses_decide_between_units(name, max_range):
    """A round trip is found although all of its ranges are within the largest maximum range."""
    found = find_range_unit(replace(RING, max_range=max_range), scaled(UNITS[name]))
    assert found is not None
    assert f"the ranges are probably {name}" in found.implausibility.cause
    assert "half path lengths in metres" in found.implausibility.remedy
    np.testing.assert_allclose(found.corrected(scaled(UNITS[name])).range, LOG.range, rtol=1e-4)


@pytest.mark.parametrize("name", ["millimetres", "centimetres", "times of flight in microseconds"])
def test_without_poses_the_maximum_range_decides(name):
    log = scaled(UNITS[name], pose=np.full((len(LOG), 3), np.nan))
    found = find_range_unit(replace(RING, max_range=1.05 * float(np.nanmax(LOG.range))), log)
    assert found is not None
    assert name in str(found.implausibility)
    assert str(found.implausibility).startswith("100% of the echoes are beyond the maximum range of the ring, ")


@pytest.mark.parametrize("max_range", [3.5, 5.0])
def test_halved_ranges(max_range):
    found = find_range_unit(replace(RING, max_range=max_range), scaled(0.5))
    assert found is not None
    assert "halved again" in found.implausibility.cause
    assert "multiply the ranges by 2" in found.implausibility.remedy
    np.testing.assert_allclose(found.corrected(scaled(0.5)).range, LOG.range)


def test_sound_ranges_have_no_unit():
    assert find_range_unit(RING, LOG) is None
    assert find_range_unit(RING, scaled(1.05)) is None
    assert find_range_unit(replace(RING, max_range=float(np.nanmedian(LOG.range))), LOG) is None
    assert find_range_unit(RING, replace(LOG, pose=np.full((len(LOG), 3), np.nan))) is None
    assert find_range_unit(RING, LOG[:0]) is None
    assert find_range_unit(RING, LOG[:2]) is None


def test_a_ring_that_reaches_less_far_than_the_echoes_is_named():
    found = find_range_unit(replace(RING, max_range=float(np.nanquantile(LOG.range, 0.1))), LOG)
    assert found is not None
    assert "maximum range of the ring is too small" in found.implausibility.cause
    assert found.corrected(LOG) is LOG


def test_a_robot_that_turns_does_not_show_the_unit():
    turning = np.column_stack([np.full((200, 2), 0.4), np.linspace(0, 12, 200)])
    log = log_of(ranges(turning), turning)
    for max_range in (3.5, 9.0):
        assert find_range_unit(replace(RING, max_range=max_range), log) is None
