"""Corners and edges: fusion and clustering in any order, and walls that end at them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar.detection.extract import local_models
from jaxsonar.detection.local_model import LocalModel, Point
from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.se2 import transform_points
from jaxsonar.geometry.segments import point_to_segments
from jaxsonar.mapping.build_map import assemble_map
from jaxsonar.mapping.map_evidence import gather_evidence
from jaxsonar.mapping.observations import concatenate, merge_cells
from jaxsonar.mapping.point_landmarks import PointLandmarks, aggregate_points, cluster_points, is_static
from jaxsonar.mapping.segment_fusion import estimate_systematic_error, fuse_segments, robust_refit
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.mapping.wall_endpoints import blocks_gap, detached_points, snap_endpoints, spurious_walls
from jaxsonar.mapping.wall_segments import WallSegments
from jaxsonar.reports.plot_map import map_figure
from jaxsonar.simulation.office import load_office
from jaxsonar.simulation.simulator import simulate

NOWHERE = np.zeros((0, 3))
PATHS = np.zeros((1, 2), np.int64)


def observation(rng, pose, place, *, kind="corner", range_sigma=0.002, bearing_sigma=0.03, noise=True):
    """A point of a local model with a precise range and an imprecise bearing."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    seen = (place - pose[:2]) @ np.array([[c, -s], [s, c]])
    ray = seen / np.linalg.norm(seen)
    across = bearing_sigma * np.linalg.norm(seen)
    axes = np.array([ray, [-ray[1], ray[0]]])
    sigma = np.array([range_sigma, across])
    x, y = seen + (noise * sigma * rng.normal(size=2)) @ axes
    return Point(
        x=float(x),
        y=float(y),
        kind=kind,
        cov=axes.T @ np.diag(sigma**2) @ axes,
        echoes=int(rng.integers(3, 20)),
        paths=PATHS,
        probability=0.9,
    )


def observations(rng, places, poses, **choices):
    """Observations of all positions from all poses, one scan per pose."""
    models = []
    for scan, pose in enumerate(poses):
        points = tuple(observation(rng, pose, place, **choices) for place in places)
        models.append(LocalModel(scan, math.nan, (), points=points))
    return aggregate_points(models, poses)


def some_points(rng, count):
    poses = np.column_stack([rng.uniform(-2, 2, (count, 2)), rng.uniform(-3, 3, count)])
    return concatenate([observations(rng, rng.uniform(-1, 1, (1, 2)), pose[None]) for pose in poses])


def same(one, two, tolerance=1e-9):
    for name in ("position", "corner_log_odds", "chi_squared", "last_seen"):
        assert getattr(one, name) == pytest.approx(getattr(two, name), rel=tolerance, abs=tolerance), name
    assert one.information == pytest.approx(two.information, rel=tolerance)
    assert one.count.tolist() == two.count.tolist()
    assert one.echoes.tolist() == two.echoes.tolist()
    assert one.cell.tolist() == two.cell.tolist()
    assert [row.tolist() for row in one.scans] == [row.tolist() for row in two.scans]


def in_order(points):
    return points.take(np.lexsort((*points.position.T, points.echoes)))


def test_no_points():
    nothing = aggregate_points([], NOWHERE)
    assert (
        len(nothing)
        == len(cluster_points(nothing)[0])
        == len(merge_cells(nothing))
        == len(concatenate([nothing, nothing]))
        == 0
    )
    assert nothing.kinds == ()
    assert len(nothing.fuse(np.zeros(0, np.int64))) == 0


def test_a_model_without_a_pose_is_left_out(rng):
    model = LocalModel(3, math.nan, (), points=(observation(rng, np.zeros(3), np.array([1.0, 0.5])),))
    assert len(aggregate_points([model, model], np.array([[0, 0, 0], [np.nan] * 3]))) == 1


