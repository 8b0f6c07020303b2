"""What one scan sees against what is known: mutual nearest in Mahalanobis distance, jointly compatible.

(Neira and Tardos 2001, with the greedy search that mutual nearest pairs allow.)
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import chi2

from jaxsonar import kernels
from jaxsonar.detection.local_map import LocalModel
from jaxsonar.geometry.se2 import unit, wrap_angle

NO_COV = np.diag([0.01, np.radians(3.0)]) ** 2
"""Of lines that come without a covariance (method hough): m^2, rad^2."""
FEWEST = 0.4, 6
"""Echoes of something new: of a wall this share of what a long one sends, of a point so many. Of a wall that is hardly
seen the edge answers as well."""
_ROUNDS = 40
_FINE = 1.5  # covariances of local models are bounds
_PAIR = float(chi2.ppf(0.999, 2))
_BESIDE = 0.3  # m; what is seen of a wall may lie this far from what is known of it
_APART = (0.02, float(np.radians(5.0)))  # m, rad; nearer than this to something known is nothing new
_JOINT = chi2.ppf(0.999, 2 * np.arange(1, _ROUNDS + 1))


class Features(NamedTuple):
    """Walls, corners and edges in one frame, as arrays: what a scan sees, or what is known."""

    kind: Int[np.ndarray, " features"]
    """``kernels.PLANE``, ``CORNER`` or ``EDGE``."""
    place: Float[np.ndarray, "features 2"]
    """(rho, theta) of walls, (x, y) of points, metres and radians."""
    cov: Float[np.ndarray, "features 2 2"]
    """Of ``place``."""
    segment: Float[np.ndarray, "features 2 2"]
    """Both ends of what was seen of a wall; of points the place, twice."""
    echoes: Int[np.ndarray, " features"]
    """Number of echoes that it explains."""

    def take(self, rows: np.ndarray) -> "Features":
        """Some of them."""
        return Features(*(column[rows] for column in self))


def features_of(model: LocalModel) -> Features:
    """What one scan sees, robot frame."""
    lines, points = model.lines, model.points
    kind = [kernels.PLANE] * len(lines)
    kind += [kernels.CORNER if point.kind == "corner" else kernels.EDGE for point in points]
    place = [(line.rho, line.theta) for line in lines] + [(point.x, point.y) for point in points]
    cov = [NO_COV if line.cov is None else line.cov for line in lines] + [point.cov for point in points]
    segment = [line.segment for line in lines] + [((point.x, point.y),) * 2 for point in points]
    return Features(
        kind=np.array(kind, dtype=np.int32),
        place=np.array(place, dtype=np.float64).reshape(-1, 2),
        cov=np.array(cov, dtype=np.float64).reshape(-1, 2, 2),
        segment=np.array(segment, dtype=np.float64).reshape(-1, 2, 2),
        echoes=np.array([one.echoes for one in (*lines, *points)], dtype=np.int64),
    )


@dataclass(frozen=True, eq=False)
class Known:
    """The robot and the reflectors around it, in the frame of a submap; NumPy, without padding."""

    pose: Float[np.ndarray, "3"]
    """frame_from_robot."""
    kind: Int[np.ndarray, " reflectors"]
    """As in ``kernels.Scene``, and so are the next three."""
    parameters: Float[np.ndarray, "reflectors 2"]
    anchor: Float[np.ndarray, "reflectors 2"]
    ends: Float[np.ndarray, "reflectors 2"]
    covariance: Float[np.ndarray, "unknowns unknowns"]
    """Of the pose (3) and of the parameters (2 each)."""
    scans: Int[np.ndarray, " reflectors"]
    """Number of scans that saw each."""

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def scene(self) -> kernels.Landmarks:
        """The reflectors alone."""
        return kernels.Landmarks(self.kind, self.parameters, self.anchor, self.ends)


class Matches(NamedTuple):
    """Which feature of a scan is which reflector."""

    reflector: Int[np.ndarray, " features"]
    """Row of the reflector; -1 for none."""
    fresh: Bool[np.ndarray, " features"]
    """Whether it is none that is known, and far enough from all that are."""


def seen_from(
    pose: Float[np.ndarray, "3"], known: Known
) -> tuple[Float[np.ndarray, "reflectors 2"], Float[np.ndarray, "reflectors 2 5"]]:
    """Reflectors in the robot frame, as ``Features.place``, and the slope by pose (3) and parameters (2)."""
    offset = known.anchor - pose[:2]
    theta = known.parameters[:, 1]
    n, t = unit(theta), unit(theta + np.pi / 2)
    ahead, left = unit(pose[2]), unit(pose[2] + np.pi / 2)
    lever = (t * offset).sum(-1)
    spot = offset + known.parameters
    x, y = spot @ ahead, spot @ left
    rho = known.parameters[:, 0] + (n * offset).sum(-1)
    wall = (known.kind == kernels.PLANE)[:, None]
    place = np.where(wall, np.stack([rho, wrap_angle(theta - pose[2])], -1), np.stack([x, y], -1))
    one, zero = np.ones(len(known)), np.zeros(len(known))
    of_wall = [np.stack([-n[:, 0], -n[:, 1], zero, one, lever], -1), np.stack([zero, zero, -one, zero, one], -1)]
    of_point = [
        np.stack([-ahead[0] * one, -ahead[1] * one, y, ahead[0] * one, ahead[1] * one], -1),
        np.stack([-left[0] * one, -left[1] * one, -x, left[0] * one, left[1] * one], -1),
    ]
    slope = np.where(wall[..., None], np.stack(of_wall, 1), np.stack(of_point, 1))
    return place, slope


def match(known: Known, seen: Features, *, full: float) -> Matches:
    """Pairs that agree, one by one and all together.

    Args:
        known: the belief before the scan.
        seen: the local model of the scan.
        full: echoes that a long wall sends back to this ring.
    """
    nothing = np.full(len(seen.kind), -1)
    worth = seen.echoes >= np.where(seen.kind == kernels.PLANE, FEWEST[0] * full, FEWEST[1])
    if not len(known) or not len(seen.kind):
        return Matches(nothing, worth)
    place, slope = seen_from(known.pose, known)
    column = np.concatenate(
        [np.tile(np.arange(3), (len(known), 1)), 3 + 2 * np.arange(len(known))[:, None] + [0, 1]], 1
    )
    own = known.covariance[column[:, :, None], column[:, None, :]]
    spread = slope @ own @ slope.transpose(0, 2, 1)
    off = _offsets(seen, place)
    total = spread[None] + _FINE * seen.cov[:, None]
    squared = np.einsum("fri,frij,frj->fr", off, np.linalg.inv(total), off)
    beside, near = _beside(known, seen), _near(off, seen, known)
    alike = (seen.kind[:, None] == known.kind) & beside
    alike &= (place[:, 0] > 0) | (known.kind != kernels.PLANE)  # a wall has one side
    cost = np.where(alike & (squared < _PAIR), squared, np.inf)
    best, back = cost.argmin(axis=1), cost.argmin(axis=0)
    feature = np.flatnonzero(np.isfinite(cost.min(axis=1)) & (back[best] == np.arange(len(best))))
    reflector = best[feature]
    order = np.argsort(cost[feature, reflector], kind="stable")[:_ROUNDS]
    feature, reflector = feature[order], reflector[order]
    kept = _jointly(known, seen, slope, off[feature, reflector], feature, reflector)
    matched = nothing.copy()
    matched[feature[kept]] = reflector[kept]
    points = (seen.kind != kernels.PLANE)[:, None] & (known.kind != kernels.PLANE)
    doubtful = (alike & (squared < _PAIR)) | (near & beside & (alike | points))
    return Matches(matched, worth & (matched < 0) & ~doubtful.any(axis=1))


def _jointly(
    known: Known,
    seen: Features,
    slope: Float[np.ndarray, "reflectors 2 5"],
    off: Float[np.ndarray, "pairs 2"],
    feature: Int[np.ndarray, " pairs"],
    reflector: Int[np.ndarray, " pairs"],
) -> list[int]:
    """Pairs that together are within the gate, the best ones first; one that does not fit those before is left out."""
    pairs = len(feature)
    if not pairs:
        return []
    rows = np.zeros((pairs, 2, len(known.covariance)))
    rows[:, :, :3] = slope[reflector, :, :3]
    for k in (0, 1):
        rows[np.arange(pairs), :, 3 + 2 * reflector + k] = slope[reflector, :, 3 + k]
    rows = rows.reshape(2 * pairs, -1)
    joint = rows @ known.covariance @ rows.T
    for k in range(pairs):
        joint[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += _FINE * seen.cov[feature[k]]
    if pairs and _squared(joint, off.ravel()) < _JOINT[pairs - 1]:
        return list(range(pairs))
    kept: list[int] = []
    for pair in range(pairs):
        rows = np.concatenate([[2 * k, 2 * k + 1] for k in (*kept, pair)])
        if _squared(joint[np.ix_(rows, rows)], off.ravel()[rows]) < _JOINT[len(kept)]:
            kept.append(pair)
    return kept


def _squared(cov: Float[np.ndarray, "n n"], off: Float[np.ndarray, " n"]) -> float:
    return float(off @ np.linalg.solve(cov, off))


def _offsets(seen: Features, place: Float[np.ndarray, "reflectors 2"]) -> Float[np.ndarray, "features reflectors 2"]:
    off = seen.place[:, None] - place
    walls = seen.kind == kernels.PLANE
    off[walls, :, 1] = wrap_angle(off[walls, :, 1])
    return off


def _beside(known: Known, seen: Features) -> Bool[np.ndarray, "features reflectors"]:
    """Whether what is seen lies along what is known of a wall; true for points."""
    ahead = np.stack([unit(known.pose[2]), unit(known.pose[2] + np.pi / 2)], -1)
    middle = known.pose[:2] + seen.segment.mean(axis=1) @ ahead.T
    along = np.einsum("frk,rk->fr", middle[:, None] - known.anchor, unit(known.parameters[:, 1] + np.pi / 2))
    beside = (along > known.ends[:, 0] - _BESIDE) & (along < known.ends[:, 1] + _BESIDE)
    return beside | (known.kind != kernels.PLANE)


def _near(
    off: Float[np.ndarray, "features reflectors 2"], seen: Features, known: Known
) -> Bool[np.ndarray, "features reflectors"]:
    """Whether a feature could be a reflector that its scan sees badly."""
    walls = (np.abs(off[..., 0]) < _APART[0]) & (np.abs(off[..., 1]) < _APART[1])
    points = np.linalg.norm(off, axis=-1) < _APART[0]
    return np.where((known.kind == kernels.PLANE)[None], walls, points)
