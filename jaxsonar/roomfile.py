"""Rooms as GeoJSON, world frame, metres: lines and polygons are walls, points of kind pole are poles."""

import json
import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxsonar.hardware.errors import SonarError

from .files import atomic_write, read_bytes, reason, shown
from .rooms import TOUCH, Room


def load_room(path: str | os.PathLike[str]) -> Room:
    """Read a room from a GeoJSON FeatureCollection in world metres.

    LineString and MultiLineString pieces and the rings of Polygon and MultiPolygon are walls, each with its feature's
    property ``name``; a Point with property ``kind`` "pole" is a pole. Points of kind "corner" and "edge", which maps
    contain, are skipped: walls imply them.

    Raises:
        SonarError: the file cannot be read, or a feature is none of these; one line names file, feature and cause.
    """
    content = read_bytes(path, what="a room, GeoJSON")
    place = shown(path)
    try:
        document = json.loads(content)
    except (ValueError, RecursionError) as failure:
        raise SonarError(f"{place}: no JSON: {reason(failure)}; allowed is a GeoJSON FeatureCollection") from None
    features = document.get("features") if isinstance(document, dict) else None
    if not (isinstance(document, dict) and document.get("type") == "FeatureCollection" and isinstance(features, list)):
        raise SonarError(f"{place}: no FeatureCollection came; allowed is a GeoJSON FeatureCollection with features")
    walls, names, poles = [], [], []
    for index, feature in enumerate(features):
        try:
            name, pieces, points = _feature(feature)
        except SonarError as error:
            raise SonarError(f"{place}: feature {index}: {error}") from None
        walls += pieces
        names += [name] * len(pieces)
        poles += points
    if not walls and not poles:
        raise SonarError(f"{place}: neither wall nor pole came; allowed is at least one LineString, Polygon or pole")
    try:
        return Room(np.array(walls).reshape(-1, 2, 2), tuple(names), np.array(poles).reshape(-1, 2))
    except SonarError as error:
        raise SonarError(f"{place}: {error}") from None


def save_room(room: Room, path: str | os.PathLike[str]) -> None:
    """Write a room as GeoJSON in world metres: a LineString a wall, a Point of kind "pole" a pole.

    The file appears complete or not at all. Coordinates are written in full: what is loaded again is the same room.

    Raises:
        SonarError: the file cannot be written.
    """
    features: list[dict[str, Any]] = []
    for wall, name in zip(room.walls.tolist(), room.wall_names, strict=True):
        properties = {"kind": "wall"} | ({"name": name} if name else {})
        geometry = {"type": "LineString", "coordinates": wall}
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    for pole in room.poles.tolist():
        geometry = {"type": "Point", "coordinates": pole}
        features.append({"type": "Feature", "properties": {"kind": "pole"}, "geometry": geometry})
    body = ",\n".join(json.dumps(feature, ensure_ascii=False) for feature in features)
    text = f'{{"type": "FeatureCollection", "features": [\n{body}\n]}}\n'
    with atomic_write(path) as file:
        file.write(text)


def _feature(feature: Any) -> tuple[str, list[np.ndarray], list[np.ndarray]]:
    """Name, walls and poles of one GeoJSON feature."""
    if not isinstance(feature, dict) or feature.get("type") != "Feature":
        raise SonarError("no Feature came; allowed are Feature objects")
    properties, geometry = feature.get("properties"), feature.get("geometry")
    properties = {} if properties is None else properties
    if not isinstance(properties, dict):
        raise SonarError("properties are no object; allowed is an object or null")
    name = properties.get("name")
    if not isinstance(name, str | None):
        raise SonarError(f"name {name!r:.60}; allowed is text")
    if not isinstance(geometry, dict) or "coordinates" not in geometry:
        raise SonarError("no geometry with coordinates came; allowed are LineString, Polygon, their Multi forms, Point")
    form, coordinates = geometry.get("type"), geometry["coordinates"]
    if form == "Point":
        kind = properties.get("kind")
        if kind not in ("pole", "corner", "edge"):
            raise SonarError(f'Point of kind {kind!r:.60}; allowed is "pole" ("corner" and "edge" are skipped)')
        return name or "", [], [_positions([coordinates])[0]] if kind == "pole" else []
    pieces: list[np.ndarray] = []
    for line, is_ring in _lines(form, coordinates):
        points = _positions(line)
        if is_ring:
            if len(points) < 4 or (points[0] != points[-1]).any():
                raise SonarError(
                    f"a ring of {len(points)} positions is open; allowed are 4 or more, the last = the first"
                )
            points = points[np.append(True, (points[1:] != points[:-1]).any(axis=1))]
        if len(points) < 2:
            raise SonarError(f"a line of {len(points)} positions; allowed are 2 or more")
        length = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if (length <= TOUCH).any():
            x, y = points[int(length.argmin())]
            raise SonarError(f"a wall of no length at ({x:g}, {y:g}); allowed is more than {TOUCH * 1e3:g} mm")
        pieces += list(np.stack([points[:-1], points[1:]], axis=1))
    return name or "", pieces, []


def _lines(form: Any, coordinates: Any) -> Iterator[tuple[Any, bool]]:
    """Every list of positions in a geometry, and whether it is a ring."""
    depth = {"LineString": 0, "MultiLineString": 1, "Polygon": 1, "MultiPolygon": 2}.get(str(form))
    if depth is None:
        raise SonarError(f"geometry {form!r:.60}; allowed are LineString, Polygon, their Multi forms and Point")
    lists = [coordinates]
    for _ in range(depth):
        if not all(isinstance(entry, list) for entry in lists):
            raise SonarError(f"coordinates of a {form:.60} are no lists of lines; allowed is what RFC 7946 gives")
        lists = [line for entry in lists for line in entry]
    for line in lists:
        yield line, str(form).endswith("Polygon")


def _positions(line: Any) -> np.ndarray:
    if not isinstance(line, list):
        raise SonarError(f"{line!r:.40} instead of a list of positions; allowed are lists of [x, y]")
    for position in line:
        pair = position[:2] if isinstance(position, list) else []
        if len(pair) < 2 or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in pair):
            raise SonarError(f"position {position!r:.60}; allowed is [x, y] in metres")
        if not all(abs(v) < 1e12 for v in pair):  # NaN fails too, and integers too large for a float
            raise SonarError(f"position {position!r:.60}; allowed are finite numbers, metres")
    return np.array([position[:2] for position in line], dtype=np.float64).reshape(-1, 2)
