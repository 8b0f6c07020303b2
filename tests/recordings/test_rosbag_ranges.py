"""Meaning of the values of sensor_msgs/Range (REP 117), and of what drivers send instead."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar.recordings.rosbag_ranges import ECHO, NOT_MEASURED, SILENT, reading_kinds

INF, NAN = np.inf, np.nan


def kinds(values, low: Any = 0.02, high: Any = 3.0, ring_max_range: float | None = 4.0):
    """Kinds of readings, after 32-bit messages, and the notes."""
    notes = []
    reported, low, high = (
        np.float32(np.broadcast_to(one, np.shape(values))).astype(float) for one in (values, low, high)
    )
    return reading_kinds(reported, low, high, ring_max_range=ring_max_range, note=notes.append).tolist(), notes


def test_values_of_rep_117():
    values = [0.5, 2.999, INF, -INF, NAN, 0.01, 0.02, 3.0]
    expected = [ECHO, ECHO, SILENT, NOT_MEASURED, NOT_MEASURED, NOT_MEASURED, NOT_MEASURED, SILENT]
    kind, notes = kinds(values)
    assert kind == expected
    assert notes == [
        "no echo: +inf (1), max_range and more (1)",
        "not measured: min_range (1), less than min_range (1), NaN (1), -inf (1)",
    ]


@pytest.mark.parametrize("mark", [0.0, -1.0, 0.02, 3.0, 3.0 + 1e-6, 3.01, 65.535, 65535.0, INF])
def test_what_drivers_send_for_no_echo(mark):
    assert kinds([0.5, mark, 1.5, mark, mark])[0] == [ECHO, SILENT, ECHO, SILENT, SILENT]


@pytest.mark.parametrize("mark", [0.0, -1.0, 0.02])
def test_beside_another_value_for_no_echo_they_measured_nothing(mark):
    assert kinds([0.5, mark, INF])[0] == [ECHO, NOT_MEASURED, SILENT]


def test_0_means_no_echo_and_the_minimum_too_close():
    assert kinds([0.5, 0.0, 0.02])[0] == [ECHO, SILENT, NOT_MEASURED]


@pytest.mark.parametrize(("low", "high"), [(0, 0), (0, INF), (NAN, NAN), (0.02, 0.0), (-1, -1), (3.0, 0.02)])
def test_limits_that_are_not_set(low, high):
    kind, notes = kinds([0.01, 0.5, 2.5, 3.5, INF], low, high)
    assert kind == [NOT_MEASURED if low == 0.02 else ECHO, ECHO, ECHO, ECHO, SILENT]
    assert "in 5 messages, which is no limit" in notes[0]


def test_limits_that_contradict_the_echoes(rng):
    values = rng.uniform(0.3, 2.5, 50)
    for low, high in ((0.0, 0.01), (2.6, 3.0), (100.0, 0.0)):
        kind, notes = kinds(values, low, high)
        assert kind == [ECHO] * 50
        assert "is no limit" in " ".join(notes)


def test_without_a_maximum_a_repeated_range_beyond_the_ring_is_no_echo():
    values = [0.5, 65.535, 1.0, 65.535, 65.535, 4.5, 5.5]
    assert kinds(values, 0, 0)[0] == [ECHO, SILENT, ECHO, SILENT, SILENT, ECHO, ECHO]
    assert kinds(values, 0, 0, ring_max_range=None)[0] == [ECHO] * 7


def test_limits_of_each_message():
    assert kinds([1.0, 1.0, 1.0], [0.02, 0.02, 1.5], [0.9, 2.0, 2.0])[0] == [SILENT, ECHO, NOT_MEASURED]


@pytest.mark.parametrize("scale", [100, 1000])
def test_ranges_in_other_units_are_a_warning(rng, scale):
    kind, notes = kinds(scale * rng.uniform(0.3, 2.5, 50), 0.02 * scale, 3.0 * scale)
    assert kind == [ECHO] * 50
    assert len(notes) == 1
    assert notes[0].startswith("warning: ranges of ")


def test_sound_ranges_give_no_note(rng):
    assert kinds(rng.uniform(0.1, 2.9, 100)) == ([ECHO] * 100, [])


@given(st.lists(st.floats(width=32), max_size=30), st.floats(width=32), st.floats(width=32))
def test_an_echo_is_a_finite_range_above_0(values, low, high):
    kind = np.array(kinds(np.array(values, np.float32), low, high)[0])
    reported = np.array(values)
    assert (np.isfinite(reported) & (reported > 0))[kind == ECHO].all()
    assert not (np.isnan(reported) | np.isneginf(reported))[kind != NOT_MEASURED].any()
