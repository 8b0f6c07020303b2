"""Corners, poles and what is no longer there leave the map; walls and openings stay. Pieces are built by hand."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from support import oracles

from jaxsonar.geometry.se2 import rotation
from jaxsonar.mapping.free_space import CELL, DIRECTIONS, LATEST, SeenThrough
from jaxsonar.mapping.ghost_removal import LONG, NEAR, openings, points_among, trim, without_corners
from jaxsonar.mapping.wall_segments import Pieces, join

LEFT_EXACT = 1e-9


def piece(start, end, *, seen_from=None, latest=0.0, scan=0, info=1e4, echoes=10, count=2):
    """One piece from start to end; its normal points away from where it was seen from (default: 1 m to the right)."""
    start, end = np.array(start, float), np.array(end, float)
    middle, along = (start + end) / 2, (end - start) / np.linalg.norm(end - start)
    normal = np.array([-along[1], along[0]])
    viewpoint = middle - normal if seen_from is None else np.array(seen_from, float)
    if (middle - viewpoint) @ normal < 0:
        normal = -normal
    half = np.linalg.norm(end - start) / 2
    return Pieces(
        centre=middle[None],
        theta=np.array([math.atan2(normal[1], normal[0])]),
        ends=np.array([[-half, half]]),
        info_offset=np.array([info]),
        info_theta=np.array([info]),
        misfit=np.zeros(1),
        count=np.array([count]),
        echoes=np.array([echoes]),
        distance=np.array([abs((middle - viewpoint) @ normal)]),
        latest=np.array([latest]),
        scans=(np.zeros(1, np.int64), np.array([scan])),
    )


def answer_of(point, pose, *, half=0.15, **about):
    """The line that a point leaves in the scan of one pose: through it, square to the line of sight."""
    sight = (np.array(point) - pose) / np.linalg.norm(np.array(point) - pose)
    across = half * np.array([-sight[1], sight[0]])
    return piece(point - across, point + across, seen_from=pose, **about)


def moved(pieces, turn, shift):
    theta = oracles.wrap(pieces.theta + turn)
    return dataclasses.replace(pieces, centre=pieces.centre @ rotation(turn).T + shift, theta=theta)


def echoes_of(pieces):
    """Pieces are told apart by their numbers of echoes."""
    return sorted(pieces.echoes.tolist())


def numbered(parts):
    joined = join(parts)
    return dataclasses.replace(joined, echoes=np.arange(len(joined)) + 100)


def cleaned(walls):
    """Without what corners leave, then without what poles leave."""
    walls = without_corners(walls, walls)
    return walls.take(~points_among(walls))


ROOM_CORNER = [
    piece((-2.0, 0.0), (-0.1, 0.0), seen_from=(-1.0, -1.0)),
    piece((0.0, -2.0), (0.0, -0.1), seen_from=(-1.0, -1.0)),
]
"""Two walls that would meet at the origin; the last 10 cm of each were not seen."""


@settings(max_examples=60)
@given(st.integers(0, 10_000))
def test_the_lines_of_a_corner_go_and_its_walls_stay(seed):
    """Seen from several poses in the room; however the room lies, and in whatever order the lines come."""
    rng = np.random.default_rng(seed)
    angle = np.radians(rng.uniform(205, 245, int(rng.integers(1, 5))))  # square to neither wall
    poses = rng.uniform(0.6, 1.8, (len(angle), 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    walls = numbered([*ROOM_CORNER, *(answer_of((0.0, 0.0), pose) for pose in poses)])
    walls = moved(walls.take(rng.permutation(len(walls))), rng.uniform(-4, 4), rng.uniform(-5, 5, 2))
    assert echoes_of(cleaned(walls)) == [100, 101]


@settings(max_examples=60)
@given(st.integers(0, 10_000))
def test_the_lines_of_a_pole_go(seed):
    """Lines through one place with different directions are a point, walls near by or not."""
    rng = np.random.default_rng(seed)
    first = rng.uniform(-4, 4)
    angle = first + np.radians(20) * np.arange(int(rng.integers(2, 8)))
    pole = rng.uniform(-3, 3, 2)
    poses = pole + np.stack([np.cos(angle), np.sin(angle)], axis=-1) * rng.uniform(0.6, 1.8, (len(angle), 1))
    lines = [answer_of(pole + rng.normal(0, 0.01, 2), pose) for pose in poses]
    far = piece(pole + 1.0, pole + np.array([1.0, 2.5]))
    walls = numbered([far, *lines])
    walls = moved(walls.take(rng.permutation(len(walls))), rng.uniform(-4, 4), rng.uniform(-5, 5, 2))
    assert echoes_of(cleaned(walls)) == [100]


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("length", [0.2, 0.3, 0.5])
def test_a_short_wall_square_to_the_end_of_a_long_one_stays(side, length):
    """The jamb of a door, the side of a cupboard."""
    long = piece((-2.0, 0.0), (0.0, 0.0))
    jamb = piece((0.02, 0.0), (0.02, side * length), seen_from=(1.0, 0.0))
    assert len(cleaned(join([long, jamb]))) == 2


def test_a_short_wall_in_line_with_a_long_one_stays():
    """Another piece of the same wall, and a step in it."""
    long = piece((-2.0, 0.0), (0.0, 0.0))
    for offset in (0.0, 0.05):
        assert len(cleaned(join([long, piece((0.05, offset), (0.35, offset))]))) == 2


def test_short_walls_apart_from_everything_stay():
    """The four sides of a box of 40 cm, each seen from its own side: a chair is no pole."""
    corners = [(0.0, 0.0), (0.4, 0.0), (0.4, 0.4), (0.0, 0.4)]
    sides = [
        piece(np.array(a) * 0.8 + 0.04, np.array(b) * 0.8 + 0.04)
        for a, b in zip(corners, [*corners[1:], corners[0]], strict=True)
    ]
    assert len(cleaned(join(sides))) == 4


@settings(max_examples=60)
@given(st.integers(0, 10_000), st.integers(0, 30))
def test_long_walls_always_stay_and_nothing_depends_on_order_or_place(seed, count):
    """Whatever else is there; and what is left is left again."""
    rng = np.random.default_rng(seed)
    start, angle = rng.uniform(-1, 1, (count, 2)), rng.uniform(-4, 4, count)
    length = np.where(rng.random(count) < 0.5, rng.uniform(0.1, 0.58, count), rng.uniform(0.62, 3, count))
    end = start + length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    nothing = piece((0, 0), (1, 0)).take(np.zeros(0, np.int64))
    walls = numbered([nothing, *(piece(a, b) for a, b in zip(start, end, strict=True))])
    left = cleaned(walls)
    assert set(walls.echoes[walls.length >= LONG]) <= set(left.echoes)
    assert echoes_of(cleaned(left)) == echoes_of(left)
    shuffled = walls.take(rng.permutation(count))
    assert echoes_of(cleaned(shuffled)) == echoes_of(left)
    assert echoes_of(cleaned(moved(walls, rng.uniform(-4, 4), rng.uniform(-9, 9, 2)))) == echoes_of(left)


def test_a_corner_beyond_the_seen_end_of_its_wall_goes():
    """The office's door, seed 0: the wall was seen up to 12 cm from its corner, whose line lies 3 cm off the corner."""
    door = piece((2.044, 1.971), (2.797, 2.031), seen_from=(2.4, 0.7))
    beside = piece((2.945, 1.91), (3.392, 1.939), seen_from=(3.1, 0.7))
    corner = piece((2.826, 2.066), (3.036, 1.976), seen_from=(2.4, 0.6))  # true corner: (2.916, 2.028)
    walls = numbered([door, beside, corner])
    # The centre of a sum is where its line is known best, not the middle between its ends.
    moved_on = dataclasses.replace(
        walls,
        centre=walls.centre + np.array([[0, 0], [0, 0], [0.016, -0.007]]),
        ends=walls.ends + np.array([[0], [0], [0.0175]]),
    )
    assert echoes_of(cleaned(walls)) == [100, 101]
    assert echoes_of(cleaned(moved_on)) == [100, 101]


