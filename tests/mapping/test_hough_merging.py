"""The paper's merging: single linkage against SciPy, the Hough transform against a loop over clusters."""

import math

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import pdist
from support import oracles
from support.segments import moved, same, segments_at

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.kernels import HoughSettings
from jaxsonar.mapping.hough_merging import merge_by_hough, single_linkage
from jaxsonar.mapping.settings import SETTINGS

CUT = 0.4
SEEDS = st.integers(0, 2**32 - 1)


def partition(labels):
    return {frozenset(np.flatnonzero(labels == k).tolist()) for k in np.unique(labels)}


# --- clusters of midpoints ---


def scattered(rng, n):
    return rng.uniform(0, 3, (n, 2))


def on_a_grid(rng, n):
    return rng.integers(0, 6, (n, 2)) * 0.39


def on_a_line(rng, n):
    turn = rng.uniform(0, 7)
    return np.outer(rng.uniform(0, n / 4, n), [math.cos(turn), math.sin(turn)])


def dense(rng, n):
    return np.repeat(rng.uniform(0, 3, (4, 2)), n, axis=0) + rng.normal(0, 1e-9, (4 * n, 2))


def with_duplicates(rng, n):
    points = rng.uniform(0, 3, (n, 2))
    return points[rng.integers(0, n, 2 * n)]


def all_equal(rng, n):
    return np.repeat(rng.uniform(-9, 9, (1, 2)), n, axis=0)


def far_from_the_origin(rng, n):
    return rng.uniform(0, 3, (n, 2)) + np.array([1e6, -1e6])


def in_two_towns(rng, n):
    """10 km apart."""
    return np.concatenate([rng.uniform(0, 3, (n, 2)), rng.uniform(0, 3, (n, 2)) + 1e4])


def in_two_countries(rng, n):
    """1000 km apart, as after a wrong pose."""
    return np.concatenate([rng.uniform(0, 3, (n, 2)), rng.uniform(0, 3, (n, 2)) + 1e6])


