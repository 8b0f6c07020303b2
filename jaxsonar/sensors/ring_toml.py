"""Rings as TOML files, with angles in degrees and every key checked; the package contains rings of known devices."""

import math
import os
import re
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NoReturn, get_type_hints

import msgspec
import numpy as np
import tomli_w
from jaxtyping import Float, Int
from msgspec import Meta

from jaxsonar.fileio.atomic_files import atomic_write, read_toml, shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.messages import REFERENCE_SPEED_OF_SOUND
from jaxsonar.sensors.ring import Ring

DATA = Path(__file__).parents[1] / "data"

_Length = Annotated[float, Meta(description="a finite number (m)")]
_Heading = Annotated[float, Meta(description="a finite number (degrees counter-clockwise from x)")]
_Beam = Annotated[float, Meta(gt=0, le=180, description="a number above 0 and up to 180 (degrees)")]
_Neighbors = Annotated[int, Meta(ge=0, description="a whole number, 0 or more and less than there are sensors")]
_Name = Annotated[str, Meta(pattern="[^/]", description="a text, the frame or the topic of a sensor in bags")]
_Closed = Annotated[bool | None, Meta(description="true (the last and the first sensor are neighbors) or false")]
_MaxRange = Annotated[float, Meta(gt=0, description="a finite number above 0 (m)")]


class _RingTable(msgspec.Struct, forbid_unknown_fields=True):
    count: Annotated[int, Meta(ge=1, le=10_000, description="a whole number from 1 to 10000")]
    radius: Annotated[float, Meta(ge=0, description="a finite number, 0 or more (m)")]
    first_heading_deg: _Heading
    beam_deg: _Beam
    neighbors: _Neighbors
    max_range: _MaxRange


class _ArrayTable(msgspec.Struct, forbid_unknown_fields=True):
    neighbors: _Neighbors
    max_range: _MaxRange
    closed: _Closed = None


class _SensorTable(msgspec.Struct, forbid_unknown_fields=True):
    x: _Length
    y: _Length
    heading_deg: _Heading
    beam_deg: _Beam
    range_offset: _Length = 0.0
    frame: _Name = ""
    topic: _Name = ""


class _NameTable(msgspec.Struct, forbid_unknown_fields=True):
    frame: _Name = ""
    topic: _Name = ""


class _FileHead(msgspec.Struct, forbid_unknown_fields=True):
    name: Annotated[str, Meta(description="a text")]
    speed_of_sound: Annotated[float, Meta(gt=0, description="a finite number above 0 (m/s)")] = REFERENCE_SPEED_OF_SOUND
    ring: Annotated[_RingTable | None, Meta(description="one table [ring]")] = None
    array: Annotated[_ArrayTable | None, Meta(description="one table [array]")] = None
    # Results of a calibration; ignored here.
    calibration: Annotated[dict[str, Any] | None, Meta(description="one table [calibration]")] = None


class _ArrayFile(_FileHead, forbid_unknown_fields=True):
    sensor: Annotated[list[_SensorTable] | None, Meta(description="tables [[sensor]], one a sensor")] = None


class _CircleFile(_FileHead, forbid_unknown_fields=True):
    sensor: Annotated[list[_NameTable] | None, Meta(description="tables [[sensor]], one a sensor")] = None


_TABLES = {"": _ArrayFile, "ring": _RingTable, "array": _ArrayTable, "sensor": _SensorTable}
_CIRCLE_TABLES = _TABLES | {"": _CircleFile, "sensor": _NameTable}


def shipped_rings() -> tuple[str, ...]:
    """Names of the rings in the package, as accepted by ``load_ring``."""
    return tuple(sorted(file.stem.removeprefix("ring-") for file in DATA.glob("ring-*.toml")))


