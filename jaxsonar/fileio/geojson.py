"""Reading and writing of GeoJSON FeatureCollections in metres; errors name the feature."""

import json
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from jaxsonar.fileio.atomic_files import open_output, read_bytes, reason, shown
from jaxsonar.hardware.errors import SonarError

T = TypeVar("T")

_COLLECTION_KEYS = ("type", "features", "name", "id", "crs", "bbox", "xy_coordinate_resolution")
_FEATURE_KEYS = ("type", "id", "bbox", "properties", "geometry")
_GEOMETRY_KEYS = ("type", "coordinates", "bbox", "crs")
_GEOMETRIES = "allowed are LineString, MultiLineString, Polygon, MultiPolygon and Point"


def read_features(
    filename: str | os.PathLike[str], read: Callable[[dict[str, Any], str, Any], T], *, what: str
) -> list[T]:
    """Read a FeatureCollection.

    Args:
        filename: the file.
        read: converts one feature, given its properties, the type of its geometry and the coordinates. The file and the
            index of the feature are prepended to its errors.
        what: expected content, for the message ("a room").

    Returns:
        The converted features, in order.

    Raises:
        SonarError: the file cannot be read, is not a FeatureCollection, or ``read`` rejected a feature.
    """
    content = read_bytes(filename, what=f"{what}, GeoJSON")
    where = shown(filename)
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as failure:
        raise SonarError(f"{where}: no JSON: {reason(failure)}; allowed is a GeoJSON FeatureCollection") from None
    features = document.get("features") if isinstance(document, dict) else None
    if not (isinstance(document, dict) and document.get("type") == "FeatureCollection" and isinstance(features, list)):
        raise SonarError(f"{where}: no FeatureCollection came; allowed is a GeoJSON FeatureCollection with features")
    try:
        _check_keys(document, _COLLECTION_KEYS, "FeatureCollection")
    except SonarError as error:
        raise SonarError(f"{where}: {error}") from None
    found = []
    for index, entry in enumerate(features):
        try:
            found.append(read(*_feature_parts(entry)))
        except SonarError as error:
            raise SonarError(f"{where}: feature {index}: {error}") from None
    return found


def write_features(features: Sequence[dict[str, Any]], filename: str | os.PathLike[str]) -> None:
    """Write a FeatureCollection with one feature per line, atomically; ``-`` is standard output.

    Raises:
        SonarError: the file cannot be written.
    """
    body = ",\n".join(json.dumps(entry, ensure_ascii=False, allow_nan=False) for entry in features)
    with open_output(filename) as file:
        file.write(f'{{"type": "FeatureCollection", "features": [\n{body}\n]}}\n')


def feature(form: str, coordinates: Any, /, **properties: Any) -> dict[str, Any]:
    """A GeoJSON feature.

    Args:
        form: type of the geometry ("LineString").
        coordinates: coordinates of the geometry.
        properties: properties of the feature.
    """
    return {"type": "Feature", "properties": properties, "geometry": {"type": form, "coordinates": coordinates}}


def lines_of(form: str, coordinates: Any) -> Iterator[tuple[Any, bool]]:
    """All lists of positions in a geometry of lines or polygons, each with True if it is a closed ring.

    Raises:
        SonarError: another geometry, or wrongly nested coordinates.
    """
    depth = {"LineString": 0, "MultiLineString": 1, "Polygon": 1, "MultiPolygon": 2}.get(form)
    if depth is None:
        raise SonarError(f"geometry {form!r:.60}; {_GEOMETRIES}")
    lists = [coordinates]
    for _ in range(depth):
        if not all(isinstance(entry, list) for entry in lists):
            raise SonarError(f"coordinates of a {form:.60} are no lists of lines; allowed is what RFC 7946 gives")
        lists = [line for entry in lists for line in entry]
    for line in lists:
        yield line, form.endswith("Polygon")


def positions(line: Any) -> Float[np.ndarray, "positions 2"]:
    """The positions of one line, metres. A third coordinate is dropped.

    Raises:
        SonarError: positions that are not pairs of finite numbers.
    """
    if not isinstance(line, list):
        raise SonarError(f"{line!r:.40} instead of a list of positions; allowed are lists of [x, y]")
    for position in line:
        pair = position[:2] if isinstance(position, list) else []
        if len(pair) < 2 or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in pair):
            raise SonarError(f"position {position!r:.60}; allowed is [x, y] in metres")
        if not all(abs(v) < 1e12 for v in pair):  # also rejects NaN, and integers too large for a float
            raise SonarError(f"position {position!r:.60}; allowed are finite numbers, metres")
    return np.array([position[:2] for position in line], dtype=np.float64).reshape(-1, 2)


def _feature_parts(entry: Any) -> tuple[dict[str, Any], str, Any]:
    """Properties, type of the geometry and coordinates of one feature."""
    if not isinstance(entry, dict) or entry.get("type") != "Feature":
        raise SonarError("no Feature came; allowed are Feature objects")
    _check_keys(entry, _FEATURE_KEYS, "Feature")
    properties, geometry = entry.get("properties"), entry.get("geometry")
    properties = {} if properties is None else properties
    if not isinstance(properties, dict):
        raise SonarError("properties are no object; allowed is an object or null")
    if isinstance(geometry, dict) and geometry.get("type") in ("GeometryCollection", "Feature", "FeatureCollection"):
        raise SonarError(f"geometry {geometry['type']!r}; {_GEOMETRIES}; give each part a Feature of its own")
    if not isinstance(geometry, dict) or "coordinates" not in geometry:
        raise SonarError("no geometry with coordinates came; allowed are LineString, Polygon, their Multi forms, Point")
    _check_keys(geometry, _GEOMETRY_KEYS, "geometry")
    return properties, str(geometry.get("type")), geometry["coordinates"]


def _check_keys(entry: dict[str, Any], allowed: tuple[str, ...], what: str) -> None:
    """Check that an object has no key that nothing reads.

    Raises:
        SonarError: it has one.
    """
    if unknown := [key for key in entry if key not in allowed]:
        raise SonarError(f"unknown key {shown(unknown[0], 60)!r}; allowed in a {what} are {', '.join(allowed)}")
