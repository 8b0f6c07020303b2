"""Grids of logs in which not every sensor was measured in every scan, or not at the pose of the scan."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.firings import explicit, fire_in_turn, repeat_readings
from support.grid_layers import assert_same_evidence, evidence_of, layers
from support.rooms import loop

from jaxsonar import Log, Ring, simulate
from jaxsonar.floor_plans.room import Room
from jaxsonar.occupancy import grid_evidence
from jaxsonar.occupancy.direct_readings import certain_angle
from jaxsonar.occupancy.grid_evidence import GridEvidence
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.occupancy.occupancy_grid import NO_WALLS

RING = Ring.circular(count=12, beam=0.7, neighbors=1)
WALLS = loop([(-1.7, -1.2), (1.6, -1.2), (1.6, 1.3), (-1.7, 1.3)])
ROOM = Room(WALLS, (), np.array([[0.9, 0.4]]))
SOME_WALLS = WALLS[:2]


def driving(time):
    """A robot on an arc, turning at 40 deg/s."""
    theta = 0.7 * time
    return np.stack([-0.6 + 0.3 * np.sin(theta), -0.3 + 0.3 * (1 - np.cos(theta)), theta], axis=-1)


def pausing(time):
    """A robot that stands still during every scan of the ring."""
    scan = np.floor(np.round(time / 0.3, 6))
    return driving(0.3 * scan)


@pytest.mark.parametrize("trajectory", [pausing, driving])
@pytest.mark.parametrize("walls", [NO_WALLS, SOME_WALLS], ids=["no walls", "walls"])
def test_one_firing_per_scan_is_the_evidence_of_full_scans(trajectory, walls):
    together, alone = fire_in_turn(RING, ROOM, trajectory, 6, sigma=0.003)
    assert len(alone) == 12 * len(together)
    assert_same_evidence(evidence_of(RING, alone, walls=walls), evidence_of(RING, together, walls=walls))


@pytest.mark.parametrize("trajectory", [pausing, driving])
def test_every_beam_starts_where_its_sensor_fired(trajectory):
    """Without known walls, the looks of a scan are the sum of the looks of its firings, each at its own pose."""
    together, alone = fire_in_turn(RING, ROOM, trajectory, 4, sigma=0.003)
    whole = evidence_of(RING, together)
    (passes, looks, _), (_, expected, _) = layers(whole, evidence_of(RING, *(firing.as_log() for firing in alone)))
    assert np.abs(looks - expected).max() <= len(together) * 12 / 2  # each look is rounded to 1/16
    assert looks.max() > 10 * len(together)
    assert passes.max() == len(together)  # a scan counts once for each direction


@settings(max_examples=5)
@given(st.integers(0, 10_000), st.floats(0, 1))
def test_a_path_without_a_measurement_is_no_evidence(seed, share):
    rng = np.random.default_rng(seed)
    poses = driving(0.3 * np.arange(5))
    log = simulate(RING, ROOM, poses, seed=seed).as_log(RING, poses)
    measured = rng.random((len(log), len(RING.paths))) < share
    parts = [explicit(RING, log, paths) for paths in (measured, ~measured, np.ones_like(measured))]
    some, rest, whole = (evidence_of(RING, part) for part in parts)
    (passes, looks, _), (other_passes, other_looks, _), (all_passes, all_looks, _) = layers(some, rest, whole)
    assert (passes <= all_passes).all()
    assert (all_passes <= passes + other_passes).all()
    assert np.abs(looks + other_looks - all_looks).max() <= len(log)


def test_explicit_silence_is_the_silence_of_a_path_that_every_scan_measures():
    poses = driving(0.3 * np.arange(5))
    log = simulate(RING, ROOM, poses).as_log(RING, poses)
    written = explicit(RING, log, np.ones((len(log), len(RING.paths)), bool))
    assert len(written.tx) > log.echo_count == written.echo_count
    assert_same_evidence(evidence_of(RING, written, walls=SOME_WALLS), evidence_of(RING, log, walls=SOME_WALLS))


def test_a_repeated_reading_adds_nothing():
    poses = driving(0.3 * np.arange(5))
    log = simulate(RING, ROOM, poses, stamps=0.3 * np.arange(5)).as_log(RING, poses)
    log = explicit(RING, log, np.ones((len(log), len(RING.paths)), bool))
    moved = repeat_readings(log, age=0.125, poses=driving(log.stamp + 0.125))
    one, other = (evidence_of(RING, some, walls=SOME_WALLS) for some in (moved, log))
    assert_same_evidence(one, other, footprint=False)


def test_an_old_reading_counts_at_the_pose_of_its_measurement():
    stamp = 0.25 * np.arange(8)
    poses = driving(stamp)
    log = simulate(RING, ROOM, poses[:-1], stamps=stamp[:-1]).as_log(RING, poses[:-1])
    log = explicit(RING, log, np.ones((len(log), len(RING.paths)), bool))
    late = replace(log, stamp=stamp[1:], pose=poses[1:], age=np.full(len(log.tx), 0.25))
    late = replace(late, odometry=np.column_stack([stamp, poses]))
    (passes, looks, _), (expected, expected_looks, _) = layers(evidence_of(RING, late), evidence_of(RING, log))
    # The tiles lie elsewhere: float32 decides otherwise at borders of cones.
    assert np.mean((passes > 0) != (expected > 0)) < 1e-3
    assert np.abs(looks - expected_looks).max() <= 2 * len(log)


def test_a_reading_from_far_away_is_seen_where_it_was_measured():
    """A reading of a robot that has driven 20 m since: only the first place was seen through."""
    stamp, poses = np.array([0.0, 20.0]), np.array([[0.0, 0.0, 0.3], [20.0, 0.0, 0.3]])
    here = {"stamp": stamp[1:], "pose": poses[1:], "odometry": np.column_stack([stamp, poses])}
    one = np.zeros(1, int)
    old = evidence_of(RING, Log.from_echoes(one, one, one, np.array([1.0]), age=np.array([20.0]), **here))
    there = Log.from_echoes(one, one, one, np.array([1.0]), stamp=stamp[:1], pose=poses[:1])
    (passes, _, footprint), (expected, _, _) = layers(old, evidence_of(RING, there))
    np.testing.assert_array_equal(passes > 0, expected > 0)
    assert np.ptp(np.nonzero(footprint.any(axis=0))[0]) < 20


def test_memory_and_arcs_grow_with_the_floor_not_with_the_scans():
    """A robot that drives the same circle again and again adds scans, but no arcs."""
    poses = driving(0.3 * np.arange(30))
    logs = [simulate(RING, ROOM, poses, seed=seed, sigma=1e-4).as_log(RING, poses) for seed in range(4)]
    arcs = [len(evidence_of(RING, *logs[:count], method="em").arcs.path) for count in (1, 4)]
    assert arcs[1] < 2 * arcs[0]
    echoes = evidence_of(RING, *logs, method="em").arcs.echoes.sum()
    assert echoes > 3.5 * evidence_of(RING, logs[0], method="em").arcs.echoes.sum()


def test_arcs_are_thinned_to_the_largest_number(monkeypatch):
    poses = driving(0.3 * np.arange(10))
    log = simulate(RING, ROOM, poses).as_log(RING, poses)
    monkeypatch.setattr(grid_evidence, "SETTINGS", replace(grid_evidence.SETTINGS, max_arcs=50))
    evidence = evidence_of(RING, log, method="em")
    assert 10 < len(evidence.arcs.path) <= 50
    assert evidence.arcs.echoes.sum() == log.echo_count


@pytest.mark.parametrize("method", ["em", "wilkes", "elfes"])
def test_methods_keep_the_echoes_of_the_paper_they_come_from(method):
    poses = driving(0.3 * np.arange(4))
    log = simulate(RING, ROOM, poses).as_log(RING, poses)
    arcs = evidence_of(RING, log, method=method).arcs
    tx, rx = RING.paths[arcs.path].T
    direct = log.tx == log.rx
    scan_sensor = np.unique(log.echo_scan[direct] * 100 + log.tx[direct])
    expected = {"em": log.echo_count, "wilkes": direct.sum(), "elfes": len(scan_sensor)}
    assert arcs.echoes.sum() == expected[method]
    assert (tx == rx).all() == (method != "em")


def test_the_certain_angle_is_that_up_to_which_a_calibration_heard_its_walls():
    edges = np.radians([0.0, 5.0, 10.0, 15.0, 20.0])
    expected = np.array([400, 100, 40, 10])
    assert certain_angle(edges, expected, np.array([396, 92, 24, 9])) == edges[2]
    assert certain_angle(edges, expected, np.array([396, 92, 38, 10])) == edges[3]  # too few beyond
    assert certain_angle(edges, expected, np.array([200, 92, 38, 10])) is None
    assert certain_angle(edges, np.zeros(4, int), np.zeros(4, int)) is None


def test_a_smaller_certain_angle_sees_through_fewer_cells():
    poses = driving(0.3 * np.arange(4))
    log = simulate(RING, ROOM, poses).as_log(RING, poses)
    found = []
    for certain in (0.05, 0.2, None, 2.0):
        evidence = GridEvidence(RING, certain=certain)
        evidence.add(log, KnownReflectors.of_walls(NO_WALLS))
        found.append(evidence.passes > 0)
    for narrow, wide in pairwise(found):  # 60 % of 0.35 rad if omitted
        assert (narrow & ~wide).sum() < 0.01 * wide.sum()  # cells at the sensors themselves
        assert narrow.sum() < wide.sum()
    assert found[0].sum() < 0.5 * found[3].sum()
