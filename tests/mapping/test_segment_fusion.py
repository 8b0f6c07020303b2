"""Fusion of segments into walls: invariance to order and rigid motions, gates, and no matching walls left."""

from itertools import combinations

import numpy as np
import pytest
import shapely
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from support.segments import moved, same, segments_at

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.mapping.observations import concatenate
from jaxsonar.mapping.segment_fusion import compare_segments, fuse_segments
from jaxsonar.mapping.settings import SETTINGS

NOISE = SETTINGS.segments
GAP = 0.5
SEEDS = st.integers(0, 2**32 - 1)
SOME = settings(max_examples=10, phases=[Phase.generate])
"""No shrinking: a smaller seed is not a simpler example."""
DOOR, THICK = 0.9, 0.12
HOUSE = np.array(
    [
        # A room of 6 m x 4 m from inside, walls counter-clockwise as seen from there.
        [[6, 0], [6, 4]], [[6, 4], [0, 4]], [[0, 4], [0, 0]], [[0, 0], [6, 0]],
        # A partition with a door, from both its sides.
        [[3, 0], [3, 1.5]], [[3, 1.5 + DOOR], [3, 4]],
        [[3 + THICK, 1.5], [3 + THICK, 0]], [[3 + THICK, 4], [3 + THICK, 1.5 + DOOR]],
    ]
)  # fmt: skip


def seen_walls(rng, walls, each, *, noise=1.0, reach=0.2):
    """Segments of walls with the noise of the Hough detector, seen from the left, and the wall of each."""
    wall = np.repeat(np.arange(len(walls)), each)
    along = walls[wall, 1] - walls[wall, 0]
    size = np.linalg.norm(along, axis=-1)
    tangent = along / size[:, None]
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=-1)
    place = np.tile((np.arange(each) + 0.5) / each, len(walls)) * (size - 2 * reach) + reach
    center = walls[wall, 0] + place[:, None] * tangent
    center += noise * rng.normal(0, NOISE.offset_sd, len(wall))[:, None] * normal
    theta = np.arctan2(normal[:, 1], normal[:, 0]) + noise * rng.normal(0, NOISE.theta_sd, len(wall))
    order = rng.permutation(len(wall))
    return segments_at(center, theta, length=2 * reach).take(order), wall[order]


def every_pair(count):
    return np.array(list(combinations(range(count), 2)), np.int64).reshape(-1, 2)


def mismatch(segments, pairs, gap=GAP):
    return compare_segments(segments, pairs, gap, SETTINGS.fusion.offset_floor)[0]


def least_mismatch(walls, gap=GAP):
    return mismatch(walls, every_pair(len(walls)), gap=gap).min(initial=np.inf)


def partition(labels):
    return {frozenset(np.flatnonzero(labels == k).tolist()) for k in np.unique(labels)}


def in_one_order(walls):
    """The walls in the order of the scans that saw them; every scan sees one segment."""
    lists = walls.scan_lists()
    return walls.take(np.array(sorted(range(len(walls)), key=lists.__getitem__), np.int64))


def near(one, two, tolerance):
    one, two = in_one_order(one), in_one_order(two)
    assert len(one) == len(two)
    assert np.abs(wrap_angle(one.theta - two.theta)).max() < tolerance
    assert np.abs(one.endpoints - two.endpoints).max() < tolerance
    for name in ("info_offset", "info_theta", "chi_squared"):
        assert getattr(one, name) == pytest.approx(getattr(two, name), rel=1e-6), name
    assert one.echoes.tolist() == two.echoes.tolist()
    assert one.scan_lists() == two.scan_lists()


def clutter(rng, count):
    theta, length, scan = rng.uniform(-np.pi, np.pi, count), rng.uniform(0.1, 0.9, count), 1000 + np.arange(count)
    return segments_at(rng.uniform(0, 5, (count, 2)), theta, length=length, scans=(np.arange(count), scan))


