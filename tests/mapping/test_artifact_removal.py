"""Lines of corners and poles, and vanished walls, are removed; walls and openings stay. Segments are made by hand."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from support import oracles

from jaxsonar import Ring
from jaxsonar.geometry.se2 import rotation
from jaxsonar.mapping.artifact_removal import (
    find_openings,
    is_pole_line,
    remove_corner_lines,
    remove_driven_through,
    remove_seen_through,
)
from jaxsonar.mapping.driven_space import DrivenSpace
from jaxsonar.mapping.free_space import DirectionalFreeSpace
from jaxsonar.mapping.observations import concatenate
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.mapping.wall_segments import WallSegments

FREE = SETTINGS.free_space
LEFT_EXACT = 1e-9


def segment(start, end, *, seen_from=None, last_seen=0.0, scan=0, info=1e4, echoes=10, count=2):
    """One segment from start to end, seen from a position on its right (default: 1 m away); its normal points away."""
    start, end = np.array(start, float), np.array(end, float)
    middle, along = (start + end) / 2, (end - start) / np.linalg.norm(end - start)
    normal = np.array([-along[1], along[0]])
    viewpoint = middle - normal if seen_from is None else np.array(seen_from, float)
    if (middle - viewpoint) @ normal < 0:
        normal = -normal
    half = np.linalg.norm(end - start) / 2
    return WallSegments(
        center=middle[None],
        theta=np.array([math.atan2(normal[1], normal[0])]),
        extent=np.array([[-half, half]]),
        info_offset=np.array([info]),
        info_theta=np.array([info]),
        chi_squared=np.zeros(1),
        count=np.array([count]),
        echoes=np.array([echoes]),
        viewing_distance=np.array([abs((middle - viewpoint) @ normal)]),
        last_seen=np.array([last_seen]),
        scans=(np.zeros(1, np.int64), np.array([scan])),
    )


def answer_of(point, pose, *, half=0.15, **about):
    """The line that a point produces at one pose: through the point, perpendicular to the line of sight."""
    sight = (np.array(point) - pose) / np.linalg.norm(np.array(point) - pose)
    across = half * np.array([-sight[1], sight[0]])
    return segment(point - across, point + across, seen_from=pose, **about)


def moved(segments, turn, shift):
    theta = oracles.wrap(segments.theta + turn)
    return dataclasses.replace(segments, center=segments.center @ rotation(turn).T + shift, theta=theta)


def echoes_of(segments):
    """Segments are identified by their numbers of echoes."""
    return sorted(segments.echoes.tolist())


def numbered(parts):
    joined = concatenate(parts)
    return dataclasses.replace(joined, echoes=np.arange(len(joined)) + 100)


def cleaned(walls):
    """Without the lines of corners, then without those of poles."""
    walls = remove_corner_lines(walls, walls)
    return walls.take(~is_pole_line(walls))


ROOM_CORNER = [
    segment((-2.0, 0.0), (-0.1, 0.0), seen_from=(-1.0, -1.0)),
    segment((0.0, -2.0), (0.0, -0.1), seen_from=(-1.0, -1.0)),
]
"""Two walls that meet at the origin; the last 10 cm of each were not observed."""


@settings(max_examples=60)
@given(st.integers(0, 10_000))
def test_lines_of_a_corner_are_removed_and_its_walls_stay(seed):
    """For several poses in the room, any orientation of the room, and any order of the lines."""
    rng = np.random.default_rng(seed)
    angle = np.radians(rng.uniform(205, 245, int(rng.integers(1, 5))))  # square to neither wall
    poses = rng.uniform(0.6, 1.8, (len(angle), 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    walls = numbered([*ROOM_CORNER, *(answer_of((0.0, 0.0), pose) for pose in poses)])
    walls = moved(walls.take(rng.permutation(len(walls))), rng.uniform(-4, 4), rng.uniform(-5, 5, 2))
    assert echoes_of(cleaned(walls)) == [100, 101]


@pytest.mark.slow
@settings(max_examples=60)
@given(st.integers(0, 10_000))
def test_lines_of_a_pole_are_removed(seed):
    """Lines through one position with different directions are a point, also near walls."""
    rng = np.random.default_rng(seed)
    first = rng.uniform(-4, 4)
    angle = first + np.radians(20) * np.arange(int(rng.integers(2, 8)))
    pole = rng.uniform(-3, 3, 2)
    poses = pole + np.stack([np.cos(angle), np.sin(angle)], axis=-1) * rng.uniform(0.6, 1.8, (len(angle), 1))
    lines = [answer_of(pole + rng.normal(0, 0.01, 2), pose) for pose in poses]
    far = segment(pole + 1.0, pole + np.array([1.0, 2.5]))
    walls = numbered([far, *lines])
    walls = moved(walls.take(rng.permutation(len(walls))), rng.uniform(-4, 4), rng.uniform(-5, 5, 2))
    assert echoes_of(cleaned(walls)) == [100]


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("length", [0.2, 0.3, 0.5])
def test_a_short_wall_perpendicular_to_the_end_of_a_long_one_stays(side, length):
    """The jamb of a door, the side of a cupboard."""
    long = segment((-2.0, 0.0), (0.0, 0.0))
    jamb = segment((0.02, 0.0), (0.02, side * length), seen_from=(1.0, 0.0))
    assert len(cleaned(concatenate([long, jamb]))) == 2


def test_a_short_wall_in_line_with_a_long_one_stays():
    """Another segment of the same wall, and a step in it."""
    long = segment((-2.0, 0.0), (0.0, 0.0))
    for offset in (0.0, 0.05):
        assert len(cleaned(concatenate([long, segment((0.05, offset), (0.35, offset))]))) == 2


def test_short_walls_apart_from_everything_stay():
    """The four sides of a box of 40 cm, each seen from its own side: a chair is not a pole."""
    corners = [(0.0, 0.0), (0.4, 0.0), (0.4, 0.4), (0.0, 0.4)]
    sides = [
        segment(np.array(a) * 0.8 + 0.04, np.array(b) * 0.8 + 0.04)
        for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)
    ]
    assert len(cleaned(concatenate(sides))) == 4


@pytest.mark.slow
@settings(max_examples=60)
@given(st.integers(0, 10_000), st.integers(0, 30))
def test_long_walls_always_stay_in_any_order_and_frame(seed, count):
    """Also among random segments; and the removal is idempotent."""
    rng = np.random.default_rng(seed)
    start, angle = rng.uniform(-1, 1, (count, 2)), rng.uniform(-4, 4, count)
    length = np.where(rng.random(count) < 0.5, rng.uniform(0.1, 0.58, count), rng.uniform(0.62, 3, count))
    end = start + length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    nothing = segment((0, 0), (1, 0)).take(np.zeros(0, np.int64))
    walls = numbered([nothing, *(segment(a, b) for a, b in zip(start, end, strict=True))])
    left = cleaned(walls)
    assert set(walls.echoes[walls.length >= SETTINGS.artifacts.min_wall_length]) <= set(left.echoes)
    assert echoes_of(cleaned(left)) == echoes_of(left)
    shuffled = walls.take(rng.permutation(count))
    assert echoes_of(cleaned(shuffled)) == echoes_of(left)
    assert echoes_of(cleaned(moved(walls, rng.uniform(-4, 4), rng.uniform(-9, 9, 2)))) == echoes_of(left)


def test_a_corner_line_beyond_the_observed_end_of_its_wall_is_removed():
    """The office's door, seed 0: the wall was seen up to 12 cm from its corner, whose line lies 3 cm off the corner."""
    door = segment((2.044, 1.971), (2.797, 2.031), seen_from=(2.4, 0.7))
    beside = segment((2.945, 1.91), (3.392, 1.939), seen_from=(3.1, 0.7))
    corner = segment((2.826, 2.066), (3.036, 1.976), seen_from=(2.4, 0.6))  # true corner: (2.916, 2.028)
    walls = numbered([door, beside, corner])
    # The center of a fused segment is not the middle between its ends.
    moved_on = dataclasses.replace(
        walls,
        center=walls.center + np.array([[0, 0], [0, 0], [0.016, -0.007]]),
        extent=walls.extent + np.array([[0], [0], [0.0175]]),
    )
    assert echoes_of(cleaned(walls)) == [100, 101]
    assert echoes_of(cleaned(moved_on)) == [100, 101]