SETS = [
    scattered, on_a_grid, on_a_line, dense, with_duplicates, all_equal, far_from_the_origin, in_two_towns,
    in_two_countries,
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("points", SETS, ids=lambda points: points.__name__)
@settings(max_examples=25, phases=[Phase.generate])
@given(seed=SEEDS, n=st.integers(2, 50), cut=st.sampled_from([0.05, 0.4, 2.0]))
def test_single_linkage_equals_scipy(points, seed, n, cut):
    found = points(np.random.default_rng(seed), n)
    cluster = single_linkage(found, cut)
    assert partition(cluster) == partition(fcluster(linkage(pdist(found), "single"), cut, "distance"))
    assert sorted(set(cluster.tolist())) == list(range(cluster.max() + 1))


@pytest.mark.parametrize("count", [0, 1])
def test_single_linkage_of_nothing_and_of_one(count):
    assert single_linkage(np.zeros((count, 2)), CUT).tolist() == [0] * count


@pytest.mark.parametrize(("apart", "clusters"), [(0.0, 1), (0.399, 1), (0.401, 2), (1e5, 2)])
def test_single_linkage_of_two(apart, clusters):
    assert single_linkage(np.array([[7.0, 1.0], [7.0, 1.0 + apart]]), CUT).max() + 1 == clusters


def test_a_chain_is_one_cluster():
    chain = np.stack([np.arange(1000) * 0.39, np.zeros(1000)], axis=-1)
    assert not single_linkage(chain, CUT).any()
    assert len(np.unique(single_linkage(np.delete(chain, 500, axis=0), CUT))) == 2


# --- clusters of lines ---


def paper(segments, cut):
    """The recipe step by step: members, origin and (rho, theta) of each merged line."""
    midpoints = segments.endpoints.mean(axis=1)
    cluster = fcluster(linkage(midpoints, "single"), cut, "distance") if len(segments) > 1 else np.zeros(1)
    merged = []
    for k in np.unique(cluster):
        members = np.flatnonzero(cluster == k)
        origin = midpoints[members].mean(axis=0)
        lines = []
        for m in members:
            rho, theta = (segments.center[m] - origin) @ segments.normal[m], segments.theta[m]
            lines.append((rho, theta) if rho >= 0 else (-rho, oracles.wrap(theta + math.pi)))
        columns = int(max(rho for rho, _ in lines) / 0.10) + 3
        settings = HoughSettings(rho_cell=0.10, rho_cells=columns)
        assert settings.theta_cell == pytest.approx(0.0628, abs=1e-4)
        cells = [oracles.cell(rho, theta, settings) for rho, theta in lines]
        mask = oracles.lowpass(oracles.accumulate(cells, settings), settings) > SETTINGS.hough.threshold
        for component in oracles.components(mask):
            mine = [i for i, cell in enumerate(cells) if cell in component]
            if mine:
                merged.append((members[mine], origin, oracles.mean_line([lines[i] for i in mine])))
    return merged


def projected(segments, members, origin, line):
    """Outermost projections of the ends of the members onto the line."""
    rho, theta = line
    n, t = np.array([math.cos(theta), math.sin(theta)]), np.array([-math.sin(theta), math.cos(theta)])
    way = [(end - origin) @ t for end in segments.endpoints[members].reshape(-1, 2)]
    return np.array([origin + rho * n + s * t for s in (min(way), max(way))])


def undirected(segments):
    """Segments with their lower left end first, in one order."""
    segments = np.array(segments).reshape(-1, 2, 2)
    ends = [sorted(segment.tolist()) for segment in segments.round(9)]
    return np.array(sorted(ends)).reshape(-1, 2, 2)


def office(rng, count):
    """Noisy segments of a few walls, and some that belong to none."""
    walls = rng.integers(1, 5)
    foot, theta = rng.uniform(-2, 2, (walls, 2)), rng.uniform(-np.pi, np.pi, walls)
    wall = rng.integers(0, walls, count)
    tangent = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
    center = foot[wall] + rng.uniform(-1, 1, count)[:, None] * tangent[wall] + rng.normal(0, 0.01, (count, 2))
    turn = theta[wall] + rng.normal(0, np.radians(3), count)
    stray = rng.random(count) < 0.1
    center[stray], turn[stray] = rng.uniform(-3, 3, (stray.sum(), 2)), rng.uniform(-np.pi, np.pi, stray.sum())
    return segments_at(center, turn, length=rng.uniform(0.3, 0.6, count))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_merging_equals_the_recipe_of_the_paper(seed):
    rng = np.random.default_rng(seed)
    segments = office(rng, int(rng.integers(20, 50)))
    merged, expected = merge_by_hough(segments, linkage_distance=CUT), paper(segments, CUT)
    assert sorted(merged.scan_lists()) == sorted(tuple(segments.scans[1][m].tolist()) for m, _, _ in expected)
    got = {lists: k for k, lists in enumerate(merged.scan_lists())}
    for members, origin, line in expected:
        k = got[tuple(segments.scans[1][members].tolist())]
        ends = segments.endpoints[members[0]] if len(members) == 1 else projected(segments, members, origin, line)
        assert undirected(merged.endpoints[k]) == pytest.approx(undirected(ends), abs=1e-4)
        assert merged.count[k] == len(members)
        assert merged.echoes[k] == segments.echoes[members].sum()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_every_segment_belongs_to_one_wall(seed):
    segments = office(np.random.default_rng(seed), 60)
    merged = merge_by_hough(segments, linkage_distance=CUT)
    assert sorted(number for numbers in merged.scan_lists() for number in numbers) == list(range(60))
    assert merged.count.sum() == 60


def walls_apart(rng, count, each):
    """Well separated walls: 3 m from one another."""
    wall = np.repeat(np.arange(count), each)
    theta = rng.uniform(-np.pi, np.pi, count)[wall]
    place = 3.0 * np.stack([wall % 4, wall // 4], axis=-1)
    along = np.tile((np.arange(each) - (each - 1) / 2) * 0.2, count)
    tangent = np.stack([-np.sin(theta), np.cos(theta)], axis=-1)
    center = place + along[:, None] * tangent + rng.normal(0, 0.005, (len(wall), 2))
    return segments_at(center, theta + rng.normal(0, np.radians(1), len(wall)))


@pytest.mark.parametrize("seed", range(6))
def test_merging_is_idempotent_for_separate_walls(seed):
    segments = walls_apart(np.random.default_rng(seed), 9, 6)
    merged = merge_by_hough(segments, linkage_distance=CUT)
    assert len(merged) == 9
    again = merge_by_hough(merged, linkage_distance=CUT)
    order = [merged.scan_lists().index(numbers) for numbers in again.scan_lists()]
    assert same(again, merged.take(np.array(order)))


@pytest.mark.parametrize(("cells", "shift"), [(0, (12.3, -4.5)), (1, (0.0, 0.0)), (50, (-7.0, 3.0)), (77, (1e4, 1e4))])
def test_merging_is_equivariant_under_rigid_motions(cells, shift):
    """Rotations by whole cells of theta, to which the accumulator is invariant, and any translation."""
    segments = office(np.random.default_rng(4), 40)
    pose = (*shift, cells * 2 * np.pi / 100)
    here, there = (
        moved(merge_by_hough(segments, linkage_distance=CUT), pose),
        merge_by_hough(moved(segments, pose), linkage_distance=CUT),
    )
    assert sorted(there.scan_lists()) == sorted(here.scan_lists())
    order = np.array([there.scan_lists().index(numbers) for numbers in here.scan_lists()])
    assert undirected(there.endpoints - shift) == pytest.approx(undirected(here.endpoints - shift), abs=1e-4)
    assert there.take(order).chi_squared == pytest.approx(here.chi_squared, rel=1e-3, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_the_order_of_the_segments_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    segments = office(rng, 40)
    one, other = (
        merge_by_hough(segments, linkage_distance=CUT),
        merge_by_hough(segments.take(rng.permutation(40)), linkage_distance=CUT),
    )
    assert sorted(one.scan_lists()) == sorted(other.scan_lists())
    assert undirected(one.endpoints) == pytest.approx(undirected(other.endpoints), abs=1e-5)


@pytest.mark.parametrize("theta", np.linspace(-np.pi, np.pi, 9))
def test_parallel_walls_in_one_cluster_are_two(theta):
    """Half a metre apart, their midpoints linked by a linkage distance of 0.6 m."""
    along = np.linspace(-0.5, 0.5, 6)
    one, other = np.stack([0 * along, along], axis=-1), np.stack([0 * along + 0.5, along], axis=-1)
    segments = moved(segments_at(np.concatenate([one, other]), np.zeros(12)), (1.0, 2.0, theta))
    merged = merge_by_hough(segments, linkage_distance=0.6)
    assert sorted(merged.scan_lists()) == [tuple(range(6)), tuple(range(6, 12))]
    assert merged.length == pytest.approx([1.5, 1.5], abs=1e-3)


def test_merged_walls_face_like_their_segments():
    """Normals point away from the robot, not away from the center of the cluster."""
    segments = segments_at([[0, 0], [0, 0.3], [0.5, 0], [0.5, 0.3]], np.zeros(4))
    merged = merge_by_hough(segments, linkage_distance=0.6)
    assert len(merged) == 2
    assert np.abs(wrap_angle(merged.theta)) == pytest.approx([0, 0], abs=1e-3)


@pytest.mark.parametrize("far", [50.0, 1e3, 1e5])
def test_a_wall_far_from_the_origin_is_not_lost(far):
    """The paper's accumulator covers ten metres from the world's origin and would contain none of these."""
    along = np.linspace(-0.5, 0.5, 6)
    center = np.stack([0 * along, along], axis=-1)
    there = moved(segments_at(center, np.zeros(6)), (far, far, 0.3))
    merged = merge_by_hough(there, linkage_distance=CUT)
    assert len(merged) == 1
    assert ((merged.center - far) @ [math.cos(0.3), math.sin(0.3)]) == pytest.approx([0], abs=1e-4)


@pytest.mark.slow
def test_a_large_cluster_with_walls_far_from_its_center():
    """Walls along a street form one cluster; rho exceeds a kilometre."""
    along = np.arange(0, 2500, 50.0)
    merged = merge_by_hough(segments_at(np.stack([along, 0 * along], axis=-1), 0 * along), linkage_distance=60.0)
    assert len(merged) == len(along)


@pytest.mark.parametrize("count", [0, 1])
def test_nothing_to_merge(count):
    segments = segments_at(np.ones((count, 2)), np.ones(count))
    assert same(merge_by_hough(segments, linkage_distance=CUT), segments)


def test_a_wall_through_the_cluster_center_seen_from_both_sides_is_one():
    """Lines around rho = 0, with normals to both sides: the seam at rho = 0."""
    along = np.linspace(-0.6, 0.6, 8)
    across = 0.01 * (-1.0) ** np.arange(8)
    segments = segments_at(np.stack([across, along], axis=-1), np.pi * (np.arange(8) % 3 > 0))
    merged = merge_by_hough(segments, linkage_distance=CUT)
    assert len(merged) == 1
    assert merged.count.tolist() == [8]
    assert abs(merged.center[0, 0]) < 1e-3
    assert abs(math.cos(merged.theta[0])) == pytest.approx(1, abs=1e-4)
