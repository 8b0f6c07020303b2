"""Grids of logs in which not every sensor was measured in every scan, or not at the pose of the scan."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.firings import explicit, fire_in_turn, repeat_readings
from support.rooms import loop

from jaxsonar import Log, Ring, simulate
from jaxsonar.floor_plans.room import Room
from jaxsonar.occupancy.occupancy_grid import NO_WALLS, OccupancyGrid, occupancy

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


def beam_counts(grid):
    """Where the beams were, the counts of free, occluded and arcs, and the viewpoints."""
    return grid.corner, *grid.counts[:3], grid.viewpoints


def assert_same_beams(one, other):
    for a, b in zip(beam_counts(one), beam_counts(other), strict=True):
        np.testing.assert_array_equal(a, b)


def aligned(*grids):
    """The counts of several grids in one frame of cells."""
    total = grids[0]
    for grid in grids[1:]:
        total += grid
    out = []
    for grid in grids:
        counts = np.zeros((5, *total.free.shape), int)
        column, row = np.subtract(grid.corner, total.corner)
        counts[:, row : row + grid.free.shape[0], column : column + grid.free.shape[1]] = grid.counts
        out.append(counts)
    return out


@pytest.mark.parametrize("trajectory", [pausing, driving])
@pytest.mark.parametrize("walls", [NO_WALLS, SOME_WALLS], ids=["no walls", "walls"])
def test_one_firing_per_scan_gives_the_grid_of_full_scans(trajectory, walls):
    together, alone = fire_in_turn(RING, ROOM, trajectory, 6, sigma=0.003)
    assert len(alone) == 12 * len(together)
    assert occupancy(RING, alone, walls=walls) == occupancy(RING, together, walls=walls)


@pytest.mark.parametrize("trajectory", [pausing, driving])
def test_every_beam_starts_where_its_sensor_fired(trajectory):
    """Without known walls, the grid of a scan is the sum of the grids of its firings, each at its own pose."""
    together, alone = fire_in_turn(RING, ROOM, trajectory, 4, sigma=0.003)
    total = OccupancyGrid.empty()
    for firing in alone:
        total = total.add(RING, firing)
    counts, expected = aligned(occupancy(RING, together), total)
    np.testing.assert_array_equal(counts[:3], expected[:3])


@settings(max_examples=5)
@given(st.integers(0, 10_000), st.floats(0, 1))
def test_a_path_without_a_measurement_is_no_evidence(seed, share):
    rng = np.random.default_rng(seed)
    poses = driving(0.3 * np.arange(5))
    log = simulate(RING, ROOM, poses, seed=seed).as_log(RING, poses)
    measured = rng.random((len(log), len(RING.paths))) < share
    fewer, all_of_them = aligned(
        *(occupancy(RING, explicit(RING, log, paths), walls=SOME_WALLS) for paths in (measured, np.ones_like(measured)))
    )
    assert (fewer[:3] <= all_of_them[:3]).all()
    # The rest: what the other paths contribute without known walls.
    parts = [occupancy(RING, explicit(RING, log, paths)) for paths in (measured, ~measured)]
    counts, expected = aligned(parts[0] + parts[1], occupancy(RING, log))
    np.testing.assert_array_equal(counts[:3], expected[:3])


def test_explicit_silence_is_the_silence_of_a_path_that_every_scan_measures():
    poses = driving(0.3 * np.arange(5))
    log = simulate(RING, ROOM, poses).as_log(RING, poses)
    written = explicit(RING, log, np.ones((len(log), len(RING.paths)), bool))
    assert len(written.tx) > log.echo_count == written.echo_count
    assert occupancy(RING, written, walls=SOME_WALLS) == occupancy(RING, log, walls=SOME_WALLS)


def test_a_repeated_reading_adds_nothing():
    poses = driving(0.3 * np.arange(5))
    log = simulate(RING, ROOM, poses, stamps=0.3 * np.arange(5)).as_log(RING, poses)
    log = explicit(RING, log, np.ones((len(log), len(RING.paths)), bool))
    moved = repeat_readings(log, age=0.125, poses=driving(log.stamp + 0.125))
    assert_same_beams(occupancy(RING, moved, walls=SOME_WALLS), occupancy(RING, log, walls=SOME_WALLS))


def test_an_old_reading_counts_at_the_pose_of_its_measurement():
    stamp = 0.25 * np.arange(8)
    poses = driving(stamp)
    log = simulate(RING, ROOM, poses[:-1], stamps=stamp[:-1]).as_log(RING, poses[:-1])
    log = explicit(RING, log, np.ones((len(log), len(RING.paths)), bool))
    late = replace(log, stamp=stamp[1:], pose=poses[1:], age=np.full(len(log.tx), 0.25))
    late = replace(late, odometry=np.column_stack([stamp, poses]))
    assert_same_beams(occupancy(RING, late), occupancy(RING, log))


def test_a_reading_from_far_away_needs_no_larger_neighborhood():
    """A reading of a robot that has driven 50 m since: both places are on the grid, and only the first has beams."""
    stamp, poses = np.array([0.0, 50.0]), np.array([[0.0, 0.0, 0.3], [50.0, 0.0, 0.3]])
    here = {"stamp": stamp[1:], "pose": poses[1:], "odometry": np.column_stack([stamp, poses])}
    one = np.zeros(1, int)
    old = occupancy(RING, Log.from_echoes(one, one, one, np.array([1.0]), age=np.array([50.0]), **here))
    there = Log.from_echoes(one, one, one, np.array([1.0]), stamp=stamp[:1], pose=poses[:1])
    counts, expected = aligned(old, occupancy(RING, there))
    np.testing.assert_array_equal(counts[:3], expected[:3])
    assert np.ptp(np.nonzero(counts[4].any(axis=0))[0]) < 20