def test_the_line_of_a_corner_takes_no_short_wall_along():
    """The office, seed 21: what is a corner's line already tells nothing about a short wall beside it."""
    door = piece((2.041, 1.974), (2.961, 2.042), seen_from=(2.4, 0.7))
    beside = piece((2.918, 1.905), (3.2, 1.926), seen_from=(3.1, 0.7))
    corner = piece((2.888, 2.045), (3.098, 1.944), seen_from=(2.4, 0.6))
    assert echoes_of(cleaned(numbered([door, beside, corner]))) == [100, 101]


WALL = piece((0.0, 0.05), (2.0, 0.05), seen_from=(1.0, -1.0), latest=10.0, scan=3)
"""Twenty parts of 10 cm, in the middle of their cells; its normal looks up."""


def cells_of(wall, parts, *, turn=0.0):
    """Cells and direction of these parts of a wall along x, counted from the left."""
    left = wall.segments[0][np.argmin(wall.segments[0, :, 0])]
    places = left + (np.asarray(parts, float)[:, None] + 0.5) * CELL * np.array([1.0, 0.0])
    facing = int(((wall.theta[0] + turn) % (2 * math.pi)) // (2 * math.pi / DIRECTIONS))
    return np.column_stack([np.floor(places / CELL).astype(np.int64), np.full(len(places), facing)])


def through(parts, times, *, wall=WALL, turn=0.0):
    """Seen through at these parts of a wall, at these times."""
    cells = cells_of(wall, list(parts), turn=turn)
    rows = np.tile(np.arange(len(cells)), len(times))
    return SeenThrough().including(cells[rows], np.repeat(np.array(times, float), len(cells)))


def extents(pieces):
    """Where pieces lie in x, sorted."""
    return np.sort(np.sort(pieces.segments[:, :, 0], axis=1), axis=0)


@pytest.mark.parametrize("times", [(11, 12, 13), (5, 11, 12, 13), (30, 20, 25, 11)])
def test_a_part_that_three_later_scans_saw_through_is_cut_out_exactly(times):
    left = trim(WALL, np.zeros(1, np.int64), through(range(5, 10), times))
    np.testing.assert_allclose(extents(left), [[0.0, 0.5], [1.0, 2.0]], atol=LEFT_EXACT)
    for name in ("theta", "info_offset", "info_theta", "count", "echoes", "distance", "latest"):
        assert (getattr(left, name) == getattr(WALL, name)).all(), name
    assert left.scan_lists() == ((3,), (3,))
    np.testing.assert_allclose(left.segments[:, :, 1], 0.05, atol=LEFT_EXACT)


@pytest.mark.parametrize("times", [(11, 12), (9, 11, 12), (10, 11, 12), (7, 8, 9), (1, 2, 3, 4), ()])
def test_fewer_or_earlier_scans_cut_nothing(times):
    left = trim(WALL, np.zeros(1, np.int64), through(range(5, 10), times))
    np.testing.assert_allclose(left.segments, WALL.segments, atol=LEFT_EXACT)


def test_the_other_side_of_a_wall_says_nothing():
    """Silence where a wall would face the other way, or stand square to it."""
    for turn in (math.pi / 2, math.pi, -math.pi / 2):
        left = trim(WALL, np.zeros(1, np.int64), through(range(20), (11, 12, 13), turn=turn))
        np.testing.assert_allclose(left.segments, WALL.segments, atol=LEFT_EXACT)


def test_both_ends_the_whole_and_nothing_can_be_cut():
    one = np.zeros(1, np.int64)
    ends = trim(WALL, one, through([0, 1, 18, 19], (11, 12, 13)))
    np.testing.assert_allclose(extents(ends), [[0.2, 1.8]], atol=LEFT_EXACT)
    assert len(trim(WALL, one, through(range(20), (11, 12, 13)))) == 0
    none = WALL.take(np.zeros(0, np.int64))
    assert len(trim(none, np.zeros(0, np.int64), through(range(20), (11, 12, 13)))) == 0
    assert trim(WALL, one, SeenThrough()) is WALL


def test_a_place_where_the_same_wall_was_seen_since_is_not_cut():
    """Two pieces of one wall: the later one renews what it covers, and nothing of another wall."""
    later = piece((0.7, 0.06), (1.5, 0.06), seen_from=(1.0, -1.0), latest=20.0, scan=4)
    both, seen = join([WALL, later]), through(range(5, 10), (11, 12, 13))
    left = trim(both, np.zeros(2, np.int64), seen)
    np.testing.assert_allclose(extents(left), [[0.0, 0.5], [0.7, 1.5], [0.7, 2.0]], atol=LEFT_EXACT)
    apart = trim(both, np.array([0, 1]), seen)
    np.testing.assert_allclose(extents(apart), [[0.0, 0.5], [0.7, 1.5], [1.0, 2.0]], atol=LEFT_EXACT)


def seen_through(times, part, latest):
    """Three later scans went through a part or its neighbors, none of them later than the last through itself."""
    own = max(times[part], default=-1)
    beside = {min(int(t), int(own)) for row in times[max(part - 1, 0) : part + 2] for t in sorted(row)[-LATEST:]}
    return sum(t > latest for t in beside) >= 3


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.integers(1, 6))
def test_trim_is_that_of_a_loop_over_parts(seed, count):
    """Random walls of 2 m, each its own, with parts seen through at random times: a part stays or goes as a whole."""
    rng = np.random.default_rng(seed)
    parts, cells, when, wanted = [], [], [], 0.0
    for k in range(count):
        wall = piece((0.0, 0.05 + k), (2.0, 0.05 + k), seen_from=(1.0, -9.0), latest=float(rng.integers(0, 9)))
        times = rng.integers(0, 15, (20, int(rng.integers(0, 5))))
        cells.append(np.repeat(cells_of(wall, range(20)), times.shape[1], axis=0))
        when.append(times.ravel().astype(float))
        gone = [seen_through(times, part, wall.latest[0]) for part in range(20)]
        runs = [len(list(run)) for stays, run in itertools.groupby(gone, lambda g: not g) if stays]
        wanted += CELL * sum(run for run in runs if run > 1)
        parts.append(wall)
    seen = SeenThrough().including(np.concatenate(cells), np.concatenate(when))
    pieces = join(parts)
    order = rng.permutation(count)
    left = trim(pieces.take(order), order, seen)
    assert left.length.sum() == pytest.approx(wanted, abs=1e-9)
    again = trim(left, np.arange(len(left)), seen)
    assert again.length.sum() == pytest.approx(wanted, abs=1e-9)


