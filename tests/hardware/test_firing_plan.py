"""Which paths a device measured: only those of transmitters that fired and of receivers that listen."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar.hardware.firing_plan import FiringPlan

SENSORS, GROUPS = 8, 4
OFFSETS = (0, 1, 7)
"""Receiver minus transmitter: direct echoes, and those of both neighbors."""
PLAN = np.array([(tx % GROUPS, tx, (tx + offset) % SENSORS) for offset in OFFSETS for tx in range(SENSORS)])
NONE = np.zeros((0, 3), int)


def silent(plan: FiringPlan, arrived: Any, echoes: Any = NONE) -> set[tuple[int, ...]]:
    """{(group, tx, rx)} of the silent paths; ``echoes`` has rows (group, tx, rx)."""
    group, tx, rx = np.array(echoes).reshape(-1, 3).T
    return set(map(tuple, plan.silent_paths(np.array(arrived), tx, rx, group).tolist()))


def paths_of(groups, *, offsets=OFFSETS):
    return {(g, tx, rx) for g, tx, rx in PLAN.tolist() if g in groups and (rx - tx) % SENSORS in offsets}


def test_a_group_without_echoes_measured_its_direct_paths():
    assert silent(FiringPlan(PLAN, SENSORS), [True] * 4) == paths_of(range(4), offsets=[0])


def test_a_missing_group_measured_nothing():
    assert silent(FiringPlan(PLAN, SENSORS), [True, False, True, False]) == paths_of([0, 2], offsets=[0])


def test_neighbors_listen_once_an_echo_over_their_offset_came():
    """A device that reports direct echoes only has no silent cross paths."""
    plan = FiringPlan(PLAN, SENSORS)
    direct = {(tx % 4, tx, tx) for tx in range(8)}
    assert silent(plan, [True] * 4, sorted(direct)) == set()
    assert silent(plan, [True] * 4, [(2, 2, 3)]) == paths_of(range(4), offsets=[0, 1]) - {(2, 2, 3)}
    assert silent(plan, [True, False, False, False]) == paths_of([0], offsets=[0, 1])


def test_transmitters_that_contradict_the_plan_are_learned():
    """Sensor 5 fires in group 3, not in group 1."""
    plan = FiringPlan(PLAN, SENSORS)
    assert (1, 5, 5) in silent(plan, [True] * 4)
    assert not {(1, 5, 5), (3, 5, 5)} & silent(plan, [True] * 4, [(3, 5, 5)])
    assert (3, 5, 5) in silent(plan, [True] * 4)
    assert not {(1, 5, 5), (3, 5, 5)} & silent(plan, [True, True, True, False])


def test_one_group_for_each_sensor_fires_them_one_after_another():
    arrived = np.arange(8) == 6
    assert silent(FiringPlan(PLAN, SENSORS), arrived) == {(6, 6, 6)}


@pytest.mark.parametrize("groups", [2, 5])
def test_with_other_groups_than_planned_only_transmitters_with_an_echo_fired(groups):
    plan, arrived = FiringPlan(PLAN, SENSORS), [True] * groups
    assert silent(plan, arrived) == set()
    assert silent(plan, arrived, [(1, 3, 4)]) == {(1, 3, 3)}
    assert silent(plan, arrived) == {(1, 3, 3), (1, 3, 4)}  # learned


def test_sensors_that_fire_in_turn_scan_by_scan_are_measured_only_with_an_echo():
    plan = FiringPlan(PLAN, SENSORS)
    assert silent(plan, [True], [(0, 3, 2)]) == {(0, 3, 3)}
    assert silent(plan, [True], [(0, 4, 4)]) == {(0, 4, 3)}
    assert silent(plan, [True]) == set()


@given(seed=st.integers(0, 2**32 - 1), loss=st.floats(0, 1))
def test_a_scan_measured_the_paths_of_the_groups_that_arrived(seed, loss):
    """A device as planned: whatever is lost, its silent paths and its echoes are the paths that it measured."""
    rng = np.random.default_rng(seed)
    plan, offsets = FiringPlan(PLAN, SENSORS), {0}
    for _ in range(5):
        arrived = rng.random(GROUPS) >= loss
        echoes = PLAN[arrived[PLAN[:, 0]] & (rng.random(len(PLAN)) < 0.2)]
        heard = set(map(tuple, echoes.tolist()))
        offsets |= {(rx - tx) % SENSORS for _, tx, rx in heard}
        found = silent(plan, arrived, echoes)
        assert not found & heard
        assert found | heard == paths_of(np.flatnonzero(arrived), offsets=offsets)
