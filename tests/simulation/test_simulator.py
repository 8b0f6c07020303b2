"""The simulator: exact geometry against independent image sources, and the laws of what a ring hears."""

from dataclasses import fields
from itertools import permutations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsonar import Room, random_pose, random_room
from jaxsonar.hardware.errors import SonarError
from jaxsonar.sensors.ring import Ring
from jaxsonar.simulation.acoustics import Acoustics
from jaxsonar.simulation.echo_tracing import trace_between
from jaxsonar.simulation.simulator import Simulation, simulate
from jaxsonar.simulation.traced_echoes import EchoKind, TracedEchoes

seeds = st.integers(0, 2**32 - 1)
RING = Ring.circular()
EVERYTHING: dict[str, Any] = {"max_echoes": 1000, "blanking": 0.0, "acoustics": Acoustics(threshold=0.0)}
"""Settings of a detector that hears whatever geometry allows."""


def loop(points):
    points = np.array(points, dtype=np.float64)
    return np.stack([points, np.roll(points, -1, axis=0)], axis=1)


def turned(points, angle, at=(0.0, 0.0)):
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(points) @ np.array([[cos, sin], [-sin, cos]]) + at


def room_of_exact_angles(rng, **parts):
    """A random room without a corner that is only nearly right-angled: those are taken as right-angled by choice."""
    while True:
        room = random_room(rng, **parts)
        widths = room.junctions.wedge_width[room.junctions.corners]
        if np.allclose(widths, np.pi / 2, atol=1e-9):
            return room


def places(rng, room, count, clearance=0.1):
    return np.array([random_pose(rng, room, clearance=clearance)[:2] for _ in range(count)])


def some_poses(rng, room, count):
    return np.array([random_pose(rng, room) for _ in range(count)])


# Exact geometry against pyroomacoustics and against a slow float64 oracle.


def pra_images(pra, corners, tx, rx):
    """Visible image sources of tx up to second order in a polygon: as they come (float32), and refined to float64.

    pyroomacoustics computes in float32: 24 bits of a few metres are no better than 1e-6 m. Which images are visible and
    over which walls they came is its answer; mirroring tx again at those walls in float64 removes its rounding.
    """
    scene = pra.Room.from_corners(corners.T, fs=16000, max_order=2, materials=pra.Material(0.1))
    scene.add_source(tx)
    scene.add_microphone(rx[:, None])
    scene.image_source_model()
    source = scene.sources[0]
    walls = [(wall.corners[:, 0].astype(float), wall.normal.astype(float)) for wall in scene.walls]
    # Its walls are ours, in float32: take the exact ones.
    exact = loop(corners)
    nearest = [np.abs(exact[:, 0] - start).sum(-1).argmin() for start, _ in walls]

    def mirrored(point, wall):
        start, end = exact[wall]
        normal = np.array([start[1] - end[1], end[0] - start[0]]) / np.linalg.norm(end - start)
        return point - 2 * ((point - start) @ normal) * normal

    raw, refined = [], []
    for index in np.flatnonzero(scene.visibility[0][0]):
        image, order, last = source.images[:, index].astype(float), source.orders[index], source.walls[index]
        if order == 0:
            continue
        chains = [(last,)] if order == 1 else [(wall, last) for wall in range(len(walls)) if wall != last]
        candidates = []
        for chain in chains:
            point = tx
            for wall in chain:
                point = mirrored(point, nearest[wall])
            candidates.append(point)
        best = min(candidates, key=lambda point: np.linalg.norm(point - image))
        assert np.linalg.norm(best - image) < 1e-4
        raw.append(np.linalg.norm(image - rx))
        refined.append(np.linalg.norm(best - rx))
    return np.sort(raw), np.sort(refined)


SPECULAR = (EchoKind.PLANE, EchoKind.CORNER, EchoKind.SECOND_ORDER)


@pytest.mark.filterwarnings("default")
def test_path_lengths_agree_with_pyroomacoustics():
    pra = pytest.importorskip("pyroomacoustics")
    rng = np.random.default_rng(1)
    convex = total = 0
    for _ in range(40):
        room = room_of_exact_angles(rng, box=0.0, segment=0.0, pole=0.0)
        corners = room.walls[:, 0] - room.walls[:, 0].mean(0)  # float32 is finest around the origin
        room = Room(loop(corners))
        along = np.diff(room.walls, axis=1)[:, 0]
        convex += (np.linalg.det(np.stack([along, np.roll(along, -1, axis=0)], axis=1)) > 0).all()
        tx, rx = places(rng, room, 6), places(rng, room, 6)
        found = trace_between(room, tx, rx)
        for k in range(len(tx)):
            lengths = np.sort(found.length[(found.pair == k) & np.isin(found.kind, SPECULAR)])
            raw, refined = pra_images(pra, corners, tx[k], rx[k])
            assert len(lengths) == len(raw)  # both ways: nothing missed, nothing invented
            assert np.abs(lengths - refined).max() < 1e-6
            assert np.abs(lengths - raw).max() < 1e-5  # as far as float32 goes
            total += len(lengths)
    assert 5 < convex < 35
    assert total > 2000


