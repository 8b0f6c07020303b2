"""Occupancy grids against true rooms (by shapely), for any order of scans, and their files."""

import ast
from itertools import pairwise

import cv2
import numpy as np
import pytest
import shapely
from support.grid_layers import assert_same_grid, grid_of_parts

from jaxsonar import Log, Ring, random_pose, random_room, simulate
from jaxsonar.floor_plans.room import Room
from jaxsonar.geometry.se2 import rotation
from jaxsonar.geometry.segments import point_to_segments
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.build_map import build_map
from jaxsonar.mapping.map_from_grid import map_from_grid
from jaxsonar.occupancy.incremental_grid import IncrementalGrid, occupancy
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.occupancy.nav2_map import grid_image_filename, save_nav2
from jaxsonar.occupancy.occupancy_grid import FREE, NO_WALLS, OCCUPIED, UNKNOWN
from jaxsonar.occupancy.wall_profile import FacingReadings, hidden_walls, profile_walls

QUARTER = np.pi / 2
RING = Ring.circular()


@pytest.fixture(scope="module")
def heard(office):
    """A log of the office."""
    simulation = simulate(office.ring, office.room, office.poses, sigma=0.003, seed=1, stamps=office.stamps)
    return simulation.as_log(office.ring, office.poses)


@pytest.fixture(scope="module")
def office_grid(office, heard):
    return occupancy(office.ring, heard, walls=office.room.walls)


def listen(ring, walls, poses, *, poles=(), **errors):
    """A simulated log at the given poses."""
    room = Room(np.array(walls).reshape(-1, 2, 2), (), np.array(poles).reshape(-1, 2))
    return simulate(ring, room, poses, **errors).as_log(ring, poses)


def silent(poses, ring=RING):
    """A log in which all sensors fired and heard nothing."""
    nothing = np.zeros(0, int)
    stamp = np.arange(len(poses)) / 10
    return Log.from_echoes(nothing, nothing, nothing, np.zeros(0), stamp=stamp, pose=poses, asked=ring.paths)


def centers(grid):
    """Center (x, y) of each pixel of the image."""
    rows, columns = grid.free.shape
    x = grid.origin[0] + (np.arange(columns) + 0.5) * grid.resolution
    y = grid.origin[1] + (np.arange(rows) + 0.5) * grid.resolution
    return np.stack(np.meshgrid(x, y[::-1]), axis=-1)


def truly_free(room, points):
    """Whether points are inside the outermost walls and outside the boxes, by shapely."""
    found = shapely.polygonize([shapely.LineString(wall) for wall in room.walls]).geoms
    faces = [face for face in found if isinstance(face, shapely.Polygon)]
    outline = max((shapely.Polygon(face.exterior) for face in faces), key=lambda face: face.area)
    free = shapely.contains_xy(outline, points[..., 0], points[..., 1])
    for face in faces:
        if face.area < 0.5:  # boxes are 0.3 to 0.6 m wide, rooms 3 m and more
            free &= ~shapely.contains_xy(face, points[..., 0], points[..., 1])
    return free


def free_trajectory(rng, room, *, step=0.1, clearance=0.35):
    """Poses along straight lines between free positions, without those too close to an obstacle."""
    stops = [random_pose(rng, room) for _ in range(4)]
    legs = []
    for start, end in pairwise(stops):
        count = 2 + int(np.linalg.norm((end - start)[:2]) / step)
        legs.append(start + np.linspace(0, 1, count)[:, None] * (end - start))
    poses = np.concatenate(legs)
    clear = point_to_segments(poses[:, :2], room.walls).min(axis=1) > clearance
    for pole in room.poles:
        clear &= np.linalg.norm(poses[:, :2] - pole, axis=-1) > clearance
    return poses[clear]