def load_ring(filename: str | os.PathLike[str]) -> Ring:
    """Load a ring from a TOML file, or one of the shipped rings by name.

    The file contains ``name``, optionally ``speed_of_sound`` (m/s), and either a circular ring or a general array. A
    ring is a table ``[ring]`` with count, radius, first_heading_deg, beam_deg, neighbors and max_range. An array is a
    table ``[array]`` with neighbors and max_range, and one table ``[[sensor]]`` per sensor with x, y, heading_deg,
    beam_deg and optionally range_offset. ``closed = true`` in ``[array]`` makes the last and the first sensor
    neighbors, ``false`` does not; without it, positions and headings decide. Lengths are in metres. A table
    ``[calibration]`` is ignored.

    In both cases a ``[[sensor]]`` may contain ``frame`` or ``topic``, the name of the sensor in ROS bags
    (``Ring.names``). Beside ``[ring]`` these are the only keys, and there is one ``[[sensor]]`` per sensor.

    Args:
        filename: the file; if there is no such file, a name from ``shipped_rings()``, as in ``load_ring("faw")``.

    Raises:
        SonarError: no such ring, or an invalid file; the message names file, key and allowed values.
    """
    file = Path(filename)
    if not os.path.isfile(filename) and os.fspath(filename) in shipped_rings():
        file = DATA / f"ring-{os.fspath(filename)}.toml"
    elif not os.path.exists(filename):
        allowed = f"allowed is a ring file or one of the shipped rings {', '.join(shipped_rings())}"
        raise SonarError(f"{shown(filename)}: no such ring; {allowed}")
    given = _read(file)
    if (given.ring is None) == (given.array is None):
        came = "neither [ring] nor [array]" if given.ring is None else "both [ring] and [array]"
        raise SonarError(f"{shown(file)}: {came} came; allowed is [ring], or [array] with one [[sensor]] each")
    if given.ring is not None and given.sensor is not None and len(given.sensor) != given.ring.count:
        came = f"{len(given.sensor)} [[sensor]] came beside [ring]"
        raise SonarError(f"{shown(file)}: {came}; allowed is one for each of its {given.ring.count} sensors, or none")
    if given.array is not None and not given.sensor:
        raise SonarError(f"{shown(file)}: sensor is missing; allowed with [array] is one [[sensor]] each, at least one")

    table, key, count = (
        (given.ring, "ring", given.ring.count) if given.ring else (given.array, "array", len(given.sensor or ()))
    )
    assert table is not None
    if table.neighbors >= count:
        came = f"{key}.neighbors: {table.neighbors} came"
        raise SonarError(f"{shown(file)}: {came}; allowed is 0 to {count - 1} with {count} sensors")
    try:
        return _ring(given)
    except SonarError as error:
        raise SonarError(f"{shown(file)}: {error}") from None


class DetectionTable(NamedTuple):
    """How often walls were heard in the runs of a calibration, over the angle off the axis."""

    off_axis: Float[np.ndarray, " edges"]
    """Edges of the bins of the angle, radians, from 0."""
    expected: Int[np.ndarray, " bins"]
    """Number of readings with a wall at this angle."""
    heard: Int[np.ndarray, " bins"]
    """Number of those that heard it."""


def load_detection(filename: str | os.PathLike[str]) -> DetectionTable | None:
    """The detections in the table ``[calibration.echo_model]`` of a ring file.

    None for a shipped ring, and for a file without this table, or with one that does not hold such numbers.
    """
    if not os.path.isfile(filename):
        return None
    calibration = _read(Path(filename)).calibration
    model = (calibration or {}).get("echo_model")
    if not isinstance(model, dict):
        return None
    try:
        edges = np.radians(np.array(model["off_axis_deg"], np.float64))
        expected, heard = np.array(model["expected"], np.int64), np.array(model["heard"], np.int64)
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    if not len(edges) == len(expected) + 1 == len(heard) + 1 or not (np.diff(edges) > 0).all():
        return None
    return DetectionTable(edges, expected, heard)


