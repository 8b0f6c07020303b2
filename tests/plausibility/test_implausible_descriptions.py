"""Rings, rooms, trajectories, noise and stamps in wrong units, which warnings name; none if they are sound."""

from dataclasses import replace

import numpy as np
import pytest
from support.rooms import loop, some_poses
from support.wandering_robot import log_of, ranges, trajectory

from jaxsonar import Ring, load_ring, random_room
from jaxsonar.floor_plans.room import Room
from jaxsonar.plausibility.implausible_noise import implausible_noise
from jaxsonar.plausibility.implausible_ring import implausible_ring
from jaxsonar.plausibility.implausible_room import implausible_room, implausible_trajectory
from jaxsonar.plausibility.implausible_stamps import implausible_stamps, implausible_times
from jaxsonar.sensors.ring import speed_of_sound
from jaxsonar.sensors.ring_toml import shipped_rings

POSES = trajectory()
LOG = log_of(ranges(POSES), POSES)
OUTLINE = [(0, 0), (8, 0), (8, 6), (0, 6)]


def one(found, kind, *words):
    """The only warning has this kind and these words."""
    (warning,) = found
    assert warning.kind == kind
    assert str(warning).count("; ") == 2, str(warning)
    assert str(warning).isprintable()
    for word in words:
        assert word in str(warning)


# Rings


def test_sound_rings_have_no_warning():
    for name in shipped_rings():
        assert [*implausible_ring(load_ring(name))] == []
    for count, radius, beam, max_range in (
        (4, 0.1, 10, 0.5),
        (48, 0.5, 30, 10.0),
        (12, 1.5, 180, 20.0),
        (1, 0.0, 5, 3.0),
    ):
        ring = Ring.circular(count=count, radius=radius, beam=np.radians(beam), neighbors=0, max_range=max_range)
        for celsius in (-40.0, 20.0, 60.0):
            assert [*implausible_ring(replace(ring, speed_of_sound=np.array(speed_of_sound(celsius))))] == []


@pytest.mark.parametrize("degrees", [15, 55, 180])
def test_a_beam_width_in_radians(degrees):
    ring = Ring.circular(beam=np.radians(np.radians(degrees)))
    one(implausible_ring(ring), "beam width", "radians", f"give degrees: {degrees}")


@pytest.mark.parametrize(
    ("factor", "name"),
    [
        (3.6, "kilometres per hour"),
        (1 / 0.3048, "feet per second"),
        (1 / 0.44704, "miles per hour"),
        (0.001, "millimetres per microsecond"),
        (0.1, "centimetres per millisecond"),
    ],
)
@pytest.mark.parametrize("celsius", [0.0, 25.0])
def test_the_speed_of_sound_in_another_unit(factor, name, celsius):
    ring = Ring.circular(speed_of_sound=factor * speed_of_sound(celsius))
    one(implausible_ring(ring), "speed of sound", name, "give metres per second")


def test_lengths_of_a_ring_in_centimetres_or_millimetres():
    one(implausible_ring(Ring.circular(radius=28.0)), "ring size", "centimetres")
    one(implausible_ring(Ring.circular(radius=95.0, max_range=2.0)), "ring size", "millimetres")
    one(implausible_ring(Ring.circular(max_range=80.0)), "maximum range", "centimetres")


def test_headings_in_radians():
    ring = Ring.circular(count=12)
    wrong = Ring(ring.position, np.radians(ring.heading), beam=ring.beam, neighbors=0, max_range=2.0)
    one(implausible_ring(wrong), "sensor headings", "radians")


# Rooms and trajectories


@pytest.mark.parametrize("seed", range(6))
def test_units_of_rooms(seed):
    room = random_room(np.random.default_rng(seed))
    assert [*implausible_room(room)] == []
    points = some_poses(np.random.default_rng(seed), room, 30)[:, :2]
    for scale, name in ((1000, "millimetres"), (100, "centimetres")):
        wrong = Room(room.walls * scale)
        one(implausible_room(wrong, points), "room unit", name, f"divide the coordinates by {scale}")


