"""A map held against a reference: which walls are there, how far off, how much of each is the other.

Nothing depends on the frame that both share: distances between lines, turns and lengths along them are measured.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.evaluation.laser_segments import lengths
from jaxsonar.floor_plans.room import cross
from jaxsonar.hardware.errors import SonarError

GATE_DISTANCE = 0.15
"""Metres up to which a piece of the map is that wall."""
GATE_ANGLE = math.radians(10.0)
"""Radians up to which it is."""
_LEAST_OVERLAP = 0.05  # m; a shorter one says nothing about how far off a wall is


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A map against a reference; a pair is a segment of the map and the nearest reference along a piece of it."""

    segment: Int[np.ndarray, " pairs"]
    """Segment of the map."""
    reference: Int[np.ndarray, " pairs"]
    """Segment of the reference."""
    overlap: Float[np.ndarray, " pairs"]
    """Length of the piece, metres."""
    distance: Float[np.ndarray, " pairs"]
    """Signed distance of the map's line from the reference, in the middle of the piece, metres: positive to the left of
    the reference's start -> end, which is where the robot is in references from a laser."""
    angle: Float[np.ndarray, " pairs"]
    """Turn from the reference to the map's line, radians, counter-clockwise; lines have no direction."""
    segment_length: Float[np.ndarray, " segments"]
    """Length of each segment of the map, metres."""
    segment_matched: Float[np.ndarray, " segments"]
    """How much of it lies on the reference, metres."""
    reference_length: Float[np.ndarray, " references"]
    """Length of each segment of the reference, metres."""
    reference_covered: Float[np.ndarray, " references"]
    """How much of it has a segment of the map on it, metres."""

    @property
    def precision_length(self) -> float:
        """Share of the map's length that lies on the reference; NaN without a map."""
        return _share(self.segment_matched.sum(), self.segment_length.sum())

    @property
    def precision(self) -> float:
        """Share of the map's segments of which at least half does; NaN without a map."""
        return _mean(_half(self.segment_matched, self.segment_length))

    @property
    def recall_length(self) -> float:
        """Share of the reference's length that is covered; NaN without a reference."""
        return _share(self.reference_covered.sum(), self.reference_length.sum())

    @property
    def recall(self) -> float:
        """Share of the reference's segments of which at least half is covered; NaN without a reference."""
        return _mean(_half(self.reference_covered, self.reference_length))

    def as_json(self) -> dict[str, Any]:
        """Plain numbers for a JSON file; null where there is nothing to tell. SI units and radians."""
        columns = (self.segment, self.reference, self.overlap, self.distance, self.angle)
        pairs = zip(*(column.tolist() for column in columns), strict=True)
        summary = {
            "segments": len(self.segment_length),
            "references": len(self.reference_length),
            "segment_length_m": float(self.segment_length.sum()),
            "reference_length_m": float(self.reference_length.sum()),
            "matched_length_m": float(self.segment_matched.sum()),
            "covered_length_m": float(self.reference_covered.sum()),
            "precision": self.precision,
            "precision_length": self.precision_length,
            "recall": self.recall,
            "recall_length": self.recall_length,
            "distance_max_m": largest(self.distance),
            "distance_rms_m": rms(self.distance),
            "angle_max_rad": largest(self.angle),
            "angle_rms_rad": rms(self.angle),
        }
        known = {name: None if math.isnan(value) else value for name, value in summary.items()}
        names = ("segment", "reference", "overlap_m", "distance_m", "angle_rad")
        return known | {"pairs": [dict(zip(names, pair, strict=True)) for pair in pairs]}


def evaluate(
    segments: Float[np.ndarray, "segments 2 2"],
    reference: Float[np.ndarray, "references 2 2"],
    *,
    gate_distance: float = GATE_DISTANCE,
    gate_angle: float = GATE_ANGLE,
) -> Evaluation:
    """Hold the segments of a map against those of a reference, both in one frame, metres.

    A piece of a segment lies on a reference where the two are side by side, less than ``gate_distance`` apart (square
    to the reference) and turned by less than ``gate_angle``. Where several references lie that near, deviations are
    those from the nearest; pieces shorter than 5 cm count as length only.

    Args:
        segments: ends of the map's segments.
        reference: ends of the true walls (``mapfile.load_walls``).
        gate_distance: metres.
        gate_angle: radians, up to a right angle.

    Raises:
        SonarError: ends that are not finite, or gates that are none.
    """
    for name, ends in (("map", segments), ("reference", reference)):
        if not np.isfinite(ends).all():
            raise SonarError(f"evaluate: a segment of the {name} is not finite; allowed are finite ends in metres")
    if not (0 < gate_distance < math.inf and 0 < gate_angle <= math.pi / 2):
        came = f"gates {gate_distance:g} m, {gate_angle:g} rad"
        raise SonarError(f"evaluate: {came}; allowed are a finite distance above 0, and above 0 to pi/2 rad")
    length, reference_length = lengths(segments), lengths(reference)
    along, across, angle = _beside(segments, reference)
    # Along a segment of the map, from share 0 to 1, both are linear: so every piece is one interval of shares.
    bounds = zip(_shares(along, 0.0, reference_length), _shares(across, -gate_distance, gate_distance), strict=True)
    (low, low_across), (high, high_across) = bounds
    low, high = np.clip(np.maximum(low, low_across), 0.0, None), np.clip(np.minimum(high, high_across), None, 1.0)
    on = (high > low) & (np.abs(angle) < gate_angle)
    pieces = np.where(on[..., None], np.stack([low, high], axis=-1), 0.0)
    feet = np.sort(along[..., :1] + pieces * (along[..., 1:] - along[..., :1]), axis=-1)
    matched = [union(piece[near]) * metres for piece, near, metres in zip(pieces, on, length, strict=True)]
    covered = [union(foot[near]) for foot, near in zip(feet.swapaxes(0, 1), on.T, strict=True)]
    rows = [
        (index, wall, share * length[index], across[index, wall] @ [1 - middle, middle], angle[index, wall])
        for index in range(len(segments))
        for wall, share, middle in _nearest(pieces[index], across[index], np.flatnonzero(on[index]))
        if share * length[index] >= _LEAST_OVERLAP
    ]
    table = np.array(rows).reshape(-1, 5)
    return Evaluation(
        segment=table[:, 0].astype(np.int64),
        reference=table[:, 1].astype(np.int64),
        overlap=table[:, 2],
        distance=table[:, 3],
        angle=table[:, 4],
        segment_length=length,
        segment_matched=np.array(matched, dtype=np.float64),
        reference_length=reference_length,
        reference_covered=np.array(covered, dtype=np.float64),
    )


