"""Walking persons: circles that move from scan to scan, and their files."""

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from support.rooms import some_poses

from jaxsonar import Ring, Room, random_room, simulate
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.messages import Group
from jaxsonar.simulation.device_messages import room_messages
from jaxsonar.simulation.traced_echoes import EchoKind
from jaxsonar.simulation.walker import Walker, distances_to_robot, load_walker

RING = Ring.circular()
EMPTY = Room(np.zeros((0, 2, 2)))


def standing(x, y, radius=0.2):
    return Walker(np.zeros(1), np.array([[x, y]]), radius)


def assert_equal_simulations(one, other):
    for field in fields(one):
        mine, expected = getattr(one, field.name), getattr(other, field.name)
        np.testing.assert_allclose(mine, expected, rtol=0, atol=1e-12, err_msg=field.name)


def test_a_walker_at_rest_is_a_circle_of_the_room(rng):
    room = random_room(rng, box=1.0, segment=1.0, pole=1.0, columns=1.0)
    poses = some_poses(rng, room, 20)
    x, y = poses[0, :2] + [0.6, 0.0]
    errors: dict[str, Any] = {"sigma": 0.002, "drift": 0.001, "dropout": 0.1, "clutter": 0.1}
    more = Room(room.walls, room.wall_names, room.poles, np.concatenate([room.circles, [[x, y, 0.15]]]))
    expected = simulate(RING, more, poses, **errors)
    assert_equal_simulations(simulate(RING, room, poses, walkers=[standing(x, y, 0.15)], **errors), expected)
    own = (expected.kind == EchoKind.CIRCLE) & (expected.reflector == 1)
    assert own.any()


def test_the_echo_of_a_walker_follows_it():
    """A person walks past; the sensor hears the nearest point of the circle at the stamp of each scan."""
    stamps = np.linspace(-1.0, 4.0, 26)
    walker = Walker(np.array([0.0, 1.0, 3.0]), np.array([[1.0, -0.4], [1.0, 0.0], [1.6, 0.2]]), 0.25)
    ring = Ring([(0.0, 0.0)], [0.0], beam=np.pi, neighbors=0, max_range=3.0)
    heard = simulate(ring, EMPTY, np.zeros((26, 3)), walkers=[walker], stamps=stamps)
    assert heard.scan.tolist() == list(range(26))
    before, after = (stamps[:, None] < at for at in (1.0, 3.0))
    early, late = np.clip(stamps[:, None], 0, 1), np.clip((stamps[:, None] - 1) / 2, 0, 1)
    a, b, c = np.array([[1.0, -0.4], [1.0, 0.0], [1.6, 0.2]])
    first, second = (1 - early) * a + early * b, (1 - late) * b + late * c
    center = np.where(before, first, np.where(after, second, c))
    np.testing.assert_allclose(heard.range, np.linalg.norm(center, axis=1) - 0.25, atol=1e-9)
    assert (heard.kind == EchoKind.CIRCLE).all()
    assert (heard.reflector == 0).all()
    np.testing.assert_allclose(distances_to_robot(walker, np.zeros((26, 3)), stamps), heard.range, atol=1e-9)


def test_a_walker_hides_a_wall_only_while_it_stands_before_it():
    wall = Room(np.array([[(1.5, -4.0), (1.5, 4.0)]]))
    walker = Walker(np.array([0.0, 2.0]), np.array([[0.8, -1.5], [0.8, 1.5]]))
    ring = Ring([(0.0, 0.0)], [0.0], beam=1.0, neighbors=0, max_range=2.0)
    stamps = np.linspace(0, 2, 21)
    heard = simulate(ring, wall, np.zeros((21, 3)), walkers=[walker], stamps=stamps)
    hidden = np.abs(walker.position_at(stamps)[:, 1]) < walker.radius
    seen = np.isin(np.arange(21), heard.scan[heard.kind == EchoKind.PLANE])
    np.testing.assert_array_equal(seen, ~hidden)
    assert hidden.any()