def mirror(point, wall):
    start, end = wall
    along = (end - start) / np.linalg.norm(end - start)
    foot = start + ((point - start) @ along) * along
    return 2 * foot - point


def meeting(p, q, wall):
    """Where the open segment p-q meets a closed wall, or None."""
    start, end = wall
    matrix = np.stack([q - p, start - end], axis=1)
    if abs(np.linalg.det(matrix)) < 1e-14:
        return None
    t, u = np.linalg.solve(matrix, start - p)
    return p + t * (q - p) if 0 < t < 1 and 0 <= u <= 1 else None


def clear(shapely, walls, p, q):
    """Whether no wall stands between p and q; the legs' ends may lie on walls."""
    margin = 1e-7 * (q - p)
    return not shapely.LineString([p + margin, q - margin]).intersects(walls)


def oracle(shapely, room, tx, rx):
    """All echoes of one pair, one after the other: sorted lengths of planes, double reflections, edges, poles."""
    walls = shapely.MultiLineString(list(room.walls))
    planes, doubles = [], []
    for wall in room.walls:
        image = mirror(tx, wall)
        hit = meeting(image, rx, wall)
        if hit is not None and clear(shapely, walls, tx, hit) and clear(shapely, walls, hit, rx):
            planes.append(np.linalg.norm(image - rx))
    for a, b in permutations(range(len(room.walls)), 2):
        first_image = mirror(tx, room.walls[a])
        second_image = mirror(first_image, room.walls[b])
        last = meeting(second_image, rx, room.walls[b])
        first = None if last is None else meeting(first_image, last, room.walls[a])
        if first is not None and all(clear(shapely, walls, p, q) for p, q in ((tx, first), (first, last), (last, rx))):
            doubles.append(np.linalg.norm(second_image - rx))

    def scattered(points):
        legs = [(c, np.linalg.norm(tx - c) + np.linalg.norm(rx - c)) for c in points]
        return sorted(length for c, length in legs if clear(shapely, walls, tx, c) and clear(shapely, walls, rx, c))

    ends = np.unique(room.walls.reshape(-1, 2).round(12), axis=0)
    edges = [c for c in ends if opening(room, c, tx) > 181 and opening(room, c, rx) > 181]
    return sorted(planes), sorted(doubles), scattered(edges), scattered(room.poles)


def opening(room, c, sensor):
    """Degrees between the walls on either side of a sensor, as seen from the end c of a wall."""
    leaving = []
    for start, end in room.walls:
        if np.linalg.norm(start - c) + np.linalg.norm(end - c) < np.linalg.norm(end - start) + 1e-9:
            leaving += [far - c for far in (start, end) if np.linalg.norm(far - c) > 1e-6]
    angles = np.degrees([np.arctan2(*v[::-1]) for v in [sensor - c, *leaving]])
    turns = (angles[1:] - angles[0]) % 360
    return turns.min() + 360 - turns.max()


def lengths_of(found: TracedEchoes, pair, *kinds):
    return np.sort(found.length[(found.pair == pair) & np.isin(found.kind, kinds)])


def assert_as_oracle(room, tx, rx):
    shapely = pytest.importorskip("shapely")
    found = trace_between(room, tx, rx)
    for k in range(len(tx)):
        planes, doubles, edges, poles = oracle(shapely, room, tx[k], rx[k])
        for expected, kinds in (
            (planes, [EchoKind.PLANE]),
            (doubles, [EchoKind.CORNER, EchoKind.SECOND_ORDER]),
            (edges, [EchoKind.EDGE]),
            (poles, [EchoKind.POLE]),
        ):
            lengths = lengths_of(found, k, *kinds)
            assert len(lengths) == len(expected), kinds
            assert np.allclose(lengths, expected, rtol=0, atol=1e-9)
    return found


@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_everything_agrees_with_a_slow_oracle(seed):
    rng = np.random.default_rng(seed)
    room = room_of_exact_angles(rng, recess=0.7, box=0.7, segment=0.7, pole=0.7)
    assert_as_oracle(room, places(rng, room, 4), places(rng, room, 4))


