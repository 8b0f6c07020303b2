"""Directional free space against a slow oracle and true walls; storage does not depend on the order of the scans."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from support import oracles
from support.hard_cones import simulate
from support.rings import bumper_ring

from jaxsonar import Log, Ring, load_ring, local_models, random_pose, random_room
from jaxsonar.geometry.se2 import compose, transform_points
from jaxsonar.mapping.free_space import DirectionalFreeSpace, observe_free_space
from jaxsonar.mapping.map_evidence import gather_evidence
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.simulation.office import load_office

FREE = SETTINGS.free_space
STEP = 2 * math.pi / FREE.directions
RAYS, POINTS = 17, 33
"""Samples of a cone and of an arc. The oracle uses the same samples, but its own arithmetic."""
BUMPER = bumper_ring(calibrated=False)


def direction_of(theta):
    return math.floor((theta % (2 * math.pi)) / STEP) % FREE.directions


def place_of(point, theta):
    """(cell x, cell y, direction) of a wall at a point with a normal."""
    return math.floor(point[0] / FREE.cell), math.floor(point[1] / FREE.cell), direction_of(theta)


def center_of(cells):
    """A point and a normal in the middle of each cell."""
    cells = np.asarray(cells)
    return (cells[:, :2] + 0.5) * FREE.cell, (cells[:, 2] + 0.5) * STEP


def some_cells(rng, count, *, around=(0, 0)):
    """Random cells over several tiles around a position, many of them repeated."""
    cells = np.column_stack([rng.integers(-40, 40, (count, 2)), rng.integers(0, FREE.directions, count)])
    cells = cells[rng.integers(0, max(count // 4, 1), count)]
    return cells + np.array([*around, 0]), rng.integers(-5, 50, count).astype(float)


def assert_same(one, other):
    assert one.tiles.keys() == other.tiles.keys()
    for key, times in one.tiles.items():
        np.testing.assert_array_equal(times, other.tiles[key])


def copied(seen):
    return {key: times.copy() for key, times in seen.tiles.items()}


@pytest.mark.slow
@settings(max_examples=40)
@given(st.integers(0, 10_000), st.integers(0, 300), st.integers(1, 6))
def test_split_and_order_of_the_scans_do_not_matter(seed, count, parts):
    rng = np.random.default_rng(seed)
    cells, when = some_cells(rng, count)
    whole = DirectionalFreeSpace().updated(cells, when)
    apart = DirectionalFreeSpace()
    for rows in np.array_split(rng.permutation(count), parts):
        apart = apart.updated(cells[rows], when[rows])
    assert_same(whole, apart)


@pytest.mark.slow
@settings(max_examples=40)
@given(st.integers(0, 10_000), st.integers(1, 300), st.sampled_from([(0, 0), (-37, 1), (10**6, -(10**6))]))
def test_query_gives_the_latest_times_in_descending_order(seed, count, around):
    """Against sorting the times of every cell, on both sides of the origin and 100 km away."""
    rng = np.random.default_rng(seed)
    cells, when = some_cells(rng, count, around=around)
    seen = DirectionalFreeSpace().updated(cells, when)
    points, theta = center_of(cells)
    times_found = seen.query(points, theta + 2 * math.pi * rng.integers(-2, 3, count))
    for cell, times in zip(cells, times_found, strict=True):
        by_hand = sorted(when[(cells == cell).all(axis=1)].tolist(), reverse=True)[: FREE.remembered]
        assert times.tolist() == by_hand + [-np.inf] * (FREE.remembered - len(by_hand))


def test_unobserved_cells_have_no_times(rng):
    cells, when = some_cells(rng, 200)
    seen = DirectionalFreeSpace().updated(cells, when)
    known = set(map(tuple, cells.tolist()))
    others = [cell for cell in map(tuple, some_cells(rng, 2000)[0].tolist()) if cell not in known]
    assert len(others) > 100
    assert np.isneginf(seen.query(*center_of(others))).all()
    assert np.isneginf(DirectionalFreeSpace().query(*center_of(cells))).all()
    assert seen.query(np.zeros((0, 2)), np.zeros(0)).shape == (0, FREE.remembered)


@pytest.mark.slow
@settings(max_examples=8)
@given(st.integers(0, 10_000), st.lists(st.integers(0, 120), min_size=3, max_size=3))
def test_union_is_a_sum(seed, counts):
    """Commutative and associative, with a neutral element, and equal to adding everything at once."""
    rng = np.random.default_rng(seed)
    parts = [some_cells(rng, count) for count in counts]
    a, b, c = (DirectionalFreeSpace().updated(*part) for part in parts)
    assert_same(a.union(b), b.union(a))
    assert_same(a.union(b).union(c), a.union(b.union(c)))
    assert_same(a.union(DirectionalFreeSpace()), a)
    assert_same(DirectionalFreeSpace().union(a), a)
    cells, when = (np.concatenate(column) for column in zip(*parts, strict=True))
    assert_same(a.union(b).union(c), DirectionalFreeSpace().updated(cells, when))


def test_updates_do_not_change_old_states(rng):
    first = DirectionalFreeSpace().updated(*some_cells(rng, 300))
    second = DirectionalFreeSpace().updated(*some_cells(rng, 300))
    before, before_second = copied(first), copied(second)
    first.updated(*some_cells(rng, 300)).updated(*some_cells(rng, 300))
    first.union(second)
    second.union(first)
    assert_same(first, DirectionalFreeSpace(before))
    assert_same(second, DirectionalFreeSpace(before_second))


def path_geometry(ring, path):
    """Midpoint, first direction and width of the cone of a path, from the cones of its two sensors."""
    tx, rx = ring.paths[path]
    turn = oracles.wrap(ring.heading[rx] - ring.heading[tx])
    first = max(-ring.beam[tx] / 2, turn - ring.beam[rx] / 2)
    last = min(ring.beam[tx] / 2, turn + ring.beam[rx] / 2)
    return (ring.position[tx] + ring.position[rx]) / 2, ring.heading[tx] + first, last - first


def free_cells_oracle(ring, pose, echoes, walls, *, measured=None, motion=None):
    """Oracle: free cells of one scan (path, range), by loops over sensors, rays and distances, and shapely."""
    measured = np.ones(len(ring.paths), bool) if measured is None else measured
    at = [pose if motion is None else compose(pose, step) for step in (motion if motion is not None else ring.paths)]
    hides = []
    for start, end in walls:
        beyond = FREE.extension * (end - start) / np.linalg.norm(end - start)
        normal = math.atan2(beyond[0], -beyond[1])
        hides.append((normal, shapely.LineString([start, end]), shapely.LineString([start - beyond, end + beyond])))
    votes, able = {}, {}
    for path, (tx, rx) in enumerate(ring.paths):
        if tx != rx:
            continue
        middle, first, width = path_geometry(ring, path)
        sensor = transform_points(at[path], middle)
        farthest = FREE.certain * ring.max_range + FREE.margin
        nearest = min([reach for k, reach in echoes if k == path], default=math.inf)
        nearest = min(nearest, farthest) if measured[path] else -math.inf
        for k in range(RAYS):
            theta = at[path][2] + first + width * (0.5 + FREE.certain * (k / (RAYS - 1) - 0.5))
            ray = np.array([math.cos(theta), math.sin(theta)])
            sight = shapely.LineString([sensor, sensor + 100 * ray])
            # A wall may extend beyond its ends, except for rays that face it and would have heard it.
            facing = [abs(oracles.wrap(2 * (theta - normal))) / 2 <= FREE.facing for normal, _, _ in hides]
            met = [seen if faces else guessed for faces, (_, seen, guessed) in zip(facing, hides, strict=True)]
            met = [sight.intersection(wall) for wall in met if sight.intersects(wall)]
            hidden = min((shapely.Point(sensor).distance(place) for place in met), default=math.inf)
            distance = FREE.cell / 2
            while distance < FREE.certain * ring.max_range:
                cell = place_of(sensor + distance * ray, theta)
                middle = (np.array(cell[:2]) + 0.5) * FREE.cell
                sector = 2 * math.pi / FREE.directions
                faced = (cell[2] * sector - at[path][2] - first) % (2 * math.pi) <= width - sector
                away = max(distance, np.linalg.norm(middle - sensor)) + FREE.margin
                if faced and away < min(farthest, hidden):
                    able.setdefault((cell[0] // 2, cell[1] // 2, cell[2]), set()).add(path)
                    if away < nearest:
                        votes.setdefault(cell, set()).add(path)
                distance += FREE.cell * 0.7
    against = set()
    for path, reach in echoes:
        middle, first, width = path_geometry(ring, path)
        sensor = transform_points(at[path], middle)
        for k in range(POINTS):
            theta = at[path][2] + first + width * k / (POINTS - 1)
            for distance in (reach - FREE.cell / 2, reach, reach + FREE.cell / 2):
                point = sensor + distance * np.array([math.cos(theta), math.sin(theta)])
                against.add(place_of(point, theta))
    twice = sum(path_geometry(ring, k)[2] for k, (tx, rx) in enumerate(ring.paths) if tx == rx) >= 4 * math.pi
    around = {}
    for (x, y, facing), sensors in votes.items():
        around.setdefault((x // 2, y // 2, facing), set()).update(sensors)

    def agreed(block):
        no_other = len(able[block]) > 1 and sum(measured[path] for path in able[block]) == 1
        return not twice or len(around[block]) > 1 or no_other

    return {(x, y, facing) for x, y, facing in votes if agreed((x // 2, y // 2, facing))} - against


def free_cells(ring, poses, echoes, walls, **measurements):
    """The free cells of several scans from the product, one set per scan."""
    scan = np.repeat(np.arange(len(poses)), [len(part) for part in echoes])
    flat = [echo for part in echoes for echo in part]
    path = np.array([k for k, _ in flat], np.int64)
    reach = np.array([r for _, r in flat], np.float64)
    cells, who = observe_free_space(ring, np.asarray(poses, np.float64), scan, path, reach, walls, **measurements)
    return [set(map(tuple, cells[who == k].tolist())) for k in range(len(poses))]


def some_scans(ring, rng, *, share=1.0):
    """Random poses, echoes and walls of five scans, and the paths that each measured."""
    poses, echoes, walls = [], [], []
    measured = rng.random((5, len(ring.paths))) < share
    for k in range(5):
        poses.append(np.append(rng.uniform(-3, 3, 2) * (100 if k == 4 else 1), rng.uniform(-4, 4)))
        count = int(rng.integers(0, 12)) if k else 0
        paths = rng.integers(0, len(ring.paths), count)
        heard = [(int(p), float(r)) for p, r in zip(paths, rng.uniform(0.3, ring.max_range, count), strict=True)]
        echoes.append([(p, r) for p, r in heard if measured[k, p]])
        walls.append(poses[-1][:2] + rng.uniform(-2, 2, (int(rng.integers(0, 4)), 2, 2)))
    return poses, echoes, walls, measured


@pytest.mark.slow
@pytest.mark.parametrize(
    "ring", [Ring.circular(), Ring.circular(count=12, beam=0.9, neighbors=1), BUMPER, load_ring("corridor8")]
)
@pytest.mark.parametrize("share", [1.0, 0.6, 0.15])
def test_free_space_equals_the_oracle(ring, share):
    """Several scans at once against one at a time; random poses, echoes, walls, measured paths and motion."""
    rng = np.random.default_rng(5)
    poses, echoes, walls, measured = some_scans(ring, rng, share=share)
    motion = rng.uniform(-0.2, 0.2, (5, len(ring.paths), 3)) if share < 1 else None
    came = free_cells(ring, poses, echoes, walls, measured=measured if share < 1 else None, path_pose=motion)
    found = 0
    for k, (pose, heard, shown, cells) in enumerate(zip(poses, echoes, walls, came, strict=True)):
        moved = None if motion is None else motion[k]
        wanted = free_cells_oracle(ring, pose, heard, shown, measured=measured[k], motion=moved)
        assert len(wanted) > 10 or share < 1
        # Intermediate values are in single precision: a point on a border may fall to either side.
        assert len(cells ^ wanted) <= 2
        found += len(wanted)
    assert found > 200


@pytest.mark.parametrize("ring", [Ring.circular(count=16, beam=0.8, neighbors=1), load_ring("corridor8")])
@pytest.mark.parametrize("share", [0.9, 0.4])
def test_a_path_without_a_measurement_frees_nothing(ring, share):
    """Unmeasured instead of silent, a path never adds a free cell; no measurement at all frees nothing."""
    rng = np.random.default_rng(8)
    poses, echoes, walls, silent = some_scans(ring, rng, share=share)
    before = free_cells(ring, poses, echoes, walls)
    for heard, row in zip(echoes, silent, strict=True):
        row[[path for path, _ in heard]] = True
    once = free_cells(ring, poses, echoes, walls, measured=silent)
    less = silent & (rng.random(silent.shape) < 0.7)
    for heard, row in zip(echoes, less, strict=True):
        row[[path for path, _ in heard]] = True
    twice = free_cells(ring, poses, echoes, walls, measured=less)
    assert all(c <= b <= a for a, b, c in zip(before, once, twice, strict=True))
    assert sum(map(len, twice)) < sum(map(len, once)) < sum(map(len, before))
    nothing = [[] for _ in poses]
    assert not any(free_cells(ring, poses, nothing, walls, measured=np.zeros_like(silent)))


def test_one_sensor_is_enough_where_no_other_was_measured(faw_ring):
    """A single measured sensor frees what it sees; as soon as its neighbor is measured, both must agree."""
    at_rest, no_wall = [(0.0, 0.0, 0.0)], [np.zeros((0, 2, 2))]
    only = np.zeros((1, len(faw_ring.paths)), bool)
    direct = [faw_ring.path_index[k, k] for k in (3, 4)]
    only[0, direct[0]] = True
    (alone,) = free_cells(faw_ring, at_rest, [[]], no_wall, measured=only)
    both = only.copy()
    both[0, direct[1]] = True
    (disputed,) = free_cells(faw_ring, at_rest, [[(direct[1], 0.1)]], no_wall, measured=both)
    (agreed,) = free_cells(faw_ring, at_rest, [[]], no_wall, measured=both)
    assert 30 < len(disputed) < len(alone) < len(agreed)
    assert disputed < alone < agreed


def test_without_echoes_the_cones_are_free(faw_ring):
    """Up to the certain fraction of the maximum range and of the width, in all directions, and no farther."""
    (cells,) = free_cells(faw_ring, [(0.0, 0.0, 0.0)], [[]], [np.zeros((0, 2, 2))])
    points, theta = center_of(sorted(cells))
    farthest = np.linalg.norm(points, axis=-1).max()
    assert 0.28 + FREE.certain * 2.0 - 2 * FREE.cell < farthest < 0.28 + FREE.certain * 2.0 + FREE.cell
    # Most positions that face a sensor; far ones may lie between the rays.
    rng = np.random.default_rng(0)
    claimed = []
    for _ in range(2000):
        sensor, distance = int(rng.integers(24)), rng.uniform(0.2, 1.2)
        turn = faw_ring.heading[sensor] + rng.uniform(-0.1, 0.1)
        point = faw_ring.position[sensor] + distance * np.array([math.cos(turn), math.sin(turn)])
        claimed.append((sensor, place_of(point, turn) in cells))
    share = [np.mean([hit for which, hit in claimed if which == sensor]) for sensor in range(24)]
    assert np.mean(share) > 0.7
    assert min(share) > 0.4
    # No wall that faces away from the robot, or along the line of sight.
    sight = np.arctan2(points[:, 1], points[:, 0])
    far = np.linalg.norm(points, axis=-1) > 0.6
    assert np.abs(oracles.wrap(theta - sight))[far].max() < math.radians(60)


def test_an_empty_update_changes_nothing(rng):
    """A scan without free cells, because all sensors heard something close."""
    nothing = (np.zeros((0, 3), np.int64), np.zeros(0))
    assert_same(DirectionalFreeSpace().updated(*nothing), DirectionalFreeSpace())
    seen = DirectionalFreeSpace().updated(*some_cells(rng, 50))
    assert_same(seen.updated(*nothing), seen)


def test_no_scans_give_no_cells(faw_ring):
    cells, who = observe_free_space(
        faw_ring, np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), []
    )
    assert cells.shape == (0, 3)
    assert len(who) == 0


@pytest.mark.slow
@settings(max_examples=30)
@given(st.floats(0.45, 1.9), st.floats(-3.1, 3.1), st.floats(-3.1, 3.1), st.floats(-50, 50))
def test_a_wall_with_echoes_is_not_free(rho, theta, heading, x):
    """No footpoint of a sensor on an infinite wall is free, and nothing behind the wall."""
    ring = Ring.circular()
    heard = oracles.echoes_of_wall(ring, rho, theta)
    pose = np.array([x, 1.0, heading])
    (cells,) = free_cells(ring, [pose], [heard], [np.zeros((0, 2, 2))])
    normal = np.array([math.cos(theta), math.sin(theta)])
    for position in ring.position:
        for shift in (-0.03, 0.0, 0.03):
            foot = transform_points(pose, position + (rho - position @ normal + shift) * normal)
            assert place_of(foot, theta + heading) not in cells
    points, facing = center_of(sorted(cells))
    robot = (points - pose[:2]) @ np.array(
        [[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]]
    )
    behind = (robot @ normal > rho + FREE.cell) & (np.abs(oracles.wrap(facing - theta - heading)) < math.radians(10))
    assert not behind.any()


def true_places(ring, room, pose):
    """Cells of true walls with a footpoint of a sensor that is in the cone, within range and visible."""
    places = {}
    for sensor, heading, beam in zip(ring.position, ring.heading, ring.beam, strict=True):
        at = transform_points(pose, sensor)
        for k, (start, end) in enumerate(room.walls):
            along = (end - start) / np.linalg.norm(end - start)
            share = (at - start) @ along
            foot = start + share * along
            reach = np.linalg.norm(foot - at)
            theta = math.atan2(*(foot - at)[::-1])
            inside = 0.02 < share < np.linalg.norm(end - start) - 0.02
            if not inside or reach > 0.95 * ring.max_range:
                continue
            if abs(oracles.wrap(theta - heading - pose[2])) > 0.95 * beam / 2:
                continue
            sight = shapely.LineString([at, foot])
            others = [shapely.LineString(wall) for j, wall in enumerate(room.walls) if j != k]
            if not any(sight.intersects(other) for other in others):
                places[place_of(foot, theta)] = k
    return places


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_true_walls_are_never_free(faw_ring, seed):
    """In random rooms without noise."""
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    poses = np.array([random_pose(rng, room) for _ in range(6)])
    heard = simulate(faw_ring, room, poses)
    near = heard.range < faw_ring.max_range
    nothing = [np.zeros((0, 2, 2))] * len(poses)
    cells, who = observe_free_space(faw_ring, poses, heard.scan[near], heard.path[near], heard.range[near], nothing)
    checked = 0
    for k, pose in enumerate(poses):
        claimed = set(map(tuple, cells[who == k].tolist()))
        truth = true_places(faw_ring, room, pose)
        wrong = {place: room.wall_names[wall] for place, wall in truth.items() if place in claimed}
        assert not wrong, (k, pose)
        checked += len(truth)
    assert checked > 20


@pytest.mark.slow
def test_walls_of_the_office_are_never_free():
    """The evidence of the whole log has no free space where some scan sees a true wall."""
    office = load_office()
    heard = simulate(office.ring, office.room, office.poses, stamps=office.stamps)
    log = heard.as_log(office.ring, office.poses)
    seen = gather_evidence(office.ring, log, list(local_models(office.ring, log))).free_space
    truth = {place for pose in office.poses for place in true_places(office.ring, office.room, pose)}
    points, theta = center_of(sorted(truth))
    times_found = seen.query(points, theta)
    assert len(truth) > 50
    assert np.isneginf(times_found[:, -1]).all()  # three scans in agreement would remove a wall


@pytest.mark.slow
def test_only_scans_with_a_pose_and_echoes_within_range_count(faw_ring):
    """An echo beyond the maximum range counts as none; a scan without a pose adds no free space."""
    far = Log.from_echoes(
        np.array([0, 1]), np.array([3, 3]), np.array([3, 3]), np.array([2.6, 1.0]),
        stamp=np.arange(2.0), pose=np.array([[0.0, 0.0, 0.0], [np.nan] * 3]), asked=faw_ring.paths,
    )  # fmt: skip
    silent = Log.from_echoes(
        np.zeros(0, int), np.zeros(0, int), np.zeros(0, int), np.zeros(0),
        stamp=np.zeros(1), pose=np.zeros((1, 3)), asked=faw_ring.paths,
    )  # fmt: skip
    came = [gather_evidence(faw_ring, log, list(local_models(faw_ring, log))).free_space for log in (far, silent)]
    assert_same(*came)
    assert came[0].tiles
