"""Growth of walls over single echoes: what extends a wall, what ends it, and what creates none."""

import itertools
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.hard_cones import simulate

from jaxsonar import Log, Ring, Room, load_log, load_ring
from jaxsonar.geometry.segments import point_to_segments
from jaxsonar.mapping.build_map import build_map
from jaxsonar.mapping.driven_space import DrivenSpace
from jaxsonar.mapping.observations import concatenate
from jaxsonar.mapping.wall_growth import _best_intervals, grow_walls
from jaxsonar.mapping.wall_segments import WallSegments
from jaxsonar.reflectors.range_measurements import RangeMeasurements

SIGMA = 0.01
SONARS = Ring.circular(count=8, radius=0.2, beam=math.radians(50.0), neighbors=0, max_range=3.0)
NOWHERE = DrivenSpace.empty()


def seed(start, end, *, y=1.0):
    """A known wall along x, seen from below."""
    return WallSegments(
        center=np.array([[(start + end) / 2, y]]),
        theta=np.array([math.pi / 2]),
        extent=np.array([[start - end, end - start]]) / 2,
        info_offset=np.array([1e4]),
        info_theta=np.array([1e3]),
        chi_squared=np.zeros(1),
        count=np.ones(1, dtype=np.int64),
        echoes=np.array([4]),
        viewing_distance=np.array([1.0]),
        last_seen=np.zeros(1),
        scans=(np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64)),
    )


def upward(x, distance):
    """Measurements of one sensor at (x, 0) that faces the wall; inf: silence."""
    x, distance = np.asarray(x, dtype=np.float64), np.asarray(distance, dtype=np.float64)
    rows = np.arange(len(x))
    return RangeMeasurements(
        origin=np.column_stack([x, np.zeros(len(x))]),
        half_baseline=np.zeros((len(x), 2)),
        axis=np.full(len(x), math.pi / 2),
        half_width=np.full(len(x), math.radians(15.0)),
        distance=distance,
        is_first=np.ones(len(x), dtype=bool),
        scan=rows,
        time=rows.astype(np.float64),
        section=rows,
        measurement=rows,
        max_range=3.0,
    )


KNOWN = np.arange(0.0, 1.01, 0.1)
"""Positions of the echoes of the known wall."""


def grown(x, distance, *, walls=None, driven=NOWHERE):
    """Walls that the echoes of the known wall and these measurements support."""
    heard = upward(np.append(KNOWN, x), np.append(np.ones(len(KNOWN)), distance))
    return grow_walls(seed(0.0, 1.0) if walls is None else walls, heard, driven, sigma=SIGMA)


def ends(walls):
    return np.sort(walls.endpoints[:, :, 0], axis=1)


def test_one_echo_extends_a_wall_across_a_short_gap_only():
    np.testing.assert_allclose(ends(grown([1.4], [1.0])), [[0.0, 1.4]], atol=1e-6)
    np.testing.assert_allclose(ends(grown([2.1], [1.0])), [[0.0, 1.0]], atol=1e-6)
    np.testing.assert_allclose(ends(grown([1.4, 1.8], [1.0, 1.0])), [[0.0, 1.8]], atol=1e-6)


def test_no_echo_creates_a_wall():
    heard = upward(KNOWN, np.ones(len(KNOWN)))
    assert not len(grow_walls(seed(0.0, 1.0).take(np.arange(0)), heard, NOWHERE))
    assert len(grown(KNOWN + 4.0, np.ones(len(KNOWN)))) == 1
    assert not len(grow_walls(seed(0.0, 1.0), upward([0.2, 0.6], [1.0, 1.0]), NOWHERE))


@pytest.mark.parametrize("distance", [1.5, 2.5, np.inf])
def test_a_wall_does_not_grow_across_an_opening(distance):
    """Echoes beyond the opening become no wall, because nothing but their line says that there is one."""
    x = np.array([1.1, 1.2, 1.3, 1.4, 1.5])
    beyond = np.array([1.6, 1.7])
    walls = grown(np.append(x, beyond), np.append(np.full(len(x), distance), [1.0, 1.0]))
    np.testing.assert_allclose(ends(walls), [[0.0, 1.0]], atol=1e-6)


