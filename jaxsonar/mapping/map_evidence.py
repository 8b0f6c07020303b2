"""The evidence that scans contribute to a map. Evidence adds up in any order, so maps can be built scan by scan."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from jaxsonar.detection.local_model import LocalModel
from jaxsonar.mapping.driven_space import DrivenSpace
from jaxsonar.mapping.free_space import DirectionalFreeSpace, ScanViews
from jaxsonar.mapping.observations import concatenate, merge_cells
from jaxsonar.mapping.point_landmarks import PointLandmarks, aggregate_points
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.mapping.wall_segments import WallSegments, aggregate_segments
from jaxsonar.reflectors.posed_scans import PosedScans
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

_NO_WALLS = np.zeros((0, 2, 2))


@dataclass(frozen=True, eq=False)
class MapEvidence:
    """Observed segments and points, and the free space in which walls were not detected.

    The evidence of two logs is the union of their evidence; the order of the scans does not matter.
    """

    segments: WallSegments
    """Segments of local models, world frame."""
    points: PointLandmarks
    """Corners and edges of local models, world frame."""
    free_space: DirectionalFreeSpace
    """Where walls would have been detected and were not."""
    robot_cells: Int[np.ndarray, "cells 2"]
    """Cells (5 cm) of the robot's positions at which local models were made, without repetition."""
    models: int
    """Number of local models with a pose."""
    driven: DrivenSpace
    """Where the robot itself was."""
    scans: PosedScans = field(default_factory=PosedScans)
    """The scans, for reflectors that answer from several of them."""

    @classmethod
    def empty(cls) -> "MapEvidence":
        """The evidence of no scans."""
        no_poses = np.zeros((0, 3))
        segments, points = aggregate_segments([], no_poses), aggregate_points([], no_poses)
        return cls(segments, points, DirectionalFreeSpace(), np.zeros((0, 2), np.int64), 0, DrivenSpace.empty())

    def union(self, other: "MapEvidence") -> "MapEvidence":
        """The evidence of both."""
        return MapEvidence(
            concatenate([self.segments, other.segments]),
            concatenate([self.points, other.points]),
            self.free_space.union(other.free_space),
            np.unique(np.concatenate([self.robot_cells, other.robot_cells]), axis=0),
            self.models + other.models,
            self.driven.union(other.driven),
            self.scans.union(other.scans),
        )

    def condensed(self) -> "MapEvidence":
        """The evidence with the observations of each cell fused; its size grows with the floor, not with the scans."""
        most = SETTINGS.evidence.listed_scans
        segments, points = merge_cells(self.segments, max_scans=most), merge_cells(self.points, max_scans=most)
        return replace(self, segments=segments, points=points)

    @property
    def linkage_distance(self) -> float:
        """Largest distance between the midpoints of neighboring segments of one wall, metres (paper, section 5).

        It is derived from the spacing of the robot's positions, which does not depend on the order of the scans.
        """
        settings = SETTINGS.evidence
        if len(self.robot_cells) < 2:
            return settings.max_gap
        position = self.robot_cells * settings.position_cell
        to_nearest = KDTree(position).query(position, k=2)[0][:, 1]
        return max(settings.min_gap, settings.linkage_per_spacing * float(np.median(to_nearest)))

    @property
    def gap(self) -> float:
        """Largest gap between two segments of one wall, metres."""
        return min(self.linkage_distance, SETTINGS.evidence.max_gap)


def gather_evidence(ring: Ring, log: Log, models: Iterable[LocalModel]) -> MapEvidence:
    """The evidence of local models and of missing echoes.

    Args:
        ring: the sensors.
        log: the scans that the models come from, with their poses. Scans and models without a pose are left out.
        models: local models in the order of the log. A model of a window represents all scans since the previous one.
    """
    return gather_evidence_of_each(ring, log, [list(models)])[0]