def test_junctions_within_walls_agree_with_the_oracle(rng):
    hall = loop([[-2, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]])
    stub = [[0.5, -1.5], [0.5, -0.7]]  # T with the hall
    plus = [[[-1.0, 0.0], [-0.2, 0.1]], [[-0.6, -0.3], [-0.5, 0.5]]]  # X
    room = Room(np.concatenate([hall, [stub], plus]))
    found = assert_as_oracle(room, places(rng, room, 40), places(rng, room, 40))
    assert set(found.kind.tolist()) == {EchoKind.PLANE, EchoKind.CORNER, EchoKind.EDGE, EchoKind.SECOND_ORDER}


@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_occlusion_is_that_of_shapely(seed):
    shapely = pytest.importorskip("shapely")
    rng = np.random.default_rng(seed)
    screens = rng.uniform(-2, 2, (12, 2, 2))
    poles = rng.uniform(-2, 2, (30, 2))
    tx, rx = rng.uniform(-2, 2, (2, 30, 2))
    found = trace_between(Room(screens, (), poles), tx, rx)
    heard = {
        (int(p), int(r))
        for p, r, kind in zip(found.pair, found.reflector, found.kind, strict=True)
        if kind == EchoKind.POLE
    }
    walls = shapely.MultiLineString(list(screens))
    for k, pole in np.ndindex(30, 30):
        free = all(not shapely.LineString([s, poles[pole]]).intersects(walls) for s in (tx[k], rx[k]))
        assert ((k, pole) in heard) == free


@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_points_of_a_path_make_up_its_length_and_lie_on_its_reflectors(seed):
    rng = np.random.default_rng(seed)
    room = room_of_exact_angles(rng, box=0.7, segment=0.7, pole=0.7)
    tx, rx = places(rng, room, 8), places(rng, room, 8)
    found = trace_between(room, tx, rx)
    legs = [found.first - tx[found.pair], found.last - found.first, rx[found.pair] - found.last]
    assert np.allclose(sum(np.linalg.norm(leg, axis=-1) for leg in legs), found.length, atol=1e-9)
    assert (found.second[found.kind != EchoKind.SECOND_ORDER] == -1).all()
    for kind, points in ((EchoKind.POLE, room.poles), (EchoKind.EDGE, room.junctions.vertices)):
        mine = found[found.kind == kind]
        assert np.allclose(mine.first, points[mine.reflector], atol=1e-12)
    for kind, wall, point in (
        (EchoKind.PLANE, found.reflector, found.first),
        (EchoKind.SECOND_ORDER, found.reflector, found.first),
        (EchoKind.SECOND_ORDER, found.second, found.last),
    ):
        mine = found.kind == kind
        ends = room.walls[wall[mine]]
        apart = np.linalg.norm(ends - point[mine, None], axis=-1).sum(-1)
        apart -= np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
        assert np.allclose(apart, 0, atol=1e-8)


@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_reciprocity_of_single_pairs(seed):
    rng = np.random.default_rng(seed)
    room = random_room(rng, box=0.7, segment=0.7, pole=0.7)
    tx, rx = places(rng, room, 8), places(rng, room, 8)

    def rows(found, first, last):
        low, high = np.minimum(found.reflector, found.second), np.maximum(found.reflector, found.second)
        table = np.column_stack([found.pair, found.kind, np.where(low < 0, high, low), high, found.length, first, last])
        return table[np.lexsort(table.T[4::-1])]

    there, back = trace_between(room, tx, rx), trace_between(room, rx, tx)
    assert np.allclose(rows(there, there.first, there.last), rows(back, back.last, back.first), atol=1e-8)


def test_far_from_the_origin_nothing_is_lost(rng):
    room = room_of_exact_angles(rng, segment=1.0, box=1.0)
    tx, rx = places(rng, room, 20), places(rng, room, 20)
    shift = np.array([4e5, 5e6])  # a map in UTM coordinates
    here = trace_between(room, tx, rx)
    there = trace_between(Room(room.walls + shift, (), room.poles + shift), tx + shift, rx + shift)
    assert np.array_equal(np.bincount(here.kind), np.bincount(there.kind))
    assert np.allclose(np.sort(here.length), np.sort(there.length), atol=1e-7)


def test_range_limit_of_the_geometry(rng):
    room = random_room(rng, segment=1.0)
    tx, rx = places(rng, room, 30), places(rng, room, 30)
    far, near = trace_between(room, tx, rx), trace_between(room, tx, rx, max_range=1.7)
    assert np.allclose(np.sort(far.length[far.length <= 3.4]), np.sort(near.length))
    assert 0 < len(near) < len(far)