@pytest.mark.parametrize(("width", "depth"), [(160, 120), (200, 80), (300, 60), (450, 400)])
def test_large_halls_are_sound_unless_the_trajectory_shows_centimetres(width, depth):
    hall = Room(loop([(0, 0), (width, 0), (width, depth), (0, depth)]))
    along = np.linspace((0.1 * width, 0.5 * depth), (0.9 * width, 0.5 * depth), 50)
    for points in (None, along, along[:0]):
        assert [*implausible_room(hall, points)] == []
    if depth > 150:
        one(implausible_room(hall, along / 100), "room unit", "centimetres")


def test_round_columns_with_a_radius_in_another_unit():
    walls = loop(OUTLINE)
    for scale, words in ((1, None), (100, "radius of 25 m"), (1000, "radius of 250 m")):
        for room in (
            Room(walls, circles=np.array([[4, 3, 0.25 * scale]])),
            Room(walls[:0], circles=np.array([[4, 3, 0.25 * scale]])),
        ):
            if words is None:
                assert [*implausible_room(room)] == []
            else:
                one(implausible_room(room), "room unit", words, "millimetres or centimetres")


def test_longitude_and_latitude():
    place = np.array([8.56, 52.03])
    one(implausible_room(Room(place + loop(OUTLINE) * 1e-3)), "room unit", "degrees of longitude and latitude")
    one(implausible_room(Room(loop(OUTLINE) * 1e-3)), "room unit", "kilometres")


@pytest.mark.parametrize("seed", range(6))
def test_trajectories_through_rooms(seed):
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    poses = some_poses(rng, room, 30)
    for sound in (poses, poses[:1], np.repeat(poses[:1], 20, axis=0), poses[:0]):
        assert [*implausible_trajectory(room, sound)] == []
    one(implausible_trajectory(room, poses * (1000, 1000, 1)), "trajectory", "in millimetres", "divide x and y by 1000")
    one(implausible_trajectory(room, poses * (100, 100, 1)), "trajectory", "in centimetres")
    one(
        implausible_trajectory(room, poses + np.array([30, 0, 0])),
        "trajectory",
        "outside of the room",
        "different origins",
    )
    one(implausible_trajectory(room, poses * (1, 1, 180 / np.pi)), "heading unit", "degrees", "give radians")


def test_a_trajectory_beside_a_closed_room_and_along_one_wall():
    beside = np.array([(8.5, y, 0.0) for y in np.linspace(1, 5, 10)])
    one(implausible_trajectory(Room(loop(OUTLINE)), beside), "trajectory", "100% of the poses are outside of the room")
    assert [*implausible_trajectory(Room(loop(OUTLINE)[1:2]), beside)] == []


def test_headings_that_do_not_agree_with_the_motion():
    for poses in (POSES, POSES[::-1], POSES + np.array([0, 0, 7 * np.pi])):
        assert [*implausible_trajectory(None, poses)] == []
    one(implausible_trajectory(None, POSES * (1, 1, -1)), "heading direction", "clockwise")
    one(implausible_trajectory(None, POSES * (1, 1, 180 / np.pi)), "heading unit", "degrees")
    compass = np.column_stack([POSES[:, :2], np.pi / 2 - POSES[:, 2]])
    one(implausible_trajectory(None, compass), "heading direction", "clockwise")


def tour(turned: float, turns: int) -> np.ndarray:
    """A drive along three and a half sides of a rectangle; at corners, the robot turns in as many poses."""
    poses, place, heading = [], np.array([1.5, 1.5]), turned
    for side in range(4):
        for _ in range(20):
            place = place + (0.2 - 0.05 * (side % 2)) * np.array([np.cos(heading), np.sin(heading)])
            poses.append((*place, heading))
        for _ in range(turns):
            heading += np.pi / 2 / turns
            poses.append((*place, heading))
    return np.array(poses)