def largest(deviation: Float[np.ndarray, " pairs"]) -> float:
    """Largest absolute value; NaN of nothing."""
    return float(np.abs(deviation).max()) if len(deviation) else math.nan


def rms(deviation: Float[np.ndarray, " pairs"]) -> float:
    """Root of the mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(deviation**2))) if len(deviation) else math.nan


def union(intervals: Float[np.ndarray, "intervals 2"]) -> float:
    """Length of what intervals (low, high) cover together."""
    low, high = intervals[np.argsort(intervals[:, 0])].T
    so_far = np.maximum.accumulate(np.append(-np.inf, high))[:-1]
    return float(np.clip(high - np.maximum(low, so_far), 0.0, None).sum())


def _beside(
    segments: Float[np.ndarray, "segments 2 2"], reference: Float[np.ndarray, "references 2 2"]
) -> tuple[
    Float[np.ndarray, "segments references 2"],
    Float[np.ndarray, "segments references 2"],
    Float[np.ndarray, "segments references"],
]:
    """Both ends of each segment along and across each reference, metres, and the turn between their lines, radians.

    NaN where one of the two has no length.
    """
    run = reference[:, 1] - reference[:, 0]
    tangent = run / _known(lengths(reference))[:, None]
    offset = segments[:, None] - reference[:, None, 0, None].swapaxes(0, 1)
    along, across = (offset * tangent[:, None]).sum(-1), cross(tangent[:, None], offset)
    turn = np.arctan2(np.diff(across)[..., 0], np.diff(along)[..., 0]) + 0 * _known(lengths(segments))[:, None]
    return along, across, (turn + np.pi / 2) % np.pi - np.pi / 2  # a line has no direction


def _shares(
    ends: Float[np.ndarray, "segments references 2"], low: Any, high: Any
) -> tuple[Float[np.ndarray, "segments references"], Float[np.ndarray, "segments references"]]:
    """Between which shares of a segment something linear, given at its ends, is from low to high."""
    start, change = ends[..., 0], np.diff(ends)[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.sort([(low - start) / change, (high - start) / change], axis=0)
    inside = (start >= low) & (start <= high)
    first = np.where(change == 0, np.where(inside, -np.inf, np.inf), shares[0])
    return first, np.where(change == 0, np.where(inside, np.inf, -np.inf), shares[1])


def _nearest(
    pieces: Float[np.ndarray, "references 2"],
    across: Float[np.ndarray, "references 2"],
    walls: Int[np.ndarray, " near"],
) -> Iterator[tuple[int, float, float]]:
    """The reference nearest along each part of a segment: (which, share of the segment, share of its middle)."""
    bounds = np.unique(pieces[walls])
    part, middle = np.diff(bounds), (bounds[1:] + bounds[:-1]) / 2
    inside = (pieces[walls, :1] < middle) & (middle < pieces[walls, 1:])
    # At both ends of a part: in its middle, lines that cross there would be as near as the wall itself.
    away = sum(np.abs(across[walls, :1] * (1 - end) + across[walls, 1:] * end) for end in (bounds[:-1], bounds[1:]))
    first = np.argmin(np.where(inside, away, np.inf), axis=0) if len(walls) else np.zeros(0, dtype=np.int64)
    for k, wall in enumerate(walls.tolist()):
        mine = inside[k] & (first == k)
        if mine.any():
            yield wall, float(part[mine].sum()), float((part * middle)[mine].sum() / part[mine].sum())


def _known(length: Float[np.ndarray, " segments"]) -> Float[np.ndarray, " segments"]:
    """NaN instead of no length."""
    return np.where(length > 0, length, np.nan)


def _half(part: Float[np.ndarray, " segments"], whole: Float[np.ndarray, " segments"]) -> Bool[np.ndarray, " segments"]:
    """Whether at least half of each is there; of something without length nothing is."""
    return (part >= whole / 2) & (whole > 0)


def _mean(holds: Bool[np.ndarray, " segments"]) -> float:
    return float(holds.mean()) if len(holds) else math.nan


def _share(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0 else math.nan