def _ring(given: _ArrayFile | _CircleFile) -> Ring:
    names = [_name(k, sensor) for k, sensor in enumerate(given.sensor or [])]
    if isinstance(given, _CircleFile):
        assert given.ring is not None
        return Ring.circular(
            count=given.ring.count,
            radius=given.ring.radius,
            beam=math.radians(given.ring.beam_deg),
            neighbors=given.ring.neighbors,
            max_range=given.ring.max_range,
            first_heading=math.radians(given.ring.first_heading_deg),
            speed_of_sound=given.speed_of_sound,
            name=given.name,
            names=names,
        )
    assert given.array is not None
    sensors = given.sensor or []
    return Ring(
        np.array([(sensor.x, sensor.y) for sensor in sensors]),
        np.radians([sensor.heading_deg for sensor in sensors]),
        beam=np.radians([sensor.beam_deg for sensor in sensors]),
        neighbors=given.array.neighbors,
        max_range=given.array.max_range,
        closed=given.array.closed,
        range_offset=np.array([sensor.range_offset for sensor in sensors]),
        speed_of_sound=given.speed_of_sound,
        name=given.name,
        names=names,
    )


def _name(k: int, sensor: _SensorTable | _NameTable) -> str:
    """The name of a sensor as in ``Ring.names``: topics begin with "/", frames do not."""
    if sensor.frame and sensor.topic:
        raise SonarError(f"sensor[{k}]: frame and topic came; allowed is one of them")
    return f"/{sensor.topic.lstrip('/')}" if sensor.topic else sensor.frame.lstrip("/")


def save_ring(ring: Ring, filename: str | os.PathLike[str]) -> None:
    """Write a ring as TOML, so that ``load_ring`` restores it to within 1e-12 (m, rad, m/s).

    A circular ring of equal sensors without range offsets is written as ``[ring]``, any other as ``[array]``.

    Args:
        ring: the ring.
        filename: the file; an existing one is replaced only after the new one is complete.

    Raises:
        SonarError: the file cannot be written.
    """
    with atomic_write(filename) as file:
        file.write(ring_toml(ring))


def ring_toml(ring: Ring, *, each: bool = False) -> str:
    """A ring as the text of a TOML file.

    Args:
        ring: the ring.
        each: write every sensor as ``[[sensor]]``, even if ``[ring]`` would suffice.
    """
    speed = float(np.asarray(ring.speed_of_sound, dtype=np.float64))
    head: dict[str, Any] = {"name": ring.name, "speed_of_sound": speed}
    names = [{"topic" if one.startswith("/") else "frame": one} if one else {} for one in ring.names]
    if (circle := _circle(ring)) and not each:
        text, sensors = tomli_w.dumps({**head, "ring": circle}), names
    else:
        array = {"neighbors": ring.neighbors, "max_range": ring.max_range, "closed": ring.closed}
        text = tomli_w.dumps({**head, "array": array})
        sensors = [sensor | name for sensor, name in zip(_sensors(ring), names or [{}] * ring.count, strict=True)]
    # One table at a time, because the library writes lists of short tables as inline arrays.
    return text + "".join(f"\n[[sensor]]\n{tomli_w.dumps(sensor)}" for sensor in sensors)


def _circle(ring: Ring) -> dict[str, Any] | None:
    """The table [ring], or None if it cannot represent this ring."""
    position, heading = np.asarray(ring.position, np.float64), np.asarray(ring.heading, np.float64)
    beam, offset = np.asarray(ring.beam, np.float64), np.asarray(ring.range_offset, np.float64)
    radius, first_heading = _short(np.hypot(*position[0])), float(heading[0])
    again = Ring.circular(count=ring.count, radius=radius, first_heading=first_heading, neighbors=ring.neighbors)
    if not ring.closed or offset.any() or (beam != beam[0]).any():
        return None
    if np.abs(again.position - position).max() > 1e-12 or np.abs(again.heading - heading).max() > 1e-12:
        return None
    return {
        "count": ring.count,
        "radius": radius,
        "first_heading_deg": _degrees(first_heading),
        "beam_deg": min(_degrees(beam[0]), 180.0),
        "neighbors": ring.neighbors,
        "max_range": ring.max_range,
    }