@given(seed=st.integers(0, 2**32 - 1))
def test_points_are_transformed_by_the_poses(seed):
    rng = np.random.default_rng(seed)
    pose, place = rng.uniform(-3, 3, 3), rng.uniform(-3, 3, 2)
    seen = observation(rng, pose, place, kind="edge", noise=False)
    points = aggregate_points([LocalModel(7, 1.5, (), points=(seen,))], pose[None])
    assert points.position[0] == pytest.approx(transform_points(pose, np.array([[seen.x, seen.y]]))[0])
    assert points.position[0] == pytest.approx(place)
    # The smallest variance is that of the range, along the line of sight.
    ray = (place - pose[:2]) / np.linalg.norm(place - pose[:2])
    assert ray @ points.cov[0] @ ray == pytest.approx(np.linalg.eigvalsh(points.cov[0])[0])
    assert points.kinds == ("edge",)
    assert (points.last_seen.tolist(), points.scans[1].tolist()) == ([1.5], [7])


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 12))
def test_fusion_of_fusions_equals_fusion_of_all_in_any_order(seed, count):
    rng = np.random.default_rng(seed)
    points = some_points(rng, count)
    points = replace(points, scans=(points.scans[0], rng.integers(0, 5, count)))
    one = np.zeros(count, np.int64)
    group = np.unique(rng.integers(0, 3, count), return_inverse=True)[1]
    at_once = points.fuse(one)
    in_parts = points.fuse(group)
    same(in_parts.fuse(np.zeros(len(in_parts), np.int64)), at_once, 1e-7)
    same(points.take(rng.permutation(count)).fuse(one), at_once, 1e-7)
    total = points.information.sum(axis=0)
    mean = np.linalg.solve(total, (points.information @ points.position[..., None]).sum(axis=0))[:, 0]
    assert at_once.position[0] == pytest.approx(mean, abs=1e-9)


def test_two_poses_determine_a_position_that_one_cannot(rng):
    place = np.array([[1.0, 1.0]])
    poses = np.array([[0.0, 1.0, 0.3], [1.0, 0.0, -2.0]])
    one, both = observations(rng, place, poses[:1], noise=False), observations(rng, place, poses, noise=False)
    both = cluster_points(both)[0]
    assert len(both) == 1
    assert np.linalg.eigvalsh(one.cov[0])[1] ** 0.5 > 0.02
    assert np.linalg.eigvalsh(both.cov[0])[1] ** 0.5 < 0.003
    assert both.position == pytest.approx(place)


@pytest.mark.slow
def test_covariances_are_consistent(rng):
    poses = np.column_stack([rng.uniform(-1.5, 1.5, (8, 2)), rng.uniform(-3, 3, 8)])
    place = np.array([[2.0, 1.5]])
    nees = []
    for _ in range(200):
        found = cluster_points(observations(rng, place, poses))[0]
        off = found.position[0] - place[0]
        nees.append(off @ np.linalg.solve(found.inflated_cov[0], off))
    assert 1.2 < np.mean(nees) < 3.0  # 2, if all were known


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1))
def test_clusters_do_not_depend_on_the_order_and_are_stable(seed):
    rng = np.random.default_rng(seed)
    places = np.array([[0.0, 2.0], [0.0, 1.0], [2.0, 2.0], [2.0, 0.5]])
    poses = np.column_stack([rng.uniform(0.5, 1.5, (5, 2)), rng.uniform(-3, 3, 5)])
    points = observations(rng, places, poses)
    found, point_of = cluster_points(points)
    order = rng.permutation(len(points))
    again, again_of = cluster_points(points.take(order))
    same(in_order(found), in_order(again), 1e-6)
    assert (point_of[:, None] == point_of)[order][:, order].tolist() == (again_of[:, None] == again_of).tolist()
    same(cluster_points(found)[0], found)
    same(cluster_points(merge_cells(merge_cells(points)))[0], cluster_points(merge_cells(points))[0])


def test_distant_points_stay_separate_and_the_kind_is_the_most_probable(rng):
    poses = np.column_stack([rng.uniform(-1, 1, (6, 2)), np.zeros(6)])
    near = np.array([[1.5, 2.0], [1.5 + 8 * SETTINGS.points.position_floor, 2.0]])
    found, _ = cluster_points(observations(rng, near, poses, bearing_sigma=0.01))
    assert len(found) == 2
    edges = observations(rng, near[:1], poses[:4], kind="edge")
    corners = observations(rng, near[:1], poses[4:], kind="corner")
    assert cluster_points(concatenate([edges, corners]))[0].kinds == ("edge",)


def test_merging_cells_step_by_step_equals_merging_at_once(rng):
    places = rng.uniform(-2, 2, (4, 2))
    poses = np.column_stack([rng.uniform(-1, 1, (30, 2)), np.zeros(30)])
    points = observations(rng, places, poses)
    whole, so_far = merge_cells(points), aggregate_points([], NOWHERE)
    for k in range(len(points)):
        so_far = merge_cells(concatenate([so_far, points.take(np.array([k]))]))
    same(so_far, whole, 1e-7)
    fewest = merge_cells(points, max_scans=1)
    assert len(fewest.scans[0]) == len(fewest)
    assert fewest.scans[1].max() == points.scans[1].max()


