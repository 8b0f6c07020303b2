"""Global maps as GeoJSON, world frame, metres; and segments from any GeoJSON, to evaluate maps."""

import os
from typing import Any, NamedTuple, TypeGuard

import numpy as np
from jaxtyping import Float

from jaxsonar.detection.local_model import KIND_NAMES
from jaxsonar.fileio.geojson import feature, lines_of, positions, read_features, write_features
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping.global_map import POINT_KINDS, GlobalMap

NON_WALL_KINDS = ("pseudo", "intersection")
"""Kinds of features in a reference that are not walls: limits of visibility, and corners."""
_NUMBERS = {"rho": False, "theta": False, "sigma_rho": True, "sigma_theta": True}
"""Numeric properties of a wall, and whether null (unknown) is allowed."""


def save_map(world: GlobalMap, filename: str | os.PathLike[str]) -> None:
    """Write a global map; ``-`` is standard output.

    A wall is a LineString of kind "segment", a corner, an edge, a circle or an undecided reflector a Point of that
    kind. Numbers have full precision, so
    that loading gives the same map. Unknown values (NaN) are null.

    Raises:
        SonarError: the file cannot be written.
    """
    numbers = {name: getattr(world, name).tolist() for name in _NUMBERS}
    features = []
    for index, ends in enumerate(world.segments.tolist()):
        line = {name: column[index] if np.isfinite(column[index]) else None for name, column in numbers.items()}
        seen = {"echoes": int(world.echoes[index]), "scans": list(world.scans[index])}
        if world.end_kinds:
            seen["ends"] = [_end(world, index, side) for side in (0, 1)]
        features.append(feature("LineString", ends, kind="segment", **line, **seen))
    for index, (position, kind) in enumerate(zip(world.points.tolist(), world.point_kinds, strict=True)):
        is_circle = kind == "circle"
        cov = world.point_circle_cov[index] if is_circle else world.point_cov[index]
        more: dict[str, Any] = {"radius": float(world.point_radius[index])} if is_circle else {}
        if np.isfinite(world.point_probabilities[index]).all():
            probability = world.point_probabilities[index].tolist()
            more["probability"] = dict(zip(KIND_NAMES, probability, strict=True))
        seen = {"echoes": int(world.point_echoes[index]), "scans": list(world.point_scans[index])}
        known = cov.tolist() if np.isfinite(cov).all() else None
        features.append(feature("Point", position, kind=kind, **more, cov=known, **seen))
    write_features(features, filename)


def _end(world: GlobalMap, wall: int, side: int) -> dict[str, Any]:
    """The property of one end of a wall."""
    cov = world.end_cov[wall, side]
    return {"kind": world.end_kinds[wall][side] or None, "cov": cov.tolist() if np.isfinite(cov).all() else None}


def load_map(filename: str | os.PathLike[str]) -> GlobalMap:
    """Read a global map as ``save_map`` writes it; a map without walls is allowed.

    A point needs only its kind and position. Missing properties are unknown.

    Raises:
        SonarError: the file cannot be read, or a feature is not a valid wall or point. The message names file, feature
            and property.
    """
    found = read_features(filename, _parse_feature, what="a global map")
    walls = [row for row in found if isinstance(row, _MapWall)]
    points = [row for row in found if isinstance(row, _MapPoint)]
    segments = np.array([one.segment for one in walls]).reshape(-1, 2, 2)
    numbers = np.array([one.numbers for one in walls], dtype=np.float64).reshape(-1, len(_NUMBERS))
    echoes = np.array([one.echoes for one in walls], dtype=np.int64)
    end_cov = np.array([one.end_cov for one in walls], dtype=np.float64).reshape(-1, 2, 2, 2)
    end_kinds = tuple(one.end_kinds or ("", "") for one in walls) if any(one.end_kinds for one in walls) else ()
    columns = dict(zip(_NUMBERS, numbers.T.copy(), strict=True))
    is_circle = np.array([one.kind == "circle" for one in points], dtype=bool)
    cov = np.array([one.cov for one in points], dtype=np.float64).reshape(-1, 3, 3)
    of_points = {
        "points": np.array([one.position for one in points], dtype=np.float64).reshape(-1, 2),
        "point_cov": cov[:, :2, :2].copy(),
        "point_echoes": np.array([one.echoes for one in points], dtype=np.int64),
        "point_radius": np.array([one.radius for one in points], dtype=np.float64),
        "point_circle_cov": np.where(is_circle[:, None, None], cov, np.nan),
        "point_probabilities": np.array([one.probability for one in points], dtype=np.float64).reshape(-1, 4),
    }
    for column in (segments, echoes, end_cov, *columns.values(), *of_points.values()):
        column.setflags(write=False)
    return GlobalMap(
        segments=segments,
        **columns,
        echoes=echoes,
        scans=tuple(one.scans for one in walls),
        end_kinds=end_kinds,
        end_cov=end_cov,
        **of_points,
        point_kinds=tuple(one.kind for one in points),
        point_scans=tuple(one.scans for one in points),
    )