# The table of path lengths.

coordinate = st.floats(-1.5, 1.5)


@given(xi=coordinate, xj=coordinate, yi=st.floats(0.1, 2), yj=st.floats(0.1, 2), angle=st.floats(-np.pi, np.pi))
def test_length_of_a_plane_echo(xi, xj, yi, yj, angle):
    walls = turned([[[-9.0, 0.0], [9.0, 0.0]]], angle)
    tx, rx = turned([[xi, yi]], angle), turned([[xj, yj]], angle)
    found = trace_between(Room(walls), tx, rx)
    plane = found.length[found.kind == EchoKind.PLANE]
    normal, tangent = turned([[0.0, 1.0], [1.0, 0.0]], angle)
    middle, half = (tx + rx)[0] / 2, (rx - tx)[0] / 2
    # rho = 0 here: the wall goes through the origin.
    assert np.allclose(plane, 2 * np.hypot(middle @ normal, half @ tangent) if yi * yj > 0 else [])
    assert len(plane) == 1


@pytest.mark.slow
@given(
    xi=st.floats(0.05, 2), xj=st.floats(0.05, 2), yi=st.floats(0.05, 2), yj=st.floats(0.05, 2), angle=st.floats(-9, 9),
    off=st.sampled_from([0.0, 0.009, -0.009]),
)  # fmt: skip
def test_length_of_a_corner_echo(xi, xj, yi, yj, angle, off):
    corner = np.array([0.3, -0.7])
    directions = turned([[9.0, 0.0], turned([0.0, 9.0], off)], angle)
    room = Room(corner + np.stack([np.zeros((2, 2)), directions], axis=1))
    e1, e2 = directions / 9.0
    tx, rx = (corner + np.array([x]) * e1 + np.array([y]) * e2 for x, y in ((xi, yi), (xj, yj)))
    for a, b in ((tx, rx), (tx, tx)):  # the direct echo goes through the corner itself
        found = trace_between(room, a[None], b[None])
        corners = found[found.kind == EchoKind.CORNER]
        assert np.allclose(corners.length, [2 * np.linalg.norm((a + b) / 2 - corner)])
        assert np.allclose(room.junctions.vertices[corners.reflector], corner)
        assert (found.kind != EchoKind.SECOND_ORDER).all()


@pytest.mark.parametrize("off_deg", [0.0, 0.9, -0.9, 1.5, -1.5, 20.0])
def test_only_right_angled_corners_reflect_twice_to_the_sender(off_deg):
    walls = [[[3.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], turned([0.0, 3.0], np.radians(off_deg))]]
    inside, outside = np.array([[1.0, 0.8]]), np.array([[-1.0, -0.8]])
    room = Room(np.array(walls))
    found = trace_between(room, inside, inside)
    assert (np.count_nonzero(found.kind == EchoKind.CORNER) == 1) == (abs(off_deg) < 1)
    # A wedge below 90 deg sends the sound back as well, by way of both walls; one above does not.
    assert np.count_nonzero(found.kind == EchoKind.SECOND_ORDER) == (off_deg < -1)
    found = trace_between(room, outside, outside)
    assert not np.isin(found.kind, [EchoKind.CORNER, EchoKind.SECOND_ORDER]).any()
    assert np.allclose(lengths_of(found, 0, EchoKind.EDGE)[0], 2 * np.hypot(1.0, 0.8))


def test_a_corner_ends_where_its_walls_end():
    room = Room(np.array([[[0.4, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 3.0]]]))
    tx = np.array([[1.0, 1.0]])
    assert EchoKind.CORNER in trace_between(room, tx, np.array([[1.0, 0.6]])).kind  # meets the short wall at 0.25 m
    assert EchoKind.CORNER not in trace_between(room, tx, np.array([[1.0, 0.2]])).kind  # would meet it at 0.67 m


@pytest.mark.slow
@given(tx=st.tuples(coordinate, coordinate), rx=st.tuples(coordinate, coordinate))
def test_length_of_echoes_of_poles_and_free_ends(tx, rx):
    pole, wall = np.array([[3.0, 1.0]]), np.array([[[2.0, 2.0], [2.0, 3.0]]])
    a, b = np.array(tx), np.array(rx)
    found = trace_between(Room(wall, (), pole), a[None], b[None])
    for kind, points in ((EchoKind.POLE, pole), (EchoKind.EDGE, wall[0])):
        expected = [np.linalg.norm(a - c) + np.linalg.norm(b - c) for c in points]
        assert np.allclose(lengths_of(found, 0, kind), np.sort(expected))