def test_a_point_that_moves_with_the_robot_is_not_static(rng):
    poses = np.column_stack([np.linspace(-1, 1, 9), np.zeros((9, 2))])
    still = np.array([0.0, 2.0])
    moving = [observations(rng, still[None] + [[0, 0.03 * pose[0]]], pose[None]) for pose in poses]
    for points, expected in ((observations(rng, still[None], poses), True), (concatenate(moving), False)):
        found = points.fuse(np.zeros(9, np.int64))
        assert is_static(found, points, np.zeros(9, np.int64), systematic_error=0.005).tolist() == [expected]


# --- walls and points ---


def walls_of(*segments, sigma=0.001, turn=0.002, count=4):
    """Walls as after fusion."""
    ends = np.array(segments, dtype=np.float64).reshape(-1, 2, 2)
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=-1)
    n = len(ends)
    return WallSegments(
        center=ends.mean(axis=1),
        theta=np.arctan2(-along[:, 0], along[:, 1]),
        extent=np.stack([-length, length], axis=-1) / 2,
        info_offset=np.full(n, sigma**-2),
        info_theta=np.full(n, turn**-2),
        chi_squared=np.full(n, 2.0 * count - 2),
        count=np.full(n, count),
        echoes=np.full(n, 40),
        viewing_distance=np.ones(n),
        last_seen=np.zeros(n),
        scans=(np.repeat(np.arange(n), count), np.tile(np.arange(count), n)),
    )


def points_at(*places, scans=3, sigma=0.003) -> PointLandmarks:
    place = np.array(places, dtype=np.float64).reshape(-1, 2)
    n = len(place)
    return PointLandmarks(
        position=place,
        information=np.tile(np.eye(2) / sigma**2, (n, 1, 1)),
        corner_log_odds=np.full(n, 5.0),
        chi_squared=np.full(n, 2.0 * scans - 2),
        count=np.full(n, scans),
        echoes=np.full(n, 20),
        last_seen=np.zeros(n),
        cell=np.zeros((n, 2), np.int64),
        scans=(np.repeat(np.arange(n), scans), np.tile(np.arange(scans), n)),
    )


def shut(gaps, theta):
    return np.zeros(len(gaps), dtype=bool)


def test_two_walls_end_at_the_corner_between_them():
    walls = snap_endpoints(walls_of([[0, 0], [1.6, 0]], [[2, 0.5], [2, 2]]), points_at([2.0, 0.001]), shut)
    for segment in walls.endpoints:
        assert np.linalg.norm(segment - [2.0, 0.0], axis=-1).min() < 0.002
    assert np.sort(walls.length) == pytest.approx([2.0, 2.0], abs=0.005)


def test_footpoints_beyond_the_corner_are_cut_off():
    walls = snap_endpoints(walls_of([[0, 0], [2.1, 0]]), points_at([2.0, 0.0]), shut)
    assert walls.length == pytest.approx([2.0], abs=1e-6)


@pytest.mark.parametrize("place", [[2.0, 0.1], [3.6, 0.0], [1.0, 0.0], [0.8, 0.3]])
def test_points_off_the_line_end_no_wall(place):
    walls = walls_of([[0, 0], [1.6, 0]])
    assert snap_endpoints(walls, points_at(place), shut).endpoints.tolist() == walls.endpoints.tolist()
    assert snap_endpoints(walls, points_at(), shut) is walls
    assert len(snap_endpoints(walls_of(), points_at(place), shut)) == 0


def test_a_wall_ends_at_the_nearest_point_and_not_beyond_an_opening():
    walls = walls_of([[0, 0], [1.6, 0]])
    assert snap_endpoints(walls, points_at([2.5, 0], [1.9, 0]), shut).length == pytest.approx([1.9])
    open_ = np.ones_like
    assert (
        snap_endpoints(walls, points_at([1.9, 0], [2.5, 0]), lambda gaps, theta: open_(theta, dtype=bool)).length[0]
        == 1.6
    )


def test_the_far_side_of_a_doorway_ends_the_other_wall():
    walls = snap_endpoints(walls_of([[0, 0], [1.6, 0]], [[2.8, 0], [4, 0]]), points_at([2.6, 0.0]), shut)
    assert walls.length == pytest.approx([1.6, 1.4])


