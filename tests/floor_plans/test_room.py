"""Rooms: junctions of walls, GeoJSON round trips, lines in the robot frame, random rooms and poses."""

import json
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar import Room, load_room, random_pose, random_room, save_room
from jaxsonar.floor_plans.room import laser_ranges, walls_in_robot_frame
from jaxsonar.geometry.segments import point_to_segments
from jaxsonar.hardware.errors import SonarError

SQUARE = [[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]]
seeds = st.integers(0, 2**32 - 1)


def loop(points):
    points = np.array(points, dtype=np.float64)
    return np.stack([points, np.roll(points, -1, axis=0)], axis=1)


def widths_at(room, point):
    """Widths of the wedges around the vertex at this point, degrees, ascending; empty without a vertex."""
    junctions = room.junctions
    vertex = np.flatnonzero(np.linalg.norm(junctions.vertices - point, axis=-1) < 1e-3)
    return np.sort(np.degrees(junctions.wedge_width[np.isin(junctions.wedge_vertex, vertex)]))


# Junctions.


def test_a_rectangle_has_four_right_angles_inside_and_four_edges_outside():
    junctions = Room(loop(SQUARE)).junctions
    assert len(junctions.vertices) == len(junctions.corners) == len(junctions.edges) == 4
    assert np.allclose(junctions.wedge_width[junctions.corners], np.pi / 2)
    assert np.allclose(junctions.wedge_width[junctions.edges], 3 * np.pi / 2)
    assert np.array_equal(junctions.right_angled.sum(axis=0), [2, 2, 2, 2])
    assert np.allclose(np.sort(junctions.wedge_reach[junctions.corners], axis=1), [[3.0, 4.0]] * 4)


def test_a_free_standing_wall_has_two_wedges_of_360_degrees():
    junctions = Room(np.array([[[0.0, 0.0], [1.0, 0.0]]])).junctions
    assert np.allclose(junctions.wedge_width, 2 * np.pi)
    assert np.array_equal(junctions.edges, [0, 1])
    assert len(junctions.corners) == 0


def test_wedges_of_t_x_and_straight_junctions():
    through = [[-1.0, 0.0], [1.0, 0.0]]
    assert np.allclose(widths_at(Room(np.array([through, [[0.0, 0.0], [0.0, 1.0]]])), [0, 0]), [90, 90, 180])
    assert np.allclose(widths_at(Room(np.array([through, [[0.0, -1.0], [0.0, 1.0]]])), [0, 0]), [90] * 4)
    assert np.allclose(widths_at(Room(np.array([through, [[1.0, 0.0], [3.0, 0.0]]])), [1, 0]), [180, 180])


def test_overlapping_walls_share_one_direction():
    room = Room(np.array([[[0.0, 0.0], [2.0, 0.0]], [[1.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]]]))
    assert np.allclose(widths_at(room, [0, 0]), [90, 270])
    assert room.junctions.right_angled.sum() == 4  # both walls along x with the wall along y, in both orders
    corner = room.junctions.corners
    assert np.allclose(np.sort(room.junctions.wedge_reach[corner]), [[1.0, 2.0]])
    leftwards = Room(np.array([[[0.0, 0.0], [-1.0, 1e-17]], [[0.0, 0.0], [-1.0, -1e-17]], [[0.0, 0.0], [0.0, 1.0]]]))
    assert np.allclose(widths_at(leftwards, [0, 0]), [90, 270])  # on both sides of theta = pi


@pytest.mark.parametrize("gap", [0.0, 0.9e-3])
def test_ends_within_a_millimetre_become_one_vertex(gap):
    room = Room(np.array([[[0.0, 0.0], [1.0, 0.0]], [[1.0, gap], [1.0, 1.0]]]))
    assert np.array_equal(room.walls[0, 1], room.walls[1, 0])
    assert len(room.junctions.vertices) == 3
    assert np.allclose(widths_at(room, [1, 0]), [90, 270], atol=0.1)


