"""Negative evidence against poses of one scan in a map: blocked lines of sight, and walls that were not detected."""

import numpy as np
from jaxtyping import Float, Int

from jaxsonar.geometry.se2 import rotate, wrap_angle
from jaxsonar.geometry.segments import point_to_segments
from jaxsonar.registration.features import Features, crosses_walls
from jaxsonar.registration.settings import FEATURE_SETTINGS as SETTINGS
from jaxsonar.scans.measured_directions import direction_sector


def scan_negative_evidence(
    known: Features,
    scan: Features,
    poses: Float[np.ndarray, "poses 3"],
    wall: Int[np.ndarray, "poses lines"],
    *,
    reliable_range: float,
    start: Float[np.ndarray, "2"] | None,
) -> Float[np.ndarray, " poses"]:
    """Evidence against poses of a scan, nats.

    Args:
        known: the map.
        scan: features of the scan in the robot frame.
        poses: map_from_robot.
        wall: row of the wall that each wall of the scan is matched to; -1 where it is new.
        reliable_range: distance within which walls are surely detected, metres; with 0 there is no negative evidence.
        start: where the robot came from in a straight line; None if that is not known.
    """
    if not len(known.theta) or not reliable_range:
        return np.zeros(len(poses))
    # No wall lies between the robot and what it detected, or between the robot and its previous position.
    position = poses[:, :2]
    target = position[:, None] + rotate(np.concatenate([scan.middle, scan.point]), poses[:, 2, None])
    first, last = np.broadcast_arrays(position[:, None], position[:, None] + 0.9 * (target - position[:, None]))
    if start is not None:
        first = np.concatenate([first, position[:, None]], axis=1)
        last = np.concatenate([last, np.broadcast_to(start, position.shape)[:, None]], axis=1)
    nats = SETTINGS.blocked_sight_nats * _crosses(known, first, last).any(axis=-1).sum(-1).astype(float)
    on_wall = (point_to_segments(position, known.segment) < SETTINGS.min_wall_distance).any(axis=-1)
    nats += SETTINGS.blocked_sight_nats * on_wall
    # Near walls that face the robot and are not hidden are detected.
    displacement = position[:, None] - known.reference
    distance = known.offset - (displacement * known.normal).sum(-1)
    due = (distance > SETTINGS.min_detection_range) & (distance < reliable_range)
    foot = position[:, None] + 0.95 * distance[..., None] * known.normal
    due &= ~_crosses(known, np.broadcast_to(position[:, None], foot.shape), foot).any(axis=-1)
    near = np.abs(distance[..., None] - scan.detections[:, 0]) < SETTINGS.detection_match[0]
    turn = wrap_angle(known.theta[:, None] - poses[:, 2, None, None] - scan.detections[:, 1])
    due &= ~(near & (np.abs(turn) < SETTINGS.detection_match[1])).any(axis=-1)
    due &= ~(wall[..., None] == np.arange(len(known.theta))).any(axis=1)
    if scan.directions is not None:
        due &= scan.directions[direction_sector(known.theta - poses[:, 2, None])]
    # The farther the foot point is from the observed part, the less certain it is that the wall is there.
    beyond = np.maximum(known.beyond((displacement * known.tangent).sum(-1)), 0.0)
    probability = SETTINGS.detection_probability - np.where(
        known.scans > 1, 0.0, SETTINGS.single_scan_detection_penalty
    )
    probability = probability * np.exp(-beyond / SETTINGS.extension_scale)
    return nats - (np.log1p(-probability) * due).sum(-1)


def _crosses(known: Features, start: Float[np.ndarray, "..."], end: Float[np.ndarray, "..."]) -> np.ndarray:
    margin = SETTINGS.sight_margin
    return crosses_walls(known, start, end, start_margin=margin, end_margin=margin, border=margin)