def circle(center, radius, count):
    """Poses on a circle with tangential headings."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([center[0] + radius * np.cos(angle), center[1] + radius * np.sin(angle), angle + QUARTER], axis=-1)


def shuffled(log, order):
    """The scans of a log in another order."""
    parts = [log[i].as_log() for i in order]
    scan = np.repeat(np.arange(len(parts)), [len(part.tx) for part in parts])
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ("tx", "rx", "range")}
    numbers = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ("stamp", "pose", "scan")}
    return Log.from_echoes(scan, **columns, **numbers)


@pytest.mark.parametrize("method", ["counts", "em", "logodds"])
def test_parts_add_up_to_the_whole_in_any_order(office, heard, rng, method):
    walls = office.room.walls
    whole = occupancy(office.ring, heard, walls=walls, method=method)
    parts = [heard[:6], heard[6:7], heard[7:]]
    for some in (parts, parts[::-1], [shuffled(heard, rng.permutation(len(heard)))]):
        assert_same_grid(grid_of_parts(office.ring, some, walls=walls, method=method), whole)


def test_a_grid_grows_between_updates(office, heard, office_grid):
    growing = IncrementalGrid(office.ring)
    latest = growing.update(office.room.walls)
    assert latest.classify().size == latest.scans == 0
    for scan in heard:
        growing.add(scan.as_log())
        latest = growing.update(office.room.walls)
    assert_same_grid(latest, office_grid)
    assert latest.scans == len(heard)


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
def test_the_grid_is_equivariant_under_quarter_turns(office, heard, known):
    walls = office.room.walls if known else NO_WALLS
    turned_pose = np.concatenate([heard.pose[:, :2] @ rotation(QUARTER).T, heard.pose[:, 2:] + QUARTER], axis=1)
    turned = Log.from_echoes(
        heard.echo_scan, heard.tx, heard.rx, heard.range, stamp=heard.stamp, pose=turned_pose, scan=heard.scan
    )
    straight = occupancy(office.ring, heard, walls=walls).classify()
    image = occupancy(office.ring, turned, walls=walls @ rotation(QUARTER).T).classify()
    assert image.shape == straight.shape[::-1]
    # Coordinates on the border of a cell, like those of the first pose, may round to either side.
    assert np.mean(image == np.rot90(straight)) > 0.97


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
# Clutter is a share of the true echoes, of which soft beams have three times as many as hard cones.
@pytest.mark.parametrize("errors", [{}, {"clutter": 0.07, "dropout": 0.3}], ids=["clean", "clutter and loss"])
def test_free_cells_are_truly_free_and_most_cells_near_the_robot_are_known(faw_ring, seed, errors):
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    poses = free_trajectory(rng, room)
    log = simulate(faw_ring, room, poses, sigma=0.003, seed=seed, **errors).as_log(faw_ring, poses)
    grid = occupancy(faw_ring, log, walls=room.walls)
    image, points = grid.classify(), centers(grid)
    inside = truly_free(room, points)
    free = image == FREE
    assert inside[free].mean() >= 0.99
    assert not free[~inside].any()  # nothing is free behind known walls
    clear = point_to_segments(points.reshape(-1, 2), room.walls).min(axis=1).reshape(inside.shape) > 0.1
    for pole in room.poles:
        clear &= np.linalg.norm(points - pole, axis=-1) > 0.3
    near = np.linalg.norm(points[:, :, None] - poses[:, :2], axis=-1).min(axis=2) < 1.0
    assert free[inside & clear & near].mean() > (0.65 if errors else 0.75)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_unknown_walls_become_obstacles(faw_ring, seed):
    rng = np.random.default_rng(seed)
    room = random_room(rng, recess=0.0, box=0.0, segment=0.0, pole=0.0)
    poses = free_trajectory(rng, room, step=0.05)
    # Nothing explains crosstalk here, so that only hard cones give clean obstacles.
    log = simulate(faw_ring, room, poses, sigma=0.003, seed=seed, beams="hard").as_log(faw_ring, poses)
    grid = occupancy(faw_ring, log)
    image, points = grid.classify(), centers(grid)
    assert truly_free(room, points)[image == FREE].mean() > 0.85
    gap = point_to_segments(points.reshape(-1, 2), room.walls).min(axis=1).reshape(image.shape)
    assert np.mean(gap[image == OCCUPIED] < 0.15) > 0.6


def test_the_office_is_free_inside_and_unknown_outside(office, office_grid):
    image, points = office_grid.classify(), centers(office_grid)
    shell = office.room.walls[[name != "chair back-rest" for name in office.room.wall_names]]
    inside = shapely.contains_xy(shapely.Polygon(shell[:, 0]), points[..., 0], points[..., 1])
    assert inside[image == FREE].all()
    assert np.mean(image[inside] == FREE) > 0.6
    for pose in office.poses:  # the robot itself stood there
        assert image[np.linalg.norm(points - pose[:2], axis=-1) < 0.2].min() == FREE


def test_walls_are_drawn_without_gaps(office, office_grid):
    image = office_grid.classify()
    share = np.linspace(0, 1, 500)[:, None]
    for wall in office.room.walls:
        points = wall[0] + share * (wall[1] - wall[0])
        reached = np.linalg.norm(points[:, None] - office.poses[:, :2], axis=-1).min(axis=1) < 2.2
        column, row = np.floor((points[reached] - office_grid.origin) / office_grid.resolution).astype(int).T
        assert np.mean(image[::-1][row, column] == OCCUPIED) > 0.97  # a clipped corner of a cell may be left out


def test_no_echo_is_free_space_and_never_a_wall(faw_ring):
    poses = circle((0.4, -0.3), 0.5, 12)
    grid = occupancy(faw_ring, silent(poses))
    image = grid.classify()
    assert not (image == OCCUPIED).any()
    reach = np.linalg.norm(centers(grid)[:, :, None] - poses[:, :2], axis=-1).min(axis=2)
    # Inside the circle all directions were seen. Farther away, views have about one: walls along it stay possible.
    middle = np.linalg.norm(centers(grid) - [0.4, -0.3], axis=-1)
    assert (image[middle < 0.5] == FREE).all()
    assert 0.3 < (image[reach < 2.0] == FREE).mean() < 0.9
    assert (image[reach > 2.28 + 0.05] == UNKNOWN).all()
    at_max = Log.from_echoes(
        np.zeros(1, int), np.zeros(1, int), np.zeros(1, int), np.array([2.0]),
        stamp=np.zeros(12), pose=poses, asked=faw_ring.paths,
    )  # fmt: skip
    assert_same_grid(occupancy(faw_ring, at_max), grid)


def test_an_unknown_pole_becomes_an_obstacle_at_its_position(faw_ring):
    pole = np.array([0.33, 0.21])
    poses = circle(pole, 0.9, 24)
    grid = occupancy(faw_ring, listen(faw_ring, [], poses, poles=pole))
    image, points = grid.classify(), centers(grid)
    gap = np.linalg.norm(points - pole, axis=-1)
    assert (image[gap < 0.04] == OCCUPIED).all()
    assert gap[image == OCCUPIED].max() < 0.2
    assert (image[(gap > 0.2) & (gap < 1.0)] == FREE).mean() > 0.55  # the pole hides much of it from each side


def test_an_arc_from_a_single_viewpoint_is_not_an_obstacle(faw_ring):
    poses = np.tile([0.1, 0.1, 0.3], (50, 1))
    grid = occupancy(faw_ring, listen(faw_ring, [], poses, poles=[1.0, 0.4]))
    image, points = grid.classify(), centers(grid)
    assert not (image == OCCUPIED).any()
    assert not (image[np.linalg.norm(points - [1.0, 0.4], axis=-1) < 0.05] == FREE).any()


def test_an_obstacle_in_front_of_a_known_wall_is_kept(faw_ring):
    wall = [[-3.0, 1.5], [3.0, 1.5]]
    poses = np.stack([np.linspace(-1, 1, 21), np.zeros(21), np.zeros(21)], axis=-1)
    grid = occupancy(faw_ring, listen(faw_ring, [wall], poses, poles=[0.1, 0.9]), walls=np.array([wall]))
    image, points = grid.classify(), centers(grid)
    assert (image[np.linalg.norm(points - [0.1, 0.9], axis=-1) < 0.04] == OCCUPIED).all()
    assert not (image[points[..., 1] > 1.5] == FREE).any()


def test_a_known_wall_bounds_oblique_beams(faw_ring):
    wall = np.array([[[-3.0, 0.8], [3.0, 0.8]]])
    poses = np.stack([np.linspace(-1, 1, 21), np.zeros(21), np.zeros(21)], axis=-1)
    log = listen(faw_ring, wall, poses)
    behind = {}
    for known in (True, False):
        grid = occupancy(faw_ring, log, walls=wall if known else NO_WALLS)
        behind[known] = centers(grid)[grid.classify() == FREE]
        behind[known] = behind[known][behind[known][:, 1] > 0.8]
    assert not len(behind[True])
    # Without the map, oblique views of different directions may exclude all walls but this one.
    assert len(behind[False]) < 0.1 * grid.free.sum()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_walls_that_end_too_early_are_extended(faw_ring, seed):
    rng = np.random.default_rng(1000 + seed)
    room = random_room(rng)
    poses = np.stack([random_pose(rng, room) for _ in range(40)])
    log = simulate(faw_ring, room, poses, sigma=0.003, seed=seed).as_log(faw_ring, poses)
    grid = occupancy(faw_ring, log, walls=build_map(faw_ring, log).segments)
    image, points = grid.classify(), centers(grid)
    inside = truly_free(room, points)
    assert inside[image == FREE].mean() >= 0.98
    clear = point_to_segments(points.reshape(-1, 2), room.walls).min(axis=1).reshape(inside.shape) > 0.1
    near = np.linalg.norm(points[:, :, None] - poses[:, :2], axis=-1).min(axis=2) < 1.0
    assert (image == FREE)[inside & clear & near].mean() > 0.8


@pytest.mark.slow
def test_the_office_with_the_walls_of_its_map_is_free_inside_only(office, heard):
    grid = occupancy(office.ring, heard, walls=build_map(office.ring, heard).segments)
    image, points = grid.classify(), centers(grid)
    inside = truly_free(office.room, points)
    assert inside[image == FREE].mean() >= 0.98
    assert np.mean(image[inside] == FREE) > 0.6


def test_an_open_door_is_free_for_beams_perpendicular_to_it(faw_ring):
    walls = np.array([[[-3.0, 1.0], [-0.4, 1.0]], [[0.4, 1.0], [3.0, 1.0]]])
    past = np.stack([np.linspace(-1, 1, 21), np.zeros(21), np.zeros(21)], axis=-1)
    grid = occupancy(faw_ring, listen(faw_ring, walls, past), walls=walls)
    points = centers(grid)
    x, y = np.abs(points[..., 0]), points[..., 1]
    assert (grid.classify()[(x < 0.15) & (y > 0.9) & (y < 1.6)] == FREE).all()
    assert not (grid.classify()[(x > 0.6) & (y > 1.05)] == FREE).any()
    # From oblique views it is unknown whether the wall continues.
    aside = past[past[:, 0] < -0.65]
    grid = occupancy(faw_ring, listen(faw_ring, walls, aside), walls=walls)
    assert not (grid.classify()[centers(grid)[..., 1] > 1.05] == FREE).any()


def facing(position, heading, first_echo, driven=()):
    """Readings of sensors with a half angle of 0.2 rad and a range of 2 m."""
    places = np.array(driven, dtype=float).reshape(-1, 2)
    certain = np.full(len(heading), 0.2)
    return FacingReadings(np.array(position), np.array(heading), certain, np.array(first_echo), places, 2.0)


NOTHING = facing(np.zeros((0, 2)), np.zeros(0), np.zeros(0))


def test_a_wall_goes_on_until_sensors_would_have_heard_it_or_it_meets_another():
    walls = np.array([[[0.0, 1.0], [2.0, 1.0]], [[2.0, 1.02], [2.0, -1.0]]])
    known = KnownReflectors.of_walls(walls)

    def left(readings):
        """Extensions of the first wall to the left: their ends nearest and farthest from it, metres."""
        found = profile_walls(known, readings, resolution=0.05).extensions
        own = found[np.abs(found[..., 1] - 1.0).max(axis=1) < 1e-9][..., 0]
        assert (own <= 1e-9).all()  # on the right it meets the second wall
        return -own.max(), -own.min()

    assert left(NOTHING) == pytest.approx((0.0, 3.0))
    at, up, silent = np.array([[-0.6, 0.0], [-0.6, 0.2]]), np.full(2, QUARTER), np.full(2, 2.0)
    assert left(facing(at, up, silent)) == pytest.approx((0.0, 3.0))  # goes on beyond the opening
    covered = np.column_stack([np.repeat(np.arange(-3.0, -0.1, 0.05), 2), np.zeros(116)])
    open_end = facing(covered, np.full(116, QUARTER), np.full(116, 2.0))
    extensions = profile_walls(known, open_end, resolution=0.05).extensions
    assert not (np.abs(extensions[..., 1] - 1.0).max(axis=1) < 1e-9).any()
    for no_proof in (facing(covered, np.full(116, -QUARTER), np.full(116, 2.0)), facing(at[:1], up[:1], silent[:1])):
        assert left(no_proof) == pytest.approx((0.0, 3.0))


def test_readings_refute_a_part_of_a_wall_and_echoes_confirm_it():
    known = KnownReflectors.of_walls(np.array([[[0.0, 1.0], [4.0, 1.0]]]))
    x = np.linspace(0.05, 3.95, 79)
    position, up = np.stack([x, np.zeros_like(x)], axis=-1), np.full(len(x), QUARTER)
    first_echo = np.where((x > 1.5) & (x < 2.4), 2.0, 1.0)
    parts = profile_walls(known, facing(position, up, first_echo), resolution=0.05).parts.walls
    assert len(parts) == 2
    assert parts[0, 1, 0] == pytest.approx(1.5, abs=0.11)
    assert parts[1, 0, 0] == pytest.approx(2.4, abs=0.11)
    # Where the robot drove there is no wall, whatever was heard.
    driven = np.stack([np.full(40, 3.0), np.linspace(0, 2, 40)], axis=-1)
    parts = profile_walls(known, facing(position, up, np.ones(len(x)), driven), resolution=0.05).parts.walls
    assert len(parts) == 2
    assert not ((parts[:, 0, 0] < 3.0) & (parts[:, 1, 0] > 3.0)).any()


def test_edges_near_each_other_may_be_the_ends_of_a_wall_that_no_sensor_faced():
    ends = np.array([[0.0, 1.0], [0.5, 1.0], [3.0, 1.0]])
    points = ends, np.zeros(3), np.zeros(3)
    known, none = KnownReflectors(np.zeros((0, 2, 2)), np.zeros((0, 2)), *points, np.zeros((3, 3, 3))), np.zeros((0, 2))
    found = hidden_walls(known, none, NOTHING, resolution=0.05)
    assert found[..., 0].min() == 0.0
    assert found[..., 0].max() == 0.5  # the third is too far away
    x = np.linspace(0.0, 0.5, 21)
    seen = facing(np.stack([x, np.zeros(21)], axis=-1), np.full(21, QUARTER), np.full(21, 2.0))
    assert not len(hidden_walls(known, none, seen, resolution=0.05))


def test_free_cells_are_connected_to_the_trajectory(office_grid):
    reached, more = office_grid.footprint > 0, True
    while more:
        wide = np.pad(reached, 1)
        wide = wide[:-2, 1:-1] | wide[2:, 1:-1] | wide[1:-1, :-2] | wide[1:-1, 2:]
        more = (wide & office_grid.free & ~reached).any()
        reached = reached | wide & office_grid.free
    np.testing.assert_array_equal(office_grid.free, reached)


def test_a_scan_that_measured_nothing_only_frees_the_robots_own_body(faw_ring):
    poses = circle((0.0, 0.0), 0.5, 12)
    nothing = np.zeros(0, int)
    log = Log.from_echoes(nothing, nothing, nothing, np.zeros(0), stamp=np.arange(12.0), pose=poses)
    grid = occupancy(faw_ring, log)
    points = centers(grid)
    gap = np.linalg.norm(points[:, :, None] - poses[:, :2], axis=-1).min(axis=2)
    assert gap[grid.classify() == FREE].max() < 0.28


def test_sensors_without_an_outline_have_no_footprint_area():
    for position in ([(0.2, 0.0)], [(0.2, -0.2), (0.2, 0.0), (0.2, 0.2)]):
        ring = Ring(position, np.zeros(len(position)), beam=0.5, neighbors=0, max_range=1.0)
        grid = occupancy(ring, silent(np.zeros((3, 3)), ring))
        points = centers(grid)
        # One direction of view proves nothing beyond the sensors' own cells.
        assert (grid.free == (grid.footprint > 0)).all()
        assert np.abs(points[grid.classify() == FREE][:, 0] - 0.225).max() < 1e-9


def test_a_saved_grid_is_read_by_map_server(tmp_path, office, heard, office_grid):
    path = tmp_path / 'a "b": #c.yaml'
    save_nav2(office_grid, path)
    header = dict(line.split(": ", 1) for line in path.read_text().splitlines())
    assert list(header) == ["image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"]
    image = cv2.imread(str(tmp_path / ast.literal_eval(header["image"])), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    np.testing.assert_array_equal(image, office_grid.classify())
    # map_server's trinary rule: 205 must stay between the thresholds.
    occupied = 1 - image / 255
    read = np.where(occupied > float(header["occupied_thresh"]), 100, -1)
    read[occupied < float(header["free_thresh"])] = 0
    for grey, value in ((OCCUPIED, 100), (UNKNOWN, -1), (FREE, 0)):
        np.testing.assert_array_equal(read == value, image == grey)
        assert (image == grey).any()
    x, y, yaw = ast.literal_eval(header["origin"])
    assert (x, y) == pytest.approx(office_grid.origin)
    assert (yaw, float(header["resolution"]), header["mode"], header["negate"]) == (0, 0.05, "trinary", "0")
    # By the origin in the file, the first pose is in a free cell.
    column, row = np.floor((office.poses[0, :2] - (x, y)) / 0.05).astype(int)
    assert image[len(image) - 1 - row, column] == FREE


def test_a_wall_at_large_y_is_in_the_upper_rows(faw_ring, tmp_path):
    wall = np.array([[[-1.0, 1.0], [0.5, 1.0]]])
    poses = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])
    save_nav2(occupancy(faw_ring, listen(faw_ring, wall, poses), walls=wall), tmp_path / "map.yml")
    image = cv2.imread(str(tmp_path / "map.pgm"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    row, column = np.nonzero(image == OCCUPIED)
    assert row.max() < len(image) / 2
    assert column.mean() < image.shape[1] / 2


def test_logs_without_scans_or_poses(faw_ring, tmp_path):
    empty = occupancy(faw_ring, silent(np.zeros((0, 3))))
    lost = occupancy(faw_ring, silent(np.full((4, 3), np.nan)))
    assert (empty.scans, empty.skipped, lost.scans, lost.skipped) == (0, 0, 0, 4)
    assert lost.classify().size == 0
    for grid, why in ((empty, "no scan"), (lost, "4 scans without a pose")):
        with pytest.raises(SonarError, match=why):
            save_nav2(grid, tmp_path / "map.yaml")
    assert not list(tmp_path.iterdir())
    poses = np.array([[0.0, 0.0, 0.0], [np.nan] * 3])
    both = occupancy(faw_ring, silent(poses))
    assert (both.scans, both.skipped) == (1, 1)


@pytest.mark.parametrize("name", ["map", "map.pgm", "map.yaml.png"])
def test_another_suffix_is_refused_before_anything_is_written(tmp_path, office_grid, name):
    with pytest.raises(SonarError, match=r"allowed for a grid is \.yaml or \.yml"):
        save_nav2(office_grid, tmp_path / name)
    assert not list(tmp_path.iterdir())
    assert grid_image_filename("a/map.YAML").name == "map.pgm"


def test_impossible_grids_are_refused_in_one_line(faw_ring):
    far = np.array([[0.0, 0.0, 0.0], [1e7, 1e7, 0.0]])
    here = silent(np.zeros((1, 3)))
    for call, words in (
        (lambda: occupancy(faw_ring, silent(far)), "cells at most"),
        (lambda: occupancy(faw_ring, here, resolution=0.0), "allowed is 0.001 to 10 m"),
        (lambda: occupancy(faw_ring, here, resolution=0.002), "allowed is at most 400 cells far"),
        (lambda: occupancy(faw_ring, here, walls=np.full((1, 2, 2), np.nan)), "wall 0"),
        (lambda: grid_of_parts(faw_ring, [here, silent(far[1:])]), "cells"),
    ):
        with pytest.raises(SonarError, match=words) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_a_log_that_cannot_be_added_changes_nothing(faw_ring):
    growing, good = IncrementalGrid(faw_ring), silent(circle((0.0, 0.0), 0.4, 3))
    growing.add(good)
    with pytest.raises(SonarError, match="cells at most"):
        growing.add(silent(np.array([[1e5, 0.0, 0.0]])))
    with pytest.raises(SonarError, match="a pose at"):
        growing.add(silent(np.array([[1e20, 0.0, 0.0]])))
    assert_same_grid(growing.update(), grid_of_parts(faw_ring, [good]))


def test_the_way_between_two_scans_is_free_and_crosses_no_wall():
    ring = Ring.circular(count=8, radius=0.12, beam=0.5, neighbors=0)
    poses = np.stack([np.arange(0.0, 2.1, 0.4), np.zeros(6), np.zeros(6)], axis=-1)
    wall = np.array([[[0.6, -1.0], [0.6, 1.0]]])
    nothing = np.zeros(0, int)
    log = Log.from_echoes(nothing, nothing, nothing, np.zeros(0), stamp=np.arange(6.0), pose=poses)
    grid = occupancy(ring, log, walls=wall)
    points = centers(grid)
    on_way = (np.abs(points[..., 1]) < 0.05) & (points[..., 0] > 0) & (points[..., 0] < 2.0)
    assert (grid.classify()[on_way] == FREE).all()
    assert not grid.occupied[(np.abs(points[..., 1]) < 0.06)[::-1]].any()
    jump = Log.from_echoes(nothing, nothing, nothing, np.zeros(0), stamp=np.arange(2.0), pose=poses[[0, -1]])
    grid = occupancy(ring, jump, walls=wall)
    points = centers(grid)
    assert not (grid.classify()[(points[..., 0] > 0.3) & (points[..., 0] < 1.6)] == FREE).any()


def test_walls_of_a_grid_are_those_of_the_room(office, office_grid):
    """A round trip: the walls of the saved grid, as ``localize`` reads them."""
    found = map_from_grid(
        office_grid.occupied, office_grid.free, resolution=0.05, origin=np.array([*office_grid.origin, 0.0])
    )
    assert len(found) >= 5
    samples = found.segments[:, 0, None] + np.linspace(0, 1, 20)[:, None] * np.diff(found.segments, axis=1)
    gap = point_to_segments(samples.reshape(-1, 2), office.room.walls).min(axis=1)
    assert np.median(gap) < 0.03
    assert found.length.sum() > 6