def test_an_edge_is_not_heard_from_within_the_wall(rng):
    box = Room(loop(np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) / 2))
    inside = rng.uniform(0.05, 0.45, (10, 2))
    assert EchoKind.EDGE not in trace_between(box, inside, inside).kind
    outside = np.array([[-0.5, -0.6]])
    assert np.count_nonzero(trace_between(box, outside, outside).kind == EchoKind.EDGE) == 3  # the fourth is hidden


# What a ring hears.


def rows(simulation: Simulation):
    """One row an echo: scan, path, range, amplitude, kind, reflector."""
    return np.column_stack([getattr(simulation, field.name) for field in fields(simulation) if field.name != "stamps"])


def by_cause(scan, path, kind, reflector, *values):
    """Rows in an order that does not depend on the last digits of the values."""
    table = np.column_stack([scan, path, kind, reflector, *values])
    return table[np.lexsort(table.T[4::-1])]


def causes(heard: Simulation):
    return by_cause(heard.scan, heard.path, heard.kind, heard.reflector, heard.range, heard.amplitude)


@settings(max_examples=8, deadline=None)
@given(seed=seeds, beam=st.floats(0.2, np.pi), neighbors=st.integers(0, 5))
def test_a_ring_hears_what_geometry_gives_within_both_cones(seed, beam, neighbors):
    rng = np.random.default_rng(seed)
    room = random_room(rng, box=0.7, segment=0.7, pole=0.7)
    beams = np.append(rng.uniform(0.2, np.pi, 11), beam)
    heading = np.sort(rng.uniform(-np.pi, np.pi, 12))
    position = rng.uniform(-0.2, 0.2, (12, 2))
    ring = Ring(position, heading, beam=beams, neighbors=neighbors, max_range=1.8)
    poses = some_poses(rng, room, 3)
    heard = simulate(ring, room, poses, **EVERYTHING)
    expected = []
    for scan, (x, y, theta) in enumerate(poses):
        sensors = turned(position, theta, (x, y))
        tx, rx = ring.paths.T
        found = trace_between(room, sensors[tx], sensors[rx])
        keep = found.length / 2 <= 1.8
        for sensor, point in ((tx[found.pair], found.first), (rx[found.pair], found.last)):
            leg = point - sensors[sensor]
            off = np.arctan2(leg[:, 1], leg[:, 0]) - theta - heading[sensor]
            keep &= np.abs((off + np.pi) % (2 * np.pi) - np.pi) <= beams[sensor] / 2 + 1e-9
        found = found[keep]
        expected.append(
            np.column_stack([np.full(len(found), scan), found.pair, found.kind, found.reflector, found.length / 2])
        )
    mine, other = causes(heard)[:, :5], by_cause(*np.concatenate(expected).T)
    assert mine.shape == other.shape
    assert np.allclose(mine, other, atol=1e-9)


@settings(max_examples=8, deadline=None)
@given(seed=seeds, angle=st.floats(-np.pi, np.pi), x=st.floats(-50, 50), y=st.floats(-50, 50))
def test_moving_world_and_robot_changes_nothing(seed, angle, x, y):
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    poses = some_poses(rng, room, 4)
    moved_room = Room(turned(room.walls, angle, (x, y)), (), turned(room.poles, angle, (x, y)))
    moved = np.column_stack([turned(poses[:, :2], angle, (x, y)), poses[:, 2] + angle])
    here, there = simulate(RING, room, poses, **EVERYTHING), simulate(RING, moved_room, moved, **EVERYTHING)
    assert np.allclose(causes(here), causes(there), atol=1e-6)


@settings(max_examples=8, deadline=None)
@given(seed=seeds)
def test_a_mirrored_world_gives_mirrored_echoes(seed):
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    poses = some_poses(rng, room, 4)
    flip = np.array([1.0, -1.0])
    here = simulate(RING, room, poses, **EVERYTHING)
    there = simulate(RING, Room(room.walls * flip, (), room.poles * flip), poses * [1, -1, -1], **EVERYTHING)
    mirrored_path = RING.path_index[tuple((-RING.paths % RING.count).T)]
    path = mirrored_path[here.path]
    mine = by_cause(here.scan, path, here.kind, here.reflector, here.range, here.amplitude)
    assert np.allclose(mine, causes(there), atol=1e-6)


def test_there_and_back_sound_the_same(rng):
    room = random_room(rng, segment=1.0, pole=1.0)
    heard = simulate(RING, room, some_poses(rng, room, 20))
    back = RING.path_index[tuple(RING.paths[:, ::-1].T)]
    for path in range(24, 168):
        mine, other = heard.path == path, heard.path == back[path]
        assert np.array_equal(heard.scan[mine], heard.scan[other])
        assert np.array_equal(heard.range[mine], heard.range[other])
        assert np.array_equal(heard.amplitude[mine], heard.amplitude[other])