GAP = np.array([[[0.0, 0.05], [0.9, 0.05]]])
UP = np.array([math.pi / 2])
HERE = piece((-2.0, 0.05), (0.0, 0.05), seen_from=(-1.0, -1.0))


def is_open(*sights, seen=None):
    (open_,) = openings(GAP, UP, join([HERE, *sights]), seen or SeenThrough())
    return bool(open_)


def test_a_gap_that_nobody_looked_at_is_no_opening():
    assert not is_open()
    assert not openings(np.zeros((0, 2, 2)), np.zeros(0), HERE, SeenThrough()).any()


@pytest.mark.parametrize(("behind", "open_"), [(1.0, True), (0.17, True), (0.08, False), (0.05, False), (-0.4, False)])
def test_a_gap_with_a_wall_seen_behind_it_is_an_opening(behind, open_):
    """A door's leaf in its recess is behind the wall; a chair before it, or a bump of the wall, is not."""
    door = piece((0.2, behind), (0.7, behind), seen_from=(0.45, -1.0))
    assert is_open(door) == open_
    beside = piece((1.2, behind), (1.7, behind), seen_from=(1.45, -1.0))
    assert not is_open(beside)


def test_a_wall_seen_from_behind_counts_too():
    assert is_open(piece((0.2, -1.0), (0.7, -1.0), seen_from=(0.45, 0.8)))