def test_a_corner_line_does_not_remove_a_short_wall():
    """The office, seed 21: a line that is already explained by a corner does not remove a short wall beside it."""
    door = segment((2.041, 1.974), (2.961, 2.042), seen_from=(2.4, 0.7))
    beside = segment((2.918, 1.905), (3.2, 1.926), seen_from=(3.1, 0.7))
    corner = segment((2.888, 2.045), (3.098, 1.944), seen_from=(2.4, 0.6))
    assert echoes_of(cleaned(numbered([door, beside, corner]))) == [100, 101]


WALL = segment((0.0, 0.05), (2.0, 0.05), seen_from=(1.0, -1.0), last_seen=10.0, scan=3)
"""A wall of twenty parts of 10 cm, in the middle of their cells; its normal points up."""


def cells_of(wall, parts, *, turn=0.0):
    """Cells and direction of these parts of a wall along x, counted from the left."""
    left = wall.endpoints[0][np.argmin(wall.endpoints[0, :, 0])]
    places = left + (np.asarray(parts, float)[:, None] + 0.5) * FREE.cell * np.array([1.0, 0.0])
    facing = int(((wall.theta[0] + turn) % (2 * math.pi)) // (2 * math.pi / FREE.directions))
    return np.column_stack([np.floor(places / FREE.cell).astype(np.int64), np.full(len(places), facing)])


def through(parts, times, *, wall=WALL, turn=0.0):
    """Free space at these parts of a wall, at these times."""
    cells = cells_of(wall, list(parts), turn=turn)
    rows = np.tile(np.arange(len(cells)), len(times))
    return DirectionalFreeSpace().updated(cells[rows], np.repeat(np.array(times, float), len(cells)))


def extents(segments):
    """Extents of segments in x, sorted."""
    return np.sort(np.sort(segments.endpoints[:, :, 0], axis=1), axis=0)


@pytest.mark.parametrize("times", [(11, 12, 13), (5, 11, 12, 13), (30, 20, 25, 11)])
def test_a_part_that_three_later_scans_saw_through_is_removed_exactly(times):
    left = remove_seen_through(WALL, np.zeros(1, np.int64), through(range(5, 10), times))
    np.testing.assert_allclose(extents(left), [[0.0, 0.5], [1.0, 2.0]], atol=LEFT_EXACT)
    for name in ("theta", "info_offset", "info_theta", "count", "echoes", "viewing_distance", "last_seen"):
        assert (getattr(left, name) == getattr(WALL, name)).all(), name
    assert left.scan_lists() == ((3,), (3,))
    np.testing.assert_allclose(left.endpoints[:, :, 1], 0.05, atol=LEFT_EXACT)


@pytest.mark.parametrize("times", [(11, 12), (9, 11, 12), (10, 11, 12), (7, 8, 9), (1, 2, 3, 4), ()])
def test_fewer_or_earlier_scans_remove_nothing(times):
    left = remove_seen_through(WALL, np.zeros(1, np.int64), through(range(5, 10), times))
    np.testing.assert_allclose(left.endpoints, WALL.endpoints, atol=LEFT_EXACT)


def driven(way, time, *, ring=None):
    """Where a robot drove on a straight way, at one time."""
    start, end = np.array(way, float)
    poses = np.column_stack([np.linspace(start, end, 41), np.zeros(41)])
    return DrivenSpace.of(Ring.circular() if ring is None else ring, poses, np.full(41, float(time)))


ACROSS = [(1.0, -0.8), (1.0, 0.9)]
DOOR = SETTINGS.artifacts.door_time


@pytest.mark.parametrize(
    ("way", "time", "stays"),
    [
        (ACROSS, 10.0 + DOOR, False),
        (ACROSS, 12.0, False),
        (ACROSS, 10.1 - DOOR, False),
        (ACROSS, 9.9 - DOOR, True),  # a door that was closed since
        ([(-0.5, -0.3), (2.5, -0.3)], 12.0, True),  # beside the wall
        ([(2.0, -0.8), (2.0, 0.9)], 12.0, True),  # past its end
    ],
)
def test_a_segment_through_which_the_robot_drove_is_removed(way, time, stays):
    other = segment((0.0, 1.6), (2.0, 1.6), seen_from=(1.0, 0.0), last_seen=10.0)
    left = remove_driven_through(concatenate([WALL, other]), driven(way, time))
    np.testing.assert_allclose(left.center[:, 1], [0.05, 1.6] if stays else [1.6])
    assert remove_driven_through(other, DrivenSpace.empty()) is other


def test_driven_space_does_not_depend_on_the_order_of_scans():
    one, two = driven(ACROSS, 3.0), driven([(0.2, 0.1), (1.4, 0.1)], 5.0)
    both, swapped = one.union(two), two.union(one)
    np.testing.assert_array_equal(both.cells, swapped.cells)
    np.testing.assert_array_equal(both.time, swapped.time)
    points = np.array([[1.02, 0.1], [1.02, -0.6], [0.22, 0.1], [5.0, 5.0]])
    np.testing.assert_array_equal(both.latest(points), [5.0, 3.0, 5.0, -np.inf])
    np.testing.assert_array_equal(both.union(both).time, both.time)


def test_a_small_robot_fills_one_cell():
    tiny = driven([(1.0, 0.0), (1.0, 0.0)], 1.0, ring=Ring.circular(count=4, radius=0.04, neighbors=0))
    np.testing.assert_array_equal(tiny.cells, [[20, 0]])


def test_free_space_in_other_directions_removes_nothing():
    """Free space for walls that face the other way, or are perpendicular."""
    for turn in (math.pi / 2, math.pi, -math.pi / 2):
        left = remove_seen_through(WALL, np.zeros(1, np.int64), through(range(20), (11, 12, 13), turn=turn))
        np.testing.assert_allclose(left.endpoints, WALL.endpoints, atol=LEFT_EXACT)


def test_both_ends_or_the_whole_wall_can_be_removed():
    one = np.zeros(1, np.int64)
    ends = remove_seen_through(WALL, one, through([0, 1, 18, 19], (11, 12, 13)))
    np.testing.assert_allclose(extents(ends), [[0.2, 1.8]], atol=LEFT_EXACT)
    assert len(remove_seen_through(WALL, one, through(range(20), (11, 12, 13)))) == 0
    none = WALL.take(np.zeros(0, np.int64))
    assert len(remove_seen_through(none, np.zeros(0, np.int64), through(range(20), (11, 12, 13)))) == 0
    assert remove_seen_through(WALL, one, DirectionalFreeSpace()) is WALL


def test_a_part_where_the_same_wall_was_seen_since_is_kept():
    """Two segments of one wall: the later one confirms what it covers, but nothing of another wall."""
    later = segment((0.7, 0.06), (1.5, 0.06), seen_from=(1.0, -1.0), last_seen=20.0, scan=4)
    both, seen = concatenate([WALL, later]), through(range(5, 10), (11, 12, 13))
    left = remove_seen_through(both, np.zeros(2, np.int64), seen)
    np.testing.assert_allclose(extents(left), [[0.0, 0.5], [0.7, 1.5], [0.7, 2.0]], atol=LEFT_EXACT)
    apart = remove_seen_through(both, np.array([0, 1]), seen)
    np.testing.assert_allclose(extents(apart), [[0.0, 0.5], [0.7, 1.5], [1.0, 2.0]], atol=LEFT_EXACT)


def seen_through(times, part, last_seen):
    """Three later scans went through a part or its neighbors, none of them later than the last through itself."""
    own = max(times[part], default=-1)
    beside = {
        min(int(t), int(own)) for row in times[max(part - 1, 0) : part + 2] for t in sorted(row)[-FREE.remembered :]
    }
    return sum(t > last_seen for t in beside) >= 3


@pytest.mark.slow
@settings(max_examples=40)
@given(st.integers(0, 10_000), st.integers(1, 6))
def test_removal_equals_a_loop_over_parts(seed, count):
    """Random separate walls of 2 m with parts seen through at random times; a part is kept or removed as a whole."""
    rng = np.random.default_rng(seed)
    parts, cells, when, wanted = [], [], [], 0.0
    for k in range(count):
        wall = segment((0.0, 0.05 + k), (2.0, 0.05 + k), seen_from=(1.0, -9.0), last_seen=float(rng.integers(0, 9)))
        times = rng.integers(0, 15, (20, int(rng.integers(0, 5))))
        cells.append(np.repeat(cells_of(wall, range(20)), times.shape[1], axis=0))
        when.append(times.ravel().astype(float))
        gone = [seen_through(times, part, wall.last_seen[0]) for part in range(20)]
        runs = [len(list(run)) for stays, run in itertools.groupby(gone, lambda g: not g) if stays]
        wanted += FREE.cell * sum(run for run in runs if run > 1)
        parts.append(wall)
    seen = DirectionalFreeSpace().updated(np.concatenate(cells), np.concatenate(when))
    segments = concatenate(parts)
    order = rng.permutation(count)
    left = remove_seen_through(segments.take(order), order, seen)
    assert left.length.sum() == pytest.approx(wanted, abs=1e-9)
    again = remove_seen_through(left, np.arange(len(left)), seen)
    assert again.length.sum() == pytest.approx(wanted, abs=1e-9)


GAP = np.array([[[0.0, 0.05], [0.9, 0.05]]])
UP = np.array([math.pi / 2])
HERE = segment((-2.0, 0.05), (0.0, 0.05), seen_from=(-1.0, -1.0))


def is_open(*sights, seen=None):
    (open_,) = find_openings(GAP, UP, concatenate([HERE, *sights]), seen or DirectionalFreeSpace())
    return bool(open_)


def test_an_unobserved_gap_is_not_an_opening():
    assert not is_open()
    assert not find_openings(np.zeros((0, 2, 2)), np.zeros(0), HERE, DirectionalFreeSpace()).any()


@pytest.mark.parametrize(("behind", "open_"), [(1.0, True), (0.17, True), (0.08, False), (0.05, False), (-0.4, False)])
def test_a_gap_with_a_wall_seen_behind_it_is_an_opening(behind, open_):
    """A closed door in its recess is behind the wall; a chair in front, or a bump of the wall, is not."""
    door = segment((0.2, behind), (0.7, behind), seen_from=(0.45, -1.0))
    assert is_open(door) == open_
    beside = segment((1.2, behind), (1.7, behind), seen_from=(1.45, -1.0))
    assert not is_open(beside)


def test_a_wall_seen_from_behind_also_proves_an_opening():
    assert is_open(segment((0.2, -1.0), (0.7, -1.0), seen_from=(0.45, 0.8)))


@pytest.mark.parametrize(("parts", "open_"), [(9, True), (3, True), (1, False)])
def test_a_gap_with_free_space_over_more_than_12_cm_is_an_opening(parts, open_):
    wall = segment((0.0, 0.05), (0.9, 0.05), seen_from=(0.45, -1.0))
    assert is_open(seen=through(range(parts), [1], wall=wall)) == open_
    assert not is_open(seen=through(range(parts), [1], wall=wall, turn=math.pi / 2))


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.integers(0, 12))
def test_openings_equal_a_loop(seed, count):
    """Against intersections of lines of sight and gaps by shapely."""
    rng = np.random.default_rng(seed)
    gaps = rng.uniform(-2, 2, (int(rng.integers(1, 6)), 2, 2))
    middle, view = rng.uniform(-2, 2, (count, 2)), rng.uniform(-2, 2, (count, 2))
    sights = [answer_of(at, pose) for at, pose in zip(middle, view, strict=True)]
    segments = concatenate([HERE, *sights])
    viewed = [(np.array([-1.0, 0.05]), np.array([-1.0, -1.0])), *zip(middle, view, strict=True)]
    came = find_openings(gaps, np.zeros(len(gaps)), segments, DirectionalFreeSpace())
    for gap, open_ in zip(gaps, came, strict=True):
        line = shapely.LineString(gap)
        along = (gap[1] - gap[0]) / np.linalg.norm(gap[1] - gap[0])
        depth = [abs((at - gap[0]) @ np.array([-along[1], along[0]])) for at, _ in viewed]
        crosses = [line.intersects(shapely.LineString(sight)) for sight in viewed]
        clear = [cross and far > 0.06 for cross, far in zip(crosses, depth, strict=True)]
        assert open_ == any(clear)


def test_settings_are_those_that_the_tests_assume():
    assert (FREE.cell, SETTINGS.artifacts.min_wall_length, SETTINGS.artifacts.corner_radius) == (0.1, 0.6, 0.15)