def gather_evidence_of_each(ring: Ring, log: Log, models: Sequence[Sequence[LocalModel]]) -> list[MapEvidence]:
    """The evidence of several lists of local models of one log, such as those of windows of several lengths.

    Args:
        ring: the sensors.
        log: as for ``gather_evidence``.
        models: lists as for ``gather_evidence``.
    """
    row_of_scan = {int(number): row for row, number in enumerate(log.scan)}
    rows = [np.array([row_of_scan[model.scan] for model in of_one], dtype=np.int64) for of_one in models]
    observations = [_observations(of_one, log.pose[at]) for of_one, at in zip(models, rows, strict=True)]
    # Free space, limited by the walls that each model shows.
    free_spaces = _free_spaces(ring, log, rows, [walls for _, _, walls in observations])
    until = max((int(at.max(initial=-1)) for at in rows), default=-1)
    scans = PosedScans.of(ring, (log[row] for row in np.flatnonzero(np.isfinite(log.pose).all(axis=1)) if row <= until))
    evidence = []
    for at, (segments, points, _), free_space in zip(rows, observations, free_spaces, strict=True):
        # Where the robot was.
        position = log.pose[at][np.all(np.isfinite(log.pose[at]), axis=1), :2]
        robot_cells = np.round(position / SETTINGS.evidence.position_cell).astype(np.int64)
        before = np.arange(len(log)) <= at.max(initial=-1)
        driven = DrivenSpace.of(ring, log.pose[before], scan_times(log)[before])
        evidence.append(
            MapEvidence(segments, points, free_space, np.unique(robot_cells, axis=0), len(position), driven, scans)
        )
    return evidence


def scan_times(log: Log) -> Float[np.ndarray, " scans"]:
    """Time of each scan as in ``WallSegments.last_seen``."""
    return np.where(np.isnan(log.stamp), log.scan, log.stamp)


def _observations(
    models: Sequence[LocalModel], poses: Float[np.ndarray, "models 3"]
) -> tuple[WallSegments, PointLandmarks, list[Float[np.ndarray, "_ 2 2"]]]:
    """Observed walls, corners and edges of models at these poses (NaN: none), and the wall segments of each model."""
    segments, points = aggregate_segments(models, poses), aggregate_points(models, poses)
    has_pose = np.all(np.isfinite(poses), axis=1)
    lines = [len(model.lines) if posed else 0 for model, posed in zip(models, has_pose, strict=True)]
    return segments, points, np.split(segments.endpoints, np.cumsum(lines)[:-1])


def _free_spaces(
    ring: Ring,
    log: Log,
    rows: Sequence[Int[np.ndarray, " _"]],
    walls: Sequence[Sequence[Float[np.ndarray, "_ 2 2"]]],
) -> list[DirectionalFreeSpace]:
    """The free space that the scans up to the last model observe, for several lists of models.

    Args:
        ring: the sensors.
        log: the scans.
        rows: of each list, the row of the last scan of each model, ascending.
        walls: of each list, the segments that each model shows, world frame, metres.
    """
    flat, _ = FlatEchoes.from_log(ring, log)
    distance = np.asarray(ring.corrected(flat.reported, *ring.paths[flat.path].T))
    posed = np.flatnonzero(np.all(np.isfinite(log.pose), axis=1))
    posed = posed[posed <= max((int(at.max(initial=-1)) for at in rows), default=-1)]
    time = scan_times(log)
    free_spaces = [DirectionalFreeSpace() for _ in rows]
    for first in range(0, len(posed), SETTINGS.evidence.block_scans):
        block = posed[first : first + SETTINGS.evidence.block_scans]
        echo = np.arange(int(flat.start[block[0]]), int(flat.start[block[-1] + 1]))
        echo = echo[(distance[echo] > 0) & (distance[echo] < ring.max_range) & np.isin(flat.scan[echo], block)]
        views = ScanViews.of(
            ring,
            log.pose[block],
            np.searchsorted(block, flat.scan[echo]),
            flat.path[echo],
            distance[echo],
            measured=None if flat.measured is None else flat.measured[block],
            path_pose=None if flat.path_pose is None else flat.path_pose[block],
        )
        for k, (at, walls_of_model) in enumerate(zip(rows, walls, strict=True)):
            model = np.searchsorted(at, block)
            represented = model < len(at)
            cells, who = views.free_cells([walls_of_model[m] if m < len(at) else _NO_WALLS for m in model.tolist()])
            counts = represented[who]
            free_spaces[k] = free_spaces[k].updated(cells[counts], time[block][who[counts]])
    return free_spaces