def crowd(rng):
    """Walls, and segments that belong to none."""
    walls, _ = seen_walls(rng, HOUSE[rng.permutation(8)[:4]], int(rng.integers(2, 9)))
    return concatenate([walls, clutter(rng, int(rng.integers(0, 12)))])


# --- the result ---


@pytest.mark.slow
@SOME
@given(SEEDS)
def test_segments_of_a_house_become_its_walls(seed):
    """Doors stay open, the two faces of a partition stay separate, and walls do not join at corners."""
    segments, truth = seen_walls(np.random.default_rng(seed), HOUSE, 24, noise=0.7)
    walls, wall_of = fuse_segments(segments, gap=GAP)
    assert partition(wall_of) == partition(truth)
    for k, ends in enumerate(walls.endpoints):
        true = HOUSE[truth[wall_of == k][0]]
        true = shapely.LineString(true)
        assert shapely.hausdorff_distance(shapely.LineString(ends), true) < 0.15
        assert true.buffer(0.02, cap_style="square").covers(shapely.LineString(ends).interpolate(0.5, normalized=True))
    assert walls.count.tolist() == [24] * 8


@SOME
@given(SEEDS, st.sampled_from([0.2, 0.5, 1.0]))
def test_no_two_walls_match(seed, gap):
    assert least_mismatch(fuse_segments(crowd(np.random.default_rng(seed)), gap=gap)[0], gap) > 1


def parallels(offset, first, last, *, theta=0.0):
    """Long parallel walls with small covariances."""
    first, last = np.broadcast_arrays(np.asarray(first, float), np.asarray(last, float), offset)[:2]
    center = np.stack([np.asarray(offset, float), (first + last) / 2], axis=-1)
    sure = np.full(len(center), 1e6)
    return segments_at(center, theta + 0 * first, length=last - first, info_offset=sure, info_theta=sure)


@pytest.mark.parametrize("beside", range(13))
def test_no_two_walls_match_among_many_parallel_walls(beside):
    """Two collinear walls with a gap of 0.45 m, among parallel walls 6.5 cm apart."""
    away = [0.065 * (k // 2 + 1) * (-1) ** k for k in range(beside)]
    segments = parallels([0, 0, *away], [-2, 0.45] + [-2.2] * beside, [0, 2] + [2.2] * beside)
    walls, wall_of = fuse_segments(segments, gap=GAP)
    assert least_mismatch(walls) > 1
    assert wall_of[0] == wall_of[1]
    assert len(walls) == 1 + beside


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.05, 0.1, 0.2, 0.5])
def test_no_two_walls_match_at_any_angle(gap):
    """Also for gaps that are small compared with the search radius of directions."""
    for degrees in range(1, 40):
        segments = segments_at([[0, 0], [0, 0.3 + gap]], np.radians([0, degrees]), length=0.3)
        for one in (segments, segments_at([[0, 0], [0, 0]], np.radians([0, degrees]))):
            assert least_mismatch(fuse_segments(one, gap=gap)[0], gap) > 1, degrees


@SOME
@given(SEEDS)
def test_every_segment_lies_on_its_wall(seed):
    segments = crowd(np.random.default_rng(seed))
    walls, wall_of = fuse_segments(segments, gap=GAP)
    assert sorted(set(wall_of.tolist())) == list(range(len(walls)))
    lists = segments.scan_lists()
    for k, ends in enumerate(walls.endpoints):
        mine = np.flatnonzero(wall_of == k)
        assert walls.count[k] == len(mine)
        assert walls.echoes[k] == segments.echoes[mine].sum()
        assert walls.scan_lists()[k] == tuple(sorted(set().union(*(lists[m] for m in mine))))
        wall = shapely.LineString(ends).buffer(0.25, cap_style="square")
        assert wall.covers(shapely.MultiLineString(list(segments.endpoints[mine])))


# --- laws ---


