"""GeoJSON: written features are read unchanged, and an error names its file and feature."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar.fileio.geojson import feature, lines_of, positions, read_features, write_features
from jaxsonar.hardware.errors import SonarError

numbers = st.floats(-1e6, 1e6)
lines = st.lists(st.lists(numbers, min_size=2, max_size=3), max_size=4)
values = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text()
features = st.builds(
    lambda coordinates, properties: feature("LineString", coordinates, **properties),
    lines,
    st.dictionaries(st.text(), values, max_size=3),
)


def as_feature(properties, form, coordinates):
    return feature(form, coordinates, **properties)


@pytest.mark.slow
@given(st.lists(features, max_size=4))
def test_features_round_trip(tmp_path_factory, written):
    file = tmp_path_factory.mktemp("features") / "features.geojson"
    write_features(written, file)
    assert read_features(file, as_feature, what="lines") == written
    text = file.read_text(encoding="utf-8")
    assert json.loads(text) == {"type": "FeatureCollection", "features": written}
    assert text.count("\n") == max(len(written), 1) + 2  # one feature per line


def test_a_value_that_is_not_json_leaves_the_old_file(tmp_path):
    file = tmp_path / "features.geojson"
    write_features([feature("Point", [1.0, 2.0])], file)
    before = file.read_bytes()
    with pytest.raises(ValueError, match="JSON"):
        write_features([feature("Point", [1.0, 2.0]), feature("Point", [np.nan, 2.0])], file)
    assert file.read_bytes() == before
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("index", [0, 2])
def test_an_error_names_file_and_feature(tmp_path, index):
    def reject(properties, form, coordinates):
        if properties["number"] == index:
            raise SonarError("rejected")

    file = tmp_path / "features.geojson"
    write_features([feature("Point", [0.0, 0.0], number=number) for number in range(4)], file)
    with pytest.raises(SonarError) as caught:
        read_features(file, reject, what="points")
    assert str(caught.value) == f"{file}: feature {index}: rejected"


@given(lines)
def test_positions_are_the_first_two_coordinates(line):
    np.testing.assert_array_equal(positions(line), np.array([entry[:2] for entry in line]).reshape(-1, 2))


@pytest.mark.parametrize(
    ("form", "depth", "closed"),
    [("LineString", 0, False), ("MultiLineString", 1, False), ("Polygon", 1, True), ("MultiPolygon", 2, True)],
)
def test_every_line_of_a_geometry_is_found(form, depth, closed):
    first, second = [[0, 0], [1, 0], [0, 0]], [[5, 5], [6, 5], [5, 5]]
    nested = {0: first, 1: [first, second], 2: [[first], [second]]}[depth]
    expected = [first] if depth == 0 else [first, second]
    assert list(lines_of(form, nested)) == [(line, closed) for line in expected]
