"""Walls and points with their uncertainties in one frame: the features of one scan, or a map of many scans."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.detection.local_model import LocalModel
from jaxsonar.geometry.se2 import tangent_of, transform_points, unit, wrap_angle
from jaxsonar.geometry.segments import point_to_segments
from jaxsonar.registration.settings import FEATURE_SETTINGS as SETTINGS


class Features(NamedTuple):
    """Walls and points. A wall has one side: its normal points away from the robot."""

    reference: Float[np.ndarray, "walls 2"]
    """A point near each wall, metres."""
    theta: Float[np.ndarray, " walls"]
    """Direction of the normal, radians."""
    offset: Float[np.ndarray, " walls"]
    """Signed distance from the reference to the wall along the normal, metres."""
    covariance: Float[np.ndarray, "walls 2 2"]
    """Of (offset, theta)."""
    extent: Float[np.ndarray, "walls 2"]
    """Observed interval along the tangent, from the reference, metres."""
    weight: Float[np.ndarray, " walls"]
    """Weight of each wall as a measurement, 0 to 1."""
    scans: Float[np.ndarray, " walls"]
    """Number of scans that observed each wall."""
    point: Float[np.ndarray, "points 2"]
    """Positions of corners and edges, metres."""
    is_corner: Bool[np.ndarray, " points"]
    point_sd: Float[np.ndarray, " points"]
    """Standard deviation of each coordinate, metres."""
    detections: Float[np.ndarray, "reflectors 2"] = np.zeros((0, 2))
    """(distance, direction) of every reflector of a scan, including undecided ones; empty for maps."""
    directions: Bool[np.ndarray, " directions"] | None = None
    """Directions that a scan measured (``scans.measured_directions``), robot frame; None: all of them."""

    @property
    def normal(self) -> Float[np.ndarray, "walls 2"]:
        """Unit normals of the walls."""
        return unit(self.theta)

    @property
    def tangent(self) -> Float[np.ndarray, "walls 2"]:
        """Unit tangents of the walls, the normals rotated by +90 degrees."""
        return tangent_of(self.theta)

    @property
    def rho(self) -> Float[np.ndarray, " walls"]:
        """Signed distances of the walls from the origin, metres."""
        return (self.reference * self.normal).sum(-1) + self.offset

    @property
    def half_length(self) -> Float[np.ndarray, " walls"]:
        """Half the lengths of the observed parts, metres."""
        return (self.extent[:, 1] - self.extent[:, 0]) / 2

    @property
    def middle(self) -> Float[np.ndarray, "walls 2"]:
        """Centers of the observed parts, metres."""
        return self._on_wall(self.extent.mean(axis=1))

    @property
    def segment(self) -> Float[np.ndarray, "walls 2 2"]:
        """End points of the observed parts, metres."""
        return np.stack([self._on_wall(self.extent[:, 0]), self._on_wall(self.extent[:, 1])], axis=1)

    @property
    def radius(self) -> float:
        """Distance of the farthest feature from the origin, metres."""
        ends = np.concatenate([self.segment.reshape(-1, 2), self.point])
        return float(np.linalg.norm(ends, axis=1).max(initial=0.0))

    def _on_wall(self, along: Float[np.ndarray, " walls"]) -> Float[np.ndarray, "walls 2"]:
        return self.reference + self.offset[:, None] * self.normal + along[:, None] * self.tangent

    def offset_variance(self, along: Float[np.ndarray, "*batch walls"]) -> Float[np.ndarray, "*batch walls"]:
        """Variances of the walls' positions across, at distances along the tangent from the reference."""
        cov = self.covariance
        return cov[:, 0, 0] + 2 * along * cov[:, 0, 1] + along**2 * cov[:, 1, 1]

    def beyond(self, along: Float[np.ndarray, "*batch walls"]) -> Float[np.ndarray, "*batch walls"]:
        """Distances of positions along the walls from the observed parts, metres; negative within."""
        return np.maximum(self.extent[:, 0] - along, along - self.extent[:, 1])

    def transform(self, new_from_old: Float[np.ndarray, "3"]) -> "Features":
        """The same features in another frame."""
        return self._replace(
            reference=transform_points(new_from_old, self.reference),
            theta=wrap_angle(self.theta + new_from_old[2]),
            point=transform_points(new_from_old, self.point),
        )

    def within(self, center: Float[np.ndarray, "2"], radius: float) -> "Features":
        """The walls that reach into a circle, and the points in it."""
        walls = (point_to_segments(center[None], self.segment)[0] if len(self.theta) else np.zeros(0)) < radius
        return self.take(walls, np.linalg.norm(self.point - center, axis=1) < radius)

    def take(self, walls: Bool[np.ndarray, " walls"], points: Bool[np.ndarray, " points"]) -> "Features":
        """Some of the walls and points, without detections."""
        return Features(*(column[walls] for column in self[:7]), *(column[points] for column in self[7:10]))

    def as_measurement(self, sd_floor: tuple[float, float, float]) -> "Features":
        """The features as one independent measurement: walls refer to their centers, and noise is added.

        Args:
            sd_floor: added standard deviations: walls across (m) and direction (rad), points (m).
        """
        variance = np.stack([self.offset_variance(self.extent.mean(axis=1)), self.covariance[:, 1, 1]], axis=-1)
        half = self.half_length
        return self._replace(
            reference=self.middle,
            offset=np.zeros(len(half)),
            covariance=(variance + np.square(sd_floor[:2]))[:, :, None] * np.eye(2),
            extent=np.stack([-half, half], axis=-1),
            point_sd=np.sqrt(self.point_sd**2 + sd_floor[2] ** 2),
        )