@pytest.mark.parametrize("gap", [0.0, 0.9e-3, -0.9e-3])
def test_an_end_within_a_millimetre_of_a_wall_touches_it(gap):
    room = Room(np.array([[[-1.0, 0.0], [1.0, 0.0]], [[0.1, gap], [0.1, 1.0]]]))
    assert np.allclose(room.walls[1, 0], [0.1, 0.0], atol=1e-15)
    assert np.allclose(widths_at(room, [0.1, 0]), [90, 90, 180])


def test_ends_farther_apart_stay_unchanged():
    room = Room(np.array([[[0.0, 0.0], [1.0, 0.0]], [[1.0, 2e-3], [1.0, 1.0]]]))
    assert len(room.junctions.vertices) == 4


@pytest.mark.slow
@given(seed=seeds)
def test_wedges_around_a_vertex_sum_to_360_degrees_and_rotate_with_the_room(seed):
    room = random_room(np.random.default_rng(seed), box=1.0, segment=1.0)
    junctions = room.junctions
    turns = np.bincount(junctions.wedge_vertex, junctions.wedge_width)
    assert np.allclose(turns, 2 * np.pi)
    angle = 1.234
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = Room(room.walls @ turn.T + [3.0, -5.0]).junctions
    assert np.allclose(np.sort(turned.wedge_width), np.sort(junctions.wedge_width))
    assert np.array_equal(turned.right_angled, junctions.right_angled)


@pytest.mark.parametrize(
    ("walls", "names", "poles", "words"),
    [
        ([[[0, 0], [1, np.nan]]], (), [], "wall 0"),
        ([[[0, 0], [1, 0]], [[2, 2], [2, 2]]], ("a", "b"), [], "wall 1 (b)"),
        ([[[0, 0], [1, 0]]], ("a", "b"), [], "2 names for 1 walls"),
        ([[[0, 0], [1, 0]]], ("two\nlines",), [], "printable"),
        ([[[0, 0], [1, 0]]], (), [[np.inf, 0]], "pole"),
    ],
)
def test_invalid_rooms_raise_an_error_with_the_reason(walls, names, poles, words):
    with pytest.raises(SonarError) as caught:
        Room(np.array(walls, dtype=float), names, np.array(poles, dtype=float).reshape(-1, 2))
    assert words in str(caught.value)
    assert "allowed" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_rooms_are_immutable():
    given_walls = loop(SQUARE)
    room = Room(given_walls)
    given_walls[:] = 7.0
    assert room.walls.max() == 4.0
    with pytest.raises(ValueError, match="read-only"):
        room.walls[0] = 0.0


# GeoJSON.


def feature(form, coordinates, **properties):
    return {"type": "Feature", "properties": properties, "geometry": {"type": form, "coordinates": coordinates}}


def write(path, *features):
    path.write_text(json.dumps({"type": "FeatureCollection", "features": list(features)}))
    return path


@pytest.mark.parametrize("seed", range(20))
def test_geojson_round_trip(seed, tmp_path):
    room = random_room(np.random.default_rng(seed))
    room = Room(room.walls, (*room.wall_names[:-1], 'Tür "1"'), np.array([[0.1, 1 / 3], [-2e-9, 7.0]]))
    save_room(room, tmp_path / "room.geojson")
    again = load_room(tmp_path / "room.geojson")
    assert np.array_equal(again.walls, room.walls)
    assert np.array_equal(again.poles, room.poles)
    assert again.wall_names == room.wall_names


