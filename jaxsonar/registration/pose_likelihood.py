"""What a map says to poses of a scan, in nats: what agrees, what is missing, and what lies in the way."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar.floor_plans.room import point_to_walls
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.registration.feature_map import Places, Seen, quarter, turned

GATE = 14.0
"""Largest squared distance, in standard deviations, of a line or point from its wall or point."""
GAP, FAR_GAP = 1.0, 2.5
"""A wall goes on beyond what was seen of it: each GAP metres cost one nat, and none goes on by more than FAR_GAP."""
LINE_ROOM, POINT_ROOM = 2.0, 12.0
"""Where chance would put a line (metres of rho) and a point (square metres)."""
POINT_TRUST = 0.5
"""The kind of a point may be wrong."""
NEW = 0.3, 0.7
"""Bounds of the probability that a line is a wall not seen before; scans in a row repeat themselves."""
SQUARE = 0.7
"""Probability that a new wall is parallel or at right angles to known ones."""
IN_THE_WAY = 3.0
"""Nats against a wall between the robot and what it heard."""
HEARD = 0.87
"""Probability that a wall that faces the robot within reach is heard."""
NEAREST = 0.15
"""No robot is nearer to a wall, metres."""


class Explained(NamedTuple):
    """What a map says to poses of what was seen."""

    evidence: Float[np.ndarray, " poses"]
    """Nats, of lines and points alone."""
    wall: Int[np.ndarray, "poses lines"]
    """Wall of each line, -1 where it is new."""
    point: Int[np.ndarray, "poses points"]
    """The same of points."""
    gradient: Float[np.ndarray, "poses 3"]
    """Of half the squared residuals."""
    information: Float[np.ndarray, "poses 3 3"]


def explained(places: Places, seen: Seen, poses: Float[np.ndarray, "poses 3"]) -> Explained:
    """Each line and point finds its wall or point, or is new."""
    count = len(poses)
    lines, points = (_Said.nothing(count, len(those)) for those in (seen.theta, seen.point))
    if len(places.theta) and len(seen.theta):
        lines = _lines(places, seen, poses)
    else:
        lines.evidence[:] = _odds_of_new(places) * seen.trust.sum()
    if len(places.point) and len(seen.point):
        points = _points(places, seen, poses)
    return Explained(
        evidence=lines.evidence + points.evidence,
        wall=lines.match,
        point=points.match,
        gradient=lines.gradient + points.gradient,
        information=lines.information + points.information,
    )


class _Said(NamedTuple):
    """What lines or points alone add."""

    evidence: Float[np.ndarray, " poses"]
    match: Int[np.ndarray, "poses seen"]
    gradient: Float[np.ndarray, "poses 3"]
    information: Float[np.ndarray, "poses 3 3"]

    @staticmethod
    def nothing(poses: int, seen: int) -> "_Said":
        """All new, and no force on any pose."""
        return _Said(np.zeros(poses), np.full((poses, seen), -1), np.zeros((poses, 3)), np.zeros((poses, 3, 3)))


def _lines(places: Places, seen: Seen, poses: Float[np.ndarray, "poses 3"]) -> _Said:
    """Each finds the wall that speaks most for it, or is new."""
    normal, heading = places.normal, poses[:, 2, None]
    lever = turned(seen.middle, heading)  # (poses, lines, 2)
    offset = (poses[:, None, :2] + lever)[:, :, None] - places.reference  # (poses, lines, walls, 2)
    along = (offset * places.tangent).sum(-1)
    across = (offset * normal).sum(-1) - places.offset
    turn = wrap_angle(seen.theta[:, None] + heading[..., None] - places.theta)
    cov = places.cov
    var = cov[:, 0, 0] + 2 * along * cov[:, 0, 1] + along**2 * cov[:, 1, 1]
    var_across, var_turn = var + seen.sigma[:, :1] ** 2, cov[:, 1, 1] + seen.sigma[:, 1:] ** 2
    misfit = across**2 / var_across + turn**2 / var_turn
    half = np.linalg.norm(seen.segment[:, 1] - seen.segment[:, 0], axis=-1)[:, None] / 2
    gap = np.maximum(_beyond(places, along) - half, 0.0)
    gain = np.log(2 * LINE_ROOM) - misfit / 2 - np.log(var_across * var_turn) / 2 - gap / GAP
    gain = np.where((misfit < GATE) & (gap < FAR_GAP), gain, -np.inf)
    wall = gain.argmax(axis=-1)
    pick = (np.arange(len(poses))[:, None], np.arange(len(seen.theta)), wall)
    # A new wall is likely to be parallel or at right angles to known ones: agreeing with them is no wonder.
    square = np.exp(-(wrap_angle(4 * turn) ** 2) / (32 * var_turn)) / np.sqrt(2 * np.pi * var_turn)
    new = _odds_of_new(places) + np.log1p(SQUARE * (np.pi / 2 * square.max(axis=-1) - 1))
    best = gain[pick]
    wall = np.where(best > new, wall, -1)
    used = (wall >= 0) * seen.trust
    n = normal[pick[2]]
    jacobian = np.concatenate([n, (n * quarter(lever)).sum(-1, keepdims=True)], axis=-1)
    weight = used / var_across[pick]
    information = np.einsum("nl,nli,nlj->nij", weight, jacobian, jacobian)
    gradient = np.einsum("nl,nli->ni", weight * across[pick], jacobian)
    weight = used / np.broadcast_to(var_turn, gain.shape)[pick]
    information[:, 2, 2] += weight.sum(-1)
    gradient[:, 2] += (weight * turn[pick]).sum(-1)
    return _Said((seen.trust * np.maximum(best, new)).sum(-1), wall, gradient, information)


def _points(places: Places, seen: Seen, poses: Float[np.ndarray, "poses 3"]) -> _Said:
    """Each finds the point that speaks most for it, or is new."""
    lever = turned(seen.point, poses[:, 2, None])
    offset = (poses[:, None, :2] + lever)[:, :, None] - places.point
    var = seen.spread[:, None] ** 2 + places.spread**2
    misfit = (offset**2).sum(-1) / var
    gain = np.log(POINT_ROOM) - misfit / 2 - np.log(2 * np.pi * var)
    gain = np.where((misfit < GATE) & (seen.kind[:, None] == places.kind), gain, -np.inf)
    point = gain.argmax(axis=-1)
    pick = (np.arange(len(poses))[:, None], np.arange(len(seen.point)), point)
    evidence = POINT_TRUST * np.maximum(gain[pick], 0.0).sum(-1)
    point = np.where(gain[pick] > 0, point, -1)
    weight = POINT_TRUST * (point >= 0) / np.broadcast_to(var, gain.shape)[pick]
    jacobian = np.zeros((*weight.shape, 2, 3))
    jacobian[..., 0, 0] = jacobian[..., 1, 1] = 1.0
    jacobian[..., 2] = quarter(lever)
    information = np.einsum("np,npki,npkj->nij", weight, jacobian, jacobian)
    gradient = np.einsum("np,npk,npki->ni", weight, offset[pick], jacobian)
    return _Said(evidence, point, gradient, information)


def contradictions(
    places: Places,
    seen: Seen,
    poses: Float[np.ndarray, "poses 3"],
    wall: Int[np.ndarray, "poses lines"],
    *,
    reach: float,
    came: Float[np.ndarray, "2"] | None,
) -> Float[np.ndarray, " poses"]:
    """Nats against poses: walls in the way of what was seen, and walls that should have been heard.

    Args:
        places: the map.
        seen: what was seen.
        poses: world_from_robot.
        wall: wall of each line, -1 where it is new.
        reach: walls as near as this would be heard, metres; 0: nothing contradicts.
        came: where the robot came from in a straight line, if it did.
    """
    if not len(places.theta) or not reach:
        return np.zeros(len(poses))
    normal, at = places.normal, poses[:, :2]
    # From the robot to the middle of each line, and the way here: no wall may be crossed.
    target = at[:, None] + turned(np.concatenate([seen.middle, seen.point]), poses[:, 2, None])
    start, end = np.broadcast_arrays(at[:, None], at[:, None] + 0.9 * (target - at[:, None]))
    if came is not None:
        start = np.concatenate([start, at[:, None]], axis=1)
        end = np.concatenate([end, np.broadcast_to(came, at.shape)[:, None]], axis=1)
    nats = IN_THE_WAY * _crossed(places, start, end).any(axis=-1).sum(-1).astype(float)
    nats += IN_THE_WAY * (point_to_walls(at, places.segment) < NEAREST).any(axis=-1)
    # Walls that face the robot, near, behind nothing; the farther from their known part the less sure it is.
    offset = at[:, None] - places.reference
    distance = places.offset - (offset * normal).sum(-1)
    due = (distance > 0.2) & (distance < reach)
    foot = at[:, None] + 0.95 * distance[..., None] * normal
    start = np.broadcast_to(at[:, None], foot.shape)
    due &= ~_crossed(places, start, foot).any(axis=-1)
    near = np.abs(distance[..., None] - seen.heard[:, 0]) < 0.12
    turn = wrap_angle(places.theta[:, None] - poses[:, 2, None, None] - seen.heard[:, 1])
    due &= ~(near & (np.abs(turn) < np.radians(15))).any(axis=-1)
    due &= ~(wall[..., None] == np.arange(len(places.theta))).any(axis=1)
    beyond = np.maximum(_beyond(places, (offset * places.tangent).sum(-1)), 0.0)
    sure = np.where(places.sightings > 1, HEARD, HEARD - 0.1) * np.exp(-beyond / GAP)
    return nats - (np.log1p(-sure) * due).sum(-1)


def _crossed(
    places: Places, start: Float[np.ndarray, "poses ways 2"], end: Float[np.ndarray, "poses ways 2"]
) -> Bool[np.ndarray, "poses ways walls"]:
    """Which ways go through the known part of which walls, not just by their ends."""
    tangent, normal = places.tangent, places.normal
    first, last = start[:, :, None] - places.reference, end[:, :, None] - places.reference
    before, behind = (first * normal).sum(-1) - places.offset, (last * normal).sum(-1) - places.offset
    apart = np.where(np.abs(before - behind) > 1e-9, before - behind, 1e-9)
    along = (first * tangent).sum(-1) + before / apart * ((last - first) * tangent).sum(-1)
    through = (np.minimum(before, behind) < -0.05) & (np.maximum(before, behind) > 0.05)
    return through & (along > places.extent[:, 0] + 0.05) & (along < places.extent[:, 1] - 0.05)


def _beyond(places: Places, along: Float[np.ndarray, "*batch walls"]) -> Float[np.ndarray, "*batch walls"]:
    """How far places along walls are beyond what was seen of these, metres; negative within."""
    return np.maximum(places.extent[:, 0] - along, along - places.extent[:, 1])


def _odds_of_new(places: Places) -> float:
    """Log odds that a line is a wall not seen before, from how often that was so."""
    new = (len(places.theta) + 2) / (places.sightings.sum() + 4)
    new = float(np.clip(new, *NEW))
    return float(np.log(new / (1 - new)))
