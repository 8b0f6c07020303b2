"""Which sensor of the ring each ultrasound sensor of a bag is: by names or numbers, never by a guess."""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from jaxsonar.hardware.errors import SonarError, shown

_MOST_SHOWN = 24
"""Number of names in a message."""


@dataclass(frozen=True)
class BagSensor:
    """An ultrasound sensor of a bag."""

    topic: str
    frame: str
    """Without a slash at the beginning."""


def sensor_indices(
    sensors: Sequence[BagSensor],
    *,
    count: int | None,
    ring_names: Sequence[str],
    given: Mapping[str, int],
    name: str,
    note: Callable[[str], None],
    places: Sequence[int] | None = None,
) -> list[int | None]:
    """Index in the ring of each sensor; None for sensors that are left out.

    The names that a person gave decide, then those of the ring. Without any, the numbers in all frames or in all topics
    are used, if they can only be indices from 0.

    Args:
        sensors: the sensors.
        count: number of sensors of the ring; None if it is unknown.
        ring_names: ``Ring.names``.
        given: index by name, a topic or a frame.
        name: name of the bag in error messages.
        note: called with one line for each choice.
        places: index of each sensor by the place of its frame, which a question proposes; None if unknown.

    Raises:
        SonarError: the names do not tell which sensor is which; the message says what to write.
    """
    if given or any(ring_names):
        return _by_names(sensors, count, ring_names, given, name, note)
    if len(sensors) == count == 1:
        note(f"sensors: the only one, {_label(sensors, 0)}, is that of the ring")
        return [0]
    found: dict[str, _Numbers] = {}
    for kind in ("frame", "topic"):
        if (numbers := _numbers([getattr(one, kind).lstrip("/") for one in sensors])) is not None:
            found[kind] = numbers
    usable = {kind: one for kind, one in found.items() if one.are_indices(count)}
    if len({tuple(one.values) for one in usable.values()}) == 1:
        kind, numbers = next(iter(usable.items()))
        _note_numbers(sensors, kind, numbers.values, count, note)
        return list(numbers.values)
    raise SonarError(f"{shown(name)}: {_question(sensors, found, usable, count, places)}")


def name_numbers(sensors: Sequence[BagSensor]) -> tuple[int, ...] | None:
    """Different numbers in the frames or in the topics of all sensors, in which the names differ; None without any."""
    for kind in ("frame", "topic"):
        found = _numbers([getattr(one, kind).lstrip("/") for one in sensors])
        if found is not None and found.alike:
            return found.values
    return None


@dataclass(frozen=True)
class _Numbers:
    """Different numbers in the names of all sensors."""

    values: tuple[int, ...]
    alike: bool
    """Whether the names differ in these numbers only."""

    def are_indices(self, count: int | None) -> bool:
        """Whether the numbers can only be indices from 0 of a ring with this many sensors.

        Numbers without 0 may count from 1. A single name does not show which of its digits is a number.
        """
        if len(self.values) < 2 or 0 not in self.values or (count is not None and max(self.values) >= count):
            return False
        complete = max(self.values) + 1 == len(self.values) and count in (None, len(self.values))
        return complete or self.alike


def _numbers(names: Sequence[str]) -> _Numbers | None:
    """The numbers in names: what differs between names that are alike, otherwise the last number of each."""
    digits = [[int(one) for one in re.findall(r"\d{1,9}", name)] for name in names]
    if not all(digits):
        return None
    alike = len({re.sub(r"\d{1,9}", "#", name) for name in names}) == 1
    if alike and len(names) > 1:
        columns = {column for column in zip(*digits, strict=True) if len(set(column)) > 1}
        values = columns.pop() if len(columns) == 1 else ()
    else:
        values = tuple(one[-1] for one in digits)
    return _Numbers(values, alike) if values and len(set(values)) == len(values) else None


def _by_names(
    sensors: Sequence[BagSensor],
    count: int | None,
    ring_names: Sequence[str],
    given: Mapping[str, int],
    name: str,
    note: Callable[[str], None],
) -> list[int | None]:
    index: list[int | None] = [None] * len(sensors)
    for one, k in given.items():
        if k < 0 or (count is not None and k >= count):
            allowed = f"0 to {count - 1}, the sensors of the ring" if count else "0 or more"
            raise SonarError(f"--sensor {shown(one)}={k}: allowed are indices {allowed}")
        if not (matching := _matching(sensors, one)):
            raise SonarError(f"{shown(name)}: --sensor {shown(one)}={k}: no such sensor; {_came(sensors)}")
        _assign(sensors, index, matching, one, k, name)
    missing = []
    for k, one in enumerate(ring_names):
        if not one or k in index:
            continue
        matching = [row for row in _matching(sensors, one) if index[row] is None]
        if matching:
            _assign(sensors, index, matching, one, k, name)
        else:
            missing.append(f"{k} ({one})")
    used = [row for row, k in enumerate(index) if k is not None]
    if not used:
        names = ", ".join(one for one in ring_names if one)
        raise SonarError(
            f"{shown(name)}: none of the sensors that the ring names came ({shown(names)}); {_came(sensors)}"
        )
    pairs = ", ".join(f"{_label(sensors, row)} = {index[row]}" for row in sorted(used, key=lambda row: index[row] or 0))
    note(f"sensors: {len(used)} by name: {shown(pairs, 1000)}")
    if missing:
        note(f"sensors of the ring without messages: {shown(', '.join(missing), 400)}")
    if left := [_label(sensors, row) for row, k in enumerate(index) if k is None]:
        note(f"sensors left out, because they have no name in the ring: {shown(', '.join(left), 400)}")
    return index