def test_the_order_of_chunks_and_walkers_does_not_change_the_echoes(rng):
    room = random_room(rng)
    poses = some_poses(rng, room, 12)
    near = poses[[0, 5], :2] + [0.5, 0.3]
    walkers = [Walker(np.array([0.0, 1.1]), near), standing(near[:, 0].mean(), near[:, 1].mean(), 0.1)]
    one = simulate(RING, room, poses, walkers=walkers)
    assert_equal_simulations(one, simulate(RING, room, poses, walkers=walkers, chunk=5))
    other = simulate(RING, room, poses, walkers=walkers[::-1])
    np.testing.assert_array_equal(np.sort(one.range), np.sort(other.range))


def test_a_sensor_inside_of_a_walker_hears_nothing():
    ring = Ring([(0.0, 0.0), (0.5, 0.0)], [0.0, 0.0], beam=1.0, neighbors=0, max_range=2.0)
    wall = Room(np.array([[(1.5, -4.0), (1.5, 4.0)]]))
    heard = simulate(ring, wall, np.zeros((1, 3)), walkers=[standing(0.05, 0.0)])
    assert set(heard.path.tolist()) == {1}


def test_a_device_sees_the_walker_when_each_group_fires():
    walker = Walker(np.array([0.0, 10.0]), np.array([[1.0, 0.0], [2.0, 0.0]]))
    ring = Ring([(0.0, 0.0), (0.0, 0.0)], [0.0, 0.0], beam=1.0, neighbors=1, max_range=4.0)
    stamps = np.array([1.0, 2.0])
    messages = room_messages(ring, EMPTY, np.zeros((2, 3)), stamps, walkers=[walker])
    echoes = [(message.time_us * 1e-6, message.echoes) for message in messages if isinstance(message, Group)]
    assert len(echoes) == 4
    for time, each in echoes:
        expected = walker.position_at(np.array([time]))[0, 0] - 0.2
        np.testing.assert_allclose(each["time_us"] * 343.2 / 2e6, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"stamps": np.array([0.0, 0.0]), "positions": np.zeros((2, 2))}, "stamp 0 of position 1"),
        ({"stamps": np.zeros(0), "positions": np.zeros((0, 2))}, "0 stamps and 0 positions"),
        ({"stamps": np.zeros(1), "positions": np.full((1, 2), np.nan)}, "not finite"),
        ({"stamps": np.zeros(1), "positions": np.zeros((1, 2)), "radius": 0.0}, "radius 0 m"),
        ({"stamps": np.zeros(1), "positions": np.zeros((1, 2)), "radius": 200.0}, "is it in mm or cm?"),
        ({"stamps": np.zeros(1), "positions": np.zeros((1, 2)), "radius": np.nan}, "radius nan m"),
    ],
)
def test_walkers_out_of_range_are_a_one_line_error(options, words):
    with pytest.raises(SonarError) as caught:
        Walker(**options)
    assert words in str(caught.value)
    assert "allowed" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_walkers_in_files(tmp_path):
    (tmp_path / "walk.csv").write_text("y,stamp,x\n0.5,1,0.25\n-1.5,2.5,3\n")
    walker = load_walker(tmp_path / "walk.csv", 0.3)
    np.testing.assert_array_equal(walker.stamps, [1, 2.5])
    np.testing.assert_array_equal(walker.positions, [[0.25, 0.5], [3, -1.5]])
    assert walker.radius == 0.3


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x,y\n1,2\n", "row 1: x,y came; allowed are the columns stamp, x, y"),
        ("stamp,x,y\n", "no position came"),
        ("stamp,x,y\n1,2,3\n1,2,3\n", "row 3, column stamp: 1 came; allowed is later than in the row before"),
        ("stamp,x,y\n1,2,word\n", "row 2, column y: 'word' came"),
        ("stamp;x;y\n1;2;3\n", "semicolons between the columns"),
    ],
)
def test_a_wrong_file_names_row_and_column(text, words, tmp_path):
    (tmp_path / "walk.csv").write_text(text)
    with pytest.raises(SonarError) as caught:
        load_walker(tmp_path / "walk.csv")
    assert words in str(caught.value)
    assert "walk.csv" in str(caught.value)
    assert "\n" not in str(caught.value)