def test_a_known_wall_is_cut_where_echoes_come_from_behind_it():
    x = np.arange(0.0, 3.01, 0.1)
    distance = np.where((x > 0.95) & (x < 2.05), 1.8, 1.0)
    walls = grow_walls(seed(0.0, 3.0), upward(x, distance), NOWHERE)
    assert len(walls) == 2
    np.testing.assert_allclose(np.sort(ends(walls), axis=0), [[0.0, 0.9], [2.1, 3.0]], atol=1e-6)
    assert not len(grow_walls(seed(1.0, 2.0), upward(x, distance), NOWHERE))


def test_echoes_that_are_too_short_do_not_end_a_wall():
    np.testing.assert_allclose(ends(grown([1.1, 1.2, 1.3, 1.4], [0.5, 0.4, 0.5, 1.0])), [[0.0, 1.4]], atol=1e-6)


def test_a_wall_does_not_grow_where_the_robot_drove():
    pose = np.column_stack([np.full(9, 1.2), np.linspace(0.6, 1.4, 9), np.full(9, math.pi / 2)])
    driven = DrivenSpace.of(SONARS, pose, np.full(9, 5.0))
    np.testing.assert_allclose(ends(grown([1.4], [1.0], driven=driven)), [[0.0, 1.0]], atol=1e-6)


def test_collinear_walls_become_one_if_echoes_close_the_gap():
    both = concatenate([seed(0.0, 1.0), seed(1.6, 2.6)])
    x = np.arange(1.6, 2.61, 0.1)
    closed = grown(np.append(x, 1.3), np.ones(len(x) + 1), walls=both)
    np.testing.assert_allclose(ends(closed), [[0.0, 2.6]], atol=1e-6)
    assert closed.echoes.tolist() == [len(KNOWN) + len(x) + 1]
    opened = grown(np.append(x, [1.2, 1.3, 1.4]), np.append(np.ones(len(x)), [2.0, 2.0, 2.0]), walls=both)
    assert len(opened) == 2


def test_a_second_line_on_the_same_echoes_is_dropped():
    slanted = replace(seed(0.2, 0.8, y=1.01), theta=np.array([math.pi / 2 + 0.05]))
    walls = grown([], [], walls=concatenate([slanted, seed(0.0, 1.0)]))
    np.testing.assert_allclose(walls.endpoints[:, :, 1], 1.0, atol=1e-3)


def test_a_line_behind_a_wall_is_dropped():
    walls = concatenate([seed(0.0, 1.0), seed(0.2, 0.8, y=1.5)])
    x = np.array([0.25, 0.35, 0.45, 0.55, 0.65, 0.75])
    assert len(grown(x, np.full(len(x), 1.5), walls=walls)) == 1


def test_the_line_is_fitted_to_the_echoes_and_outliers_hardly_move_it():
    x = np.arange(0.0, 2.01, 0.1)
    distance = np.hypot(1.0, 0.0) + 0.03 * x / np.hypot(1, 0.03)
    distance[5] += 0.04
    walls = grow_walls(seed(0.0, 2.0, y=1.02), upward(x, distance), NOWHERE, sigma=0.02)
    assert len(walls) == 1
    slope = np.diff(walls.endpoints[0, :, 1]) / np.diff(walls.endpoints[0, :, 0])
    assert slope == pytest.approx(0.03, abs=0.002)


@given(
    score=st.lists(st.floats(-4, 4).map(lambda value: round(value, 2)), min_size=1, max_size=9),
    switch=st.floats(0.1, 3).map(lambda value: round(value, 2)),
)
@settings(max_examples=60)
def test_the_best_intervals_are_those_of_an_exhaustive_search(score, switch):
    def gain(states):
        edges = np.count_nonzero(np.diff(np.concatenate([[0], states, [0]])))
        return float(np.dot(states, score)) - switch * edges

    found = np.zeros(len(score), dtype=int)
    for first, last in _best_intervals(np.array(score), switch):
        assert not found[first : last + 1].any()
        found[first : last + 1] = 1
    best = max(gain(np.array(states)) for states in itertools.product((0, 1), repeat=len(score)))
    assert gain(found) == pytest.approx(best, abs=1e-9)


# Maps of simulated and recorded runs

HALL = Room(
    np.array([[[0.0, 0.0], [6.0, 0.0]], [[6.0, 0.0], [6.0, 4.0]], [[6.0, 4.0], [0.0, 4.0]], [[0.0, 4.0], [0.0, 0.0]]])
)


