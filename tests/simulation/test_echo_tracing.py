"""Exact geometry of traced echoes against pyroomacoustics, shapely and a slow oracle."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.rooms import loop, places, room_of_exact_angles, turned
from support.tracing import trace_between

from jaxsonar import Room, random_room
from jaxsonar.simulation.traced_echoes import EchoKind, TracedEchoes

seeds = st.integers(0, 2**32 - 1)


def pra_images(pra, corners, tx, rx):
    """Visible image sources of tx up to second order in a polygon: in float32 as returned, and refined to float64.

    pyroomacoustics computes in float32: 24 bits of a few metres are no better than 1e-6 m. Which images are visible and
    over which walls they came is its answer; mirroring tx again at those walls in float64 removes its rounding.
    """
    scene = pra.Room.from_corners(corners.T, fs=16000, max_order=2, materials=pra.Material(0.1))
    scene.add_source(tx)
    scene.add_microphone(rx[:, None])
    scene.image_source_model()
    source = scene.sources[0]
    walls = [(wall.corners[:, 0].astype(float), wall.normal.astype(float)) for wall in scene.walls]
    # Its walls are rounded to float32; use the exact ones.
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


@pytest.mark.slow
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
            assert len(lengths) == len(raw)  # exactly the same echoes
            assert np.abs(lengths - refined).max() < 1e-6
            assert np.abs(lengths - raw).max() < 1e-5  # float32 precision
            total += len(lengths)
    assert 5 < convex < 35
    assert total > 2000


def mirror(point, wall):
    start, end = wall
    along = (end - start) / np.linalg.norm(end - start)
    foot = start + ((point - start) @ along) * along
    return 2 * foot - point


def meeting(p, q, wall):
    """Intersection of the open segment p-q with a closed wall, or None."""
    start, end = wall
    matrix = np.stack([q - p, start - end], axis=1)
    if abs(np.linalg.det(matrix)) < 1e-14:
        return None
    t, u = np.linalg.solve(matrix, start - p)
    return p + t * (q - p) if 0 < t < 1 and 0 <= u <= 1 else None


def clear(shapely, walls, p, q):
    """Whether no wall intersects the leg p-q; its ends may lie on walls."""
    margin = 1e-7 * (q - p)
    return not shapely.LineString([p + margin, q - margin]).intersects(walls)


def oracle(shapely, room, tx, rx):
    """All echoes of one pair by loops: sorted lengths of planes, double reflections, edges, poles."""
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
    """Angle (degrees) of the wedge at the end c of a wall in which a sensor lies."""
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


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_traced_echoes_agree_with_a_slow_oracle(seed):
    rng = np.random.default_rng(seed)
    room = room_of_exact_angles(rng, recess=0.7, box=0.7, segment=0.7, pole=0.7)
    assert_as_oracle(room, places(rng, room, 4), places(rng, room, 4))


@pytest.mark.slow
def test_junctions_within_walls_agree_with_the_oracle(rng):
    hall = loop([[-2, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]])
    stub = [[0.5, -1.5], [0.5, -0.7]]  # T with the hall
    plus = [[[-1.0, 0.0], [-0.2, 0.1]], [[-0.6, -0.3], [-0.5, 0.5]]]  # X
    room = Room(np.concatenate([hall, [stub], plus]))
    found = assert_as_oracle(room, places(rng, room, 40), places(rng, room, 40))
    assert set(found.kind.tolist()) == {EchoKind.PLANE, EchoKind.CORNER, EchoKind.EDGE, EchoKind.SECOND_ORDER}


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_occlusion_agrees_with_shapely(seed):
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


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_incidence_points_lie_on_the_reflectors_and_give_the_path_length(seed):
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


@pytest.mark.slow
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


def test_precision_does_not_depend_on_the_distance_from_the_origin(rng):
    room = room_of_exact_angles(rng, segment=1.0, box=1.0)
    tx, rx = places(rng, room, 20), places(rng, room, 20)
    shift = np.array([4e5, 5e6])  # a map in UTM coordinates
    here = trace_between(room, tx, rx)
    there = trace_between(Room(room.walls + shift, (), room.poles + shift), tx + shift, rx + shift)
    assert np.array_equal(np.bincount(here.kind), np.bincount(there.kind))
    assert np.allclose(np.sort(here.length), np.sort(there.length), atol=1e-7)


def test_max_range_limits_the_traced_echoes(rng):
    room = random_room(rng, segment=1.0)
    tx, rx = places(rng, room, 30), places(rng, room, 30)
    far, near = trace_between(room, tx, rx), trace_between(room, tx, rx, max_range=1.7)
    assert np.allclose(np.sort(far.length[far.length <= 3.4]), np.sort(near.length))
    assert 0 < len(near) < len(far)


# Closed-form path lengths.

coordinate = st.floats(-1.5, 1.5)


@pytest.mark.slow
@given(xi=coordinate, xj=coordinate, yi=st.floats(0.1, 2), yj=st.floats(0.1, 2), angle=st.floats(-np.pi, np.pi))
def test_length_of_a_plane_echo(xi, xj, yi, yj, angle):
    walls = turned([[[-9.0, 0.0], [9.0, 0.0]]], angle)
    tx, rx = turned([[xi, yi]], angle), turned([[xj, yj]], angle)
    found = trace_between(Room(walls), tx, rx)
    plane = found.length[found.kind == EchoKind.PLANE]
    normal, tangent = turned([[0.0, 1.0], [1.0, 0.0]], angle)
    middle, half = (tx + rx)[0] / 2, (rx - tx)[0] / 2
    # Here rho = 0: the wall contains the origin.
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
    for a, b in ((tx, rx), (tx, tx)):  # the direct echo passes through the vertex
        found = trace_between(room, a[None], b[None])
        corners = found[found.kind == EchoKind.CORNER]
        assert np.allclose(corners.length, [2 * np.linalg.norm((a + b) / 2 - corner)])
        assert np.allclose(room.junctions.vertices[corners.reflector], corner)
        assert (found.kind != EchoKind.SECOND_ORDER).all()


@pytest.mark.parametrize("off_deg", [0.0, 0.9, -0.9, 1.5, -1.5, 20.0])
def test_only_right_angled_corners_are_retroreflectors(off_deg):
    walls = [[[3.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], turned([0.0, 3.0], np.radians(off_deg))]]
    inside, outside = np.array([[1.0, 0.8]]), np.array([[-1.0, -0.8]])
    room = Room(np.array(walls))
    found = trace_between(room, inside, inside)
    assert (np.count_nonzero(found.kind == EchoKind.CORNER) == 1) == (abs(off_deg) < 1)
    # A wedge below 90 deg also returns the sound by both walls; one above 90 deg does not.
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


def test_an_edge_is_visible_only_from_inside_its_wedge(rng):
    box = Room(loop(np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) / 2))
    inside = rng.uniform(0.05, 0.45, (10, 2))
    assert EchoKind.EDGE not in trace_between(box, inside, inside).kind
    outside = np.array([[-0.5, -0.6]])
    assert np.count_nonzero(trace_between(box, outside, outside).kind == EchoKind.EDGE) == 3  # the fourth is hidden