def _sensors(ring: Ring) -> list[dict[str, Any]]:
    """The tables [[sensor]], one per sensor."""
    columns = (ring.position, ring.heading, ring.beam, ring.range_offset)
    sensors = []
    for (x, y), heading, beam, offset in zip(*(np.asarray(column, np.float64) for column in columns), strict=True):
        sensor = {
            "x": _short(x),
            "y": _short(y),
            "heading_deg": _degrees(heading),
            "beam_deg": min(_degrees(beam), 180.0),
        }
        sensors.append({**sensor, "range_offset": _short(offset)} if offset else sensor)
    return sensors


def _short(value: float) -> float:
    """A length without rounding noise: 0.14 for 0.14000000000000004. The file format guarantees 1e-12 only."""
    return round(float(value), 14) + 0.0


def _degrees(angle: float) -> float:
    return round(math.degrees(angle), 12) + 0.0


def _read(file: Path) -> _ArrayFile | _CircleFile:
    data = read_toml(file, what="a ring")
    _refuse_not_finite(file, {key: value for key, value in data.items() if key != "calibration"}, "")
    try:
        return msgspec.convert(data, type=_CircleFile if "ring" in data and "array" not in data else _ArrayFile)
    except (msgspec.ValidationError, OverflowError) as failure:
        _refuse(file, data, str(failure))


def _refuse_not_finite(file: Path, value: Any, key: str) -> None:
    """Raise a SonarError for nan and inf, which TOML allows and which the bounds above do not exclude."""
    if isinstance(value, float) and not math.isfinite(value):
        raise SonarError(f"{shown(file)}: {shown(key)}: {value} came; allowed is {_allowed(key) or 'a finite number'}")
    if isinstance(value, dict):
        for name, item in value.items():
            _refuse_not_finite(file, item, f"{key}.{name}" if key else name)
    if isinstance(value, list):
        for k, item in enumerate(value):
            _refuse_not_finite(file, item, f"{key}[{k}]")


def _refuse(file: Path, data: dict[str, Any], message: str) -> NoReturn:
    """Raise a one-line SonarError for a message of msgspec, which names a key or its table."""
    what, _, place = message.partition(" - at `$")
    place = place.rstrip("`").removeprefix(".")
    if field := re.fullmatch(r"Object (missing required|contains unknown) field `(.*)`", what, re.DOTALL):
        key = f"{place}.{field[2]}" if place else field[2]
        if field[1] == "missing required":
            raise SonarError(f"{shown(file)}: {key} is missing; needed is {_allowed(key)}")
        table = re.sub(r"\[\d+\]", "", place)
        tables = _CIRCLE_TABLES if "ring" in data and "array" not in data else _TABLES
        keys = ", ".join(tables[table].__struct_fields__)
        beside = " beside [ring]" if tables is _CIRCLE_TABLES else ""
        where = {"": "outside of tables", "sensor": f"in [[sensor]]{beside}"}.get(table, f"in [{table}]")
        raise SonarError(f"{shown(file)}: unknown key {shown(key)}; allowed {where} are {keys}")
    value: Any = data
    for name, index in re.findall(r"(\w+)|\[(\d+)\]", place):
        value = value[name] if name else value[int(index)]
    came = shown(repr(value), 80) if place else shown(what)
    raise SonarError(f"{shown(file)}: {shown(place)}: {came} came; allowed is {_allowed(place) or what}")


def _allowed(key: str) -> str:
    """Description of the allowed values of a key such as ``sensor[3].beam_deg``; empty for an unknown key."""
    table, _, name = re.sub(r"\[\d+\]", "", key).rpartition(".")
    hint = get_type_hints(_TABLES[table], include_extras=True).get(name) if table in _TABLES else None
    return next((meta.description or "" for meta in getattr(hint, "__metadata__", ()) if isinstance(meta, Meta)), "")