def test_every_geometry_becomes_walls_and_poles(tmp_path):
    ring = [*SQUARE, SQUARE[0]]
    hole = [[1, 1], [2, 1], [2, 1], [2, 2], [1, 1]]  # a repeated position
    room = load_room(
        write(
            tmp_path / "room.geojson",
            feature("LineString", [[0, 5], [1, 5], [1, 6]], name="bent"),
            feature("MultiLineString", [[[7, 0], [8, 0]], [[7, 1], [8, 1, 99.0]]], name="pair"),
            feature("Polygon", [ring, hole], name="hall"),
            feature("MultiPolygon", [[[[x + 20, y] for x, y in ring]]]),
            feature("Point", [3, 2], kind="pole"),
            feature("Point", [0, 0], kind="corner"),
            feature("Point", [1, 2], kind="edge"),
        )
    )
    assert room.wall_names == ("bent",) * 2 + ("pair",) * 2 + ("hall",) * 7 + ("",) * 4
    assert np.array_equal(room.walls[:4, 1], [[1, 5], [1, 6], [8, 0], [8, 1]])
    assert np.array_equal(room.walls[4:8], loop(SQUARE))
    assert np.array_equal(room.walls[8:11], loop([[1, 1], [2, 1], [2, 2]]))
    assert np.array_equal(room.poles, [[3.0, 2.0]])