def test_a_corner_improves_the_direction_of_a_short_wall():
    turned = walls_of([[0, 0], [0.3, 0.004]], turn=0.02)
    walls = snap_endpoints(turned, points_at([1.3, 0.0]), shut)
    assert abs(walls.theta[0] + math.pi / 2) < 0.005 < abs(turned.theta[0] + math.pi / 2)
    assert walls.info_theta[0] > 4 * turned.info_theta[0]


def test_points_on_a_face_are_detached_unless_walls_meet_there():
    walls = walls_of([[0, 0], [2, 0]], [[1.5, 0.05], [1.5, 1]])
    points = points_at([0.7, 0.005], [1.5, 0.0], [1.98, 0.0], [0.7, 0.4])
    assert detached_points(walls, points).tolist() == [True, False, False, False]


def test_a_short_wall_across_a_point_is_spurious():
    short, long = [[0, 0], [0.2, 0]], [[0, 1], [2, 1]]
    walls = walls_of(short, long, count=2)
    assert spurious_walls(walls, points_at([0.1, 0.005], [1, 1])).tolist() == [True, False]
    assert spurious_walls(walls, points_at([0.2, 0.005])).tolist() == [False, False]
    assert spurious_walls(walls_of(short, count=4), points_at([0.1, 0.005])).tolist() == [False]


# --- maps ---


@pytest.fixture(scope="module")
def office_map():
    """Three runs through the office: the log, its local models and its evidence."""
    office, runs = load_office(), []
    for seed in range(3):
        heard = simulate(office.ring, office.room, office.poses, sigma=0.005, seed=seed, stamps=office.stamps)
        log = heard.as_log(office.ring, office.poses)
        models = list(local_models(office.ring, log))
        runs.append((log, models, gather_evidence(office.ring, log, models)))
    return office, runs


def ends_off(world, room):
    """Distance of the ends of segments from the nearest true end of their wall, along it, metres."""
    off = []
    for segment in world.segments:
        apart = point_to_segments(segment, room.walls).sum(axis=0)
        wall = room.walls[apart.argmin()]
        length = np.linalg.norm(wall[1] - wall[0])
        along = np.sort((segment - wall[0]) @ (wall[1] - wall[0]) / length)
        off += [abs(along[0]), abs(length - along[1])]
    return np.array(off)


@pytest.mark.slow
def test_points_of_the_office_are_where_walls_end(office_map):
    office, runs = office_map
    junctions = office.room.junctions
    places = np.concatenate([junctions.vertices, office.room.poles])
    for _, _, evidence in runs:
        world = assemble_map(evidence)
        assert len(world.points) >= 2
        assert len(world.points) == len(world.point_kinds) == len(world.point_scans) == len(world.point_echoes)
        away = np.linalg.norm(world.points[:, None] - places, axis=-1).min(axis=1)
        assert np.median(away) < 0.01
        assert away.max() < 0.08
        assert min(len(scans) for scans in world.point_scans) >= 2
        assert np.all(np.linalg.eigvalsh(world.point_cov) > 0)
        assert (np.diff(world.point_echoes) <= 0).all()


@pytest.mark.slow
def test_snapped_ends_are_closer_to_the_true_ends_than_footpoints(office_map):
    office, runs = office_map
    with_points, without = [], []
    for _, _, evidence in runs:
        blind = replace(evidence, points=evidence.points.take(np.arange(0)))
        for found, worlds in ((evidence, with_points), (blind, without)):
            worlds.append(ends_off(assemble_map(found), office.room))
    ends, feet = np.concatenate(with_points), np.concatenate(without)
    assert np.median(ends) < 0.6 * np.median(feet)
    assert (ends < 0.02).mean() > 2 * (feet < 0.02).mean()


@pytest.mark.slow
def test_merging_as_in_the_paper_has_no_points(office_map):
    _, runs = office_map
    assert len(assemble_map(runs[0][2], merging="paper").points) == 0