@pytest.mark.parametrize("turned", [0.0, 0.2])
@pytest.mark.parametrize("turns", [1, 9, 30])
def test_headings_on_a_rectangular_tour(turned, turns):
    poses = tour(turned, turns)
    degrees, swapped = np.array([1, 1, 180 / np.pi]), poses[:, [1, 0, 2]]
    for sound in (poses, poses + np.array([0, 0, np.pi]), poses + np.array([0, 0, 1.2])):
        assert [*implausible_trajectory(None, sound)] == []
    one(implausible_trajectory(None, poses * (1, 1, -1)), "heading direction", "clockwise", "y is negated")
    one(implausible_trajectory(None, swapped), "heading direction", "compass", "x and y are swapped")
    one(implausible_trajectory(None, poses * degrees), "heading unit", "degrees")
    if turned or turns != 1:  # else the headings 90 and -90 stand for the same motion, and a warning names either
        one(implausible_trajectory(None, poses * degrees * (1, 1, -1)), "heading unit", "degrees")


@pytest.mark.parametrize("degrees", [30, 90, 135, 270])
def test_a_straight_drive_with_one_heading(degrees):
    way = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    points = np.arange(20)[:, None] * 0.05 * way
    one(implausible_trajectory(None, np.column_stack([points, np.full(20, degrees)])), "heading unit", "degrees")
    for heading in (0.0, np.radians(degrees), np.radians(degrees) + np.pi, np.radians(degrees) + 6 * np.pi):
        assert [*implausible_trajectory(None, np.column_stack([points, np.full(20, heading)]))] == []


def test_a_robot_that_turns_in_a_narrow_place_or_goes_back_and_forth():
    leg = np.linspace(0, 1, 10)
    turn = [(x, 0.0, 0.0) for x in leg] + [(1.0, -y, np.pi / 2) for y in leg] + [(1 - x, -1.0, np.pi) for x in leg]
    shuttle = [(x, 0.0, 0.0) for _ in range(3) for x in np.concatenate([leg, leg[::-1]])]
    for poses in (turn, shuttle):
        assert [*implausible_trajectory(None, np.array(poses))] == []


# Noise and stamps


def test_noise_in_millimetres_and_clutter_in_per_cent():
    assert [*implausible_noise()] == []
    assert [*implausible_noise(0.1, drift=0.02, clutter=1.0)] == []
    one(implausible_noise(3.0), "noise unit", "millimetres", "0.003")
    one(implausible_noise(0.3), "noise unit", "centimetres", "0.003")
    one(implausible_noise(0.003, drift=5.0), "noise unit", "drift", "millimetres")
    one(implausible_noise(clutter=20.0), "noise unit", "per cent", "0.2")


@pytest.mark.parametrize(("factor", "name"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")])
def test_stamps_in_another_unit(factor, name):
    one(implausible_stamps(replace(LOG, stamp=LOG.stamp * factor)), "stamps", name, "give seconds")
    one(implausible_stamps(replace(LOG, stamp=(LOG.stamp + 1.7e9) * factor)), "stamps", name)


def test_stamps_of_poses():
    (of_log,) = implausible_stamps(replace(LOG, stamp=LOG.stamp * 1e3))
    one(implausible_times(LOG.stamp * 1e3, LOG.pose), "stamps", str(of_log))
    assert [*implausible_times(LOG.stamp, LOG.pose)] == []


def test_sound_stamps():
    for stamp in (LOG.stamp, LOG.stamp + 1.7e9, 10 * LOG.stamp, np.zeros(len(LOG)), np.full(len(LOG), np.nan)):
        assert [*implausible_stamps(replace(LOG, stamp=stamp))] == []
    at_rest = np.repeat(POSES[:1], len(LOG), axis=0)
    assert [*implausible_stamps(replace(LOG, stamp=600 * LOG.stamp, pose=at_rest))] == []
    assert [*implausible_stamps(LOG[:1])] == []