def _assign(
    sensors: Sequence[BagSensor], index: list[int | None], matching: list[int], one: str, k: int, name: str
) -> None:
    """Give an index to the sensor that a name matches."""
    if len(matching) > 1:
        found = ", ".join(f"{sensors[row].topic} ({sensors[row].frame or 'no frame'})" for row in matching)
        raise SonarError(
            f"{shown(name)}: {len(matching)} sensors have the name {shown(one)}: {shown(found)}; "
            f"name the topic instead: --sensor {shown(sensors[matching[0]].topic)}={k}"
        )
    row = matching[0]
    if k in index or index[row] not in (None, k):
        other = index.index(k) if k in index else row
        came = f"{_label(sensors, row)} and {_label(sensors, other)} came for sensor {k}"
        if other == row:
            came = f"indices {index[row]} and {k} came for {_label(sensors, row)}"
        raise SonarError(f"{shown(name)}: {came}; allowed is one index for each sensor")
    index[row] = k


def _matching(sensors: Sequence[BagSensor], name: str) -> list[int]:
    """Rows of the sensors with a name: exactly, without the first slash, or as the last part of a longer name."""
    bare = name.strip("/")
    kinds = ("topic", "frame") if name.startswith("/") else ("frame", "topic")
    for is_match in (lambda text: text.lstrip("/") == bare, lambda text: text.endswith(f"/{bare}")):
        for kind in kinds:
            if found := [row for row, one in enumerate(sensors) if bare and is_match(getattr(one, kind))]:
                return found
    return []


def _note_numbers(
    sensors: Sequence[BagSensor], kind: str, values: Sequence[int], count: int | None, note: Callable[[str], None]
) -> None:
    names = [getattr(sensors[row], kind) for row in sorted(range(len(values)), key=lambda row: values[row])]
    note(f"sensors: {len(names)} by the numbers of their {kind}s, {shown(names[0])} to {shown(names[-1])}")
    if missing := sorted(set(range(count or max(values) + 1)) - set(values)):
        note(f"sensors of the ring without messages: {', '.join(map(str, missing))}")


def _question(
    sensors: Sequence[BagSensor],
    found: Mapping[str, _Numbers],
    usable: Mapping[str, _Numbers],
    count: int | None,
    places: Sequence[int] | None,
) -> str:
    """What came, why it does not tell the sensors apart, and what to write."""
    labels = _labels(sensors)
    numbers = found.get("frame") or found.get("topic")
    values = range(len(sensors)) if numbers is None else numbers.values
    order = sorted(range(len(sensors)), key=lambda row: values[row])
    proposed, condition = ["INDEX"] * len(sensors), ""
    if places is not None:
        proposed, condition = places, ", which is where the transforms place them"
        order.sort(key=lambda row: places[row])
    elif numbers is not None and min(values) == 1 and len(sensors) == count:
        proposed, condition = [k - 1 for k in values], f", if {labels[order[0]]} is sensor 0"
    written = " ".join(f"--sensor {labels[row]}={proposed[row]}" for row in order[:_MOST_SHOWN])
    written += " ..." if len(order) > _MOST_SHOWN else ""
    names = 'frame = "..." or topic = "..." in each [[sensor]] of the ring'
    why = "the numbers of frames and topics contradict each other" if len(usable) > 1 else _why(labels, numbers, count)
    return f"{_came(sensors)}; {why}; write {shown(written, 2000)}{condition}, or {names}"


def _why(labels: Sequence[str], numbers: _Numbers | None, count: int | None) -> str:
    """Why names do not tell the sensors apart."""
    last = "" if count is None else f" 0 to {count - 1}"
    if numbers is None:
        shared = [one for one, times in Counter(labels).items() if times > 1]
        return (
            f"{shared[0]} came more than once" if shared else "these names do not tell which sensor of the ring each is"
        )
    low, high = min(numbers.values), max(numbers.values)
    if (count is not None and high > count) or (low == 0 and len(labels) > 1):
        return f"the numbers {low} to {high} are not those of the ring's sensors{last}"
    if high == count or (count is None and low == 1):
        return f"the numbers {low} to {high} seem to count from 1, the ring's sensors are{last or ' counted from 0'}"
    return f"these names do not show whether they count from 0 or from 1, the ring's sensors are{last}"


def _came(sensors: Sequence[BagSensor]) -> str:
    labels = _labels(sensors)
    listed = ", ".join(labels[:_MOST_SHOWN]) + (" ..." if len(labels) > _MOST_SHOWN else "")
    return f"the ultrasound sensors {shown(listed, 1500)} came"


def _labels(sensors: Sequence[BagSensor]) -> list[str]:
    """Names of sensors in messages: their frames, or their topics if the frames are not all different."""
    frames = [one.frame for one in sensors]
    if all(frames) and len(set(frames)) == len(frames):
        return frames
    topics = [one.topic for one in sensors]
    return topics if len(set(topics)) == len(topics) else [f"{one.topic} ({one.frame or '?'})" for one in sensors]


def _label(sensors: Sequence[BagSensor], row: int) -> str:
    return _labels(sensors)[row]
