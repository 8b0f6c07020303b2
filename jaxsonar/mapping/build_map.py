"""Global maps from many scans: all at once, or scan by scan (paper, section 5)."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Int
from scipy.spatial import KDTree

from jaxsonar import kernels
from jaxsonar.detection.extract import LocalModel, local_models
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.hardware.errors import SonarError
from jaxsonar.mapping import point_landmarks as points
from jaxsonar.mapping.free_space import SeenThrough, silence
from jaxsonar.mapping.ghost_removal import openings, points_among, trim, without_corners
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.hough_merging import merge_as_paper
from jaxsonar.mapping.observations import join, latest_scans
from jaxsonar.mapping.point_landmarks import Points
from jaxsonar.mapping.segment_fusion import BESIDE, common_floor, fuse, settle
from jaxsonar.mapping.wall_endpoints import end_at, ended, floating, mirages
from jaxsonar.mapping.wall_segments import Pieces, add_up, aggregate
from jaxsonar.scans.echo_batches import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

MERGINGS = ("fused", "paper")
"""How pieces become walls: pieces that agree add up, or the paper's clusters of midpoints and Hough transform."""
CONFIRMED = 2
"""Scans in which a wall must be seen, unless there are only one or two, or scans were gathered over windows."""
BRIDGE = 1.0
"""Metres of a wall that may be hidden behind something; a gap that was seen through stays open however small."""
LEAST_GAP, MOST_GAP = 0.4, 0.7
"""Metres; less than a door, more than what two neighboring scans leave of a wall between them."""
FARTHEST = 1e8
"""Metres from the origin of the world; up to there the cells of the floor are numbers."""
SCANS_KEPT = 32
"""Scans whose numbers a piece keeps when maps are built scan by scan, the latest ones."""
_PLACE, _TURN = 0.05, float(np.radians(6.0))  # m, rad: pieces this near are kept as their sum
_BLOCK = 64


@dataclass(frozen=True, eq=False)
class Evidence:
    """What scans say of the world's walls: where pieces of them were seen, and where they would have been heard.

    Both add up: the evidence of two logs together is that of all their scans, in any order.
    """

    pieces: Pieces
    """Segments of local models, world frame."""
    points: Points
    """Corners and edges of local models, world frame."""
    seen: SeenThrough
    """Where walls would have been heard and were not."""
    places: Int[np.ndarray, "places 2"]
    """Where the robot was when it made a local model: cells of 5 cm, each once."""
    models: int
    """Local models with a pose."""

    def joined(self, other: "Evidence") -> "Evidence":
        """The evidence of both."""
        return Evidence(
            join([self.pieces, other.pieces]),
            join([self.points, other.points]),
            self.seen.joined(other.seen),
            np.unique(np.concatenate([self.places, other.places]), axis=0),
            self.models + other.models,
        )

    def condensed(self) -> "Evidence":
        """The same, with pieces and points of one place (and direction) kept as their sum: as large as the floor."""
        kept = points.condense(self.points, scans=SCANS_KEPT)
        return replace(self, pieces=condense(self.pieces, scans=SCANS_KEPT), points=kept)

    @property
    def cut(self) -> float:
        """How far apart the midpoints of segments of one wall may lie, metres (paper, section 5).

        Deduced from how far apart neighboring models were made, which unlike the way between successive ones does not
        depend on the order of the scans.
        """
        if len(self.places) < 2:
            return MOST_GAP
        nearest = KDTree(self.places * _PLACE).query(self.places * _PLACE, k=2)[0][:, 1]
        return max(LEAST_GAP, 1.5 * float(np.median(nearest)))

    @property
    def gap(self) -> float:
        """How much of a wall may lie between two segments of it, metres."""
        return min(self.cut, MOST_GAP)


