"""Accuracy of a map against a reference: matched walls, their deviations, precision and recall."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.evaluation.settings import SETTINGS
from jaxsonar.geometry.segments import cross, lengths
from jaxsonar.hardware.errors import SonarError


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A map compared with a reference. A pair is a segment of the map and its nearest reference along a piece of it.

    Nothing depends on the frame that both share.
    """

    segment: Int[np.ndarray, " pairs"]
    """Row of the segment of the map."""
    reference: Int[np.ndarray, " pairs"]
    """Row of the segment of the reference."""
    overlap: Float[np.ndarray, " pairs"]
    """Length of the piece, metres."""
    distance: Float[np.ndarray, " pairs"]
    """Signed distance of the map's line from the reference, at the middle of the piece, metres: positive to the left of
    the reference's start -> end, which is the robot's side in references from a laser."""
    angle: Float[np.ndarray, " pairs"]
    """Angle from the reference to the map's line, radians, counter-clockwise, in [-pi/2, pi/2)."""
    segment_length: Float[np.ndarray, " segments"]
    """Length of each segment of the map, metres."""
    segment_matched: Float[np.ndarray, " segments"]
    """Length of its part that lies on the reference, metres."""
    reference_length: Float[np.ndarray, " references"]
    """Length of each segment of the reference, metres."""
    reference_covered: Float[np.ndarray, " references"]
    """Length of its part that a segment of the map covers, metres."""

    @property
    def precision_length(self) -> float:
        """Fraction of the map's length that lies on the reference; NaN without a map."""
        return _ratio(self.segment_matched.sum(), self.segment_length.sum())

    @property
    def precision(self) -> float:
        """Fraction of the map's segments of which at least half lies on the reference; NaN without a map."""
        return _mean(_at_least_half(self.segment_matched, self.segment_length))

    @property
    def recall_length(self) -> float:
        """Fraction of the reference's length that is covered; NaN without a reference."""
        return _ratio(self.reference_covered.sum(), self.reference_length.sum())

    @property
    def recall(self) -> float:
        """Fraction of the reference's segments of which at least half is covered; NaN without a reference."""
        return _mean(_at_least_half(self.reference_covered, self.reference_length))

    def as_json(self) -> dict[str, Any]:
        """Plain numbers for a JSON file, SI units and radians; null for NaN."""
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
            "distance_max_m": max_abs(self.distance),
            "distance_rms_m": rms(self.distance),
            "angle_max_rad": max_abs(self.angle),
            "angle_rms_rad": rms(self.angle),
        }
        known = {name: None if math.isnan(value) else value for name, value in summary.items()}
        names = ("segment", "reference", "overlap_m", "distance_m", "angle_rad")
        return known | {"pairs": [dict(zip(names, pair, strict=True)) for pair in pairs]}


