"""Echoes of circles: exact path lengths, occlusion, amplitudes."""

import numpy as np
import pytest
from support.rooms import loop, turned

from jaxsonar import Ring, Room, simulate
from jaxsonar.floor_plans.room import laser_ranges
from jaxsonar.floor_plans.room_geojson import load_room, save_room
from jaxsonar.simulation.echo_tracing import trace_echoes
from jaxsonar.simulation.traced_echoes import EchoKind

PAIRS = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])


def circle_room(x=0.0, y=0.0, radius=0.3, walls=()):
    return Room(np.array(walls).reshape(-1, 2, 2), circles=np.array([[x, y, radius]]))


def traced(room, *sensors, **limits):
    found = trace_echoes(room, np.array([sensors], dtype=np.float64), PAIRS, **limits)
    return found[np.lexsort((found.pair, found.kind))]


@pytest.mark.parametrize("seed", range(20))
def test_the_path_is_the_shortest_one_over_the_circle(seed):
    rng = np.random.default_rng(seed)
    center, radius = rng.uniform(-5, 5, 2), rng.uniform(0.02, 2.0)
    direction = rng.uniform(-np.pi, np.pi) + np.array([0.0, rng.uniform(-0.6, 0.6)])
    distance = radius + rng.uniform(0.5, 3.0, 2)
    sensors = center + distance[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=-1)
    found = traced(circle_room(center[0], center[1], radius), *sensors)
    around = np.linspace(-np.pi, np.pi, 400_001)
    points = center + radius * np.stack([np.cos(around), np.sin(around)], axis=-1)
    legs = [np.linalg.norm(points - sensor, axis=-1) for sensor in sensors]
    expected = [(legs[tx] + legs[rx]).min() for tx, rx in PAIRS]
    # A pair sees the point if its incidence is below 90 deg; this holds for sensors that see each other's point.
    assert set(found.pair) >= {0, 3}
    np.testing.assert_allclose(found.length, np.array(expected)[found.pair], atol=1e-8)
    np.testing.assert_allclose(found.length[found.pair == 0], 2 * (distance[0] - radius), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found.first - center, axis=-1), radius, atol=1e-12)
    assert (found.kind == EchoKind.CIRCLE).all()


def test_a_circle_hides_what_is_behind_it_and_nothing_else():
    wall = [[(2.0, -3.0), (2.0, 3.0)]]
    kinds = traced(circle_room(walls=wall), (-1.0, 0.0), (-1.0, 1.0)).kind
    assert (kinds == EchoKind.CIRCLE).sum() == 4
    # The wall is hidden from sensor 0, and from the path between the two, but not from sensor 1.
    planes = traced(circle_room(walls=wall), (-1.0, 0.0), (-1.0, 1.0))
    planes = planes[planes.kind == EchoKind.PLANE]
    assert planes.pair.tolist() == [3]
    assert len(traced(circle_room(), (0.1, 0.0), (-1.0, 0.0)).pair) == 1  # none to or from inside
    assert not len(traced(circle_room(), (-1.0, 0.0), (-1.2, 0.0), max_range=0.6))


def test_the_amplitude_is_between_that_of_a_pole_and_that_of_a_wall():
    """A large circle is a wall, and a thin one a pole of the same radius."""
    ring = Ring.circular(count=1, radius=0.0, neighbors=0, max_range=3.0)
    pose = np.zeros((1, 3))

    def amplitude(room):
        log = simulate(ring, room, pose).as_log(ring, pose)
        assert abs(log.range[0] - 1) < 1e-6
        return log.amplitude[0]

    wall = amplitude(Room(np.array([[(1.0, -2.0), (1.0, 2.0)]])))
    assert amplitude(circle_room(1e4 + 1, radius=1e4)) == pytest.approx(wall, rel=1e-3)
    assert amplitude(circle_room(1.01, radius=0.01)) == pytest.approx(0.1 * wall, rel=0.01)


def test_circles_in_files_and_for_lasers(tmp_path):
    room = Room(
        loop([(0, 0), (4, 0), (4, 3), (0, 3)]), poles=np.array([[1.0, 1.0]]), circles=np.array([[2, 1.5, 0.25]])
    )
    save_room(room, tmp_path / "room.geojson")
    again = load_room(tmp_path / "room.geojson")
    assert np.array_equal(again.circles, room.circles)
    assert np.array_equal(again.poles, room.poles)
    seen = laser_ranges(room, np.array([1.0, 1.5, 0.0]), np.array([0.0, np.pi / 2, np.pi]))
    np.testing.assert_allclose(seen, [0.75, 1.5, 1.0])


@pytest.mark.slow
def test_many_circles_block_as_segments_and_disks_of_shapely_do(rng):
    shapely = pytest.importorskip("shapely")
    circles = np.column_stack([rng.uniform(-2, 2, (40, 2)), rng.uniform(0.02, 0.15, 40)])
    poles = rng.uniform(-2, 2, (30, 2))
    poles = poles[(np.linalg.norm(poles[:, None] - circles[:, :2], axis=-1) > circles[:, 2]).all(axis=1)]
    sensors = rng.uniform(-2, 2, (12, 2))
    room = Room(np.zeros((0, 2, 2)), (), poles, circles)
    found = trace_echoes(room, sensors[:, None], np.array([[0, 0]]))
    heard = set(
        zip(found.group[found.kind == EchoKind.POLE], found.reflector[found.kind == EchoKind.POLE], strict=True)
    )
    centers = shapely.points(circles[:, :2])
    for k, pole in np.ndindex(len(sensors), len(poles)):
        leg = shapely.LineString([sensors[k], poles[pole]])
        free = (shapely.distance(leg, centers) >= circles[:, 2]).all()
        assert ((k, pole) in heard) == free
    assert 0 < len(heard) < len(sensors) * len(poles)


def test_echoes_of_circles_are_invariant_under_a_motion_of_the_room(rng):
    ring = Ring.circular(count=12, beam=1.2, neighbors=2)
    walls = loop([(-2.0, -1.5), (2.0, -1.5), (2.0, 1.5), (-2.0, 1.5)])
    circles = np.array([[0.9, 0.2, 0.1], [-0.6, -0.7, 0.25]])
    pose = np.array([[0.1, 0.0, 0.3]])
    angle, at = 0.8, np.array([30.0, -7.0])
    here = simulate(ring, Room(walls, circles=circles), pose)
    moved = np.column_stack([turned(circles[:, :2], angle, at), circles[:, 2]])
    there = np.column_stack([turned(pose[:, :2], angle, at), pose[:, 2] + angle])
    again = simulate(ring, Room(turned(walls, angle, at), circles=moved), there)
    np.testing.assert_array_equal(here.reflector, again.reflector)
    np.testing.assert_allclose(here.range, again.range, atol=1e-9)
    np.testing.assert_allclose(here.amplitude, again.amplitude, atol=1e-9)
    assert set(here.reflector[here.kind == EchoKind.CIRCLE].tolist()) == {0, 1}
