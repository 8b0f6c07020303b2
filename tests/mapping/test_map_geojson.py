"""Global maps as GeoJSON: lossless round trip, errors for malformed files, and segments of any GeoJSON."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar.evaluation.laser_polygonal_model import PolygonalModel
from jaxsonar.evaluation.laser_reference_map import save_reference
from jaxsonar.fileio.geojson import feature
from jaxsonar.floor_plans.room_geojson import save_room
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.map_geojson import load_map, load_segments, load_walls, save_map
from jaxsonar.simulation.office import load_office

COLUMNS = (
    "segments",
    "rho",
    "theta",
    "sigma_rho",
    "sigma_theta",
    "echoes",
    "points",
    "point_cov",
    "point_echoes",
    "point_radius",
    "point_circle_cov",
    "point_probabilities",
)


def some_map(rng, count):
    rho, theta, sigma_rho, sigma_theta = rng.normal(size=(4, count))
    sigma_rho[::3] = sigma_theta[::4] = np.nan
    scans = tuple(tuple(sorted(rng.integers(0, 99, k % 4).tolist())) for k in range(count))
    return GlobalMap(
        rng.normal(size=(count, 2, 2)), rho, theta, sigma_rho, sigma_theta, rng.integers(0, 500, count), scans
    )


def with_points(rng, world, count):
    """Points of all kinds; unknown covariances and probabilities among them."""
    roots = rng.normal(size=(count, 3, 3)) * 10.0 ** rng.integers(-6, 1, (count, 1, 1))
    cov = roots @ roots.swapaxes(1, 2)
    cov = (cov + cov.swapaxes(1, 2)) / 2
    cov[1::3] = np.nan
    kinds = rng.choice(["corner", "edge", "circle", "undecided"], count)
    circle = kinds == "circle"
    probability = rng.dirichlet(np.ones(4), count)
    probability[::2] = np.nan
    return world.with_points(
        rng.normal(size=(count, 2)),
        point_kinds=tuple(kinds.tolist()),
        point_cov=cov[:, :2, :2],
        point_echoes=rng.integers(0, 500, count),
        point_scans=tuple(tuple(sorted(rng.integers(0, 99, k % 4).tolist())) for k in range(count)),
        point_radius=np.where(circle, rng.uniform(0.01, 1.0, count), np.nan),
        point_circle_cov=np.where(circle[:, None, None], cov, np.nan),
        point_probabilities=probability,
    )


def same(one, two):
    lists = ("scans", "point_kinds", "point_scans")
    return all(getattr(one, name) == getattr(two, name) for name in lists) and all(
        np.array_equal(getattr(one, name), getattr(two, name), equal_nan=True) for name in COLUMNS
    )


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 9), points=st.integers(0, 9))
def test_saving_and_loading_gives_the_same_map(seed, count, points, tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "map.geojson"
    rng = np.random.default_rng(seed)
    world = with_points(rng, some_map(rng, count), points)
    save_map(world, path)
    again = load_map(path)
    assert same(again, world)
    assert len(again) == count
    assert not any(getattr(again, name).flags.writeable for name in COLUMNS)


def test_the_file_has_the_documented_format(tmp_path, rng):
    world = some_map(rng, 2)
    save_map(world, tmp_path / "map.geojson")
    text = (tmp_path / "map.geojson").read_text()
    assert "NaN" not in text
    document = json.loads(text)
    assert document["type"] == "FeatureCollection"
    for index, entry in enumerate(document["features"]):
        assert entry["geometry"] == {"type": "LineString", "coordinates": world.segments[index].tolist()}
        assert list(entry["properties"]) == ["kind", "rho", "theta", "sigma_rho", "sigma_theta", "echoes", "scans"]
        assert entry["properties"]["kind"] == "segment"
        assert entry["properties"]["scans"] == list(world.scans[index])
    assert [entry["properties"]["sigma_rho"] is None for entry in document["features"]] == [True, False]


def test_points_need_only_kind_and_position(tmp_path, rng):
    write(tmp_path / "map.geojson", feature("Point", [1, 2, 0], kind="edge"), feature("LineString", ENDS, **GOOD))
    world = load_map(tmp_path / "map.geojson")
    assert (len(world), world.points.tolist(), world.point_kinds) == (1, [[1, 2]], ("edge",))
    assert (world.point_echoes.tolist(), world.point_scans) == ([0], ((),))
    assert np.isnan(world.point_cov).all()
    assert np.isnan(world.point_probabilities).all()
    save_map(with_points(rng, world, 4), tmp_path / "points.geojson")
    features = json.loads((tmp_path / "points.geojson").read_text())["features"][1:]
    for entry, probability in zip(features, ([], ["probability"]) * 2, strict=True):
        radius = ["radius"] if entry["properties"]["kind"] == "circle" else []
        assert list(entry["properties"]) == ["kind", *radius, *probability, "cov", "echoes", "scans"]
    assert features[1]["properties"]["cov"] is None


def test_a_dash_is_standard_output(capsys, rng):
    world = some_map(rng, 3)
    save_map(world, "-")
    assert len(json.loads(capsys.readouterr().out)["features"]) == 3


GOOD = dict(kind="segment", rho=1.0, theta=0.5, sigma_rho=None, sigma_theta=0.1, echoes=3, scans=[0, 2])
ENDS = [[0, 0], [1, 0]]


def write(path, *features):
    path.write_text(json.dumps({"type": "FeatureCollection", "features": list(features)}))
    return path


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (feature("LineString", ENDS, **GOOD | {"rho": None}), "rho None; allowed is a finite number"),
        (feature("LineString", ENDS, **GOOD | {"theta": "north"}), "theta 'north'"),
        (feature("LineString", ENDS, **GOOD | {"sigma_rho": True}), "sigma_rho True; allowed is a finite number, or"),
        (feature("LineString", ENDS, **GOOD | {"sigma_theta": float("inf")}), "sigma_theta inf"),
        (feature("LineString", ENDS, **GOOD | {"echoes": -1}), "echoes -1"),
        (feature("LineString", ENDS, **GOOD | {"echoes": 1.5}), "echoes 1.5"),
        (feature("LineString", ENDS, **GOOD | {"scans": [1, "2"]}), "scans [1, '2']"),
        (feature("LineString", ENDS, **GOOD | {"scans": 1}), "scans 1"),
        (feature("LineString", [*ENDS, [2, 0]], **GOOD), "3 positions"),
        (feature("LineString", [[0, 0], [1, float("nan")]], **GOOD), "nan"),
        (feature("LineString", ENDS, **GOOD | {"kind": "wall"}), "LineString of kind 'wall'"),
        (feature("Point", [0, 0], kind="pole"), "Point of kind 'pole'"),
        (feature("Polygon", [ENDS], **GOOD), "Polygon of kind 'segment'"),
        (feature("Point", [0, "east"], kind="edge"), "position [0, 'east']"),
        (feature("Point", [0, 0], kind="edge", echoes=-2), "echoes -2"),
        (feature("Point", [0, 0], kind="corner", scans=[0.5]), "scans [0.5]"),
        (feature("Point", [0, 0], kind="corner", cov=[[1, 0]]), "cov [[1, 0]]; allowed are two rows"),
        (feature("Point", [0, 0], kind="circle"), "radius None; allowed is a number above 0"),
        (feature("Point", [0, 0], kind="circle", radius=1, cov=[[1, 0], [0, 1]]), "allowed are three rows"),
        (feature("Point", [0, 0], kind="undecided", probability={"plane": 1}), "probability {'plane': 1}"),
        (feature("Point", [0, 0], kind="corner", cov=[[1, 2], [2, 1]]), "cov [[1, 2], [2, 1]]"),
        (feature("Point", [0, 0], kind="corner", cov=[[1, float("nan")], [0, 1]]), "cov [[1, nan], [0, 1]]"),
        ({"type": "Feature", "geometry": None}, "no geometry"),
    ],
)
def test_an_invalid_feature_is_named_in_one_line(bad, words, tmp_path):
    path = write(
        tmp_path / "map.geojson", feature("LineString", ENDS, **GOOD), feature("Point", [0, 0], kind="edge"), bad
    )
    with pytest.raises(SonarError) as caught:
        load_map(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: feature 2: ")
    assert words in message
    assert "allowed" in message
    assert message.isprintable()


def test_a_missing_file_or_invalid_json_is_refused(tmp_path):
    (tmp_path / "bad").write_text("{")
    for act in (load_map, load_segments):
        with pytest.raises(SonarError, match="bad: no JSON"):
            act(tmp_path / "bad")
        with pytest.raises(SonarError, match="nowhere"):
            act(tmp_path / "nowhere")
    with pytest.raises(SonarError, match="nowhere"):
        save_map(some_map(np.random.default_rng(0), 1), tmp_path / "nowhere" / "map.geojson")


def test_segments_of_any_geojson_with_lines(tmp_path, rng):
    ring = [[0, 0], [2, 0], [2, 1], [0, 0]]
    path = write(
        tmp_path / "any.geojson",
        feature("LineString", [[0, 5], [1, 5], [1, 5], [1, 6]], kind="wall"),
        feature("MultiLineString", [[[7, 0], [8, 0]]]),
        feature("Polygon", [ring], kind="table"),
        feature("Point", [3, 2], kind="lamp"),
        feature("LineString", [[9, 9]], kind=7),
    )
    segments, kinds = load_segments(path)
    assert kinds == ("wall", "wall", "", "table", "table", "table")
    assert np.array_equal(segments[:, 0], [[0, 5], [1, 5], [7, 0], [0, 0], [2, 0], [2, 1]])
    assert np.array_equal(segments[:, 1], [[1, 5], [1, 6], [8, 0], [2, 0], [2, 1], [0, 0]])
    world = some_map(rng, 4)
    save_map(world, tmp_path / "map.geojson")
    assert np.array_equal(load_segments(tmp_path / "map.geojson")[0], world.segments)
    path = write(tmp_path / "none.geojson", feature("Point", [0, 0]))
    assert load_segments(path)[0].shape == load_walls(path).shape == (0, 2, 2)


def test_walls_of_a_room_are_its_segments(tmp_path):
    room = load_office().room
    save_room(room, tmp_path / "room.geojson")
    segments, kinds = load_segments(tmp_path / "room.geojson")
    assert np.array_equal(segments, room.walls)
    assert set(kinds) == {"wall"}


def test_walls_of_a_reference_exclude_pseudo_segments(tmp_path, rng):
    model = PolygonalModel(rng.normal(size=(3, 2, 2)), rng.normal(size=(2, 2, 2)), rng.normal(size=(1, 2)))
    save_reference(model, tmp_path / "ref.geojson")
    assert load_segments(tmp_path / "ref.geojson")[1] == ("reference",) * 3 + ("pseudo",) * 2
    assert np.array_equal(load_walls(tmp_path / "ref.geojson"), model.segments)
    assert json.loads((tmp_path / "ref.geojson").read_text())["features"][-1]["properties"] == {"kind": "intersection"}
    with pytest.raises(SonarError, match="kind 'reference'"):
        load_map(tmp_path / "ref.geojson")