def evaluate(
    segments: Float[np.ndarray, "segments 2 2"],
    reference: Float[np.ndarray, "references 2 2"],
    *,
    gate_distance: float = SETTINGS.maps.gate_distance,
    gate_angle: float = SETTINGS.maps.gate_angle,
) -> Evaluation:
    """Compare the segments of a map with those of a reference, both in one frame, metres.

    A piece of a segment lies on a reference if they are side by side, closer than ``gate_distance`` (perpendicular to
    the reference), and the angle between them is below ``gate_angle``. If several references are that close, the
    deviations are those from the nearest one. Pieces shorter than 5 cm count for the lengths only.

    Args:
        segments: ends of the map's segments.
        reference: ends of the true walls (``map_geojson.load_walls``).
        gate_distance: metres.
        gate_angle: radians, at most a right angle.

    Raises:
        SonarError: ends that are not finite, or gates out of range.
    """
    for name, ends in (("map", segments), ("reference", reference)):
        if not np.isfinite(ends).all():
            raise SonarError(f"evaluate: a segment of the {name} is not finite; allowed are finite ends in metres")
    if not (0 < gate_distance < math.inf and 0 < gate_angle <= math.pi / 2):
        came = f"gates {gate_distance:g} m, {gate_angle:g} rad"
        raise SonarError(f"evaluate: {came}; allowed are a finite distance above 0, and above 0 to pi/2 rad")
    length, reference_length = lengths(segments), lengths(reference)
    along, across, angle = _relative_position(segments, reference)
    # Along a segment, from fraction 0 to 1, both coordinates are linear, so every piece is one interval of fractions.
    bounds = zip(
        _fractions_within(along, 0.0, reference_length),
        _fractions_within(across, -gate_distance, gate_distance),
        strict=True,
    )
    (low, low_across), (high, high_across) = bounds
    low, high = np.clip(np.maximum(low, low_across), 0.0, None), np.clip(np.minimum(high, high_across), None, 1.0)
    on = (high > low) & (np.abs(angle) < gate_angle)
    pieces = np.where(on[..., None], np.stack([low, high], axis=-1), 0.0)
    # Matched length of each segment, and covered length of each reference.
    on_reference = np.sort(along[..., :1] + pieces * (along[..., 1:] - along[..., :1]), axis=-1)
    matched = [union_length(piece[near]) * metres for piece, near, metres in zip(pieces, on, length, strict=True)]
    covered = [union_length(part[near]) for part, near in zip(on_reference.swapaxes(0, 1), on.T, strict=True)]
    # Deviations from the nearest reference.
    rows = [
        (index, wall, fraction * length[index], across[index, wall] @ [1 - middle, middle], angle[index, wall])
        for index in range(len(segments))
        for wall, fraction, middle in _nearest_references(pieces[index], across[index], np.flatnonzero(on[index]))
        if fraction * length[index] >= SETTINGS.maps.min_overlap
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


def max_abs(deviation: Float[np.ndarray, " pairs"]) -> float:
    """Largest absolute value; NaN for an empty array."""
    return float(np.abs(deviation).max()) if len(deviation) else math.nan


def rms(deviation: Float[np.ndarray, " pairs"]) -> float:
    """Root mean square; NaN for an empty array."""
    return float(np.sqrt(np.mean(deviation**2))) if len(deviation) else math.nan


def union_length(intervals: Float[np.ndarray, "intervals 2"]) -> float:
    """Length of the union of intervals (low, high)."""
    low, high = intervals[np.argsort(intervals[:, 0])].T
    so_far = np.maximum.accumulate(np.append(-np.inf, high))[:-1]
    return float(np.clip(high - np.maximum(low, so_far), 0.0, None).sum())


def _relative_position(
    segments: Float[np.ndarray, "segments 2 2"], reference: Float[np.ndarray, "references 2 2"]
) -> tuple[
    Float[np.ndarray, "segments references 2"],
    Float[np.ndarray, "segments references 2"],
    Float[np.ndarray, "segments references"],
]:
    """Both ends of each segment along and across each reference, metres, and the angle between their lines, radians.

    NaN if one of the two has no length.
    """
    run = reference[:, 1] - reference[:, 0]
    tangent = run / _nan_if_zero(lengths(reference))[:, None]
    offset = segments[:, None] - reference[:, None, 0, None].swapaxes(0, 1)
    along, across = (offset * tangent[:, None]).sum(-1), cross(tangent[:, None], offset)
    angle = np.arctan2(np.diff(across)[..., 0], np.diff(along)[..., 0]) + 0 * _nan_if_zero(lengths(segments))[:, None]
    return along, across, (angle + np.pi / 2) % np.pi - np.pi / 2  # lines are undirected


def _fractions_within(
    ends: Float[np.ndarray, "segments references 2"], low: Any, high: Any
) -> tuple[Float[np.ndarray, "segments references"], Float[np.ndarray, "segments references"]]:
    """First and last fraction of a segment at which a linear quantity, given at its ends, is from low to high."""
    start, change = ends[..., 0], np.diff(ends)[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        fractions = np.sort([(low - start) / change, (high - start) / change], axis=0)
    inside = (start >= low) & (start <= high)
    first = np.where(change == 0, np.where(inside, -np.inf, np.inf), fractions[0])
    return first, np.where(change == 0, np.where(inside, np.inf, -np.inf), fractions[1])


def _nearest_references(
    pieces: Float[np.ndarray, "references 2"],
    across: Float[np.ndarray, "references 2"],
    walls: Int[np.ndarray, " near"],
) -> Iterator[tuple[int, float, float]]:
    """The nearest reference along each part of a segment: (row, fraction of the segment, fraction at its middle)."""
    bounds = np.unique(pieces[walls])
    part, middle = np.diff(bounds), (bounds[1:] + bounds[:-1]) / 2
    inside = (pieces[walls, :1] < middle) & (middle < pieces[walls, 1:])
    # Distances at both ends of a part: at its middle, a line that crosses there would be as near as the wall itself.
    distance = sum(np.abs(across[walls, :1] * (1 - end) + across[walls, 1:] * end) for end in (bounds[:-1], bounds[1:]))
    first = np.argmin(np.where(inside, distance, np.inf), axis=0) if len(walls) else np.zeros(0, dtype=np.int64)
    for k, wall in enumerate(walls.tolist()):
        own = inside[k] & (first == k)
        if own.any():
            yield wall, float(part[own].sum()), float((part * middle)[own].sum() / part[own].sum())


def _nan_if_zero(length: Float[np.ndarray, " segments"]) -> Float[np.ndarray, " segments"]:
    return np.where(length > 0, length, np.nan)


def _at_least_half(
    part: Float[np.ndarray, " segments"], whole: Float[np.ndarray, " segments"]
) -> Bool[np.ndarray, " segments"]:
    """Whether the part is at least half of the whole; False without length."""
    return (part >= whole / 2) & (whole > 0)


def _mean(holds: Bool[np.ndarray, " segments"]) -> float:
    return float(holds.mean()) if len(holds) else math.nan


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0 else math.nan