def test_an_empty_world_is_silent(rng):
    nothing = Room(np.zeros((0, 2, 2)))
    far = Room(np.array([[[50.0, -1.0], [50.0, 1.0]]]))
    for room in (nothing, far):
        assert len(simulate(RING, room, np.zeros((3, 3)), clutter=5.0, dropout=0.5).range) == 0
    heard = simulate(RING, random_room(rng), np.zeros((0, 3)), sigma=0.1, drift=0.1)
    assert heard.dense(168, 3).shape == (0, 168, 3)


# From echoes to a detector.


def sensor(beam=np.pi / 3, **options):
    return Ring([(0.0, 0.0)], [0.0], beam=beam, neighbors=0, max_range=8.0, **options)


def wall_at(distance):
    return Room(np.array([[[distance, -50.0], [distance, 50.0]]]))


def test_amplitude_of_a_wall():
    def amplitude(distance, angle=0.0, **options):
        heard = simulate(sensor(), wall_at(distance), np.array([[0.0, 0.0, angle]]), acoustics=Acoustics(**options))
        return heard.amplitude[0]

    assert np.isclose(amplitude(1.0), 1.0)
    edge = np.pi / 6 - 1e-9
    assert np.isclose(20 * np.log10(amplitude(1.0, edge)), -12.0)  # 6 dB out and 6 dB in
    assert np.isclose(20 * np.log10(amplitude(1.0, edge / 2)), -3.0)
    assert np.isclose(20 * np.log10(amplitude(4.0)), -20 * np.log10(4.0) - 6 * 1.3)
    assert np.isclose(amplitude(2.0, absorption_db_per_m=0.0, reflectivity=0.5), 0.25)


def test_amplitude_of_points_and_corners():
    still = Acoustics(absorption_db_per_m=0.0, edge_strength=0.2, pole_strength=0.3, reflectivity=0.5)
    pole = simulate(sensor(), Room(np.zeros((0, 2, 2)), (), np.array([[2.0, 0.0]])), np.zeros((1, 3)), acoustics=still)
    assert np.isclose(pole.amplitude[0], 0.3 / 2.0**1.5)
    stick = Room(np.array([[[1.5, 0.0], [3.0, 1.0]]]))
    edge = simulate(sensor(), stick, np.zeros((1, 3)), acoustics=still)
    assert edge.kind[0] == EchoKind.EDGE
    assert np.isclose(edge.amplitude[0], 0.2 / 1.5**1.5)
    corner = Room(np.array([[[2.0, 0.0], [-7.0, 9.0]], [[2.0, 0.0], [-7.0, -9.0]]]))
    heard = simulate(sensor(), corner, np.zeros((1, 3)), acoustics=still)
    assert np.isclose(heard.amplitude[heard.kind == EchoKind.CORNER], 0.5**2 / 2.0)


def test_faint_echoes_are_not_heard(rng):
    room = random_room(rng, pole=1.0)
    poses = some_poses(rng, room, 10)
    everything = simulate(RING, room, poses, **EVERYTHING)
    options: dict[str, Any] = EVERYTHING | {"acoustics": Acoustics(threshold=0.1)}
    loud = simulate(RING, room, poses, **options)
    assert np.array_equal(rows(loud), rows(everything)[everything.amplitude >= 0.1])
    assert 0 < len(loud.range) < len(everything.range)


@pytest.mark.parametrize(("blanking", "max_echoes"), [(0.0, 2), (0.03, 1), (0.03, 3), (0.3, 9)])
def test_blanking_and_the_number_of_echoes(rng, blanking, max_echoes):
    room = random_room(rng, box=1.0, segment=1.0, pole=1.0)
    poses = some_poses(rng, room, 20)
    options = EVERYTHING | {"blanking": blanking, "max_echoes": max_echoes}
    all_rows, heard = rows(simulate(RING, room, poses, **EVERYTHING)), rows(simulate(RING, room, poses, **options))
    kept, last = [], {}
    for row in all_rows:
        key = (row[0], row[1])
        before = last.setdefault(key, [])
        if len(before) < max_echoes and (not before or row[2] >= before[-1] + blanking):
            before.append(row[2])
            kept.append(row)
    assert np.array_equal(heard, np.array(kept))
    assert len(kept) < len(all_rows)