@pytest.mark.slow
@SOME
@given(SEEDS)
def test_order_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    segments = crowd(rng)
    order = rng.permutation(len(segments))
    (walls, wall_of), (again, shuffled) = fuse_segments(segments, gap=GAP), fuse_segments(segments.take(order), gap=GAP)
    assert partition(wall_of) == partition(shuffled[np.argsort(order)])
    near(again, walls, 1e-9)


@SOME
@given(SEEDS)
def test_fusion_is_idempotent(seed):
    walls, _ = fuse_segments(crowd(np.random.default_rng(seed)), gap=GAP)
    again, wall_of = fuse_segments(walls, gap=GAP)
    assert same(again, walls)
    assert wall_of.tolist() == list(range(len(walls)))


@pytest.mark.slow
@SOME
@given(SEEDS, st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-4, 4)))
def test_fusion_is_equivariant_under_rigid_motions(seed, pose):
    segments, _ = seen_walls(np.random.default_rng(seed), HOUSE, 9)
    walls, wall_of = fuse_segments(segments, gap=GAP)
    there, wall_of_there = fuse_segments(moved(segments, pose), gap=GAP)
    assert partition(wall_of) == partition(wall_of_there)
    near(there, moved(walls, pose), 1e-9)


@pytest.mark.parametrize("shift", [(1e4, 0), (-1e4, 1e4), (3e3, -1e4)])
def test_far_from_the_origin(shift):
    segments, _ = seen_walls(np.random.default_rng(5), HOUSE, 9)
    near(
        fuse_segments(moved(segments, (*shift, 0.0)), gap=GAP)[0],
        moved(fuse_segments(segments, gap=GAP)[0], (*shift, 0.0)),
        1e-6,
    )


def test_distant_walls_do_not_affect_each_other():
    segments, _ = seen_walls(np.random.default_rng(5), HOUSE, 9)
    far = moved(segments, (1e4, -1e4, 1.0))
    both, _ = fuse_segments(concatenate([segments, far]), gap=GAP)
    one, other = fuse_segments(segments, gap=GAP)[0], fuse_segments(far, gap=GAP)[0]
    near(both.take(both.center[:, 0] < 1e3), one, 1e-9)
    near(both.take(both.center[:, 0] > 1e3), other, 1e-9)


@pytest.mark.parametrize("count", [0, 1])
def test_nothing_to_fuse(count):
    segments = segments_at(np.zeros((count, 2)), np.zeros(count))
    walls, wall_of = fuse_segments(segments, gap=GAP)
    assert same(walls, segments)
    assert wall_of.tolist() == list(range(count))


# --- gates ---


@pytest.mark.parametrize("gap", [0.3, 0.5, 1.0])
@pytest.mark.parametrize("theta", [0.0, 2.0, np.pi])
def test_gaps_up_to_the_limit_are_closed(gap, theta):
    def two(between):
        there = moved(segments_at([[0, 0], [0, 0.4 + between]], [0, 0], length=0.4), (1, 2, theta))
        return len(fuse_segments(there, gap=gap)[0])

    assert two(-0.2) == two(0.0) == two(0.99 * gap) == 1
    assert two(1.01 * gap) == 2


@pytest.mark.slow
@SOME
@given(SEEDS, st.sampled_from([(0.10, 2), (0.02, 1)]))
def test_parallel_walls(seed, apart):
    """At 10 cm they are two; at 2 cm the noise makes them one."""
    offset, expected = apart
    side = np.array([[[0, 0], [0, 2.0]], [[offset, 0], [offset, 2.0]]])
    segments, _ = seen_walls(np.random.default_rng(seed), side, 8, noise=0.5)
    assert len(fuse_segments(segments, gap=GAP)[0]) == expected