def no_features() -> Features:
    """An empty map."""
    walls, none = np.zeros((0, 2)), np.zeros(0)
    return Features(walls, none, none, np.zeros((0, 2, 2)), walls, none, none, walls, np.zeros(0, dtype=bool), none)


def scan_features(
    model: LocalModel, *, noise_scale: float = 1.0, directions: Bool[np.ndarray, " directions"] | None = None
) -> Features:
    """Features of a local model in the robot frame.

    Args:
        model: lines, points and undecided reflectors of one scan.
        noise_scale: factor on the added noise: 1 for an uncalibrated ring, less for a calibrated one.
        directions: directions that the scan measured; None: all of them.
    """
    theta = np.array([line.theta for line in model.lines], dtype=np.float64)
    segment = np.array([line.segment for line in model.lines], dtype=np.float64).reshape(-1, 2, 2)
    cov = np.array([np.zeros((2, 2)) if line.cov is None else line.cov for line in model.lines], dtype=np.float64)
    cov = cov.reshape(-1, 2, 2)
    middle = segment.mean(axis=1)
    along = (middle * tangent_of(theta)).sum(-1)
    across = np.maximum(cov[:, 0, 0] - 2 * along * cov[:, 0, 1] + along**2 * cov[:, 1, 1], 0.0)
    variance = np.stack([across, cov[:, 1, 1]], axis=-1) + np.square(noise_scale * np.array(SETTINGS.wall_sd_floor))
    half = np.linalg.norm(segment[:, 1] - segment[:, 0], axis=-1) / 2
    # A corner that two walls of the same scan already imply carries no additional information.
    points = [one for one in model.points if not _is_wall_crossing(np.array([one.x, one.y]), model)]
    noise = np.array([np.trace(one.cov[:2, :2]) / 2 for one in points], dtype=np.float64)
    reflectors = [(line.rho, line.theta) for line in model.lines]
    reflectors += [(other.rho, other.theta) for other in model.undecided]
    reflectors += [(float(np.hypot(one.x, one.y)), float(np.arctan2(one.y, one.x))) for one in model.points]
    echoes = np.array([line.echoes for line in model.lines], dtype=np.float64)
    return Features(
        reference=middle,
        theta=theta,
        offset=np.zeros(len(theta)),
        covariance=variance[:, :, None] * np.eye(2),
        extent=np.stack([-half, half], axis=-1),
        weight=np.clip(echoes / SETTINGS.full_weight_echoes, SETTINGS.min_weight, 1.0),
        scans=np.ones(len(theta)),
        point=np.array([(one.x, one.y) for one in points], dtype=np.float64).reshape(-1, 2),
        is_corner=np.array([one.kind == "corner" for one in points], dtype=bool),
        point_sd=np.sqrt(noise + (noise_scale * SETTINGS.point_sd_floor) ** 2),
        detections=np.array(reflectors, dtype=np.float64).reshape(-1, 2),
        directions=directions,
    )