def test_echoes_are_sorted_and_in_range(rng):
    room = random_room(rng, segment=1.0)
    heard = simulate(RING, room, some_poses(rng, room, 20), clutter=0.5, sigma=0.005)
    order = np.lexsort((heard.range, heard.path, heard.scan))
    assert np.array_equal(order, np.arange(len(order)))
    assert np.unique(np.column_stack([heard.scan, heard.path]), axis=0, return_counts=True)[1].max() <= 3
    exact = simulate(RING, room, some_poses(rng, room, 20))
    assert exact.range.max() <= RING.max_range


def test_dense_holds_the_same_echoes(rng):
    room = random_room(rng)
    heard = simulate(RING, room, some_poses(rng, room, 20))
    dense = heard.dense(168, 3)
    scan, path, _ = np.nonzero(~np.isnan(dense))
    assert np.array_equal(np.column_stack([scan, path, dense[~np.isnan(dense)]]), rows(heard)[:, :3])
    assert np.array_equal(heard.dense(168, 2), dense[..., :2], equal_nan=True)


def test_the_ring_corrects_what_the_log_reports(rng):
    room = random_room(rng)
    poses = some_poses(rng, room, 5)
    offsets = rng.uniform(-0.02, 0.02, 24)
    warm = Ring(RING.position, RING.heading, beam=RING.beam, neighbors=3, max_range=2.0, range_offset=offsets,
                speed_of_sound=350.0)  # fmt: skip
    true, reported = simulate(RING, room, poses), simulate(warm, room, poses)
    tx, rx = warm.paths[reported.path].T
    assert np.allclose(warm.corrected(reported.range, tx, rx), true.range, atol=1e-12)
    assert not np.allclose(reported.range, true.range, atol=1e-3)
    false = simulate(warm, room, poses, clutter=5.0, dropout=1.0, max_echoes=1000)
    tx, rx = warm.paths[false.path].T
    clean = warm.corrected(false.range, tx, rx)
    assert clean.min() >= 0.1 - 1e-12
    assert clean.max() <= 2.0 + 1e-12


# Errors.


def many(seed=0, scans=400, **options):
    rng = np.random.default_rng(9)
    room = random_room(rng, segment=1.0, pole=1.0)
    poses = some_poses(rng, room, 20)[np.arange(scans) % 20]
    return simulate(RING, room, poses, seed=seed, **options)


def test_white_noise():
    exact, noisy = many(max_echoes=1), many(max_echoes=1, sigma=0.005)
    error = noisy.range - exact.range  # one echo a path: noise cannot change their order
    n = len(error)
    assert abs(error.mean()) < 5 * 0.005 / np.sqrt(n)
    assert abs(error.std() / 0.005 - 1) < 5 / np.sqrt(2 * n)
    assert abs(np.mean(error**4) / 0.005**4 - 3) < 5 * np.sqrt(96 / n)  # Gaussian
    assert abs(np.corrcoef(error[:-1], error[1:])[0, 1]) < 5 / np.sqrt(n)


