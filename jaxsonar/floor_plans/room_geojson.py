"""Rooms as GeoJSON, world frame, metres: lines and polygons are walls, points of kind "pole" are poles."""

import os
from typing import Any

import numpy as np

from jaxsonar.fileio.atomic_files import shown
from jaxsonar.fileio.geojson import feature, lines_of, positions, read_features, write_features
from jaxsonar.floor_plans.junctions import TOUCH
from jaxsonar.floor_plans.room import Room
from jaxsonar.hardware.errors import SonarError

_PROPERTIES = ("kind", "name", "id")
"""Properties of the features of a room."""
_KINDS_OF_MAPS = ("segment", "corner", "edge")
"""Kinds of features of maps, which have properties of their own."""


def load_room(filename: str | os.PathLike[str]) -> Room:
    """Read a room from a GeoJSON FeatureCollection, world frame, metres.

    The pieces of LineString and MultiLineString and the rings of Polygon and MultiPolygon are walls, named by the
    property ``name`` of their feature. A Point with the property ``kind`` "pole" is a pole. Points of kind "corner" and
    "edge", which maps contain, are skipped, because walls imply them.

    Raises:
        SonarError: the file cannot be read, or a feature is of another type; the message names file, feature and cause.
    """
    place = shown(filename)
    walls, names, poles = [], [], []
    for name, pieces, points in read_features(filename, _feature, what="a room"):
        walls += pieces
        names += [name] * len(pieces)
        poles += points
    if not walls and not poles:
        raise SonarError(f"{place}: neither wall nor pole came; allowed is at least one LineString, Polygon or pole")
    try:
        return Room(np.array(walls).reshape(-1, 2, 2), tuple(names), np.array(poles).reshape(-1, 2))
    except SonarError as error:
        raise SonarError(f"{place}: {error}") from None


def save_room(room: Room, filename: str | os.PathLike[str]) -> None:
    """Write a room as GeoJSON, world frame, metres: one LineString per wall, one Point of kind "pole" per pole.

    Coordinates are written with all digits, so that ``load_room`` restores the same room. An existing file is replaced
    only after the new one is complete; ``-`` is standard output.

    Raises:
        SonarError: the file cannot be written.
    """
    walls = zip(room.walls.tolist(), room.wall_names, strict=True)
    features = [feature("LineString", wall, kind="wall", **({"name": name} if name else {})) for wall, name in walls]
    features += [feature("Point", pole, kind="pole") for pole in room.poles.tolist()]
    write_features(features, filename)


def _feature(properties: dict[str, Any], form: str, coordinates: Any) -> tuple[str, list[np.ndarray], list[np.ndarray]]:
    """Name, walls and poles of one GeoJSON feature."""
    name, kind = properties.get("name"), properties.get("kind")
    if not isinstance(name, str | None):
        raise SonarError(f"name {name!r:.60}; allowed is text")
    if kind not in _KINDS_OF_MAPS and (unknown := [key for key in properties if key not in _PROPERTIES]):
        raise SonarError(f"unknown property {shown(unknown[0], 60)!r}; allowed are {', '.join(_PROPERTIES)}")
    if form == "Point":
        if kind not in ("pole", "corner", "edge"):
            raise SonarError(f'Point of kind {kind!r:.60}; allowed is "pole" ("corner" and "edge" are skipped)')
        return name or "", [], [positions([coordinates])[0]] if kind == "pole" else []
    if kind in ("pole", "corner", "edge"):
        raise SonarError(f"{form:.60} of kind {kind!r}; allowed with this kind is a Point")
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