def _is_wall_crossing(point: Float[np.ndarray, "2"], model: LocalModel) -> bool:
    """Whether two lines of the scan cross at a point."""
    theta = np.array([line.theta for line in model.lines], dtype=np.float64)
    rho = np.array([line.rho for line in model.lines], dtype=np.float64)
    near = theta[np.abs(unit(theta) @ point - rho) < SETTINGS.position_tolerance]
    return bool((np.abs(np.sin(near[:, None] - near)) > SETTINGS.crossing_sine).any())


def landmark_features(
    landmarks: kernels.Landmarks,
    covariance: Float[np.ndarray, "landmarks 2 2"],
    scan_counts: Float[np.ndarray, " landmarks"] | Int[np.ndarray, " landmarks"],
) -> Features:
    """Landmarks as features in the same frame.

    Args:
        landmarks: walls, corners and edges, without unused rows.
        covariance: of the parameters of each landmark.
        scan_counts: number of scans that observed each landmark.
    """
    wall, corner = np.asarray(landmarks.kind) == kernels.PLANE, np.asarray(landmarks.kind) == kernels.CORNER
    parameters, anchor = np.asarray(landmarks.parameters), np.asarray(landmarks.anchor)
    return Features(
        reference=anchor[wall],
        theta=parameters[wall, 1],
        offset=parameters[wall, 0],
        covariance=covariance[wall],
        extent=np.asarray(landmarks.extent)[wall],
        weight=np.ones(int(wall.sum())),
        scans=scan_counts[wall].astype(np.float64),
        point=anchor[~wall] + parameters[~wall],
        is_corner=corner[~wall],
        point_sd=np.sqrt(np.trace(covariance[~wall], axis1=1, axis2=2) / 2),
    )


def crosses_walls(
    walls: Features,
    start: Float[np.ndarray, "poses lines 2"],
    end: Float[np.ndarray, "poses lines 2"],
    *,
    start_margin: float,
    end_margin: float,
    border: float,
) -> Bool[np.ndarray, "poses lines walls"]:
    """Whether straight lines pass through the observed parts of walls.

    Args:
        walls: the walls.
        start: start points of the lines, in the frame of the walls, metres.
        end: their end points.
        start_margin: smallest distance of the start point from the wall, metres.
        end_margin: the same for the end point.
        border: distance from the ends of the observed part within which a crossing does not count, metres.
    """
    tangent, normal = walls.tangent, walls.normal
    first, last = start[:, :, None] - walls.reference, end[:, :, None] - walls.reference
    before, behind = (first * normal).sum(-1) - walls.offset, (last * normal).sum(-1) - walls.offset
    apart = np.where(np.abs(before - behind) > 1e-9, before - behind, 1e-9)
    along = (first * tangent).sum(-1) + before / apart * ((last - first) * tangent).sum(-1)
    through = (before * behind < 0) & (np.abs(before) > start_margin) & (np.abs(behind) > end_margin)
    return through & (along > walls.extent[:, 0] + border) & (along < walls.extent[:, 1] - border)
