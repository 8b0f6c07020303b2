"""Rooms as GeoJSON, world frame, metres: lines and polygons are walls, points are poles and circles."""

import os
from typing import Any

import numpy as np

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.fileio.geojson import feature, lines_of, positions, read_features, write_features
from jaxsonar.floor_plans.junctions import TOUCH
from jaxsonar.floor_plans.room import Room
from jaxsonar.hardware.errors import SonarError

_PROPERTIES = ("kind", "name", "id", "radius")
"""Properties of the features of a room."""
_CIRCLE_PROPERTIES_OF_MAPS = ("cov", "echoes", "scans", "probability")
"""Further properties of circles in maps."""
_SKIPPED_POINTS = ("corner", "edge", "undecided")
"""Kinds of points of maps that are no reflectors of a room."""
_KINDS_OF_MAPS = ("segment", *_SKIPPED_POINTS)
"""Kinds of features of maps, which have properties of their own."""
_KINDS_OF_WALLS = (None, "wall", "segment")
"""Kinds of lines and polygons; without a kind, they are walls."""


def load_room(filename: str | os.PathLike[str]) -> Room:
    """Read a room from a GeoJSON FeatureCollection, world frame, metres.

    The pieces of LineString and MultiLineString and the rings of Polygon and MultiPolygon are walls, named by the
    property ``name`` of their feature; their ``kind`` is "wall", "segment" (in maps) or absent. A Point with the
    property ``kind`` "pole" is a pole; one of kind "circle" with the property ``radius`` (metres) is a round column.
    Points of kind "corner" and "edge", which maps contain, are skipped, because walls imply them, and those of kind
    "undecided", too.

    Raises:
        SonarError: the file cannot be read, or a feature is of another type; the message names file, feature and cause.
    """
    place = shown(filename)
    walls, names, points = [], [], []
    for name, pieces, found in read_features(filename, _feature, what="a room"):
        walls += pieces
        names += [name] * len(pieces)
        points += found
    if not walls and not points:
        raise SonarError(
            f"{place}: no wall, pole or circle came; allowed is at least one LineString, Polygon, pole or circle"
        )
    table = np.array(points).reshape(-1, 3)
    is_pole = table[:, 2] == 0
    try:
        return Room(np.array(walls).reshape(-1, 2, 2), tuple(names), table[is_pole, :2], table[~is_pole])
    except SonarError as error:
        raise SonarError(f"{place}: {error}") from None


def save_room(room: Room, filename: str | os.PathLike[str]) -> None:
    """Write a room as GeoJSON, world frame, metres: one LineString per wall, one Point per pole and circle.

    Coordinates are written with all digits, so that ``load_room`` restores the same room. An existing file is replaced
    only after the new one is complete; ``-`` is standard output.

    Raises:
        SonarError: the file cannot be written.
    """
    walls = zip(room.walls.tolist(), room.wall_names, strict=True)
    features = [feature("LineString", wall, kind="wall", **({"name": name} if name else {})) for wall, name in walls]
    features += [feature("Point", pole, kind="pole") for pole in room.poles.tolist()]
    features += [feature("Point", [x, y], kind="circle", radius=radius) for x, y, radius in room.circles.tolist()]
    write_features(features, filename)


def _feature(properties: dict[str, Any], form: str, coordinates: Any) -> tuple[str, list[np.ndarray], list[np.ndarray]]:
    """Name, walls and points of one GeoJSON feature. A point is x, y and radius, 0 for a pole."""
    name, kind = properties.get("name"), properties.get("kind")
    if not isinstance(name, str | None):
        raise SonarError(f"name {name!r:.60}; allowed is text")
    known = _PROPERTIES + (_CIRCLE_PROPERTIES_OF_MAPS if kind == "circle" else ())
    if kind not in _KINDS_OF_MAPS and (unknown := [key for key in properties if key not in known]):
        raise SonarError(f"unknown property {shown(unknown[0], 60)!r}; allowed are {', '.join(known)}")
    if form == "Point":
        if kind not in ("pole", "circle", *_SKIPPED_POINTS):
            allowed = 'allowed is "pole" or "circle" ("corner", "edge" and "undecided" are skipped)'
            raise SonarError(f"Point of kind {kind!r:.60}; {allowed}")
        return name or "", [], [] if kind in _KINDS_OF_MAPS else [_round(properties, positions([coordinates])[0])]
    if "radius" in properties:
        raise SonarError(f"radius of a {form:.60}; allowed is it with a Point of kind circle")
    if kind in ("pole", "circle", *_SKIPPED_POINTS):
        raise SonarError(f"{form:.60} of kind {kind!r}; allowed with this kind is a Point")
    if kind not in _KINDS_OF_WALLS:
        raise SonarError(f'{form:.60} of kind {kind!r:.60}; allowed is "wall" ("segment" in maps), or no kind')
    pieces: list[np.ndarray] = []
    for line, is_ring in lines_of(form, coordinates):
        points = positions(line)
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
            tiny = np.ptp(points, axis=0).max() < 0.1 and not (points[1:] == points[:-1]).all(axis=1).any()
            degrees = "; are the coordinates degrees of longitude and latitude? needed are metres" if tiny else ""
            allowed = f"allowed is more than {TOUCH * 1e3:g} mm{degrees}"
            raise SonarError(f"a wall of no length at ({x:g}, {y:g}); {allowed}")
        pieces += list(np.stack([points[:-1], points[1:]], axis=1))
    return name or "", pieces, []


def _round(properties: dict[str, Any], position: np.ndarray) -> np.ndarray:
    """Position and radius of a pole or circle; a pole has radius 0."""
    radius = properties.get("radius")
    if properties["kind"] == "pole":
        if radius is not None:
            raise SonarError("radius of a pole; allowed is it with kind circle, because poles have no thickness")
        return np.append(position, 0.0)
    if radius is None:
        raise SonarError("circle without radius; allowed is a number above 0, metres")
    if isinstance(radius, bool) or not isinstance(radius, int | float) or not 0 < radius < 1e6:
        raise SonarError(f"circle of radius {radius!r:.60}; allowed is a number above 0, metres")
    return np.append(position, float(radius))