GOOD = feature("LineString", [[0, 0], [1, 0]])


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (feature("LineString", [[0, 0], [0, 0]]), "no length at (0, 0)"),
        (feature("LineString", [[0, 0]]), "1 positions"),
        (feature("LineString", [[0, 0], [1]]), "[1]"),
        (feature("LineString", [[0, 0], [1, float("nan")]]), "nan"),
        (feature("LineString", [[0, 0], [1, 10**400]]), "position"),
        (feature("LineString", [[0, 0], ["1", 0]]), "'1'"),
        (feature("LineString", [[0, 0], [True, 0]]), "True"),
        (feature("LineString", None), "None"),
        (feature("MultiLineString", [3]), "3"),
        (feature("Polygon", 3), "Polygon"),
        (feature("Polygon", [SQUARE]), "open"),
        (feature("Polygon", [[[0, 0], [0, 0], [0, 0], [0, 0]]]), "1 positions"),
        (feature("Point", [0, 0]), "kind None"),
        (feature("Point", [0, 0], kind="lamp"), "'lamp'"),
        (feature("Point", [], kind="pole"), "position []"),
        (feature("Point", "here", kind="pole"), "here"),
        (feature("Circle", [0, 0]), "Circle"),
        (feature("MultiPoint", [[0, 0]]), "MultiPoint"),
        (feature("Point", [0, 0], kind="circle"), "circle without radius"),
        (feature("Point", [0, 0], kind="circle", radius=0), "circle of radius 0"),
        (feature("Point", [0, 0], kind="pole", radius=0.1), "radius of a pole"),
        (feature("LineString", [[0, 0], [0, 1]], radius=0.1), "radius of a LineString"),
        (feature("LineString", [[0, 0], [0, 1]], kind="circle"), "LineString of kind 'circle'"),
        (feature("LineString", [[0, 0], [0, 1]], kind="wall", colour="red"), "unknown property 'colour'"),
        (feature("LineString", [[0, 0], [0, 1]], kind="wal"), "LineString of kind 'wal'"),
        (feature("Polygon", [[*SQUARE, SQUARE[0]]], kind=["wall"]), "Polygon of kind ['wall']"),
        (GOOD | {"geometry": GOOD["geometry"] | {"unit": "mm"}}, "unknown key 'unit'"),
        (feature("LineString", [[8.5, 52], [8.5001, 52.0001]]), "degrees of longitude and latitude"),
        (GOOD | {"propertys": {}}, "unknown key 'propertys'"),
        ({"type": "Feature", "geometry": {"type": "GeometryCollection", "geometries": []}}, "GeometryCollection"),
        (feature("LineString", [[0, 0], [0, 1]], name=3), "name 3"),
        ({"type": "Feature", "properties": None, "geometry": None}, "geometry"),
        ({"type": "Feature", "properties": [], "geometry": GOOD["geometry"]}, "properties"),
        ({"type": "Feature", "properties": {}, "geometry": {"type": "LineString"}}, "coordinates"),
        (7, "Feature"),
    ],
)
def test_an_invalid_feature_raises_a_one_line_error(bad, words, tmp_path):
    path = write(tmp_path / "room.geojson", GOOD, bad)
    with pytest.raises(SonarError) as caught:
        load_room(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: feature 1: ")
    assert words in message
    assert "allowed" in message
    assert "\n" not in message


@pytest.mark.parametrize(
    "text",
    [
        *("", "{", "[]", "null", "[" * 100_000, "\xff\x00", '{"type": "Feature"}', '{"type": "FeatureCollection"}'),
        '{"type": "FeatureCollection", "features": []}',
        '{"type": "FeatureCollection", "unit": "mm", "features": []}',
    ],
)
def test_an_invalid_file_raises_a_one_line_error(text, tmp_path):
    path = tmp_path / "room.geojson"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(SonarError) as caught:
        load_room(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_missing_file_or_folder_raises_a_named_error(tmp_path):
    for act in (load_room, lambda path: save_room(Room(loop(SQUARE)), path)):
        with pytest.raises(SonarError, match="nowhere"):
            act(tmp_path / "nowhere" / "room.geojson")


def test_a_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "room.geojson"
    save_room(Room(loop(SQUARE)), path)
    before = path.read_bytes()

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(SonarError, match="No space left"):
        save_room(Room(loop(SQUARE)[:2]), path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["room.geojson"]


# Lines, random rooms.


@pytest.mark.slow
@given(seed=seeds)
def test_lines_contain_their_walls_in_the_robot_frame(seed):
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    pose = np.append(rng.uniform(-5, 5, 2), rng.uniform(-10, 10))
    rho, theta = walls_in_robot_frame(room, pose)
    assert (rho >= 0).all()
    assert ((theta >= -np.pi) & (theta < np.pi)).all()
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    p_robot = (room.walls - pose[:2]) @ np.array([[cos, -sin], [sin, cos]])
    normal = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    assert np.allclose((p_robot * normal[:, None]).sum(-1), rho[:, None], atol=1e-12)


def test_theta_stays_below_pi():
    room = Room(np.array([[[-1.0, -1.0], [-1.0, 1.0]]]))
    rho, theta = walls_in_robot_frame(room, np.zeros(3))
    assert rho[0] == 1.0
    assert theta[0] == -np.pi
    assert walls_in_robot_frame(room, np.array([0.0, 0.0, 1e-17]))[1][0] == -np.pi


@pytest.mark.slow
@given(seed=seeds)
def test_random_rooms_are_closed_and_poses_keep_clear(seed):
    shapely = pytest.importorskip("shapely")
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    shell = sum(name.startswith("wall") for name in room.wall_names)
    outline = shapely.Polygon(room.walls[:shell, 0])
    assert outline.is_valid
    assert np.array_equal(np.roll(room.walls[:shell, 0], -1, axis=0), room.walls[:shell, 1])
    assert 4 <= shell <= 7 + 4
    assert 2.5 < np.ptp(room.walls[:shell], axis=(0, 1)).max() <= 7.0
    x, y, theta = random_pose(rng, room)
    assert outline.contains(shapely.Point(x, y))
    assert -np.pi <= theta < np.pi
    assert point_to_segments(np.array([[x, y]]), room.walls).min() >= 0.45
    assert np.linalg.norm(room.poles - [x, y], axis=-1).min(initial=np.inf) >= 0.45


@pytest.mark.slow
def test_random_rooms_have_all_features():
    rng = np.random.default_rng(0)
    rooms = [random_room(rng) for _ in range(60)]
    corners = [len(room.junctions.corners) for room in rooms]
    assert 0 in corners
    assert max(corners) >= 4
    for name in ("box", "segment"):
        assert 0 < sum(name in room.wall_names for room in rooms) < 60
    assert 0 < sum(len(room.poles) for room in rooms) < 60
    assert len({sum(name.startswith("wall") for name in room.wall_names) for room in rooms}) >= 4


def test_the_same_generator_gives_the_same_room_and_pose():
    one, two = (np.random.default_rng(5) for _ in range(2))
    first, second = random_room(one), random_room(two)
    assert np.array_equal(first.walls, second.walls)
    assert np.array_equal(random_pose(one, first), random_pose(two, second))


@pytest.mark.parametrize("walls", [loop(SQUARE)[:3], loop(SQUARE) / 10, np.zeros((0, 2, 2))])
def test_no_pose_in_an_open_or_small_room(walls):
    with pytest.raises(SonarError, match="closed room"):
        random_pose(np.random.default_rng(0), Room(walls))


def test_clearance_is_checked():
    with pytest.raises(SonarError, match="clearance -1"):
        random_pose(np.random.default_rng(0), Room(loop(SQUARE)), clearance=-1.0)


@pytest.mark.slow
def test_rooms_and_tracing_do_not_import_jax():
    code = "import sys, jaxsonar.floor_plans.room, jaxsonar.simulation.echo_tracing; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_random_columns_are_apart_from_everything_and_change_nothing_else():
    for seed in range(8):
        room = random_room(np.random.default_rng(seed), box=1.0, pole=1.0, columns=3.0)
        assert len(room.circles) == 3
        center, radius = room.circles[:, :2], room.circles[:, 2]
        assert ((radius >= 0.05) & (radius <= 0.3)).all()
        for k in range(3):
            along = np.linspace(0, 1, 500)[:, None, None]
            points = room.walls[:, 0] + along * (room.walls[:, 1] - room.walls[:, 0])
            others = np.delete(center, k, axis=0), np.delete(radius, k)
            assert np.linalg.norm(points - center[k], axis=-1).min() > radius[k] + 0.09
            assert np.linalg.norm(room.poles - center[k], axis=-1).min() > radius[k] + 0.09
            assert (np.linalg.norm(others[0] - center[k], axis=-1) > radius[k] + others[1] + 0.09).all()
            assert np.isfinite(laser_ranges(room, np.append(center[k], 0.0), np.linspace(-3, 3, 9))).all()  # inside
        pose = random_pose(np.random.default_rng(seed), room, clearance=0.4)
        assert (np.linalg.norm(center - pose[:2], axis=-1) >= radius + 0.4).all()
        plain, none = (random_room(np.random.default_rng(seed), **options) for options in ({}, {"columns": 0.0}))
        assert np.array_equal(plain.walls, none.walls)
        assert not len(plain.circles)
    count = [len(random_room(np.random.default_rng(seed), columns=1.5).circles) for seed in range(20)]
    assert set(count) == {1, 2}


@pytest.mark.parametrize("columns", [-1.0, 9.0, np.nan])
def test_a_number_of_columns_out_of_range_is_an_error(columns):
    with pytest.raises(SonarError, match=r"columns .*; allowed is 0 to 8"):
        random_room(np.random.default_rng(0), columns=columns)


def test_without_columns_a_seed_gives_the_rooms_that_it_always_gave():
    """The generator draws nothing for columns: its state after a room does not depend on them."""
    one, other = np.random.default_rng(3), np.random.default_rng(3)
    random_room(one)
    random_room(other, columns=0.0)
    assert one.random() == other.random()


def test_a_map_with_circles_is_a_room(tmp_path):
    circle = {"radius": 0.2, "cov": np.eye(3).tolist(), "echoes": 9, "scans": [0], "probability": {"circle": 1.0}}
    wall = feature("LineString", [[0, 0], [2, 0]], kind="segment", rho=0.0, echoes=9, scans=[0], ends=[])
    column = feature("Point", [1, 1], kind="circle", **circle)
    undecided = feature("Point", [2, 2], kind="undecided", cov=None)
    room = load_room(write(tmp_path / "map.geojson", wall, column, undecided))
    assert room.circles.tolist() == [[1, 1, 0.2]]
    assert (len(room.walls), len(room.poles)) == (1, 0)