def build_map(
    ring: Ring,
    log: Log,
    *,
    method: str = "ml",
    settings: kernels.HoughSettings | None = None,
    sigma: float | None = None,
    window: float | None = None,
    merging: str = "fused",
    on_left_out: Callable[[int], None] | None = None,
) -> GlobalMap:
    """The walls of the world, from a log of scans with poses (paper, section 5).

    Args:
        ring: the sensors.
        log: scans; those without a pose are left out.
        method: how lines are found in a scan, as ``local_models``.
        settings: of the Hough step, as ``local_models``.
        sigma: noise of the ranges, as ``local_models``.
        window: metres of path gathered into one local model, as ``local_models``.
        merging: "fused", or "paper" for the paper's way.
        on_left_out: told how many echoes are of pairs of sensors that this ring does not listen to.

    Raises:
        SonarError: as ``local_models``, an unknown way of merging, or no scan with a pose.
    """
    check_merging(merging)
    check_poses(log)
    choices = {"method": method, "settings": settings, "sigma": sigma, "window": window}
    models = list(local_models(ring, log, **choices, on_left_out=on_left_out))
    evidence = gather_evidence(ring, log, models)
    return assemble(evidence, merging=merging, confirmed=1 if window else CONFIRMED)


def gather_evidence(ring: Ring, log: Log, models: Iterable[LocalModel]) -> Evidence:
    """What local models and the silence of the sensors say of the world.

    Args:
        ring: the sensors.
        log: the scans that the models come from, with their poses.
        models: in the order of the log; a model of a window stands for the scans since the one before.
    """
    models = list(models)
    row_of = {int(number): row for row, number in enumerate(log.scan)}
    rows = np.array([row_of[model.scan] for model in models], dtype=np.int64)
    poses = log.pose[rows]
    known = np.all(np.isfinite(poses), axis=1)
    pieces = aggregate(models, poses)
    counts = [len(model.lines) if here else 0 for model, here in zip(models, known, strict=True)]
    shows = np.split(pieces.segments, np.cumsum(counts)[:-1])  # the segments of each model
    flat, _ = FlatEchoes.from_log(ring, log)
    reach = np.asarray(ring.corrected(flat.reported, *ring.paths[flat.path].T))
    placed = np.flatnonzero(np.all(np.isfinite(log.pose), axis=1))
    placed = placed[placed <= rows.max(initial=-1)]
    when = np.where(np.isnan(log.stamp), log.scan, log.stamp)
    seen = SeenThrough()
    for first in range(0, len(placed), _BLOCK):
        block = placed[first : first + _BLOCK]
        echo = np.arange(int(flat.start[block[0]]), int(flat.start[block[-1] + 1]))
        echo = echo[(reach[echo] > 0) & (reach[echo] < ring.max_range) & np.isin(flat.scan[echo], block)]
        scan = np.searchsorted(block, flat.scan[echo])
        walls = [shows[k] for k in np.searchsorted(rows, block)]
        cells, who = silence(ring, log.pose[block], scan, flat.path[echo], reach[echo], walls)
        seen = seen.including(cells, when[block][who])
    places = np.unique(np.round(poses[known, :2] / _PLACE).astype(np.int64), axis=0)
    return Evidence(pieces, points.aggregate(models, poses), seen, places, int(known.sum()))


def assemble(evidence: Evidence, *, merging: str = "fused", confirmed: int = CONFIRMED) -> GlobalMap:
    """The map that the evidence supports.

    Args:
        evidence: of all scans.
        merging: "fused" or "paper".
        confirmed: scans in which a wall must be seen, where there are enough of them.
    """
    check_merging(merging)
    if merging == "paper":
        return _as_map(merge_as_paper(evidence.pieces, cut=evidence.cut), evidence.points.take(np.arange(0)))
    pieces, seen = condense(evidence.pieces), evidence.seen
    confirmed = min(confirmed, max(1, evidence.models - 1))
    floor = common_floor(pieces, gap=evidence.gap)
    corners = _confirmed(points.condense(evidence.points), confirmed, floor=floor)
    # Pieces of one wall add up; what later scans look through goes, and the rest adds up again.
    walls, wall_of = fuse(pieces, gap=evidence.gap, floor=floor)
    trimmed = trim(pieces, wall_of, seen)
    if trimmed is not pieces:
        pieces = trimmed
        walls, _ = fuse(pieces, gap=evidence.gap, floor=floor)
    # Corners and poles answer like walls, from every pose in another direction.
    pieces = without_corners(pieces, walls)
    walls, wall_of = fuse(pieces, gap=evidence.gap, floor=floor)
    real = np.flatnonzero(~points_among(walls) & ~mirages(walls, corners) & (walls.count >= confirmed))
    # A wall goes on behind what hides it, but neither beyond an edge nor across what something was seen through.
    through = partial(openings, pieces=pieces, seen=seen)

    def open_(gaps: np.ndarray, theta: np.ndarray) -> np.ndarray:
        return through(gaps, theta) | ended(gaps, corners)

    walls, whole = fuse(walls.take(real), gap=BRIDGE, floor=floor, opening=open_, beside=BESIDE)
    # Each piece counts for as much as it agrees with its wall.
    one_of = np.full(len(pieces), -1)
    one_of[real] = whole
    own = one_of[wall_of] >= 0
    walls = settle(pieces.take(own), one_of[wall_of[own]], walls, floor=floor)
    # It ends at the corners and edges on its line.
    walls = end_at(walls, corners, through)
    return _as_map(walls, corners.take(~floating(walls, corners)))