def load_segments(filename: str | os.PathLike[str]) -> tuple[Float[np.ndarray, "segments 2 2"], tuple[str, ...]]:
    """The straight segments of any GeoJSON of lines and polygons: a map, a floor plan, a reference.

    Points and segments without length are skipped. A file without lines gives no segments.

    Returns:
        segments: both ends of each segment, metres.
        kinds: property ``kind`` of the feature of each segment, "" where it has none.

    Raises:
        SonarError: the file cannot be read, or a feature is not a line, polygon or point.
    """
    features = read_features(filename, _straight_segments, what="lines")
    segments = [(segment, kind) for kind, found in features for segment in found]
    return np.array([segment for segment, _ in segments]).reshape(-1, 2, 2), tuple(kind for _, kind in segments)


def load_walls(filename: str | os.PathLike[str]) -> Float[np.ndarray, "walls 2 2"]:
    """The segments of ``load_segments`` that are walls: all kinds except ``NON_WALL_KINDS``.

    Raises:
        SonarError: as ``load_segments``.
    """
    segments, kinds = load_segments(filename)
    return segments[~np.isin(np.array(kinds, dtype=np.str_), NON_WALL_KINDS)]


def load_points(
    filename: str | os.PathLike[str], *, kinds: tuple[str, ...]
) -> tuple[Float[np.ndarray, "points 2"], tuple[str, ...], Float[np.ndarray, " points"]]:
    """The points of some kinds of any GeoJSON: a map, a floor plan.

    Returns:
        points: positions, metres.
        kinds: their kinds.
        radii: property ``radius`` of circles, metres; NaN for all other points.

    Raises:
        SonarError: the file cannot be read, or a circle has no radius.
    """

    def read(properties: dict[str, Any], form: str, coordinates: Any) -> list[tuple[Any, str, float]]:
        kind, radius = properties.get("kind"), properties.get("radius")
        if form != "Point" or kind not in kinds:
            return []
        if kind != "circle":
            return [(positions([coordinates])[0], kind, float("nan"))]
        if not _is_number(radius) or radius <= 0:
            raise SonarError(f"radius {radius!r:.60}; allowed is a number above 0, metres")
        return [(positions([coordinates])[0], kind, float(radius))]

    found = [one for of_feature in read_features(filename, read, what="points") for one in of_feature]
    position = np.array([position for position, _, _ in found], dtype=np.float64).reshape(-1, 2)
    return position, tuple(kind for _, kind, _ in found), np.array([radius for *_, radius in found], dtype=np.float64)


class _MapWall(NamedTuple):
    """A wall of the file."""

    segment: Float[np.ndarray, "2 2"]
    numbers: list[float]
    end_kinds: tuple[str, str] | None
    """None where the file has none."""
    end_cov: list[Float[np.ndarray, "2 2"]]
    echoes: int
    scans: tuple[int, ...]


class _MapPoint(NamedTuple):
    """A point of the file."""

    position: Float[np.ndarray, " 2"]
    kind: str
    radius: float
    """NaN unless it is a circle."""
    cov: Float[np.ndarray, "3 3"]
    """Of (x, y, radius); NaN where unknown."""
    probability: list[float]
    echoes: int
    scans: tuple[int, ...]


