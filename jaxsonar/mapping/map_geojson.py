"""Global maps as GeoJSON, world frame, metres; and the segments of any GeoJSON, to hold maps against."""

import os
from typing import Any, TypeGuard

import numpy as np
from jaxtyping import Float

from jaxsonar.fileio.geojson import feature, lines_of, positions, read_features, write_features
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.global_map import POINT_KINDS, GlobalMap

NO_WALLS = ("pseudo", "intersection")
"""Kinds of features that a reference carries beside its walls: what hides behind an occlusion, where walls meet."""
_NUMBERS = {"rho": False, "theta": False, "sigma_rho": True, "sigma_theta": True}  # whether null (not known) is allowed


def save_map(world: GlobalMap, path: str | os.PathLike[str]) -> None:
    """Write a global map; ``-`` is standard output.

    A wall is a LineString of kind "segment", a corner or an edge a Point of that kind. Numbers are written in full, so
    that what is loaded again is the same map; what is not known (NaN) is null.

    Raises:
        SonarError: the file cannot be written.
    """
    numbers = {name: getattr(world, name).tolist() for name in _NUMBERS}
    features = []
    for index, ends in enumerate(world.segments.tolist()):
        line = {name: column[index] if np.isfinite(column[index]) else None for name, column in numbers.items()}
        seen = {"echoes": int(world.echoes[index]), "scans": list(world.scans[index])}
        features.append(feature("LineString", ends, kind="segment", **line, **seen))
    for index, (place, kind) in enumerate(zip(world.points.tolist(), world.point_kinds, strict=True)):
        cov = world.point_cov[index]
        seen = {"echoes": int(world.point_echoes[index]), "scans": list(world.point_scans[index])}
        known = cov.tolist() if np.isfinite(cov).all() else None
        features.append(feature("Point", place, kind=kind, cov=known, **seen))
    write_features(features, path)


def load_map(path: str | os.PathLike[str]) -> GlobalMap:
    """Read a global map as ``save_map`` writes it; one without a segment is a map, too.

    A point needs no more than its kind and place: what else is missing is not known.

    Raises:
        SonarError: the file cannot be read, or a feature is no such segment or point; one line names file, feature,
            property.
    """
    found = read_features(path, _row, what="a global map")
    rows = [row for row in found if len(row) == 4]
    points = [row for row in found if len(row) == 5]
    segments = np.array([ends for ends, _, _, _ in rows]).reshape(-1, 2, 2)
    numbers = np.array([line for _, line, _, _ in rows], dtype=np.float64).reshape(-1, len(_NUMBERS))
    echoes = np.array([count for _, _, count, _ in rows], dtype=np.int64)
    columns = dict(zip(_NUMBERS, numbers.T.copy(), strict=True))
    place = np.array([place for place, *_ in points], dtype=np.float64).reshape(-1, 2)
    cov = np.array([cov for _, _, cov, _, _ in points], dtype=np.float64).reshape(-1, 2, 2)
    point_echoes = np.array([count for *_, count, _ in points], dtype=np.int64)
    for column in (segments, echoes, *columns.values(), place, cov, point_echoes):
        column.setflags(write=False)
    return GlobalMap(
        segments=segments,
        **columns,
        echoes=echoes,
        scans=tuple(scans for *_, scans in rows),
        points=place,
        point_kinds=tuple(kind for _, kind, *_ in points),
        point_cov=cov,
        point_echoes=point_echoes,
        point_scans=tuple(scans for *_, scans in points),
    )


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


_Segment = tuple[Float[np.ndarray, "2 2"], list[float], int, tuple[int, ...]]
_Point = tuple[Float[np.ndarray, " 2"], str, Float[np.ndarray, "2 2"], int, tuple[int, ...]]


def _row(properties: dict[str, Any], form: str, coordinates: Any) -> _Segment | _Point:
    """Ends, numbers, echoes and scans of one segment; place, kind, covariance, echoes and scans of one point."""
    kind = properties.get("kind")
    if form == "Point" and kind in POINT_KINDS:
        place, defaults = positions([coordinates])[0], {"echoes": 0, "scans": []}
        return place, kind, _covariance(properties.get("cov")), *_seen(defaults | properties)
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
        elif not _is_number(value):
            allowed = "a finite number" + (", or null = not known" if may_be_null else "")
            raise SonarError(f"{name} {value!r:.60}; allowed is {allowed}")
        numbers.append(float(value))
    return ends, numbers, *_seen(properties)


def _covariance(value: Any) -> Float[np.ndarray, "2 2"]:
    """A covariance from its two rows; NaN where it is not known."""
    if value is None:
        return np.full((2, 2), np.nan)
    rows = value if isinstance(value, list) else []
    if len(rows) == 2 and all(isinstance(r, list) and len(r) == 2 and all(map(_is_number, r)) for r in rows):
        cov = np.array(rows, dtype=np.float64)
        if (
            cov[0, 1] == cov[1, 0]
            and cov.diagonal().min() >= 0
            and np.linalg.det(cov) >= -1e-9 * np.prod(cov.diagonal())
        ):
            return cov
    raise SonarError(f"cov {value!r:.60}; allowed are two rows of two numbers, a covariance, or null = not known")


def _seen(properties: dict[str, Any]) -> tuple[int, tuple[int, ...]]:
    """Echoes and scans."""
    echoes, scans = properties.get("echoes"), properties.get("scans")
    if not _is_whole(echoes) or not 0 <= echoes < 2**63:
        raise SonarError(f"echoes {echoes!r:.60}; allowed is a whole number from 0 on")
    if not isinstance(scans, list) or not all(_is_whole(scan) for scan in scans):
        raise SonarError(f"scans {scans!r:.60}; allowed is a list of whole numbers")
    return echoes, tuple(scans)


def _is_number(value: Any) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e12


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