def _confirmed(sightings: Points, confirmed: int, *, floor: float) -> Points:
    """Corners and edges that enough scans saw, where they are."""
    found, point_of = points.cluster(sightings)
    return found.take((found.times >= confirmed) & points.steady(found, sightings, point_of, floor=floor))


def condense(pieces: Pieces, *, scans: int | None = None) -> Pieces:
    """Pieces of one place (5 cm) and direction (6 deg) as their sum; the order of the pieces does not matter.

    Args:
        pieces: pieces of walls.
        scans: keep the numbers of at most so many scans of each, the largest ones; all if left out.
    """
    if not len(pieces):
        return pieces
    cell = np.column_stack([np.floor(pieces.centre / _PLACE), np.floor(pieces.theta / _TURN)]).astype(np.int64)
    _, group = np.unique(cell, axis=0, return_inverse=True)
    summed = add_up(pieces, group.ravel())
    return replace(summed, scans=latest_scans(summed.scans, scans))


def check_merging(merging: str) -> None:
    """Raise a SonarError for an unknown way of merging."""
    if merging not in MERGINGS:
        raise SonarError(f"merging {merging!r}; allowed is {' or '.join(MERGINGS)}")


def check_poses(log: Log) -> None:
    """Raise a SonarError for a log with scans but without a single pose, or with one that is out of this world."""
    if len(log) and not np.isfinite(log.pose).any():
        raise SonarError(f"none of the {len(log)} scans has a pose; allowed is a log with x, y, theta for a map")
    far = np.abs(log.pose[:, :2]).max(axis=1, initial=0) > FARTHEST  # False for NaN
    if far.any():
        k = int(far.argmax())
        x, y, _ = log.pose[k]
        raise SonarError(f"scan {log.scan[k]}: pose x {x:g}, y {y:g} m; allowed are {FARTHEST:g} m at most")


def _as_map(walls: Pieces, corners: Points) -> GlobalMap:
    walls = walls.take(np.lexsort((walls.centre[:, 1], walls.centre[:, 0], -walls.echoes)))
    corners = corners.take(np.lexsort((corners.place[:, 1], corners.place[:, 0], -corners.echoes)))
    normal, tangent = walls.normal, walls.tangent
    rho, lever = (normal * walls.centre).sum(-1), (tangent * walls.centre).sum(-1)
    # The spread of the pieces around their wall tells how good they are; what is expected of them counts as one more.
    scale = (walls.misfit + 2) / (2 * walls.count)
    sigma_theta = np.sqrt(scale / walls.info_theta)
    sigma_rho = np.sqrt(scale / walls.info_offset + (lever * sigma_theta) ** 2)
    theta = np.where(rho < 0, walls.theta + np.pi, walls.theta)
    return GlobalMap(
        segments=walls.segments,
        rho=np.abs(rho),
        theta=wrap_angle(theta),
        sigma_rho=sigma_rho,
        sigma_theta=sigma_theta,
        echoes=walls.echoes,
        scans=walls.scan_lists(),
        points=corners.place,
        point_kinds=corners.kinds,
        point_cov=corners.honest_cov,
        point_echoes=corners.echoes,
        point_scans=corners.scan_lists(),
    )