def _parse_feature(properties: dict[str, Any], form: str, coordinates: Any) -> _MapWall | _MapPoint:
    """A wall or a point."""
    kind = properties.get("kind")
    if form == "Point" and kind in POINT_KINDS:
        position, defaults = positions([coordinates])[0], {"echoes": 0, "scans": []}
        radius, size = float("nan"), 2
        if kind == "circle":
            radius, size = properties.get("radius"), 3
            if not _is_number(radius) or radius <= 0:
                raise SonarError(f"radius {radius!r:.60}; allowed is a number above 0, metres")
        cov = np.full((3, 3), np.nan)
        cov[:size, :size] = _parse_covariance(properties.get("cov"), size)
        probability = _parse_probability(properties.get("probability"))
        seen = _parse_echoes_and_scans(defaults | properties)
        return _MapPoint(position, kind, float(radius), cov, probability, *seen)
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
    end_kinds, end_cov = _parse_ends(properties.get("ends"))
    return _MapWall(ends, numbers, end_kinds, end_cov, *_parse_echoes_and_scans(properties))


def _parse_ends(value: Any) -> tuple[tuple[str, str] | None, list[Float[np.ndarray, "2 2"]]]:
    """Kinds and covariances of both ends of a wall; None and NaN if they are unknown."""
    if value is None:
        return None, [np.full((2, 2), np.nan)] * 2
    if isinstance(value, list) and len(value) == 2 and all(isinstance(end, dict) for end in value):
        first, second = (end.get("kind") for end in value)
        if {first, second} <= {"corner", "edge", None}:
            return (first or "", second or ""), [_parse_covariance(end.get("cov"), 2) for end in value]
    raise SonarError(f'ends {value!r:.60}; allowed are two objects with kind "corner", "edge" or null, and cov')


def _parse_covariance(value: Any, size: int) -> Float[np.ndarray, "size size"]:
    """A covariance from its rows; NaN if it is unknown."""
    if value is None:
        return np.full((size, size), np.nan)
    rows = value if isinstance(value, list) else []
    if len(rows) == size and all(isinstance(r, list) and len(r) == size and all(map(_is_number, r)) for r in rows):
        cov = np.array(rows, dtype=np.float64)
        largest = float(np.abs(cov).max())
        if (cov == cov.T).all() and np.linalg.eigvalsh(cov).min() >= -1e-9 * largest:
            return cov
    many = {2: "two rows of two", 3: "three rows of three"}[size]
    raise SonarError(f"cov {value!r:.60}; allowed are {many} numbers, a covariance, or null = not known")


def _parse_probability(value: Any) -> list[float]:
    """Probability of each of ``KIND_NAMES``; NaN if unknown."""
    if value is None:
        return [float("nan")] * len(KIND_NAMES)
    if isinstance(value, dict) and sorted(value) == sorted(KIND_NAMES):
        found = [value[kind] for kind in KIND_NAMES]
        if all(_is_number(one) and 0 <= one <= 1 for one in found):
            return [float(one) for one in found]
    allowed = f"an object with a number from 0 to 1 for each of {', '.join(KIND_NAMES)}"
    raise SonarError(f"probability {value!r:.60}; allowed is {allowed}")


def _parse_echoes_and_scans(properties: dict[str, Any]) -> tuple[int, tuple[int, ...]]:
    echoes, scans = properties.get("echoes"), properties.get("scans")
    if not _is_integer(echoes) or not 0 <= echoes < 2**63:
        raise SonarError(f"echoes {echoes!r:.60}; allowed is a whole number from 0 on")
    if not isinstance(scans, list) or not all(_is_integer(scan) for scan in scans):
        raise SonarError(f"scans {scans!r:.60}; allowed is a list of whole numbers")
    return echoes, tuple(scans)


def _is_number(value: Any) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e12


def _is_integer(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def _straight_segments(
    properties: dict[str, Any], form: str, coordinates: Any
) -> tuple[str, list[Float[np.ndarray, "2 2"]]]:
    """Kind and straight segments of one feature."""
    kind = properties.get("kind")
    kind = kind if isinstance(kind, str) else ""
    if form in ("Point", "MultiPoint"):
        return kind, []
    segments: list[np.ndarray] = []
    for line, _ in lines_of(form, coordinates):
        points = positions(line)
        ends = np.stack([points[:-1], points[1:]], axis=1)
        segments += list(ends[(ends[:, 0] != ends[:, 1]).any(axis=1)])
    return kind, segments