@pytest.mark.slow
def test_scan_by_scan_in_any_order_equals_all_at_once(office_map, rng):
    office, runs = office_map
    log, models, evidence = runs[0]
    whole = assemble_map(evidence)
    so_far = gather_evidence(office.ring, log, [])
    for k in rng.permutation(len(models)):
        part = gather_evidence(office.ring, log[int(k) : int(k) + 1], [models[k]])
        so_far = so_far.union(part).condensed()
    again = assemble_map(so_far)
    assert again.segments == pytest.approx(whole.segments, abs=1e-6)
    assert again.points == pytest.approx(whole.points, abs=1e-9)
    assert again.point_cov == pytest.approx(whole.point_cov, rel=1e-6)
    assert (again.point_kinds, again.point_scans) == (whole.point_kinds, whole.point_scans)


@pytest.mark.slow
def test_walls_do_not_extend_across_a_doorway():
    """A wall with a doorway, through which another wall was observed."""
    walls = [[[-2, 1.2], [-0.4, 1.2]], [[0.5, 1.2], [2, 1.2]], [[-1, 1.9], [1, 1.9]], [[-2, -1], [2, -1]]]
    room = Room(np.array(walls, dtype=np.float64))
    ring = load_office().ring
    poses = np.column_stack([np.linspace(-1.2, 1.2, 9), np.zeros(9), np.zeros(9)])
    log = simulate(ring, room, poses, sigma=0.003, seed=1).as_log(ring, poses)
    world = assemble_map(gather_evidence(ring, log, list(local_models(ring, log))))
    front = world.segments[np.abs(world.segments[:, :, 1] - 1.2).max(axis=1) < 0.05]
    assert len(front) >= 2
    # Up to 0.1 m beyond its end, the range of an edge differs from that of the wall by less than 6 mm.
    inside = (front[..., 0] > -0.29) & (front[..., 0] < 0.39)
    assert not inside.any()
    assert not ((front[..., 0].min(axis=1) < -0.4) & (front[..., 0].max(axis=1) > 0.5)).any()


def test_edges_block_gaps():
    gaps = np.array([[[0.0, 0.0], [0.9, 0.0]], [[0.0, 1.0], [0.9, 1.0]], [[0.0, 2.0], [0.9, 2.0]]])
    points = points_at([0.02, 0.0], [0.4, 1.0], [1.3, 2.0])
    edges = replace(points, corner_log_odds=-points.corner_log_odds)
    assert blocks_gap(gaps, edges).tolist() == [True, True, False]
    assert not blocks_gap(gaps, points).any()  # corners do not end a wall


def test_pose_errors_raise_the_systematic_error_and_leave_one_wall(rng):
    """Segments become one wall whether poses are exact or off by a centimetre."""
    for off in (0.0, 0.01):
        ends = np.stack([np.linspace(0, 2, 9), np.linspace(0.3, 2.3, 9)], axis=-1)
        across = rng.normal(0, math.hypot(off, 0.001), (9, 1)) + rng.normal(0, 0.0002, (9, 2))
        segments = walls_of(*np.stack([ends, across], axis=-1), count=1, turn=0.02)
        floor = estimate_systematic_error(segments, gap=0.5)
        assert (floor > SETTINGS.fusion.offset_floor) == (off > 0)
        assert (
            len(fuse_segments(segments, gap=0.5, systematic_error=floor, near_wall=SETTINGS.fusion.near_wall)[0]) == 1
        )


def test_a_line_with_foreign_echoes_is_down_weighted():
    segments = walls_of(*[[[k / 4, 0.0], [k / 4 + 0.3, 0.0]] for k in range(6)], [[0.5, 0.012], [0.8, 0.012]], count=1)
    segments = replace(segments, chi_squared=np.zeros(7))
    together = np.zeros(7, np.int64)
    plain = segments.fuse(together)
    settled = robust_refit(segments, together, plain)
    assert abs(settled.center[0, 1]) < 0.3 * abs(plain.center[0, 1])
    clean = segments.take(np.arange(6))
    assert robust_refit(clean, together[:6], clean.fuse(together[:6])).center[0, 1] == pytest.approx(0, abs=1e-12)


@pytest.mark.slow
def test_the_map_figure_shows_the_points(office_map):
    world = assemble_map(office_map[1][0][2])
    figure = map_figure(world)
    (axes,) = figure.axes
    shown = {line.get_marker(): line.get_xydata() for line in axes.lines if line.get_marker() in ("s", "D")}
    for kind, marker in (("corner", "s"), ("edge", "D")):
        mine = world.points[np.array(world.point_kinds) == kind]
        assert np.array_equal(shown.get(marker, np.zeros((0, 2))), mine)
        assert (kind in axes.get_title(loc="left") + axes.get_title()) == bool(len(mine))
