"""Corrections of logs: mistakes in units, headings, axes and the numbering of sensors, undone."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.plausibility.pose_agreement import bounded
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


@dataclass(frozen=True)
class CorrectionSettings:
    """Which corrections are tried. Chosen by hand."""

    least_extent: float = 0.05
    """A robot whose trajectory is smaller than this in another unit does not move, metres: the unit is not tried."""
    even: float = float(np.radians(0.5))
    """A ring is evenly spaced if no heading differs by more, radians."""


SETTINGS = CorrectionSettings()

_OF_SENSORS = ("position", "heading", "beam", "range_offset")
"""Fields of a ring that belong to a place of a sensor."""

_LENGTH_UNITS = (
    (1e-3, "millimetres", "mm"),
    (1e-2, "centimetres", "cm"),
    (0.0254, "inches", "in"),
    (0.3048, "feet", "ft"),
)
"""Metres per unit, its name, and its abbreviation."""

Poses = Float[np.ndarray, "poses 3"]


@dataclass(frozen=True, eq=False)
class Correction:
    """One mistake in the description of a log, and how it is undone."""

    kind: str
    """Kind of the mistake, as in ``Implausibility``."""
    mistake: str
    """The mistake in words, such as "the headings are in degrees"."""
    remedy: str
    """What to do."""
    apply: Callable[[Log], Log]
    """Gives the corrected log; it has the same scans and readings in the same order."""
    equivalents: tuple[str, ...] = ()
    """Other mistakes with the same effect, in words."""
    order: Int[np.ndarray, " sensors"] | None = None
    """Of another numbering: sensor k of the log is sensor ``order[k]`` of the ring."""

    def describe(self, ring: Ring, log: Log) -> tuple[Ring, Log]:
        """The corrected ring and log. The sensors keep their numbers, so that findings about them hold for the log."""
        if self.order is None:
            return ring, self.apply(log)
        columns = {name: np.asarray(getattr(ring, name))[self.order] for name in _OF_SENSORS}
        return replace(ring, **columns), log


def heading_corrections() -> list[Correction]:
    """Headings in degrees, clockwise, or as a compass shows them."""
    degrees, clockwise, compass = np.pi / 180, "clockwise", "compass headings"
    rows = (
        ("heading unit", "in degrees", "give radians", "--angle-unit deg", degrees, 0.0),
        ("heading direction", f"{clockwise}", "negate theta", "--clockwise", -1.0, 0.0),
        (
            "heading direction",
            f"{compass}, {clockwise} from the y axis",
            "give pi / 2 - theta",
            "--compass",
            -1.0,
            np.pi / 2,
        ),
        (
            "heading unit",
            f"in degrees and {clockwise}",
            "give radians, counter-clockwise",
            "--angle-unit deg --clockwise",
            -degrees,
            0.0,
        ),
        (
            "heading unit",
            f"{compass} in degrees, {clockwise} from the y axis",
            "give radians, counter-clockwise from x",
            "--angle-unit deg --compass",
            -degrees,
            np.pi / 2,
        ),
    )
    return [
        Correction(kind, f"the headings are {what}", f"{remedy} (of a table: {option})", _headings(scale, offset))
        for kind, what, remedy, option, scale, offset in rows
    ]


def axis_corrections() -> list[Correction]:
    """Axes of the positions that are swapped or negated."""

    def positions(matrix: list[list[float]]) -> Callable[[Log], Log]:
        return _poses(lambda pose: np.column_stack([pose[:, :2] @ np.array(matrix).T, pose[:, 2]]))

    return [
        Correction("axes", "x and y of the poses are swapped", "swap them", positions([[0.0, 1.0], [1.0, 0.0]])),
        Correction(
            "axes",
            "y of the poses is negated",
            "give y that grows to the left of x (of a table: --y-right)",
            positions([[1.0, 0.0], [0.0, -1.0]]),
        ),
        Correction("axes", "x of the poses is negated", "negate it", positions([[-1.0, 0.0], [0.0, 1.0]])),
    ]


def pose_unit_corrections(log: Log) -> list[Correction]:
    """Positions in another unit, if the robot moves at all in this unit."""
    position = bounded(log.pose[np.isfinite(log.pose).all(axis=1)])[:, :2]
    extent = float(np.ptp(position, axis=0).max()) if len(position) else 0.0
    found = []
    for unit, name, short in _LENGTH_UNITS:
        if extent * unit >= SETTINGS.least_extent:
            scale = np.array([unit, unit, 1.0])
            action = f"divide x and y by {1 / unit:g}" if unit <= 0.01 else f"multiply x and y by {unit:g}"
            remedy = f"give metres: {action} (of a table: --pose-unit {short})"
            apply = _poses(lambda pose, scale=scale: pose * scale)
            found.append(Correction("pose unit", f"x and y of the poses are in {name}", remedy, apply))
    return found


def turned_rings(ring: Ring) -> list[Correction]:
    """A ring that is mounted at another angle, or mirrored, which no renumbering of its sensors describes."""
    found = []
    if _is_even(ring):
        angles = [np.pi / ring.count, -np.pi / ring.count]
    else:
        spacings = 2 * np.pi * np.arange(1, ring.count) / ring.count
        angles = np.unique(np.round(wrap_angle(np.append(spacings, [np.pi / 2, -np.pi / 2, np.pi])), 9))
        mirror = _poses(lambda pose: pose * [1.0, -1.0, -1.0])
        remedy = "negate y and the headings of the sensors of the ring, or of the poses"
        frame = ("y and the headings are those of a frame with z down",)
        found.append(Correction("sensor order", "the ring is mirrored", remedy, mirror, frame))
    for angle in angles:
        degrees = f"{np.degrees(angle):+.4g} deg"
        remedy = f"add {degrees} to the headings of the ring, and turn its positions likewise"
        found.append(Correction("first sensor", f"the ring is rotated by {degrees}", remedy, _headings(1.0, angle)))
    return found


def renumbering(ring: Ring, shift: int, *, clockwise: bool) -> Correction:
    """Another numbering of the sensors.

    Args:
        ring: the sensors.
        shift: sensor k of the log is sensor k + shift of the ring, modulo the number of sensors; ...
        clockwise: ... or sensor shift - k.
    """
    count = ring.count
    order = ((-1 if clockwise else 1) * np.arange(count) + shift) % count
    apply = _renumbered(order)
    if clockwise:
        first = f", from sensor {shift} of the ring" if shift else ""
        remedy = f"replace the sensor numbers k by {shift or count} - k (modulo {count}) in tx and rx"
        frame = "the ring is mirrored" + ("" if shift else ": y and the headings are those of a frame with z down")
        return Correction("sensor order", f"the sensors are numbered clockwise{first}", remedy, apply, (frame,), order)
    if shift == count - 1:
        other = f"the ring is rotated by one sensor{_angle(ring, -1)}"
        remedy = "subtract 1 from tx and rx, or turn the headings of the ring"
        return Correction("first sensor", "the sensors are numbered from 1", remedy, apply, (other,), order)
    by = shift if shift <= count // 2 else shift - count
    plural = "s" * (abs(by) != 1)
    mistake = f"the ring is rotated by {abs(by)} sensor{plural}{_angle(ring, by)}"
    remedy = f"add {shift} to tx and rx (modulo {count}), or turn the headings of the ring"
    half = ("x and y of the poses are both negated",) if _is_even(ring) and 2 * shift == count else ()
    return Correction("first sensor", mistake, remedy, apply, half, order)


def _angle(ring: Ring, shift: int) -> str:
    """The angle of a shift in an evenly spaced ring, in words."""
    return f" ({shift * 360 / ring.count:+.4g} deg)" if _is_even(ring) else ""


def _is_even(ring: Ring) -> bool:
    """Whether the sensors are evenly spaced, counter-clockwise."""
    steps = wrap_angle(np.diff(np.asarray(ring.heading)) - 2 * np.pi / ring.count)
    return bool((np.abs(steps) < SETTINGS.even).all())


def _headings(scale: float, offset: float) -> Callable[[Log], Log]:
    return _poses(lambda pose: np.column_stack([pose[:, :2], offset + scale * pose[:, 2]]))


def _poses(change: Callable[[Poses], Poses]) -> Callable[[Log], Log]:
    """A change of all poses of a log, those of its odometry included."""

    def apply(log: Log) -> Log:
        motion = log.motion
        samples = None if motion is None else np.column_stack([motion[:, 0], change(motion[:, 1:])])
        return replace(log, pose=change(log.pose), odometry=samples)

    return apply


def _renumbered(order: Int[np.ndarray, " sensors"]) -> Callable[[Log], Log]:
    """Other numbers of sensors: k becomes ``order[k]``, and the first number beyond the ring that of sensor 0."""

    def renumber(sensor: np.ndarray) -> np.ndarray:
        return np.where(sensor <= len(order), order[sensor % len(order)], sensor)

    def apply(log: Log) -> Log:
        return replace(log, tx=renumber(log.tx), rx=renumber(log.rx), asked=renumber(log.asked))

    return apply