def test_drift_is_of_sensors_and_forgets_slowly():
    ring = Ring.circular(count=6, neighbors=1, beam=np.pi, radius=0.0)
    room = Room(loop([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    scans, gap, time = 4000, 2.0, 8.0
    poses, stamps = np.zeros((scans, 3)), gap * np.arange(scans)
    drifting, still = (
        simulate(ring, room, poses, drift=drift, drift_time=time, stamps=stamps, max_echoes=1) for drift in (0.004, 0.0)
    )
    error = (drifting.range - still.range).reshape(scans, 18)
    own = error[:, :6]
    tx, rx = ring.paths.T
    assert np.allclose(error, (own[:, tx] + own[:, rx]) / 2, atol=1e-12)
    samples = own.size * gap / (2 * time)  # independent ones
    assert abs(own.std() / 0.004 - 1) < 5 / np.sqrt(2 * samples)
    assert abs(own[0].std() / 0.004 - 1) < 1.5  # from the first scan on
    for lag in (1, 4, 8):
        expected = np.exp(-lag * gap / time)
        assert abs((own[lag:] * own[:-lag]).mean() / own.var() - expected) < 5 / np.sqrt(samples)
    assert abs(np.corrcoef(own.T)[0, 1]) < 5 / np.sqrt(samples / 6)


def test_drift_stands_still_with_the_clock_and_forgets_over_long_pauses():
    stamps = np.repeat([0.0, 1e6], 50)
    room, ring = wall_at(1.0), sensor()
    heard = simulate(ring, room, np.zeros((100, 3)), drift=0.01, stamps=stamps)
    assert len(np.unique(heard.range)) == 2


def test_lost_echoes():
    everything, some = many(), many(dropout=0.3)
    n = len(everything.range)
    assert abs(len(some.range) / n - 0.7) < 5 * np.sqrt(0.3 * 0.7 / n)
    assert {tuple(row) for row in rows(some)} <= {tuple(row) for row in rows(everything)}
    assert len(many(dropout=1.0).range) == 0


def test_false_echoes():
    everything, more = many(), many(clutter=0.2, max_echoes=1000)
    real = many(max_echoes=1000)
    false = more.kind == EchoKind.CLUTTER
    count = np.count_nonzero(false)
    expected = 0.2 * len(real.range)
    assert abs(count - expected) < 5 * np.sqrt(expected)
    assert np.array_equal(rows(more)[~false], rows(real))
    assert (more.reflector[false] == -1).all()
    u = (np.sort(more.range[false]) - 0.1) / 1.9
    assert np.abs(u - (np.arange(count) + 0.5) / count).max() < 2 / np.sqrt(count)  # Kolmogorov: uniform
    per_path = np.bincount(more.path[false], minlength=168)
    assert abs(per_path.var() / per_path.mean() - 1) < 5 * np.sqrt(2 / 168)  # Poisson
    assert (more.amplitude[false] >= 0.02).all()
    assert len(everything.range) <= len(real.range)


def test_false_echoes_only_where_cones_overlap():
    narrow = Ring.circular(beam=np.radians(20), neighbors=3)  # 15 deg apart: the second neighbor hears nothing
    room = Room(loop([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    heard = simulate(narrow, room, np.zeros((50, 3)), clutter=2.0, max_echoes=1000)
    assert set(heard.path[heard.kind == EchoKind.CLUTTER].tolist()) == set(range(72))


def test_seeds_decide_everything_and_streams_are_separate():
    options = {"sigma": 0.003, "drift": 0.002, "dropout": 0.2, "clutter": 0.2, "scans": 40}
    one, same, other = many(1, **options), many(1, **options), many(2, **options)
    assert np.array_equal(rows(one), rows(same))
    assert not np.array_equal(one.range, other.range[: len(one.range)])
    without_loss = many(1, **options | {"dropout": 0.0, "max_echoes": 1000})
    with_loss = many(1, **options | {"max_echoes": 1000})
    assert {tuple(row) for row in rows(with_loss)} <= {tuple(row) for row in rows(without_loss)}


@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_chunks_do_not_matter(chunk):
    options = {"sigma": 0.003, "drift": 0.002, "dropout": 0.2, "clutter": 0.2, "scans": 40}
    assert np.array_equal(rows(many(chunk=chunk, **options)), rows(many(**options)))


def test_no_range_before_the_start():
    heard = simulate(sensor(), wall_at(0.01), np.zeros((200, 3)), sigma=0.02)
    assert heard.range.min() > 0
    assert 100 < len(heard.range) < 190


def test_progress_reaches_the_end():
    calls = []
    simulate(RING, wall_at(1.0), np.zeros((10, 3)), chunk=4, progress=lambda done, of: calls.append((done, of)))
    assert calls == [(4, 10), (8, 10), (10, 10)]


POSES = np.zeros((2, 3))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"poses": np.array([[0, 0, 0], [0, np.nan, 0]])}, "pose 1"),
        ({"sigma": -1.0}, "sigma -1"),
        ({"sigma": np.nan}, "sigma nan"),
        ({"drift": -0.1}, "drift -0.1"),
        ({"drift_time": 0.0}, "drift_time 0"),
        ({"dropout": 1.1}, "dropout 1.1"),
        ({"clutter": -0.1}, "clutter -0.1"),
        ({"clutter": np.inf}, "clutter inf"),
        ({"blanking": -0.1}, "blanking -0.1"),
        ({"max_echoes": 0}, "max_echoes 0"),
        ({"chunk": 0}, "chunk 0"),
        ({"seed": -1}, "seed -1"),
        ({"stamps": np.array([1.0, 0.0])}, "stamps"),
        ({"stamps": np.array([1.0, np.nan])}, "stamps"),
    ],
)
def test_values_out_of_range_are_named_in_one_line(options, words):
    with pytest.raises(SonarError) as caught:
        simulate(RING, wall_at(1.0), **{"poses": POSES} | options)
    message = str(caught.value)
    assert words in message
    assert "allowed" in message
    assert "\n" not in message


@pytest.mark.parametrize("name", [field.name for field in fields(Acoustics)])
def test_acoustics_out_of_range_are_named(name):
    with pytest.raises(SonarError, match=f"{name} -1"):
        Acoustics(**{name: -1.0})