def drive(seed=0, noise=SIGMA):
    """A log of a sparse ring along a rectangle in the hall."""
    corners = np.array([[1.2, 1.1], [4.9, 1.0], [4.8, 2.9], [1.1, 3.0], [1.2, 1.3]])
    legs = [np.linspace(a, b, int(np.hypot(*(b - a)) / 0.08)) for a, b in itertools.pairwise(corners)]
    heading = [np.full(len(leg), math.atan2(*(leg[-1] - leg[0])[::-1])) for leg in legs]
    poses = np.column_stack([np.concatenate(legs), np.concatenate(heading)])
    return simulate(SONARS, HALL, poses, sigma=noise, seed=seed).as_log(SONARS, poses)


@cache
def world_of(seed=0, window=1.5):
    """The map of a drive."""
    return build_map(SONARS, drive(seed), window=window)


def covered(world, *, within=0.05):
    """Share of the walls of the hall that lies on walls of a map."""
    share = np.linspace(0, 1, 100)[:, None]
    points = np.concatenate([start + share * (end - start) for start, end in HALL.walls])
    if not len(world):
        return 0.0
    return float((point_to_segments(points, world.segments).min(axis=1) < within).mean())


def test_the_map_hardly_depends_on_the_length_of_the_windows():
    worlds = [world_of(window=window) for window in (0.8, 1.5, 3.0)]
    assert [len(world) for world in worlds] == [4, 4, 4]
    np.testing.assert_allclose([world.length.sum() for world in worlds], worlds[0].length.sum(), atol=0.3)
    assert min(covered(world) for world in worlds) > 0.5


@pytest.mark.slow
def test_the_map_moves_with_the_poses():
    log = drive()
    turn, shift = 0.7, np.array([30.0, -20.0])
    cos, sin = math.cos(turn), math.sin(turn)
    rotation = np.array([[cos, -sin], [sin, cos]])
    pose = np.column_stack([log.pose[:, :2] @ rotation.T + shift, log.pose[:, 2] + turn])
    here, there = world_of(), build_map(SONARS, replace(log, pose=pose), window=1.5)
    wanted = here.segments @ rotation.T + shift
    apart = np.linalg.norm(wanted[:, None, :, None] - there.segments[None, :, None, :], axis=-1)
    assert np.abs(apart.min(axis=3).max(axis=2).min(axis=1)).max() < 0.1
    np.testing.assert_allclose(there.length.sum(), here.length.sum(), rtol=0.02)


@pytest.mark.slow
def test_standard_deviations_of_lines_agree_with_their_errors():
    """Deviations of rho over many runs, normalised by the stated standard deviation."""
    normalised = []
    for number in range(4):
        world = world_of(number)
        for rho, theta, sd in zip(world.rho, world.theta, world.sigma_rho, strict=True):
            far = 6.0 if abs(math.cos(theta)) > 0.7 else 4.0
            normalised.append(min(abs(rho), abs(rho - far)) / sd)
    assert len(normalised) == 16
    assert 0.2 < np.sqrt(np.mean(np.square(normalised))) < 2.0


def test_sigma_applies_to_windows():
    log = drive(noise=0.03)
    known, wrong = (build_map(SONARS, log, window=1.5, sigma=sigma) for sigma in (0.03, 0.001))
    assert covered(known, within=0.08) > covered(wrong, within=0.08) + 0.2


def test_without_growth_windows_have_one_length():
    plain = build_map(SONARS, drive(), window=1.5, grow=False)
    assert covered(world_of()) > covered(plain)


@pytest.mark.slow
def test_maps_of_single_scans_do_not_grow():
    log = drive()
    one, other = (build_map(SONARS, log, grow=grow) for grow in (False, True))
    np.testing.assert_array_equal(one.segments, other.segments)


def test_a_wall_is_found_with_windows_of_any_length():
    folder = Path(__file__).resolve().parents[3] / "shared" / "cases" / "window_misses_wall"
    if not folder.is_dir():
        pytest.skip("the shared case window_misses_wall is not here")
    ring, log = load_ring(str(folder / "ring.toml")), load_log(str(folder / "log8.csv"))
    for window in (0.8, 1.5):
        world = build_map(ring, log, window=window)
        assert len(world) == 4
        assert world.length.sum() > 10


def test_an_empty_log_gives_no_wall():
    assert not len(build_map(SONARS, Log.from_scans([])[:0], window=1.5))