@pytest.mark.parametrize(("parts", "open_"), [(9, True), (3, True), (1, False)])
def test_a_gap_that_was_silent_over_more_than_15_cm_is_an_opening(parts, open_):
    wall = piece((0.0, 0.05), (0.9, 0.05), seen_from=(0.45, -1.0))
    assert is_open(seen=through(range(parts), [1], wall=wall)) == open_
    assert not is_open(seen=through(range(parts), [1], wall=wall, turn=math.pi / 2))


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.integers(0, 12))
def test_openings_are_those_of_a_loop(seed, count):
    """Against lines of sight and gaps as shapely sees them."""
    rng = np.random.default_rng(seed)
    gaps = rng.uniform(-2, 2, (int(rng.integers(1, 6)), 2, 2))
    middle, view = rng.uniform(-2, 2, (count, 2)), rng.uniform(-2, 2, (count, 2))
    sights = [answer_of(at, pose) for at, pose in zip(middle, view, strict=True)]
    pieces = join([HERE, *sights])
    viewed = [(np.array([-1.0, 0.05]), np.array([-1.0, -1.0])), *zip(middle, view, strict=True)]
    came = openings(gaps, np.zeros(len(gaps)), pieces, SeenThrough())
    for gap, open_ in zip(gaps, came, strict=True):
        line = shapely.LineString(gap)
        along = (gap[1] - gap[0]) / np.linalg.norm(gap[1] - gap[0])
        depth = [abs((at - gap[0]) @ np.array([-along[1], along[0]])) for at, _ in viewed]
        crosses = [line.intersects(shapely.LineString(sight)) for sight in viewed]
        clear = [cross and far > 0.06 for cross, far in zip(crosses, depth, strict=True)]
        assert open_ == any(clear)


def test_constants_are_what_the_tests_were_written_for():
    assert (CELL, LONG, NEAR) == (0.1, 0.6, 0.15)
