"""Global maps as GeoJSON, world frame, metres; and the segments of any GeoJSON, to hold maps against."""

import os
from typing import Any, TypeGuard

import numpy as np
from jaxtyping import Float

from jaxsonar.hardware.errors import SonarError

from .geojson import feature, lines_of, positions, read_features, write_features
from .maps import GlobalMap

NO_WALLS = ("pseudo", "intersection")
"""Kinds of features that a reference carries beside its walls: what hides behind an occlusion, where walls meet."""
_NUMBERS = {"rho": False, "theta": False, "sigma_rho": True, "sigma_theta": True}  # whether null (not known) is allowed


def save_map(world: GlobalMap, path: str | os.PathLike[str]) -> None:
    """Write a global map: a LineString of kind "segment" a wall; ``-`` is standard output.

    Numbers are written in full, so that what is loaded again is the same map; what is not known (NaN) is null.

    Raises:
        SonarError: the file cannot be written.
    """
    numbers = {name: getattr(world, name).tolist() for name in _NUMBERS}
    features = []
    for index, ends in enumerate(world.segments.tolist()):
        line = {name: column[index] if np.isfinite(column[index]) else None for name, column in numbers.items()}
        seen = {"echoes": int(world.echoes[index]), "scans": list(world.scans[index])}
        features.append(feature("LineString", ends, kind="segment", **line, **seen))
    write_features(features, path)


def load_map(path: str | os.PathLike[str]) -> GlobalMap:
    """Read a global map as ``save_map`` writes it; one without a segment is a map, too.

    Points of kind "corner" and "edge" are skipped.

    Raises:
        SonarError: the file cannot be read, or a feature is no such segment; one line names file, feature, property.
    """
    rows = [row for row in read_features(path, _row, what="a global map") if row is not None]
    segments = np.array([ends for ends, _, _, _ in rows]).reshape(-1, 2, 2)
    numbers = np.array([line for _, line, _, _ in rows], dtype=np.float64).reshape(-1, len(_NUMBERS))
    echoes = np.array([count for _, _, count, _ in rows], dtype=np.int64)
    columns = dict(zip(_NUMBERS, numbers.T.copy(), strict=True))
    for column in (segments, echoes, *columns.values()):
        column.setflags(write=False)
    return GlobalMap(segments=segments, **columns, echoes=echoes, scans=tuple(scans for *_, scans in rows))


def load_segments(path: str | os.PathLike[str]) -> tuple[Float[np.ndarray, "segments 2 2"], tuple[str, ...]]:
    """The straight pieces of any GeoJSON of lines and polygons: a map, a room, a reference.

    Points are skipped, and so are pieces of no length. Nothing but points, or nothing at all, is no segments.

    Returns:
        segments: both ends of each piece, metres.
        kinds: property ``kind`` of the feature that each piece is of, "" where it has none.

    Raises:
        SonarError: the file cannot be read, or a feature is no line, polygon or point.
    """
    features = read_features(path, _pieces, what="lines")
    pieces = [(piece, kind) for kind, found in features for piece in found]
    return np.array([piece for piece, _ in pieces]).reshape(-1, 2, 2), tuple(kind for _, kind in pieces)


def load_walls(path: str | os.PathLike[str]) -> Float[np.ndarray, "walls 2 2"]:
    """Those pieces of ``load_segments`` that stand for something real: all but the kinds of ``NO_WALLS``.

    Raises:
        SonarError: as ``load_segments``.
    """
    segments, kinds = load_segments(path)
    return segments[~np.isin(np.array(kinds, dtype=np.str_), NO_WALLS)]


def _row(
    properties: dict[str, Any], form: str, coordinates: Any
) -> tuple[Float[np.ndarray, "2 2"], list[float], int, tuple[int, ...]] | None:
    """Ends, numbers, echoes and scans of one segment; None for a point."""
    kind = properties.get("kind")
    if form == "Point" and kind in ("corner", "edge"):
        return None
    if form != "LineString" or kind != "segment":
        raise SonarError(f'{form:.60} of kind {kind!r:.60}; allowed is a LineString of kind "segment"')
    ends = positions(coordinates)
    if len(ends) != 2:
        raise SonarError(f"a segment of {len(ends)} positions; allowed are 2")
    numbers = []
    for name, may_be_null in _NUMBERS.items():
        value = properties.get(name)
        if value is None and may_be_null:
            value = np.nan
        elif not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < 1e12:
            allowed = "a finite number" + (", or null = not known" if may_be_null else "")
            raise SonarError(f"{name} {value!r:.60}; allowed is {allowed}")
        numbers.append(float(value))
    echoes, scans = properties.get("echoes"), properties.get("scans")
    if not _is_whole(echoes) or not 0 <= echoes < 2**63:
        raise SonarError(f"echoes {echoes!r:.60}; allowed is a whole number from 0 on")
    if not isinstance(scans, list) or not all(_is_whole(scan) for scan in scans):
        raise SonarError(f"scans {scans!r:.60}; allowed is a list of whole numbers")
    return ends, numbers, echoes, tuple(scans)


def _is_whole(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def _pieces(properties: dict[str, Any], form: str, coordinates: Any) -> tuple[str, list[Float[np.ndarray, "2 2"]]]:
    """Kind and straight pieces of one feature."""
    kind = properties.get("kind")
    kind = kind if isinstance(kind, str) else ""
    if form in ("Point", "MultiPoint"):
        return kind, []
    pieces: list[np.ndarray] = []
    for line, _ in lines_of(form, coordinates):
        points = positions(line)
        ends = np.stack([points[:-1], points[1:]], axis=1)
        pieces += list(ends[(ends[:, 0] != ends[:, 1]).any(axis=1)])
    return kind, pieces