@pytest.mark.slow
@SOME
@given(SEEDS, st.sampled_from([(0.12, 2), (0.08, 2), (0.01, 1)]))
def test_the_two_faces_of_a_wall(seed, apart):
    thick, expected = apart
    faces = np.array([[[0, 0], [0, 2.0]], [[thick, 2.0], [thick, 0]]])
    segments, _ = seen_walls(np.random.default_rng(seed), faces, 8, noise=0.3)
    assert len(fuse_segments(segments, gap=GAP)[0]) == expected


@SOME
@given(SEEDS)
def test_walls_that_meet_at_20_degrees_are_two(seed):
    turn = np.radians(20)
    bent = np.array([[[-2, 0], [0, 0]], [[0, 0], [2 * np.cos(turn), 2 * np.sin(turn)]]])
    segments, truth = seen_walls(np.random.default_rng(seed), bent, 8, noise=0.5)
    assert partition(fuse_segments(segments, gap=GAP)[1]) == partition(truth)


def test_the_gate_of_directions_is_in_standard_deviations():
    """Standard deviation of the difference, including the systematic error."""
    spread = np.hypot(np.sqrt(2) * NOISE.theta_sd, np.sqrt(2) * np.radians(1.5))
    for turn, expected in ((0.9 * SETTINGS.fusion.gate * spread, 1), (1.1 * SETTINGS.fusion.gate * spread, 2)):
        assert len(fuse_segments(segments_at([[0, 0], [0, 0]], [0, turn]), gap=GAP)[0]) == expected, np.degrees(turn)


def test_two_lines_that_cross_at_20_degrees_are_two():
    assert len(fuse_segments(segments_at([[0, 0], [0, 0]], np.radians([0, 20])), gap=GAP)[0]) == 2


@SOME
@given(SEEDS)
def test_mismatch_is_symmetric(seed):
    segments = crowd(np.random.default_rng(seed))
    pairs = every_pair(len(segments))
    there, back = mismatch(segments, pairs, gap=GAP), mismatch(segments, pairs[:, ::-1].copy(), gap=GAP)
    assert there == pytest.approx(back, rel=1e-9, abs=1e-9)
    itself = np.repeat(np.arange(len(segments))[:, None], 2, axis=1)
    assert np.abs(mismatch(segments, itself, gap=GAP)).max() < 1e-9


# --- openings ---


def test_openings_stay_open():
    """A wall with two gaps of 0.4 m; one of them was seen through."""
    segments = segments_at([[0, 0], [0, 1.0], [0, 2.0]], np.zeros(3), length=0.6)
    asked = []

    def opening(gaps, theta):
        asked.extend(gaps.tolist())
        assert np.cos(theta) == pytest.approx(1)
        return gaps[:, :, 1].mean(axis=1) > 1

    walls, wall_of = fuse_segments(segments, gap=GAP, is_opening=opening)
    assert wall_of[0] == wall_of[1] != wall_of[2]
    assert np.sort(walls.endpoints[..., 1], axis=1).tolist() == [[pytest.approx(-0.3), pytest.approx(1.3)], [1.7, 2.3]]
    ways = {tuple(np.round(np.sort(np.array(gap)[:, 1]), 9).tolist()) for gap in asked}
    assert ways == {(0.3, 0.7), (1.3, 1.7)}
    assert same(fuse_segments(walls, gap=GAP, is_opening=opening)[0], walls)


@pytest.mark.slow
@SOME
@given(SEEDS)
def test_without_openings_nothing_changes(seed):
    segments = crowd(np.random.default_rng(seed))
    walls, _ = fuse_segments(segments, gap=GAP, is_opening=lambda gaps, theta: np.zeros(len(gaps), bool))
    assert same(walls, fuse_segments(segments, gap=GAP)[0])


def test_overlapping_segments_have_no_opening():
    """Overlapping segments have no gap."""
    segments = segments_at([[0, 0], [0, 0.3]], [0, 0], length=1.0)
    assert len(fuse_segments(segments, gap=GAP, is_opening=lambda gaps, theta: np.ones(len(gaps), bool))[0]) == 1
